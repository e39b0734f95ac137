"""Files of sessions and results: regular ones of a bounded size, read and hashed; names; folders that last.

A name in a file may lead to a pipe, which never answers, or to a device, which never ends. Both are refused here.
"""

import errno
import hashlib
import os
import stat
from io import BufferedReader
from pathlib import Path

# Leaves room for what is appended to a name: file systems allow 255 bytes.
MAX_NAME_LENGTH = 200


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file, or a link to one, for reading; raise OSError for a pipe, a device, a socket or a folder."""
    _require_regular(path, os.stat(path))  # before it is opened, which can already act on a device
    descriptor = os.open(path, os.O_RDONLY | os.O_NONBLOCK | os.O_CLOEXEC)
    try:
        _require_regular(path, os.fstat(descriptor))
        return os.fdopen(descriptor, "rb")
    except BaseException:
        os.close(descriptor)
        raise


def read_regular(path: Path, max_bytes: int) -> bytes:
    """Return the content of a regular file; raise OSError if it is larger than `max_bytes`, or grows meanwhile."""
    with open_regular(path) as file:
        return read_all(file, max_bytes)


def read_all(file: BufferedReader, max_bytes: int) -> bytes:
    """Return the content of an open regular file from its present position on; raise OSError as `read_regular` does."""
    left = require_size(file, max_bytes)
    content = file.read(left + 1)  # no more, because `read` takes the memory that it is asked for
    if len(content) > left:
        raise OSError(errno.EBUSY, "grows while it is read")
    return content


def require_size(file: BufferedReader, max_bytes: int) -> int:
    """Return the number of bytes from the present position on; raise OSError if there are more than `max_bytes`."""
    left = os.fstat(file.fileno()).st_size - file.tell()
    if left > max_bytes:
        raise OSError(errno.EFBIG, f"holds {left} bytes, at most {max_bytes} are read")
    return left


def sha256(path: Path) -> str:
    """Return the SHA-256 of a regular file's bytes, in hexadecimal."""
    with open_regular(path) as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def _require_regular(path: Path, state: os.stat_result) -> None:
    if not stat.S_ISREG(state.st_mode):
        raise OSError(errno.EINVAL, "is not a regular file", str(path))


def is_plain_name(name: str) -> bool:
    """Return whether `name` is that of a file in the very folder it is joined to, in printable ASCII as all of ours."""
    return (
        0 < len(name) <= MAX_NAME_LENGTH
        and name.isascii()
        and name.isprintable()
        and not {"/", "\\"} & set(name)
        and name.strip(".") != ""
    )


def sync_folder(folder: Path) -> None:
    """Flush the entries of a folder, so that a rename survives a power cut."""
    descriptor = os.open(folder, os.O_RDONLY)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)


def make_folder(folder: Path) -> None:
    """Create a folder, and those above it, if they are missing, so that they survive a power cut."""
    if not folder.is_dir():
        make_folder(folder.parent)
        folder.mkdir(exist_ok=True)
    sync_folder(folder.parent)
