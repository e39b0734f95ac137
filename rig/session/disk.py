"""Files of a session: written whole or not at all, never overwritten, never deleted; and the lock on its folder."""

import fcntl
import hashlib
import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import tifffile

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import SessionBusy, SessionUnwritable

PART = ".part"


def write_new(path: Path, content: bytes | memoryview) -> None:
    """Write `content` to `path`, which must not exist, such that it survives a power cut.

    The bytes go to `path` with `.part` behind it, are flushed, take their name, and the folder is flushed.

    Raises
    ------
    SessionUnwritable
        In words; no half of a file is left behind.
    """
    part = path.with_name(path.name + PART)
    with in_words(path):
        if path.exists():
            raise SessionUnwritable(f"{path}: is there already and is never overwritten; set it aside and go on")
        try:
            with part.open("wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            part.rename(path)
        except OSError:
            part.unlink(missing_ok=True)
            raise
        sync_folder(path.parent)


def set_aside(path: Path, folder: Path) -> Path:
    """Move a file into `folder` under a name that is free, and return it."""
    with in_words(path):
        folder.mkdir(exist_ok=True)
        number = 0
        while (target := folder / f"{path.name}.{number}").exists():
            number += 1
        path.rename(target)
        sync_folder(folder)
        sync_folder(path.parent)
    return target


def sync_folder(folder: Path) -> None:
    """Flush a folder's entries, so that a rename survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def sha256(path: Path) -> str:
    """Return the SHA-256 of a file's bytes, in hexadecimal."""
    with path.open("rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def file_of(exposure: Exposure) -> bytes | memoryview:
    """Return what is kept: the camera's own bytes, or an array as a TIFF."""
    if exposure.content is not None:
        return exposure.content
    assert exposure.pixels is not None
    buffer = BytesIO()
    photometric = "rgb" if exposure.pixels.ndim == 3 else "minisblack"
    tifffile.imwrite(buffer, exposure.pixels, photometric=photometric)
    return buffer.getbuffer()  # no second copy of what may be a hundred megabytes


@contextmanager
def locked(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Have the session to oneself, or share it with others who only look; the lock ends with the process.

    Raises
    ------
    SessionBusy
        Another capture has it.
    """
    path = folder / "lock"
    with in_words(path):
        descriptor = os.open(path, os.O_RDONLY if shared else os.O_RDWR | os.O_CREAT, 0o644)
    try:
        try:
            fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
        except BlockingIOError as failure:
            holder = os.pread(descriptor, 100, 0).decode(errors="replace") or "another process"
            raise SessionBusy(f"{folder}: a capture is under way ({holder}); wait for it or stop it first") from failure
        if not shared:
            os.ftruncate(descriptor, 0)
            os.pwrite(descriptor, f"process {os.getpid()}".encode(), 0)
        yield
    finally:
        os.close(descriptor)


@contextmanager
def in_words(path: Path) -> Iterator[None]:
    """Turn what the system says about a file into a named failure."""
    try:
        yield
    except OSError as failure:
        place = failure.filename or path
        raise SessionUnwritable(
            f"{place}: {failure.strerror or failure}; what was committed is safe: make room, or make the folder "
            "writable, and run the same command again"
        ) from failure
