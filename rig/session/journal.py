"""Keep the journal of a session: a database of all that happened during a capture.

The journal is SQLite in WAL mode with synchronous=FULL: once a call returns, what it recorded survives a power cut.
Rows are only added, and ordered by their numbers; times are for people, since clocks can be set back.
"""

import threading
from collections.abc import Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, Self

import msgspec
from msgspec import Meta, Struct

from faintfield.rig.cameras.protocol import Metadata
from faintfield.rig.errors import SessionCorrupt
from faintfield.rig.files import is_plain_name
from faintfield.rig.plan import MAX_FRAMES
from faintfield.rig.session.database import (
    check_database,
    connect,
    create_database,
    enter_wal_mode,
    leave_wal_mode,
    translate_sqlite_errors,
)
from faintfield.rig.stages.protocol import Point
from faintfield.rig.stages.transport import Direction

_COMMITTED = """
SELECT intent.id, intent.frame, "commit".file, "commit".sha256, "commit".bytes, "commit".detail, void.why
FROM "commit" JOIN intent ON intent.id = "commit".intent LEFT JOIN void ON void.intent = intent.id ORDER BY intent.id
"""
_UNCOMMITTED = 'SELECT id, frame FROM intent WHERE id NOT IN (SELECT intent FROM "commit") ORDER BY id'
_EVENTS = "SELECT id, at, kind, frame, detail FROM event WHERE kind = ifnull(?, kind) ORDER BY id"
_TO_BE_RETAKEN = """
SELECT "commit".intent FROM "commit" JOIN intent AS old ON old.id = "commit".intent
JOIN intent AS new ON new.frame = old.frame WHERE new.id = ? AND "commit".intent NOT IN (SELECT intent FROM void)
"""
# What the columns of these queries hold; SQLite keeps any type in any column of a journal of format 1.
type _Number = Annotated[int, Meta(ge=1)]
type _Index = Annotated[int, Meta(ge=0)]
type _Sha256 = Annotated[str, Meta(pattern=r"\A[0-9a-f]{64}\Z")]
type _CommittedRow = tuple[_Number, _Index, str, _Sha256, _Index, str, str | None]
type _UncommittedRow = tuple[_Number, _Index]
type _EventRow = tuple[_Number, str, str, _Index | None, str]
type _TrafficRow = tuple[float, Direction, bytes]
# More rows are in no journal, and they would fill the memory: each frame is taken once or a few times.
_MAX_ROWS = 10 * MAX_FRAMES
# Records of serial traffic held in memory before they are written, as each write costs a flush of the disk; any other
# entry writes them earlier.
_MAX_PENDING_TRAFFIC = 2000


class FrameRecord(Struct, frozen=True):
    """Entry of the journal about a frame, without its file.

    Attributes
    ----------
    position_mm : Point
        Position that the stage reported before the exposure.
    exposure_s : float
        Exposure time.
    camera : dict
        Metadata from the camera.
    checks, warnings : dict of float, tuple of str
        Values and warnings of `rig.capture.checks.Findings`.
    lights : tuple of str, optional
        Names of the lights that were on; None where a person saw to the light.
    """

    position_mm: Point
    exposure_s: float
    camera: Metadata = {}
    checks: dict[str, float] = {}
    warnings: tuple[str, ...] = ()
    lights: tuple[str, ...] | None = None

    @property
    def temperature_c(self) -> float | None:
        """Temperature of the sensor in °C, None if the camera does not report it."""
        value = self.camera.get("temperature_c")
        return value if isinstance(value, int | float) else None


class CommittedFrame(Struct, frozen=True):
    """A frame that was taken and is on disk.

    Attributes
    ----------
    intent : int
        Number of the exposure within the session.
    frame : int
        Index of the frame in the plan.
    file, sha256, bytes : str, str, int
        Name within `frames/`, its SHA-256, and its size.
    record : FrameRecord
        Entry of the journal.
    void : str, optional
        Reason why the frame is void although its file stays.
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
    """Detail of an event `suspect`: the exposures after which no check says that the stage kept its scale."""

    intents: tuple[int, ...]


class Sealed(Struct, frozen=True):
    """Detail of the event `sealed`: the frames that were left out, by their index in the plan."""

    skipped: tuple[int, ...]


class RoundsEnded(Struct, frozen=True):
    """Detail of the event `rounds_ended`: a step, by its index, needs no more than these rounds.

    `sigma_e` is the predicted noise of a sample after them, in electrons, None if it is not known; `by_operator` says
    that a person ended the step.
    """

    step: int
    rounds: _Number
    sigma_e: float | None
    by_operator: bool = False


class RoundsLimited(Struct, frozen=True):
    """Detail of the event `rounds_limited`: the operator wants no more rounds of a step than these."""

    step: int
    rounds: _Number


class Journal:
    """An open journal, which is also the `TrafficLog` of the stage; `read_only` opens it on a write-protected medium.

    Raises `SessionCorrupt` if it is missing, unless it is to be created, damaged or not what a capture wrote, and
    `SessionUnreadable` or `SessionUnwritable` if the system does not let it be opened.
    """

    def __init__(self, path: Path, *, create: bool = False, read_only: bool = False) -> None:
        self.path = path
        self._read_only = read_only
        self._traffic: list[tuple[float, str, bytes]] = []
        self._lock = threading.RLock()  # a frame is recorded in another thread while the stage moves
        if create and not path.exists():
            create_database(path)
        with self._translate_errors():
            self._db = connect(path, read_only=read_only)
        try:
            with self._translate_errors():
                self._db.execute("BEGIN")  # one state of the journal for all checks
                self.format = check_database(self._db, self.path)
                self._db.execute("COMMIT")
                if not read_only:  # prefer durability to speed
                    enter_wal_mode(self._db)
                    self._db.execute("PRAGMA synchronous = FULL")
                    self._db.execute("PRAGMA foreign_keys = ON")
        except BaseException:
            self._db.close()
            raise

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write pending traffic, and close."""
        try:
            if self._traffic:
                self._write_traffic()
        finally:
            self._db.close()

    def finish(self) -> None:
        """Close the journal for good: all that it holds is in one file, and no program has it open.

        Raises `SessionUnwritable` if another program has, and goes on having it for some seconds.
        """
        if self._traffic:
            self._write_traffic()
        with self._translate_errors():
            leave_wal_mode(self._db, self.path)
        self.close()

    def record(self, at_s: float, direction: Direction, data: bytes) -> None:
        """Record serial traffic, which reaches the disk with the next entry."""
        self._traffic.append((at_s, direction, data))
        if len(self._traffic) >= _MAX_PENDING_TRAFFIC:
            self._write_traffic()

    def _write_traffic(self) -> None:
        with self._transaction():
            pass

    def event(self, kind: str, *, frame: int | None = None, **detail: object) -> None:
        """Record an event."""
        self.add_events(kind, [detail], frame)

    def add_events(self, kind: str, details: Sequence[object], frame: int | None = None) -> None:
        """Record events of a kind, all or none."""
        if details:
            with self._transaction():
                self._add("event", *((None, _now(), kind, frame, _to_json(detail)) for detail in details))

    def intend(self, frame: int) -> int:
        """Record that `frame` will be taken now, and return the number of the exposure."""
        with self._transaction():
            return self._add("intent", (None, _now(), frame))

    def commit(self, intent: int, file: str, sha256: str, size_bytes: int, record: FrameRecord) -> None:
        """Record that the frame of `intent` is complete on disk; earlier takes of it become void."""
        with self._transaction():
            for (retaken,) in self._db.execute(_TO_BE_RETAKEN, (intent,)).fetchall():
                self._add("void", (retaken, _now(), "retaken"))
            self._add("commit", (intent, _now(), file, sha256, size_bytes, _to_json(record)))

    def void(self, intents: list[int], why: str) -> None:
        """Record that committed frames, which are not void yet, are void, and will be taken again."""
        with self._transaction():
            for intent in intents:
                self._add("void", (intent, _now(), why))

    def committed(self) -> list[CommittedFrame]:
        """Return all committed frames in the order of their exposures."""
        with self._translate_errors():
            frames = [
                CommittedFrame(intent, frame, file, sha256, size, msgspec.json.decode(record, type=FrameRecord), void)
                for intent, frame, file, sha256, size, record, void in self._read(_CommittedRow, _COMMITTED)
            ]
        for name in (frame.file for frame in frames):
            if not is_plain_name(name):
                raise SessionCorrupt(
                    f"{self.path}: {name!r:.60} is no name of a frame; restore the journal from a copy"
                )
        return frames

    def uncommitted(self) -> list[tuple[int, int]]:
        """Return the number and the frame of every exposure that was not committed."""
        return self._read(_UncommittedRow, _UNCOMMITTED)

    def next_intent(self) -> int:
        """Return the number that the next exposure will have."""
        ((last,),) = self._read(tuple[_Index], "SELECT coalesce(max(id), 0) FROM intent")
        return int(last) + 1

    def events(self, kind: str | None = None) -> list[JournalEvent]:
        """Return the events in order, all or those of one kind."""
        with self._translate_errors():
            return [
                JournalEvent(number, at, kind, frame, msgspec.json.decode(detail, type=dict[str, object]))
                for number, at, kind, frame, detail in self._read(_EventRow, _EVENTS, kind)
            ]

    def details[T](self, kind: str, layout: type[T]) -> list[T]:
        """Return the details of the events of a kind, in order, each as an instance of `layout`."""
        with self._translate_errors():
            return [msgspec.convert(event.detail, layout) for event in self.events(kind)]

    def traffic(self) -> Iterator[tuple[float, str, bytes]]:
        """Yield the traffic of the stage as time in s, direction and bytes."""
        with self._translate_errors():
            for row in self._db.execute("SELECT at_s, direction, data FROM traffic ORDER BY id"):
                yield msgspec.convert(row, _TrafficRow)

    def _read(self, layout: Any, query: str, *arguments: object) -> list[Any]:
        with self._translate_errors():
            rows = [msgspec.convert(row, layout) for row in self._db.execute(query, arguments).fetchmany(_MAX_ROWS + 1)]
        if len(rows) > _MAX_ROWS:
            raise SessionCorrupt(f"{self.path}: holds more than {_MAX_ROWS} rows of a kind; restore it from a copy")
        return rows

    def _add(self, table: str, *rows: tuple[object, ...]) -> int:
        insert = f'INSERT INTO "{table}" VALUES ({", ".join("?" * len(rows[0]))})'
        return [self._db.execute(insert, row).lastrowid or 0 for row in rows][-1]

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        """Run the block as one transaction, which also writes the pending traffic; an interrupt may come anywhere."""
        written: list[tuple[float, str, bytes]] = []
        with self._lock, self._translate_errors():
            try:
                if self._db.in_transaction:  # an interrupt came before it could be rolled back
                    self._db.execute("ROLLBACK")
                self._db.execute("BEGIN IMMEDIATE")
                yield
                pending = self._traffic[:]  # the stage may add to it meanwhile
                if pending:
                    self._add("traffic", *((None, *entry) for entry in pending))
                written, self._traffic[: len(pending)] = pending, []
                self._db.execute("COMMIT")
            except BaseException:
                if self._db.in_transaction:  # else the commit was done, or nothing begun
                    self._traffic[:0] = written
                    self._db.execute("ROLLBACK")
                raise

    def _translate_errors(self) -> AbstractContextManager[None]:
        return translate_sqlite_errors(self.path, read_only=self._read_only)


def _now() -> str:
    return datetime.now(UTC).isoformat(timespec="milliseconds")


def _to_json(detail: object) -> str:
    return msgspec.json.encode(detail).decode()
