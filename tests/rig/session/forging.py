"""Edit sessions as somebody might who means harm."""

import os
import sqlite3
import tarfile
from contextlib import closing
from pathlib import Path


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


def old_sessions(folder: Path, version: int) -> Path:
    """Unpack two sessions of an earlier format, `complete` and `interrupted`, and return their folder."""
    with tarfile.open(Path(__file__).parent / f"format_{version}.tar.xz") as archive:
        archive.extractall(folder, filter="data")
    return folder


def flip(path: Path, content: bytes, bit: int) -> None:
    """Write `content` with one bit flipped."""
    flipped = bytearray(content)
    flipped[bit // 8] ^= 1 << bit % 8
    path.write_bytes(flipped)
