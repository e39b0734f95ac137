"""Files of sessions and results: regular ones of a bounded size, read and hashed; names; locks; folders that last.

A name in a file may lead to a pipe, which never answers, or to a device, which never ends. Both are refused here.
The differences between operating systems that concern files are all in this module.
"""

import errno
import hashlib
import os
import stat
import sys
import tempfile
from io import BufferedReader
from pathlib import Path

if sys.platform == "win32":
    import msvcrt

    # Links and pipes cannot be refused as a file is opened: that they are looked for before has to do
    NO_LINK = NO_WAIT = 0
else:
    import fcntl

    NO_LINK, NO_WAIT = os.O_NOFOLLOW, os.O_NONBLOCK

# The bytes of a file that stand for its lock on Windows: one for each reader. They lie beyond every content, because
# locked bytes cannot be read.
_LOCK_START, _MAX_READERS = 1 << 30, 64

# Leaves room for what is appended to a name: file systems allow 255 bytes.
MAX_NAME_LENGTH = 200


def open_regular(path: Path) -> BufferedReader:
    """Open a regular file, or a link to one, for reading; raise OSError for a pipe, a device, a socket or a folder."""
    _require_regular(path, os.stat(path))  # before it is opened, which can already act on a device
    descriptor = os.open(path, os.O_RDONLY | NO_WAIT)
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
    """Flush the entries of a folder, so that a rename survives a power cut; Windows offers no such thing."""
    if sys.platform == "win32":
        return
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


def open_for_lock(folder: Path) -> int:
    """Return an open file that stands for a folder where it is locked: the folder itself if the system can open it.

    On Windows it is a file in the user's folder for temporary files, which stays there, empty. A file in the folder
    would be a stranger among the results, and while it is open, the folder could not be renamed or removed.
    """
    if sys.platform == "win32":
        name = hashlib.sha256(os.fsencode(folder.resolve())).hexdigest()
        return os.open(Path(tempfile.gettempdir(), f"faintfield-{name[:32]}.lock"), os.O_RDWR | os.O_CREAT)
    return os.open(folder, os.O_RDONLY)


def lock(descriptor: int, *, shared: bool) -> None:
    """Lock an open file, exclusively or shared with other readers, until it is closed or the process ends.

    Raises BlockingIOError if another has locked it, and another OSError if it cannot be locked.
    """
    if sys.platform == "win32":
        for reader in range(_MAX_READERS if shared else 1):
            os.lseek(descriptor, _LOCK_START + reader, os.SEEK_SET)
            try:
                return msvcrt.locking(descriptor, msvcrt.LK_NBLCK, 1 if shared else _MAX_READERS)
            except PermissionError:  # these bytes are locked
                continue
        raise BlockingIOError(errno.EAGAIN, "is locked")
    else:
        fcntl.flock(descriptor, (fcntl.LOCK_SH if shared else fcntl.LOCK_EX) | fcntl.LOCK_NB)
