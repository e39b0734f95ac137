"""Write the files of a session whole or not at all, never overwrite or delete one, and lock the session's folder."""

import fcntl
import os
from collections.abc import Iterator
from contextlib import contextmanager
from io import BytesIO
from pathlib import Path

import tifffile

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import SessionBusy, SessionUnwritable
from faintfield.rig.session.durable import sync_folder

PART = ".part"


def write_new(path: Path, content: bytes | memoryview) -> None:
    """Write `content` to a new file that survives a power cut.

    The bytes are written to `path` with the suffix `.part` and flushed; then the file is renamed and its folder is
    flushed.

    Raises
    ------
    SessionUnwritable
        The file exists or cannot be written; no partial file is left behind.
    """
    part = path.with_name(path.name + PART)
    with translate_errors(path):
        if path.exists():
            raise SessionUnwritable(f"{path}: exists and is never overwritten; set it aside and go on")
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
    """Move a file into `folder` under an unused name, and return its new path."""
    with translate_errors(path):
        folder.mkdir(exist_ok=True)
        number = 0
        while (target := folder / f"{path.name}.{number}").exists():
            number += 1
        path.rename(target)
        sync_folder(folder)
        sync_folder(path.parent)
    return target


def encode_exposure(exposure: Exposure) -> bytes | memoryview:
    """Return the bytes of the file to keep: the camera's own file, or its array as a TIFF."""
    if exposure.content is not None:
        return exposure.content
    assert exposure.pixels is not None
    buffer = BytesIO()
    photometric = "rgb" if exposure.pixels.ndim == 3 else "minisblack"
    tifffile.imwrite(buffer, exposure.pixels, photometric=photometric)
    return buffer.getbuffer()  # not `getvalue`, which copies perhaps a hundred megabytes


@contextmanager
def lock_session(folder: Path, *, shared: bool = False) -> Iterator[None]:
    """Hold the lock on a session, exclusive or shared with other readers; it ends with the process at the latest.

    Raises
    ------
    SessionBusy
        Another capture holds the session.
    """
    path = folder / "lock"
    with translate_errors(path):
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
def translate_errors(path: Path) -> Iterator[None]:
    """Raise `SessionUnwritable` for an error of the operating system."""
    try:
        yield
    except OSError as failure:
        place = failure.filename or path
        raise SessionUnwritable(
            f"{place}: {failure.strerror or failure}; what was committed is safe: make room, or make the folder "
            "writable, and run the same command again"
        ) from failure
