"""Keep the journal of a session: a database of all that happened during a capture.

The journal is SQLite in WAL mode with synchronous=FULL: once a call returns, what it recorded survives a power cut.
Rows are only added, and ordered by their numbers; times are for people, since clocks can be set back.
"""

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Self

import msgspec
from msgspec import Struct

from faintfield.rig.cameras.protocol import Metadata
from faintfield.rig.errors import SessionCorrupt, SessionUnwritable
from faintfield.rig.stages.protocol import Point
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
# Records of serial traffic held in memory before they are written, as each write costs a flush of the disk; any other
# entry writes them earlier.
_MAX_PENDING_TRAFFIC = 2000


class FrameRecord(Struct, frozen=True):
    """What the journal says about a frame besides its file.

    Parameters
    ----------
    position_mm : Point
        Position that the stage reported before the exposure.
    exposure_s : float
        Exposure time.
    camera : dict
        Metadata from the camera.
    checks : dict of str to float
        Measured values, see `rig.capture.checks.Findings`.
    warnings : tuple of str
        Warnings about the frame.
    """

    position_mm: Point
    exposure_s: float
    camera: Metadata = {}
    checks: dict[str, float] = {}
    warnings: tuple[str, ...] = ()

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the sensor in °C, None if the camera does not report it."""
        value = self.camera.get("temperature_c")
        return value if isinstance(value, int | float) else None


class CommittedFrame(Struct, frozen=True):
    """A frame that was taken and is on disk.

    Parameters
    ----------
    intent : int
        Number of the exposure within the session.
    frame : int
        Index of the frame in the plan.
    file : str
        Name of the file within `frames/`.
    sha256, bytes : str, int
        Hash and size of the file.
    record : FrameRecord
        Position, camera metadata, checks.
    void : str, optional
        Why the frame is void; its file stays.
    """

    intent: int
    frame: int
    file: str
    sha256: str
    bytes: int
    record: FrameRecord
    void: str | None = None


class JournalEvent(Struct, frozen=True):
    """Any other entry: a prompt and its answer, a warning, a failure, a measurement."""

    id: int
    at: str
    kind: str
    frame: int | None
    detail: dict[str, object]


class Begun(Struct, frozen=True):
    """Detail of the event `begun`: the hash of the plan."""

    plan_sha256: str


class Suspect(Struct, frozen=True):
    """Detail of an event `suspect`: the exposures that relied on a stage that lost its scale."""

    intents: tuple[int, ...]


class Sealed(Struct, frozen=True):
    """Detail of the event `sealed`: the frames that were left out, by their index in the plan."""

    skipped: tuple[int, ...]


class Journal:
    """An open journal, which is also the `TrafficLog` of the stage.

    Parameters
    ----------
    path : Path
        The SQLite file.
    create : bool
        Create the file if it is missing.
    read_only : bool
        Open without a lock and without writing, so that a write-protected medium can be read.
    """

    def __init__(self, path: Path, *, create: bool = False, read_only: bool = False) -> None:
        self.path = path
        self._traffic: list[tuple[float, str, bytes]] = []
        if not create and not path.is_file():
            raise SessionCorrupt(f"{path}: the journal is missing; restore it, or begin a new session")
        with self._translate_errors():
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
        """Write pending traffic, and close."""
        try:
            if self._traffic:
                with self._transaction():
                    pass
        finally:
            self._db.close()

    def record(self, at_s: float, direction: Direction, data: bytes) -> None:
        """Record serial traffic, which reaches the disk with the next entry."""
        self._traffic.append((at_s, direction, data))
        if len(self._traffic) >= _MAX_PENDING_TRAFFIC:
            with self._transaction():
                pass

    def event(self, kind: str, *, frame: int | None = None, **detail: object) -> None:
        """Record an event."""
        with self._transaction():
            self._db.execute(
                "INSERT INTO event (at, kind, frame, detail) VALUES (?, ?, ?, ?)",
                (_now(), kind, frame, _to_json(detail)),
            )

    def intend(self, frame: int) -> int:
        """Record that `frame` will be taken now, and return the number of the exposure."""
        with self._transaction():
            row = self._db.execute("INSERT INTO intent (at, frame) VALUES (?, ?)", (_now(), frame))
        assert row.lastrowid is not None
        return row.lastrowid

    def commit(self, intent: int, file: str, sha256: str, size_bytes: int, record: FrameRecord) -> None:
        """Record that the frame of `intent` is complete on disk; earlier takes of it become void."""
        with self._transaction():
            self._db.execute(
                'INSERT INTO void (intent, at, why) SELECT "commit".intent, ?, ? FROM "commit" '
                'JOIN intent AS old ON old.id = "commit".intent JOIN intent AS new ON new.frame = old.frame '
                'WHERE new.id = ? AND "commit".intent NOT IN (SELECT intent FROM void)',
                (_now(), "retaken", intent),
            )
            self._db.execute(
                'INSERT INTO "commit" (intent, at, file, sha256, bytes, detail) VALUES (?, ?, ?, ?, ?, ?)',
                (intent, _now(), file, sha256, size_bytes, _to_json(record)),
            )

    def void(self, intents: list[int], why: str) -> None:
        """Record that committed frames are void, and will be taken again."""
        with self._transaction():
            self._db.executemany(
                "INSERT OR IGNORE INTO void (intent, at, why) VALUES (?, ?, ?)", [(it, _now(), why) for it in intents]
            )

    def committed(self) -> list[CommittedFrame]:
        """Return all committed frames in the order of their exposures."""
        with self._translate_errors():
            rows = self._db.execute(_COMMITTED).fetchall()
            return [
                CommittedFrame(a, b, c, d, e, msgspec.json.decode(record, type=FrameRecord), void)
                for a, b, c, d, e, record, void in rows
            ]

    def uncommitted(self) -> list[tuple[int, int]]:
        """Return the number and the frame of every exposure that was not committed."""
        with self._translate_errors():
            query = 'SELECT id, frame FROM intent WHERE id NOT IN (SELECT intent FROM "commit") ORDER BY id'
            return self._db.execute(query).fetchall()

    def events(self, kind: str | None = None) -> list[JournalEvent]:
        """Return the events in order, all or those of one kind."""
        with self._translate_errors():
            query = "SELECT id, at, kind, frame, detail FROM event WHERE ?1 IS NULL OR kind = ?1 ORDER BY id"
            rows = self._db.execute(query, (kind,)).fetchall()
            return [JournalEvent(a, b, c, d, msgspec.json.decode(detail)) for a, b, c, d, detail in rows]

    def details[T](self, kind: str, layout: type[T]) -> list[T]:
        """Return the details of the events of a kind, in order, each as an instance of `layout`."""
        with self._translate_errors():
            return [msgspec.convert(event.detail, layout) for event in self.events(kind)]

    def traffic(self) -> list[tuple[float, str, bytes]]:
        """Return the traffic of the stage as time in s, direction and bytes."""
        with self._translate_errors():
            return self._db.execute("SELECT at_s, direction, data FROM traffic ORDER BY id").fetchall()

    def damage(self) -> str | None:
        """Return what SQLite's integrity check finds, None if nothing."""
        with self._translate_errors():
            found = str(self._db.execute("PRAGMA integrity_check").fetchone()[0])
            return None if found == "ok" else " ".join(found.split())

    def _prepare(self) -> None:
        """Prefer durability to speed, and create the tables."""
        self._db.execute("PRAGMA journal_mode = WAL")
        self._db.execute("PRAGMA synchronous = FULL")
        self._db.execute("PRAGMA foreign_keys = ON")
        self._db.executescript(_SCHEMA)

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Run the block as one transaction, which also writes the pending traffic."""
        with self._translate_errors():
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
    def _translate_errors(self) -> Iterator[None]:
        """Raise `SessionUnwritable` or `SessionCorrupt` for an error of SQLite."""
        try:
            yield
        except (sqlite3.OperationalError, OSError) as failure:
            raise SessionUnwritable(
                f"{self.path}: {failure}; make room, or make the folder writable, and run the same command again"
            ) from failure
        except (sqlite3.DatabaseError, msgspec.DecodeError) as failure:
            raise SessionCorrupt(f"{self.path}: {failure}; restore the journal from a copy") from failure


def _now() -> str:
    """Return the time in UTC as ISO 8601."""
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _to_json(detail: object) -> str:
    """Return a detail as JSON text."""
    return msgspec.json.encode(detail).decode()
