"""Hashes of a session's files, remembered as long as the files do not change: frames are read once, not every time."""

import time
from contextlib import suppress
from pathlib import Path

import msgspec

from faintfield.pipelines.errors import CannotWrite
from faintfield.pipelines.formats.files import sha256, write_json

CACHE_FILE = ".hashes.json"

# A file changed within this time of its hashing could change again without its time stamp showing it.
_AT_REST_NS = 2_000_000_000


class _Known(msgspec.Struct, frozen=True):
    """A hash, and the size and time of change of the file when it was taken."""

    size: int
    mtime_ns: int
    sha256: str


class Hashes:
    """SHA-256 of the files of a folder, each computed again only when its size or its time of change has changed.

    Parameters
    ----------
    folder : Path
        The folder; the hashes are kept in a hidden file there, which may be removed at any time.
    """

    def __init__(self, folder: Path) -> None:
        self._folder = folder
        self._known: dict[str, _Known] = {}
        try:
            self._known = msgspec.json.decode((folder / CACHE_FILE).read_bytes(), type=dict[str, _Known])
        except (OSError, msgspec.MsgspecError, UnicodeDecodeError):
            self._changed = True  # there is none, or it is no use: everything is hashed
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
        """Keep what was computed for the next time, but for files that had changed only just before.

        Where the folder cannot be written to, nothing is kept: it costs time, nothing else.
        """
        if self._changed:
            with suppress(CannotWrite):
                write_json(self._folder / CACHE_FILE, self._known)
