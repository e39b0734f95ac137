"""Read files, of a bounded size, and turn all that can go wrong into one named failure with the path."""

import errno
import math
import zipfile
from collections.abc import Callable, Collection, Iterator
from contextlib import contextmanager
from io import BufferedReader
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.provenance import DIGEST_KEY, digest_holds
from faintfield.pipelines.formats.units import record_of
from faintfield.rig.files import open_regular, read_regular

# Size in bytes up to which a file of text, settings or records is read. The largest that faintfield writes, the record
# of a sweep of a thousand planes, has a few million.
MAX_TEXT_BYTES = 64_000_000

# What msgspec raises on content that is not JSON of the expected type, or is nested too deeply.
JSON_FAILURES = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)

# Kinds of numpy's data types that are plain numbers: booleans, integers and floats.
_NUMBERS = "biuf"

# What a .npz file may have besides its arrays: headers, and the list of its members.
_OVERHEAD_BYTES = 1_000_000


def is_file(path: Path) -> bool:
    """Return whether there is a regular file; False for names that no file can have, MissingFile if it is not known."""
    return _is_there(path, Path.is_file)


def is_folder(path: Path) -> bool:
    """Return whether there is a folder; otherwise as `is_file`."""
    return _is_there(path, Path.is_dir)


def _is_there(path: Path, test: Callable[[Path], bool]) -> bool:
    with naming_unreadable(path):
        try:
            return test(path)
        except OSError as failure:
            if failure.errno != errno.ENAMETOOLONG:
                raise
            return False


@contextmanager
def naming_unreadable(path: Path, remedy: str = "name a file of the kind that is read here") -> Iterator[None]:
    """Turn the failures of a file that cannot be opened or read into MissingFile with the path."""
    try:
        yield
    except (OSError, ValueError) as failure:  # a ValueError is a name with a NUL
        reason = failure.strerror if isinstance(failure, OSError) else failure
        raise MissingFile(f"{path}: cannot be read ({reason}); {remedy}") from failure


@contextmanager
def opened(path: Path) -> Iterator[BufferedReader]:
    """Open a regular file for reading; raise MissingFile if it cannot be opened, or is not a regular file."""
    with naming_unreadable(path):
        file = open_regular(path)
    with file:
        yield file


def read_content(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Return the content of a regular file; raise MissingFile if it cannot be read, or is larger than `max_bytes`."""
    with naming_unreadable(path):
        return read_regular(path, max_bytes)


def read_text(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> str:
    """Return the text of a file, in which undecodable bytes become replacement characters; raise as `read_content`."""
    return read_content(path, max_bytes).decode(errors="replace")


def read_json[T](path: Path, kind: type[T], *, what: str, remedy: str) -> T:
    """Return the content of a JSON file as a type that msgspec decodes; `what` and `remedy` are for the message.

    Raises MissingFile if it cannot be read, and BadValue if it is not JSON, not of this type, or disagrees with its
    own digest.
    """
    content = read_content(path)
    try:
        record = record_of(content, kind)
        altered = digest_holds(content) is False
    except JSON_FAILURES as failure:
        raise BadValue(f"{path}: is not {what} ({failure}); {remedy}") from failure
    if altered:
        raise BadValue(f"{path}: was altered after it was written: it disagrees with its {DIGEST_KEY}; {remedy}")
    return record


def read_arrays(
    path: Path, names: Collection[str], *, shape: tuple[int, ...], max_bytes: int, remedy: str
) -> dict[str, NDArray[Any]]:
    """Return those of the named arrays of numbers that a .npz file has; they cannot be written to.

    The declared size of an array is checked before it is decompressed, and its checksum after. Raises BadValue if the
    file is damaged, an array has another shape or is not of numbers, or all together exceed `max_bytes`.
    """
    arrays: dict[str, NDArray[Any]] = {}
    with opened(path) as file:
        try:
            if (size := path.stat().st_size) > max_bytes + _OVERHEAD_BYTES:
                raise ValueError(f"holds {size} bytes, at most {max_bytes} are expected")
            with zipfile.ZipFile(file) as archive:
                held = set(archive.namelist())
                for name in [name for name in names if f"{name}.npy" in held]:
                    arrays[name] = _member(archive, name, max_bytes, shape)
                    max_bytes -= arrays[name].nbytes
        except Exception as failure:  # zipfile, zlib and numpy raise exceptions of a dozen types
            reason = " ".join(str(failure).split()) or type(failure).__name__
            raise BadValue(f"{path}: cannot be read ({reason}); {remedy}") from failure
    return arrays


def _member(archive: zipfile.ZipFile, name: str, max_bytes: int, shape: tuple[int, ...]) -> NDArray[Any]:
    entry = archive.getinfo(f"{name}.npy")
    if entry.compress_type not in (zipfile.ZIP_STORED, zipfile.ZIP_DEFLATED):
        raise ValueError(f"{name} is compressed by method {entry.compress_type}, which numpy does not use")
    with archive.open(entry) as member:
        if (version := np.lib.format.read_magic(member)) != (1, 0):
            raise ValueError(f"{name} is of .npy format {version[0]}.{version[1]}, only 1.0 is read")
        found, column_major, dtype = np.lib.format.read_array_header_1_0(member)
        if dtype.kind not in _NUMBERS:
            raise ValueError(f"{name} is {dtype}, which are no numbers")
        if found != shape:
            raise ValueError(f"{name} has shape {found}, expected is {shape}")
        size = math.prod(found) * dtype.itemsize
        if size > max_bytes:
            raise ValueError(f"{name} takes {size} bytes, at most {max_bytes} are expected")
        content = member.read(size + 1)  # up to the end, where the checksum is compared
    if len(content) != size:
        raise ValueError(f"{name} does not have the {size} bytes that it states")
    return np.frombuffer(content, dtype).reshape(found, order="F" if column_major else "C")
