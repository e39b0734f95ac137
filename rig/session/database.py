"""Open the database of a journal, and check all that it holds before any of it is used.

The file may be damaged, or made to do harm. So triggers, views and functions of the schema are switched off, memory and
work are bounded, the schema must be the one that is written here, and errors due to the file are told from those due to
the system.
"""

import os
import sqlite3
import stat
import time
from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress
from functools import cache, partial
from pathlib import Path

import msgspec

from faintfield.rig.errors import SessionCorrupt, SessionUnreadable, SessionUnwritable, in_one_line
from faintfield.rig.session.disk import require_kind, translate_errors, write_new

# Format of the sessions that are begun now. In format 1 the tables are not strict; format 2 has a chain of hashes over
# all rows, which is not read any more.
FORMAT = 3

_TABLES = """
CREATE TABLE event (
    id INTEGER PRIMARY KEY, at TEXT NOT NULL, kind TEXT NOT NULL, frame INTEGER, detail TEXT NOT NULL) STRICT;
CREATE TABLE intent (
    id INTEGER PRIMARY KEY, at TEXT NOT NULL, frame INTEGER NOT NULL) STRICT;
CREATE TABLE "commit" (
    intent INTEGER PRIMARY KEY REFERENCES intent (id), at TEXT NOT NULL, file TEXT NOT NULL UNIQUE,
    sha256 TEXT NOT NULL, bytes INTEGER NOT NULL, detail TEXT NOT NULL) STRICT;
CREATE TABLE void (
    intent INTEGER PRIMARY KEY REFERENCES intent (id), at TEXT NOT NULL, why TEXT NOT NULL) STRICT;
CREATE TABLE traffic (
    id INTEGER PRIMARY KEY, at_s REAL NOT NULL, direction TEXT NOT NULL, data BLOB NOT NULL) STRICT;
"""
_CHAIN = """
CREATE TABLE chain (
    id INTEGER PRIMARY KEY, "table" TEXT NOT NULL, first INTEGER NOT NULL, last INTEGER NOT NULL,
    sha256 BLOB NOT NULL) STRICT;
"""
_KEY = "id INTEGER PRIMARY KEY"
_OLD_TABLES = _TABLES.replace(" STRICT;", ";").replace(f"{_KEY},", f"{_KEY} AUTOINCREMENT,")
SCHEMAS = {1: _OLD_TABLES, 2: _TABLES + _CHAIN, FORMAT: _TABLES}

# Limits of what a journal may hold. A week of serial traffic takes a third of a gigabyte. The longest value is a list
# of skipped frames, less than a megabyte.
MAX_JOURNAL_BYTES = 4 * 2**30
_MAX_VALUE_BYTES = 2**24

# Instructions of SQLite's virtual machine that the checks may take per byte of the journal, and besides. They take
# about a half; a file in which many pages lead to the same ones would take years.
_STEPS_PER_BYTE = 5
_STEPS = 1_000_000

# Bytes 18 and 19 of a file, the versions of the format that a writer and a reader must know: in WAL mode, as during a
# capture, and in a complete session.
_WAL_VERSIONS, _SINGLE_FILE_VERSIONS = b"\x02\x02", b"\x01\x01"
# Tries to leave WAL mode while another program reads the journal, and the time between them in s.
_TRIES, _RETRY_S = 50, 0.2

# What to do when the system is at fault, by SQLite's primary result code; all other codes blame the file.
_REMEDIES = {
    sqlite3.SQLITE_FULL: "make room",
    sqlite3.SQLITE_IOERR: "make room, and check the disk",
    sqlite3.SQLITE_READONLY: "make the folder writable",
    sqlite3.SQLITE_CANTOPEN: "make the folder writable",
    sqlite3.SQLITE_PERM: "make the folder writable",
    sqlite3.SQLITE_BUSY: "end the program that holds the journal",
    sqlite3.SQLITE_LOCKED: "end the program that holds the journal",
    sqlite3.SQLITE_PROTOCOL: "use a file system on which files can be locked",
    sqlite3.SQLITE_NOMEM: "free memory",
}


def create_database(path: Path) -> None:
    """Write an empty journal, whole or not at all; raises `SessionCorrupt` if there are remains of an earlier one."""
    for remains in _companions(path):
        if os.path.lexists(remains):
            raise SessionCorrupt(f"{path}: is missing but {remains.name} is not; restore the journal from a copy")
    with closing(sqlite3.connect(":memory:")) as empty:
        empty.executescript(SCHEMAS[FORMAT])
        content = bytearray(empty.serialize())
    content[18:20] = _WAL_VERSIONS
    write_new(path, content)


def connect(path: Path, *, read_only: bool) -> sqlite3.Connection:
    """Open the database of a journal; `check_database` has to follow.

    Raises `SessionCorrupt` if it is missing, not a file of its own, or larger than any journal.
    """
    wal, shared_memory, rollback = _companions(path)
    with translate_errors(path, read_only=read_only):
        for file in (path, wal, shared_memory):
            require_kind(file, stat.S_ISREG, "file")
        if not path.exists():
            raise SessionCorrupt(f"{path}: the journal is missing; restore it, or begin a new session")
        # In WAL mode SQLite writes none, and what it reads there can make it delete any file
        if os.path.lexists(rollback):
            raise SessionCorrupt(f"{rollback}: is not written by a capture; move it away")
        if (size := _size(path)) > MAX_JOURNAL_BYTES:
            raise SessionCorrupt(f"{path}: holds {size} bytes, at most {MAX_JOURNAL_BYTES}; restore it from a copy")
        with path.open("rb") as opened:
            header = opened.read(20)
        if header[:16] != b"SQLite format 3\0" or header[18:] not in (_WAL_VERSIONS, _SINGLE_FILE_VERSIONS):
            raise SessionCorrupt(f"{path}: is not a journal; restore it from a copy")
    mode = "rw" if not read_only else "ro" if wal.exists() else "ro&immutable=1"
    db = sqlite3.connect(
        f"{path.absolute().as_uri()}?mode={mode}", uri=True, isolation_level=None, check_same_thread=False
    )
    db.text_factory = partial(str, encoding="utf-8", errors="backslashreplace")  # damaged text is text, too
    db.setconfig(sqlite3.SQLITE_DBCONFIG_TRUSTED_SCHEMA, False)
    db.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_TRIGGER, False)
    db.setconfig(sqlite3.SQLITE_DBCONFIG_ENABLE_VIEW, False)
    db.setconfig(sqlite3.SQLITE_DBCONFIG_DEFENSIVE, True)
    db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, _MAX_VALUE_BYTES)
    db.setlimit(sqlite3.SQLITE_LIMIT_ATTACHED, 0)
    return db


def check_database(db: sqlite3.Connection, path: Path) -> int:
    """Check the schema, the pages, the types and the references of a journal, and return its format.

    Raises `SessionCorrupt` if a check fails.
    """
    budget = iter(range(_STEPS // 1000 + _STEPS_PER_BYTE * _size(path) // 1000))
    db.set_progress_handler(lambda: next(budget, None) is None, 1000)
    try:
        db.execute("PRAGMA cell_size_check = ON")
        schema = _schema(db)
        formats = [number for number, text in SCHEMAS.items() if schema == _schema_of(text)]
        if not formats:
            raise SessionCorrupt(f"{path}: has other tables than a journal; restore the journal from a copy")
        damage = str(db.execute("PRAGMA integrity_check(1)").fetchone()[0])
        if damage != "ok":
            raise SessionCorrupt(f"{path}: {' '.join(damage.split())}; restore the journal from a copy")
        if db.execute("PRAGMA foreign_key_check").fetchone() is not None:
            raise SessionCorrupt(f"{path}: an exposure that it names is missing; restore the journal from a copy")
    finally:
        db.set_progress_handler(None, 0)
    return formats[0]


def enter_wal_mode(db: sqlite3.Connection) -> None:
    """Let the database have a WAL, which `leave_wal_mode` may have ended; no rollback journal is written."""
    if db.execute("PRAGMA journal_mode").fetchone() != ("wal",):
        db.execute("PRAGMA journal_mode = MEMORY")
    db.execute("PRAGMA journal_mode = WAL")


def leave_wal_mode(db: sqlite3.Connection, path: Path) -> None:
    """Move all records into the one file of the database, whose WAL ends; no rollback journal is written.

    Raises `SessionUnwritable` if another program keeps the journal open, which is only waited for a few seconds.
    """
    for attempts_left in reversed(range(_TRIES)):
        try:
            db.execute("PRAGMA journal_mode = MEMORY")
        except sqlite3.OperationalError as failure:
            if failure.sqlite_errorcode & 0xFF != sqlite3.SQLITE_BUSY:
                raise
            if not attempts_left:
                raise SessionUnwritable(
                    f"{path}: is open in {_other_user(path)}, so that the session cannot be sealed; what was committed "
                    "is safe: close it there, and run the same command again"
                ) from failure
            time.sleep(_RETRY_S)
        else:
            break
    if wal_bytes(path):
        raise SessionUnwritable(f"{path}: its WAL does not end; check the disk, and run the same command again")


def wal_bytes(path: Path) -> int:
    """Return the size of the WAL beside a database: of records that are not in the database file itself."""
    wal = _companions(path)[0]
    return wal.stat().st_size if wal.exists() else 0


def _other_user(path: Path) -> str:
    """Return another process that holds a lock on a file, as Linux lists them; the others are not known."""
    with suppress(OSError, ValueError, IndexError):
        for fields in map(str.split, Path("/proc/locks").read_text("utf-8").splitlines()):
            if fields[1] == "POSIX" and fields[5].endswith(f":{path.stat().st_ino}") and int(fields[4]) != os.getpid():
                return f"process {fields[4]} ({Path('/proc', fields[4], 'comm').read_text('utf-8').strip()})"
    return "another program"


@contextmanager
def translate_sqlite_errors(path: Path, *, read_only: bool) -> Iterator[None]:
    """Raise `SessionUnwritable` or `SessionUnreadable` where the system is at fault, `SessionCorrupt` for the file."""
    try:
        yield
    except sqlite3.Error as failure:
        code = getattr(failure, "sqlite_errorcode", None)
        if code is None:  # a wrong use of the library
            raise
        remedy = _REMEDIES.get(code & 0xFF)
        if remedy is None:
            raise SessionCorrupt(f"{path}: {in_one_line(failure)}; restore the journal from a copy") from failure
        if read_only:
            raise SessionUnreadable(
                f"{path}: cannot be read ({in_one_line(failure)}); allow the folder to be written, or copy the session"
            ) from failure
        raise SessionUnwritable(
            f"{path}: {in_one_line(failure)}; what was committed is safe: {remedy}, and run the same command again"
        ) from failure
    except (msgspec.DecodeError, RecursionError, UnicodeDecodeError) as failure:
        # A message of SQLite quotes what it finds in the file, which need not be text
        raise SessionCorrupt(f"{path}: {failure}; restore the journal from a copy") from failure


def _companions(path: Path) -> tuple[Path, Path, Path]:
    """Return the files that SQLite may keep beside a database: the WAL, its index, and a rollback journal."""
    wal, index, rollback = (path.with_name(f"{path.name}-{suffix}") for suffix in ("wal", "shm", "journal"))
    return wal, index, rollback


def _size(path: Path) -> int:
    return path.stat().st_size + wal_bytes(path)


def _schema(db: sqlite3.Connection) -> list[tuple[str, ...]]:
    return db.execute("SELECT type, name, tbl_name, sql FROM sqlite_schema ORDER BY type, name").fetchmany(100)


@cache
def _schema_of(text: str) -> list[tuple[str, ...]]:
    with closing(sqlite3.connect(":memory:")) as db:
        db.executescript(text)
        return _schema(db)
