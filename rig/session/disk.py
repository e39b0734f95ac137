"""Write the files of a session whole or not at all, never overwrite or delete one, and lock the session's folder."""

import errno
import os
import re
import stat
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import tifffile

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import SessionBusy, SessionCorrupt, SessionUnreadable, SessionUnwritable
from faintfield.rig.files import NO_LINK, NO_WAIT, is_plain_name, lock, make_folder, sync_folder

PART = ".part"

_REMEDIES = {
    errno.ENOSPC: "make room",
    errno.EDQUOT: "make room",
    errno.EFBIG: "make room",
    errno.EACCES: "make the folder writable",
    errno.EPERM: "make the folder writable",
    errno.EROFS: "make the folder writable",
    errno.ENOLCK: "use a file system on which files can be locked",
    errno.EOPNOTSUPP: "use a file system on which files can be locked",
    errno.EIO: "check the disk and its cable",
    errno.ENAMETOOLONG: "shorten the name",
}


def write_new(path: Path, content: bytes | bytearray | memoryview) -> None:
    """Write `content` to a new file that survives a power cut.

    The bytes are written to `path` with the suffix `.part` and flushed; then the file is renamed and its folder is
    flushed. Raises `SessionUnwritable` if the file exists or cannot be written; no partial file is left behind.
    """
    part = path.with_name(path.name + PART)
    with translate_errors(path):
        if os.path.lexists(path):
            raise SessionUnwritable(f"{path}: exists and is never overwritten; set it aside and go on")
        part.unlink(missing_ok=True)  # what a kill left behind, or a link that leads elsewhere
        try:
            with part.open("xb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            part.rename(path)
        except BaseException:  # an interrupt, too
            part.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def set_aside(path: Path, folder: Path) -> Path:
    """Move a file into `folder` under an unused name, and return its new path."""
    with translate_errors(path):
        require_kind(folder, stat.S_ISDIR, "folder")
        make_folder(folder)
        name = path.name if is_plain_name(path.name) else "unnamed"
        number = 0
        while os.path.lexists(target := folder / f"{name}.{number}"):
            number += 1
        path.rename(target)
        sync_folder(folder)
        sync_folder(path.parent)
    return target


def encode_exposure(exposure: Exposure) -> memoryview:
    """Return the bytes of the file to keep, the camera's own file, or its array as a TIFF; they are to be released."""
    if exposure.content is not None:
        return memoryview(exposure.content)
    assert exposure.pixels is not None
    buffer = BytesIO()
    photometric = "rgb" if exposure.pixels.ndim == 3 else "minisblack"
    tifffile.imwrite(buffer, exposure.pixels, photometric=photometric)
    return buffer.getbuffer()  # not `getvalue`, which copies perhaps a hundred megabytes


def list_names(folder: Path) -> list[str]:
    """Return the names in a folder of a session, sorted; there are none before it is created.

    Raises `SessionCorrupt` if it is no folder, or a link, and `SessionUnreadable` if it cannot be listed.
    """
    with translate_errors(folder, read_only=True):
        require_kind(folder, stat.S_ISDIR, "folder")
        return sorted(os.listdir(folder)) if os.path.lexists(folder) else []


def require_kind(path: Path, is_kind: Callable[[int], bool], kind: str) -> None:
    """Raise `SessionCorrupt` for a link, pipe, … where a session has a file or folder of its own, or nothing yet."""
    try:
        mode = os.lstat(path).st_mode
    except FileNotFoundError:
        return
    if not is_kind(mode):
        raise SessionCorrupt(f"{path}: is not a {kind} of the session itself; move it away, or restore it from a copy")


@contextmanager
def lock_session(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Hold the lock on a session, exclusive or shared with other readers; it ends with the process at the latest.

    Raises `SessionBusy` if another capture holds it, `SessionCorrupt` if it is not a regular file, and
    `SessionUnwritable` or, if shared, `SessionUnreadable` if it cannot be locked.
    """
    path = folder / "lock"
    with translate_errors(path, read_only=shared):
        require_kind(path, stat.S_ISREG, "file")
        access = os.O_RDONLY if shared else os.O_RDWR | os.O_CREAT
        descriptor = os.open(path, access | NO_LINK | NO_WAIT, 0o644)
    try:
        with translate_errors(path, read_only=shared):
            try:
                lock(descriptor, shared=shared)
            except BlockingIOError as failure:
                os.lseek(descriptor, 0, os.SEEK_SET)
                process = re.fullmatch(rb"process \d+", os.read(descriptor, 100))
                holder = process[0].decode() if process else "another process"
                raise SessionBusy(f"{folder}: a capture is under way ({holder}); wait for it or stop it") from failure
            if not shared:
                os.ftruncate(descriptor, 0)
                os.lseek(descriptor, 0, os.SEEK_SET)
                os.write(descriptor, f"process {os.getpid()}".encode())
        yield
    finally:
        os.close(descriptor)


@contextmanager
def translate_errors(path: Path, *, read_only: bool = False) -> Iterator[None]:
    """Raise `SessionUnwritable`, or `SessionUnreadable` if `read_only`, for an error of the operating system."""
    try:
        yield
    except OSError as failure:
        place, reason = failure.filename or path, failure.strerror or failure
        if read_only:
            raise SessionUnreadable(
                f"{place}: cannot be read ({reason}); allow it to be read, or check the disk, and run the same command "
                "again"
            ) from failure
        remedy = _REMEDIES.get(failure.errno or 0, "see that the disk is whole and the path leads to a folder")
        raise SessionUnwritable(
            f"{place}: {reason}; what was committed is safe: {remedy}, and run the same command again"
        ) from failure
