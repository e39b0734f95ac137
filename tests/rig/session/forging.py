"""Edit journals as somebody might who means harm."""

import hashlib
import sqlite3
import tarfile
from contextlib import closing
from functools import partial
from pathlib import Path
from tempfile import TemporaryDirectory

import msgspec

JOURNAL = "journal.sqlite"
TABLES = ("event", "intent", "commit", "void", "traffic")


def edit(journal: Path, *statements: str) -> None:
    """Run statements on a journal; triggers and references do not hinder them."""
    with closing(sqlite3.connect(journal, isolation_level=None)) as db:
        for statement in statements:
            db.execute(statement)
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def chain_again(journal: Path) -> None:
    """Compute the chain of a journal anew, one link for each row, as anybody can who reads how it is computed."""
    with closing(sqlite3.connect(journal, isolation_level=None)) as db:
        db.text_factory = partial(str, encoding="utf-8", errors="backslashreplace")
        db.execute("DELETE FROM chain")
        head = bytes(32)
        for table in TABLES:
            for number, *_ in db.execute(f'SELECT rowid, * FROM "{table}" ORDER BY rowid').fetchall():
                row = db.execute(f'SELECT * FROM "{table}" WHERE rowid = ?', (number,)).fetchone()
                encoded = msgspec.msgpack.encode((table, number, number)) + msgspec.msgpack.encode(row)
                head = hashlib.sha256(head + encoded).digest()
                db.execute("INSERT INTO chain VALUES (NULL, ?, ?, ?, ?)", (table, number, number, head))
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def old_sessions(folder: Path) -> Path:
    """Unpack two sessions captured by an earlier version, `complete` and `interrupted`, and return their folder."""
    with tarfile.open(Path(__file__).parent / "format_1.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


def make_format_1(session: Path) -> None:
    """Turn a session into what the earlier version would have written."""
    with (
        TemporaryDirectory() as folder,
        closing(sqlite3.connect(old_sessions(Path(folder)) / "complete" / JOURNAL)) as old,
    ):
        schema = [sql for (sql,) in old.execute("SELECT sql FROM sqlite_schema WHERE name IN (?, ?, ?, ?, ?)", TABLES)]
    plan = session / "plan.json"
    plan.write_text(plan.read_text().replace('"format": 2', '"format": 1'))
    begun = msgspec.json.encode({"plan_sha256": hashlib.sha256(plan.read_bytes()).hexdigest()}).decode()
    with closing(sqlite3.connect(session / JOURNAL, isolation_level=None)) as db:
        rows = {table: db.execute(f'SELECT * FROM "{table}"').fetchall() for table in TABLES}
        for table in ("chain", *reversed(TABLES)):
            db.execute(f'DROP TABLE "{table}"')
        for sql in schema:
            db.execute(sql)
        for table in TABLES:
            for row in rows[table]:
                db.execute(f'INSERT INTO "{table}" VALUES ({", ".join("?" * len(row))})', row)
        db.execute("UPDATE event SET detail = ? WHERE kind = 'begun'", (begun,))
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def columns(journal: Path) -> list[tuple[str, str, str]]:
    """Return table, name and type of every column of a journal."""
    with closing(sqlite3.connect(journal)) as db:
        tables = [name for (name,) in db.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
        return [
            (table, name, kind) for table in tables for _, name, kind, *_ in db.execute(f'PRAGMA table_info("{table}")')
        ]


def flip(path: Path, content: bytes, bit: int) -> None:
    """Write `content` with one bit flipped."""
    flipped = bytearray(content)
    flipped[bit // 8] ^= 1 << bit % 8
    path.write_bytes(flipped)
