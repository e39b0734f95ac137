"""Hashes of a session's files, cached until the files change: frames are read once, not every time."""

import time
from contextlib import suppress
from pathlib import Path

import msgspec

from faintfield.pipelines.errors import CannotWrite
from faintfield.pipelines.formats.files import sha256, write_json

CACHE_FILE = ".hashes.json"

# In nanoseconds: a file changed this shortly before its hashing could change again with the same time stamp.
_AT_REST_NS = 2_000_000_000


class _Known(msgspec.Struct, frozen=True):
    """A hash, with the size and the time of change of the file at that time."""

    size: int
    mtime_ns: int
    sha256: str


class Hashes:
    """SHA-256 of the files of a folder, each computed again only if its size or its time of change differs.

    Parameters
    ----------
    folder : Path
        The folder; the hashes are stored in a hidden file in it, which may be removed at any time.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, _Known] = {}
        try:
            self._known = msgspec.json.decode((folder / CACHE_FILE).read_bytes(), type=dict[str, _Known])
        except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
            self._changed = True  # there is none, or it cannot be read: everything is hashed
        else:
            self._changed = False

    def of(self, name: str) -> str:
        """Return the SHA-256 of a file, by its name within the folder."""
        path = self._folder / name
        state = path.stat()
        known = self._known.get(name)
        if known is not None and (known.size, known.mtime_ns) == (state.st_size, state.st_mtime_ns):
            return known.sha256
        begun_ns = time.time_ns()
        digest = sha256(path)
        self._known.pop(name, None)
        if state.st_mtime_ns < begun_ns - _AT_REST_NS:
            self._known[name] = _Known(state.st_size, state.st_mtime_ns, digest)
        self._changed = True
        return digest

    def save(self) -> None:
        """Store the hashes, except of files that had changed just before.

        If the folder cannot be written to, nothing is stored, which costs time only.
        """
        if self._changed:
            with suppress(CannotWrite):
                write_json(self._folder / CACHE_FILE, self._known)
