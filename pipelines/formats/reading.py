"""Read files whole, of a bounded size, and turn all that can go wrong into one named failure with the path."""

from pathlib import Path

import msgspec

from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.digests import DIGEST_KEY, digest_holds
from faintfield.rig.session.regular_files import read_regular

# Size in bytes up to which a file of text, settings or records is read. The largest that faintfield writes, the record
# of a sweep of a thousand planes, has a few million.
MAX_TEXT_BYTES = 64_000_000

# What msgspec raises on content that is not JSON of the expected type, or is nested too deeply.
JSON_FAILURES = (msgspec.MsgspecError, UnicodeDecodeError, RecursionError)


def read_content(path: Path, max_bytes: int = MAX_TEXT_BYTES) -> bytes:
    """Return the content of a file.

    Raises
    ------
    MissingFile
        It cannot be read, is not a regular file, or is larger than `max_bytes`.
    """
    try:
        return read_regular(path, max_bytes)
    except (OSError, ValueError) as failure:  # ValueError: a name with a NUL
        reason = failure.strerror if isinstance(failure, OSError) else str(failure)
        raise MissingFile(f"{path}: cannot be read ({reason}); name a file of the kind that is read here") from failure


def read_json[T](path: Path, kind: type[T], *, what: str, remedy: str) -> T:
    """Return the content of a JSON file as an instance of `kind`.

    Parameters
    ----------
    path : Path
        The file.
    kind : type
        A msgspec Struct, or another type that msgspec decodes.
    what, remedy : str
        What the file should be, and what to do if it is not, for the message.

    Raises
    ------
    MissingFile
        The file cannot be read.
    BadValue
        It is not JSON, not of this type, or does not agree with the digest that it carries.
    """
    content = read_content(path)
    try:
        record = msgspec.json.decode(content, type=kind)
        altered = digest_holds(content) is False
    except JSON_FAILURES as failure:
        raise BadValue(f"{path}: is not {what} ({failure}); {remedy}") from failure
    if altered:
        raise BadValue(f"{path}: was altered after it was written: it disagrees with its {DIGEST_KEY}; {remedy}")
    return record
