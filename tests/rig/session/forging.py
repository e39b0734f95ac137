"""Edit sessions as somebody might who means harm."""

import hashlib
import os
import sqlite3
import tarfile
from contextlib import closing
from functools import partial
from pathlib import Path

import msgspec

TABLES = ("event", "intent", "commit", "void", "traffic")


def frame_files(folder: Path) -> list[Path]:
    return sorted((folder / "frames").iterdir())


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


def put_pipe(path: Path) -> None:
    os.mkfifo(path)


def put_link_out(path: Path) -> None:
    """Link to `victim` beside the session of the file or folder."""
    path.symlink_to(path.parent.parent / "victim")


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
        db.execute("BEGIN")
        db.execute("DELETE FROM chain")
        head = bytes(32)
        for table in TABLES:
            for number, *_ in db.execute(f'SELECT rowid, * FROM "{table}" ORDER BY rowid').fetchall():
                row = db.execute(f'SELECT * FROM "{table}" WHERE rowid = ?', (number,)).fetchone()
                encoded = msgspec.msgpack.encode((table, number, number)) + msgspec.msgpack.encode(row)
                head = hashlib.sha256(head + encoded).digest()
                db.execute("INSERT INTO chain VALUES (NULL, ?, ?, ?, ?)", (table, number, number, head))
        db.execute("COMMIT")
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")


def old_sessions(folder: Path) -> Path:
    """Unpack two sessions captured by an earlier version, `complete` and `interrupted`, and return their folder."""
    with tarfile.open(Path(__file__).parent / "format_1.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


def flip(path: Path, content: bytes, bit: int) -> None:
    """Write `content` with one bit flipped."""
    flipped = bytearray(content)
    flipped[bit // 8] ^= 1 << bit % 8
    path.write_bytes(flipped)
