"""The journal of a session: everything that happened, in the order in which it did, on disk before it counts.

SQLite in WAL mode with synchronous=FULL: when a call returns, what it recorded survives a power cut. Rows are only
ever added. Order is that of their numbers; times are for people, since clocks can be set back.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, Self

import msgspec
from msgspec import Struct

from faintfield.rig.errors import SessionCorrupt, SessionUnwritable
from faintfield.rig.stages.transport import Direction

_SCHEMA = """
CREATE TABLE IF NOT EXISTS event (
    id INTEGER PRIMARY KEY AUTOINCREMENT, at TEXT NOT NULL, kind TEXT NOT NULL, frame INTEGER, detail TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS intent (
    id INTEGER PRIMARY KEY AUTOINCREMENT, at TEXT NOT NULL, frame INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS "commit" (
    intent INTEGER PRIMARY KEY REFERENCES intent (id), at TEXT NOT NULL, file TEXT NOT NULL UNIQUE,
    sha256 TEXT NOT NULL, bytes INTEGER NOT NULL, detail TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS void (
    intent INTEGER PRIMARY KEY REFERENCES intent (id), at TEXT NOT NULL, why TEXT NOT NULL);
CREATE TABLE IF NOT EXISTS traffic (
    id INTEGER PRIMARY KEY AUTOINCREMENT, at_s REAL NOT NULL, direction TEXT NOT NULL, data BLOB NOT NULL);
"""
_COMMITTED = """
SELECT intent.id, intent.frame, "commit".file, "commit".sha256, "commit".bytes, "commit".detail, void.why
FROM "commit" JOIN intent ON intent.id = "commit".intent LEFT JOIN void ON void.intent = intent.id ORDER BY intent.id
"""
# Serial traffic waits in memory for the next entry that must be on disk at once, or for this many pieces.
_TRAFFIC_WAITS = 2000


class Committed(Struct, frozen=True):
    """A frame that was taken and is on disk.

    Parameters
    ----------
    intent : int
        Number of the intent, which counts the exposures of the session.
    frame : int
        Its place in the plan.
    file : str
        Name within `frames/`.
    sha256, bytes : str, int
        Of the file.
    detail : dict
        Position, camera metadata, checks.
    void : str, optional
        Why the frame does not count any more; its file stays.
    """

    intent: int
    frame: int
    file: str
    sha256: str
    bytes: int
    detail: dict[str, Any]
    void: str | None = None


class Event(Struct, frozen=True):
    """Something else that happened: a prompt and its answer, a warning, a failure, a measurement."""

    id: int
    at: str
    kind: str
    frame: int | None
    detail: dict[str, Any]


class Journal:
    """Open journal; also a `TrafficLog` of the stage.

    Parameters
    ----------
    path : Path
        The SQLite file; it is created when `create`.
    read_only : bool
        Look, and leave no trace: not even a lock, so that a write-protected medium can be read.
    """

    def __init__(self, path: Path, *, create: bool = False, read_only: bool = False) -> None:
        self.path = path
        self._traffic: list[tuple[float, str, bytes]] = []
        if not create and not path.is_file():
            raise SessionCorrupt(f"{path}: the journal is missing; restore it, or begin a new session")
        with self._in_words():
            wal = path.with_name(path.name + "-wal")
            mode = "ro" if wal.exists() else "ro&immutable=1"
            uri = f"{path.absolute().as_uri()}?mode={mode if read_only else 'rwc'}"
            self._db = sqlite3.connect(uri, uri=True, isolation_level=None, check_same_thread=False)
            if not read_only:
                self._prepare()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write what still waits, and close."""
        try:
            if self._traffic:
                with self._transaction():
                    pass
        finally:
            self._db.close()

    def record(self, at_s: float, direction: Direction, data: bytes) -> None:
        """Keep serial traffic; it reaches the disk with the next entry."""
        self._traffic.append((at_s, direction, data))
        if len(self._traffic) >= _TRAFFIC_WAITS:
            with self._transaction():
                pass

    def event(self, kind: str, *, frame: int | None = None, **detail: Any) -> None:
        """Record that something happened."""
        with self._transaction():
            self._db.execute(
                "INSERT INTO event (at, kind, frame, detail) VALUES (?, ?, ?, ?)", (_now(), kind, frame, _text(detail))
            )

    def intend(self, frame: int) -> int:
        """Record that `frame` is about to be taken, and return the number of the exposure."""
        with self._transaction():
            row = self._db.execute("INSERT INTO intent (at, frame) VALUES (?, ?)", (_now(), frame))
        assert row.lastrowid is not None
        return row.lastrowid

    def commit(self, intent: int, file: str, sha256: str, size_bytes: int, detail: dict[str, Any]) -> None:
        """Record that the frame of `intent` is whole and on disk. Earlier takes of it do not count any more."""
        with self._transaction():
            self._db.execute(
                'INSERT INTO void (intent, at, why) SELECT "commit".intent, ?, ? FROM "commit" '
                'JOIN intent AS old ON old.id = "commit".intent JOIN intent AS new ON new.frame = old.frame '
                'WHERE new.id = ? AND "commit".intent NOT IN (SELECT intent FROM void)',
                (_now(), "retaken", intent),
            )
            self._db.execute(
                'INSERT INTO "commit" (intent, at, file, sha256, bytes, detail) VALUES (?, ?, ?, ?, ?, ?)',
                (intent, _now(), file, sha256, size_bytes, _text(detail)),
            )

    def void(self, intents: list[int], why: str) -> None:
        """Record that committed frames do not count any more; they will be taken again."""
        with self._transaction():
            self._db.executemany(
                "INSERT OR IGNORE INTO void (intent, at, why) VALUES (?, ?, ?)", [(it, _now(), why) for it in intents]
            )

    def committed(self) -> list[Committed]:
        """Return every frame that was committed, in the order in which they were intended."""
        with self._in_words():
            rows = self._db.execute(_COMMITTED).fetchall()
            return [Committed(a, b, c, d, e, msgspec.json.decode(detail), void) for a, b, c, d, e, detail, void in rows]

    def uncommitted(self) -> list[tuple[int, int]]:
        """Return number and frame of every intent that came to nothing."""
        with self._in_words():
            query = 'SELECT id, frame FROM intent WHERE id NOT IN (SELECT intent FROM "commit") ORDER BY id'
            return self._db.execute(query).fetchall()

    def events(self, kind: str | None = None) -> list[Event]:
        """Return what happened, all or of one kind, in order."""
        with self._in_words():
            query = "SELECT id, at, kind, frame, detail FROM event WHERE ?1 IS NULL OR kind = ?1 ORDER BY id"
            rows = self._db.execute(query, (kind,)).fetchall()
            return [Event(a, b, c, d, msgspec.json.decode(detail)) for a, b, c, d, detail in rows]

    def traffic(self) -> list[tuple[float, str, bytes]]:
        """Return the stage's traffic: time, direction, bytes."""
        with self._in_words():
            return self._db.execute("SELECT at_s, direction, data FROM traffic ORDER BY id").fetchall()

    def damage(self) -> str | None:
        """Return what SQLite finds wrong with its file, None when nothing."""
        with self._in_words():
            found = str(self._db.execute("PRAGMA integrity_check").fetchone()[0])
            return None if found == "ok" else " ".join(found.split())

    def _prepare(self) -> None:
        """Choose durability over speed, and make the tables."""
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = FULL")
        self._db.execute("PRAGMA foreign_keys = ON")
        self._db.executescript(_SCHEMA)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Make what the block records durable, all of it or nothing, with the traffic that waits."""
        with self._in_words():
            self._db.execute("BEGIN IMMEDIATE")
            try:
                yield
                self._db.executemany("INSERT INTO traffic (at_s, direction, data) VALUES (?, ?, ?)", self._traffic)
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:
                    self._db.execute("ROLLBACK")
                raise
        self._traffic.clear()

    @contextmanager
    def _in_words(self) -> Iterator[None]:
        """Turn what SQLite says into a named failure."""
        try:
            yield
        except (sqlite3.OperationalError, OSError) as failure:
            raise SessionUnwritable(
                f"{self.path}: {failure}; make room, or make the folder writable, and run the same command again"
            ) from failure
        except (sqlite3.DatabaseError, msgspec.DecodeError) as failure:
            raise SessionCorrupt(f"{self.path}: {failure}; restore the journal from a copy") from failure


def _now() -> str:
    """Return the time as people write it, in UTC."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _text(detail: dict[str, Any]) -> str:
    """Return a detail as JSON."""
    return msgspec.json.encode(detail).decode()
