"""Files and folders written whole or not at all, and the hashes by which results name their inputs."""

import errno
import os
import secrets
import shutil
import sys
import time
from collections.abc import Callable, Collection, Iterable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from fnmatch import fnmatchcase
from pathlib import Path
from typing import Any, BinaryIO

import msgspec

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, CannotWrite, DiskFull, MissingFile, OutputBusy, OutputExists
from faintfield.pipelines.formats.provenance import with_digest
from faintfield.pipelines.formats.reading import MAX_TEXT_BYTES, is_folder, naming_unreadable
from faintfield.pipelines.formats.units import json_of
from faintfield.rig import files as rig_files

# Error numbers of a full disk; numpy reports a short write of an array without a number.
_NO_ROOM = {errno.ENOSPC, errno.EDQUOT, errno.EFBIG, None}

# Error numbers of a file system that cannot lock folders.
_NO_LOCKS = {errno.ENOLCK, errno.ENOTSUP, errno.ENOSYS, errno.EBADF, errno.EINVAL}

# Suffix of temporary names; a file that keeps it was left by a process that was killed.
UNFINISHED = ".unfinished"

CACHE_FILE = ".hashes.json"

# Bytes of results that a user wants to know of beforehand.
_MUCH_BYTES = 200_000_000

# Folders of results lie at most this far below the folder that is shown.
_MAX_LEVELS_BELOW = 3

# In nanoseconds: a file changed this shortly before its hashing could change again with the same time stamp.
_AT_REST_NS = 2_000_000_000


@contextmanager
def writing(path: Path) -> Iterator[BinaryIO]:
    """Open a file for writing that appears at `path` whole or not at all.

    The bytes go to a temporary file in the same folder, which is flushed to the disk and then renamed in one step.
    If it cannot be written (DiskFull, CannotWrite), it is removed, and an earlier file at `path` is unchanged.
    """
    with translated_write_errors(path):
        path.parent.mkdir(parents=True, exist_ok=True)
        # Named before it is created, so that an interrupt at any moment can remove it
        unfinished = path.with_name(f".{path.name}.{secrets.token_hex(4)}{UNFINISHED}")
        try:
            with unfinished.open("xb") as file:
                yield file
                file.flush()
                os.fsync(file.fileno())
            os.replace(unfinished, path)
        except BaseException:
            unfinished.unlink(missing_ok=True)
            raise
        rig_files.sync_folder(path.parent)


def write_whole(path: Path, content: bytes | str) -> None:
    """Write bytes, or text in UTF-8, whole or not at all."""
    with writing(path) as file:
        file.write(content.encode() if isinstance(content, str) else content)


def write_json(path: Path, value: Any) -> None:
    """Write a JSON-able value or msgspec Struct, indented, whole or not at all."""
    write_whole(path, msgspec.json.format(msgspec.json.encode(value)) + b"\n")


def write_record(path: Path, record: msgspec.Struct) -> None:
    """Write the record of a result as JSON in its units, with its own digest, whole or not at all."""
    write_whole(path, with_digest(json_of(record)))


@contextmanager
def writing_folder(
    out: Path,
    *,
    replace_if: str | None = None,
    replace_only: Collection[str] = (),
    overwrite: bool = True,
    reads: Iterable[Path] = (),
) -> Iterator[Path]:
    """Yield a temporary folder, which becomes `out` when the block ends without an exception; see `check_free`."""
    check_free(out, replace_if=replace_if, replace_only=replace_only, overwrite=overwrite, reads=reads)
    with translated_write_errors(out):
        out = out.resolve()
        out.parent.mkdir(parents=True, exist_ok=True)
        building = out.with_name(f".{out.name}.{secrets.token_hex(4)}")  # named first, as in `writing`
        try:
            building.mkdir()
            yield building
            _put_in_place(building, out)
        except BaseException:
            shutil.rmtree(building, ignore_errors=True)
            raise
        rig_files.sync_folder(out.parent)


def _put_in_place(building: Path, out: Path) -> None:
    """Rename a folder to `out`; an earlier one is first renamed, so that nobody sees it half removed."""
    if not out.exists():
        os.replace(building, out)
        return
    replaced = out.with_name(f".{out.name}.{secrets.token_hex(4)}")
    try:
        os.replace(out, replaced)
        os.replace(building, out)
    except BaseException:  # an interrupt may come after either of them was done
        if out.exists():
            shutil.rmtree(replaced, ignore_errors=True)
        else:
            os.replace(replaced, out)
        raise
    shutil.rmtree(replaced, ignore_errors=True)


def check_free(
    out: Path,
    *,
    replace_if: str | None = None,
    replace_only: Collection[str] = (),
    overwrite: bool = True,
    reads: Iterable[Path] = (),
) -> None:
    """Refuse a folder that would be replaced, and is none that may be; before the work that leads to its content.

    An earlier `out` may be replaced if it is empty or, to `overwrite`, if it holds the file `replace_if`, or only names
    that match the patterns `replace_only`. Raises OutputExists if it is another, or holds a path of `reads`.
    """
    with translated_write_errors(out):
        folder = out.resolve()
        _refuse_file(out)
        held = sorted(path.name for path in out.iterdir()) if out.exists() else []
        if replace_if is not None and (out / replace_if).is_file():
            kept = []
        else:
            kept = [name for name in held if not any(fnmatchcase(name, pattern) for pattern in replace_only)]
    if kept:
        raise OutputExists(
            f"{out}: holds files already ({some(kept)}) that are not overwritten; name a new or empty folder"
        )
    for path in reads:
        # A link counts both where it leads and where it lies
        if any(place.resolve().is_relative_to(folder) for place in (path, path.parent)):
            raise OutputExists(f"{out}: holds {path}, which is read; name another folder")
    if held and not overwrite:
        raise OutputExists(
            f"{out}: holds an earlier result ({some(held)}); give --overwrite to replace it, or name another folder"
        )


def _refuse_file(out: Path) -> None:
    if out.exists() and not out.is_dir():
        raise OutputExists(f"{out}: is a file, and a folder is to be written there; name another place")


def some(names: Sequence[str], join: str = ", ") -> str:
    """Return the first three of some names, and how many more there are."""
    return join.join(names[:3]) + (f" and {len(names) - 3} more" if len(names) > 3 else "")


@contextmanager
def removed_if_empty(folder: Path) -> Iterator[None]:
    """Remove a folder that the block made and left empty."""
    existed = folder.exists()
    try:
        yield
    finally:
        if not existed:
            with suppress(OSError):  # it has files, or was never made
                folder.rmdir()


@contextmanager
def exclusive(folder: Path) -> Iterator[None]:
    """Lock a folder of results while the block runs, and first remove what a killed process left unfinished there.

    The folder is created if missing, and removed if it stays empty; OutputExists if it is a file, OutputBusy if another
    command is writing there.
    On a file system without locks, such as some network disks, nothing keeps a second command out; on Windows nothing
    keeps out that of another user or computer.
    """
    with _locked(folder, shared=False):
        remove_leftovers(folder)
        yield


def shared(folder: Path) -> AbstractContextManager[None]:
    """Lock a folder of results as `exclusive` does, but against that only: several blocks can run at a time."""
    return _locked(folder, shared=True)


@contextmanager
def _locked(folder: Path, *, shared: bool) -> Iterator[None]:
    with translated_write_errors(folder):
        _refuse_file(folder)
        folder.mkdir(parents=True, exist_ok=True)
        descriptor = rig_files.open_for_lock(folder)
    try:
        rig_files.lock(descriptor, shared=shared)
    except OSError as failure:
        if failure.errno not in _NO_LOCKS:
            os.close(descriptor)
            if isinstance(failure, BlockingIOError):
                busy = f"{folder}: another faintfield command is writing there; wait for it, or give another --out"
                raise OutputBusy(busy) from failure
            locked = f"{folder}: cannot be locked ({failure.strerror}); name a place that can be written"
            raise CannotWrite(locked) from failure
    try:
        yield
    finally:
        with suppress(OSError):
            folder.rmdir()
        os.close(descriptor)


def check_results_folder(folder: Path) -> None:
    """Refuse a folder of results that cannot be, or is busy, before the work that leads to them; see `exclusive`."""
    with exclusive(folder):
        pass


def remove(path: Path) -> None:
    """Remove a result that is about to be replaced, if there is one."""
    with translated_write_errors(path):
        path.unlink(missing_ok=True)


def remove_leftovers(folder: Path) -> None:
    """Remove unfinished files that a killed process left in a folder; no other process may be writing there."""
    for path in folder.glob(f".*{UNFINISHED}"):
        if path.is_dir():
            shutil.rmtree(path, ignore_errors=True)
        else:
            path.unlink(missing_ok=True)


def require_room(path: Path, needed_bytes: int, *, written_bytes: int = 0) -> None:
    """Refuse to begin work whose results would not fit on the disk of `path` (DiskFull).

    If much of it will be written to stay, `written_bytes`, say how much.
    """
    free = _free_bytes(path)
    if free < needed_bytes:
        raise DiskFull(
            f"{path}: {needed_bytes / 1e6:.1f} MB are needed, {free / 1e6:.1f} MB are free; make room or use another"
        )
    if written_bytes >= _MUCH_BYTES:
        inform(f"{path}: about {written_bytes / 1e9:.1f} GB will be written")


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file, in hexadecimal; raise MissingFile if it cannot be read."""
    with naming_unreadable(path, "allow it to be read"):
        return rig_files.sha256(path)


@contextmanager
def translated_write_errors(path: Path) -> Iterator[None]:
    """Turn the system's write errors into DiskFull or CannotWrite with the path."""
    try:
        yield
    except OSError as failure:
        place = failure.filename or path
        if failure.errno in _NO_ROOM:
            raise DiskFull(
                f"{path}: no space left on the disk ({_free_bytes(path) / 1e6:.1f} MB free); make room or use another"
            ) from failure
        raise CannotWrite(f"{place}: {failure.strerror}; name a place that can be written") from failure


def _free_bytes(path: Path) -> int:
    existing = next(folder for folder in (path, *path.absolute().parents) if folder.exists())
    return shutil.disk_usage(existing).free


class _Known(msgspec.Struct, frozen=True):
    """A hash, with the state of the file at that time.

    Nobody can give a file the inode and the time of its last status change (`ctime`) that they want: hashes that came
    with a folder from elsewhere never match, whatever they claim.
    """

    size: int
    mtime_ns: int
    ctime_ns: int
    inode: int
    sha256: str


class Hashes:
    """SHA-256 of the files of a folder, each computed again only if its size, inode or times of change differ.

    They are stored in a hidden file in the folder, which may be removed at any time. None is read from there on
    Windows, which does not tell the time of the last status change.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, _Known] = {}
        self._changed = False
        if sys.platform == "win32":
            return
        # Without a whole file everything is hashed
        with suppress(OSError, msgspec.MsgspecError, UnicodeDecodeError, RecursionError):
            content = rig_files.read_regular(folder / CACHE_FILE, MAX_TEXT_BYTES)
            self._known = msgspec.json.decode(content, type=dict[str, _Known])

    def of(self, name: str) -> str:
        """Return the SHA-256 of a file, by its name within the folder."""
        path = self._folder / name
        with naming_unreadable(path, "allow it to be read"):
            state = path.stat()
        begun_ns = time.time_ns()
        known = self._known.get(name)
        now = _Known(state.st_size, state.st_mtime_ns, state.st_ctime_ns, state.st_ino, known.sha256 if known else "")
        if known == now:
            return now.sha256
        digest = sha256(path)
        self._known.pop(name, None)
        if state.st_mtime_ns < begun_ns - _AT_REST_NS:
            self._known[name] = msgspec.structs.replace(now, sha256=digest)
        self._changed = True
        return digest

    def save(self) -> None:
        """Store the hashes, except of files that had changed just before; in a folder that cannot be written, none."""
        if self._changed:
            with suppress(CannotWrite):
                write_json(self._folder / CACHE_FILE, self._known)


def files_below(directory: Path, name: str) -> list[Path]:
    """Return the files of a name in a folder and down to three folders below it, in order; no link out of it counts.

    The name may be a pattern. Raises MissingFile if a folder cannot be listed: what it holds would go unnoticed.
    """
    whole = directory.resolve()
    folders, found = [directory], list[Path]()
    for _ in range(_MAX_LEVELS_BELOW + 1):
        entries = [entry for folder in folders for entry in _list_folder(folder)]
        found += [Path(entry) for entry in entries if fnmatchcase(entry.name, name)]
        folders = [Path(entry) for entry in entries if _is_folder(entry)]
    return sorted(path for path in found if path.resolve().is_relative_to(whole))


def folders_in(folder: Path) -> list[Path]:
    """Return the folders in a folder, in order; MissingFile if it cannot be listed."""
    return sorted(Path(entry) for entry in _list_folder(folder) if _is_folder(entry))


def files_in(folder: Path) -> list[Path]:
    """Return what is in a folder but folders, in order; MissingFile if it cannot be listed."""
    return sorted(Path(entry) for entry in _list_folder(folder) if not _is_folder(entry))


def files_named(folder: Path, patterns: Iterable[str]) -> list[Path]:
    """Return the files in a folder by patterns of their names, in order; MissingFile if it cannot be listed."""
    names = sorted(entry.name for entry in _list_folder(folder))
    return [folder / name for pattern in patterns for name in names if fnmatchcase(name, pattern)]


def _list_folder(folder: Path) -> list[os.DirEntry[str]]:
    with naming_unreadable(folder, "make it readable, or move it away"), os.scandir(folder) as entries:
        return list(entries)


def _is_folder(entry: os.DirEntry[str]) -> bool:
    return is_folder(Path(entry)) if entry.is_symlink() else entry.is_dir()


def file_within(folder: Path, name: str) -> Path:
    """Return the path of a file that a record in `folder` names; it may be missing, but not be elsewhere (BadValue)."""
    path = folder / name
    if not _is_within(path, folder):
        raise BadValue(f"{path}: leads out of the folder, or is no regular file; reconstruct again")
    return path


def problem_of_file(path: Path, folder: Path, known: str, hashed: Callable[[Path], str] = sha256) -> str | None:
    """Return in words how a file, which must lie in `folder`, differs from its recorded hash, None if it does not."""
    if not _is_within(path, folder):
        return "leads out of its folder, or is no regular file"
    try:
        if not path.exists():
            return "is missing"
        return None if hashed(path) == known else "was altered"
    except MissingFile as failure:
        return f"cannot be read ({failure.__cause__})"


def _is_within(path: Path, folder: Path) -> bool:
    try:
        return path.resolve().is_relative_to(folder.resolve()) and (path.is_file() or not path.exists())
    except (OSError, ValueError):  # a name that no file can have
        return False
