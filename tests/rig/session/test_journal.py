"""The journal: whatever its file holds, it is read as it was written or refused."""

import re
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.rig.errors import SessionCorrupt, SessionUnreadable, SessionUnwritable
from faintfield.rig.session import database
from faintfield.rig.session.database import FORMAT
from faintfield.rig.session.journal import FrameRecord, Journal
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import FRAMES, capture_small
from tests.rig.session.forging import edit, flip, old_sessions

RECORD = FrameRecord(Point(1.0, 2.0), 0.1)


def write_journal(path: Path) -> None:
    """Write a journal with rows in every table."""
    with Journal(path, create=True) as journal:
        journal.event("begun", plan_sha256="0" * 64)
        for number in range(3):
            journal.record(0.5 + number, "sent", b"?\n")
            journal.record(0.75 + number, "received", b"<Idle>\xff")
            intent = journal.intend(number)
            journal.commit(intent, f"0000{number}_x{intent}.tiff", f"{number}" * 64, 100 + number, RECORD)
        journal.event("prompt", frame=2, answer="go")
        journal.void([1], "taken from a doubtful position")
        journal.void([2], "altered or gone")
        journal.commit(journal.intend(2), "00002_x4.tiff", "4" * 64, 104, RECORD)


def content(path: Path) -> list[list[Any]]:
    """Return all that a journal says."""
    with Journal(path, read_only=True) as journal:
        return [journal.committed(), journal.uncommitted(), journal.events(), list(journal.traffic())]


@pytest.fixture
def journal_file(tmp_path: Path) -> Path:
    path = tmp_path / "journal.sqlite"
    write_journal(path)
    return path


def assert_refused(folder: Path, words: str = r"journal\.sqlite.*; restore") -> None:
    """Assert that nothing that reads or resumes a session uses its journal."""
    for use in (verify, taken_frames, capture_small):
        with pytest.raises(SessionCorrupt, match=words):
            use(folder)


def test_session_of_changed_journal_is_not_used(unsealed: Path) -> None:
    edit(unsealed / "journal.sqlite", "DELETE FROM event WHERE rowid = 1")
    assert verify(unsealed).problems == ("plan.json: is not the plan that the session was begun with",)
    with pytest.raises(SessionCorrupt, match="is empty but there are frames; restore"):
        capture_small(unsealed)


def test_failed_entry_leaves_earlier_ones(journal_file: Path) -> None:
    with Journal(journal_file) as journal:
        with pytest.raises(SessionCorrupt, match="UNIQUE"):
            journal.commit(journal.intend(0), "00001_x2.tiff", "1" * 64, 1, RECORD)
        journal.record(9.0, "sent", b"!")
        journal.event("after")
    assert content(journal_file)[1] == [(5, 0)]


def forged(unsealed: Path, version: int, statement: str) -> Path:
    """Return a session whose journal was edited."""
    session = unsealed if version == FORMAT else old_sessions(unsealed.parent / "old", version) / "complete"
    (session / "SHA256SUMS").unlink(missing_ok=True)
    edit(session / "journal.sqlite", statement)
    return session


@pytest.mark.parametrize("name", ["../../victim.txt", "line\nline"])
@pytest.mark.parametrize("version", [1, FORMAT])
def test_file_name_outside_the_session_moves_nothing(unsealed: Path, tmp_path: Path, name: str, version: int) -> None:
    (tmp_path / "victim.txt").write_text("important")
    quoted = "||".join(f"char({ord(character)})" for character in name)
    session = forged(unsealed, version, f'UPDATE "commit" SET file = {quoted} WHERE intent = 3')
    before = sorted(tmp_path.rglob("*"))
    assert_refused(session, "is no name of a frame; restore")
    assert (tmp_path / "victim.txt").read_text() == "important"
    assert sorted(tmp_path.rglob("*")) == before


def test_name_of_another_exposure_is_refused(unsealed: Path) -> None:
    forged(unsealed, FORMAT, "UPDATE \"commit\" SET file = '00001_bright_0_r0_c1_x3.tiff' WHERE intent = 3")
    assert any("is not a frame of the plan" in problem for problem in verify(unsealed).problems)
    for use in (taken_frames, capture_small):
        with pytest.raises(SessionCorrupt, match=r"journal\.sqlite.*; restore"):
            use(unsealed)


WRONG_VALUES = [
    (FORMAT, "intent", "frame = -1"),
    (FORMAT, "commit", "sha256 = 'f00'"),
    (FORMAT, "commit", "detail = '[]'"),
    (FORMAT, "commit", "detail = CAST(x'ffff' AS TEXT)"),
    (FORMAT, "commit", "detail = replace(hex(zeroblob(50000)), '0', '[')"),
    (FORMAT, "commit", "detail = printf('%.*c', 20000000, 'x')"),
    (1, "intent", "frame = 'x'"),
    (1, "commit", "bytes = 0.5"),
]


@pytest.mark.parametrize(("version", "table", "change"), WRONG_VALUES)
def test_value_of_wrong_type_or_size_is_refused(unsealed: Path, version: int, table: str, change: str) -> None:
    last = f'WHERE rowid = (SELECT max(rowid) FROM "{table}")'
    assert_refused(forged(unsealed, version, f'UPDATE "{table}" SET {change} {last}'))


@pytest.mark.parametrize(
    "statement",
    [
        "CREATE TRIGGER more AFTER INSERT ON intent BEGIN UPDATE \"commit\" SET file = '../../victim.txt'; END",
        "ALTER TABLE event RENAME COLUMN kind TO sort",
        "DROP TABLE void",
    ],
)
def test_other_tables_and_triggers_are_refused(unsealed: Path, statement: str) -> None:
    edit(unsealed / "journal.sqlite", statement)
    assert_refused(unsealed, "has other tables than a journal; restore")


def test_rollback_journal_is_not_played_back(unsealed: Path) -> None:
    (unsealed / "journal.sqlite-journal").write_bytes(b"anything")
    for use in (verify, capture_small):
        with pytest.raises(SessionCorrupt, match=r"sqlite-journal: is not written by a capture; move it away"):
            use(unsealed)


def test_wal_of_a_lost_journal_is_not_used(tmp_path: Path) -> None:
    (tmp_path / "journal.sqlite-wal").write_bytes(b"left over")
    with pytest.raises(SessionCorrupt, match=r"is missing but journal\.sqlite-wal is not; restore"):
        Journal(tmp_path / "journal.sqlite", create=True)
    assert not (tmp_path / "journal.sqlite").exists()


def test_only_checks_at_opening_are_limited(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_STEPS", 0)
    monkeypatch.setattr(database, "_STEPS_PER_BYTE", 0)
    path = tmp_path / "journal.sqlite"
    with Journal(path, create=True) as journal:
        for number in range(300):
            journal.event("warning", message=str(number))
        assert len(list(journal.events("warning"))) == 300
    with pytest.raises(SessionCorrupt, match="; restore"):
        Journal(path)


@pytest.mark.parametrize(
    ("code", "remedy"),
    [
        (sqlite3.SQLITE_FULL, "make room"),
        (sqlite3.SQLITE_IOERR_FSYNC, "check the disk"),
        (sqlite3.SQLITE_BUSY, "end the program that holds the journal"),
        (sqlite3.SQLITE_CORRUPT_VTAB, None),
        (sqlite3.SQLITE_TOOBIG, None),
    ],
)
def test_error_code_tells_system_from_file(code: int, remedy: str | None) -> None:
    failure = sqlite3.OperationalError("it failed")
    failure.sqlite_errorcode = code
    for read_only, blames_system in ((True, SessionUnreadable), (False, SessionUnwritable)):
        with (
            pytest.raises(SessionCorrupt if remedy is None else blames_system) as caught,
            database.translate_sqlite_errors(Path("journal.sqlite"), read_only=read_only),
        ):
            raise failure
        expected = "restore the journal from a copy" if remedy is None else "folder" if read_only else remedy
        assert expected in str(caught.value).rpartition("; ")[2]


@pytest.mark.parametrize("count", [100, pytest.param(2000, marks=pytest.mark.deep)])
def test_journal_with_flipped_bit_is_read_or_refused(journal_file: Path, count: int) -> None:
    expected, written = content(journal_file), journal_file.read_bytes()
    generator = np.random.default_rng(1)
    filled = np.flatnonzero(np.frombuffer(written, np.uint8))  # most bytes are 0, and unused
    header, anywhere = np.arange(100), generator.choice(len(written), count // 2)
    flipped_bytes = np.concatenate([header, generator.choice(filled, count), anywhere])
    bits = 8 * flipped_bytes + generator.integers(8, size=len(flipped_bytes))
    messages: list[str] = []
    for bit in bits.tolist():
        flip(journal_file, written, bit)
        try:
            entries = content(journal_file)
        except SessionCorrupt as failure:
            messages.append(str(failure))
        else:
            assert [len(rows) for rows in entries] == [len(rows) for rows in expected]
    assert all(re.search(r"journal\.sqlite.*; restore", message) for message in messages)
    assert len(messages) > 0.1 * len(bits)


@pytest.mark.parametrize("version", [1, 2])
def test_complete_session_of_earlier_version_is_whole(tmp_path: Path, version: int) -> None:
    folder = old_sessions(tmp_path, version) / "complete"
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.missing, verdict.sealed) == (FRAMES, (), True)
    assert len(taken_frames(folder)) == FRAMES
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        assert journal.format == read_plan(folder).format == version


@pytest.mark.parametrize("version", [1, 2])
def test_interrupted_session_of_earlier_version_is_resumed(tmp_path: Path, version: int) -> None:
    folder = old_sessions(tmp_path, version) / "interrupted"
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, len(verdict.missing)) == (9, FRAMES - 9)
    assert verdict.interrupted == ("00009_dark_scene_0_r1_c2_x10.tiff",)
    capture_small(folder)
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed, verdict.interrupted) == (FRAMES, True, ())
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        assert journal.format == version


class Interruptible:
    """A connection at whose n-th statement from now on Ctrl-C is pressed, before or after it takes effect."""

    def __init__(self, db: sqlite3.Connection) -> None:
        self._db = db
        self.statements_left = 0
        self.after = False

    def __getattr__(self, name: str) -> object:
        return getattr(self._db, name)

    def execute(self, *words: Any) -> sqlite3.Cursor:
        self.statements_left -= 1
        if self.statements_left == 0 and not self.after:
            raise KeyboardInterrupt
        cursor = self._db.execute(*words)
        if self.statements_left == 0:
            raise KeyboardInterrupt
        return cursor


@pytest.mark.parametrize("after", [False, True], ids=["before", "after"])
def test_interrupt_at_any_statement_leaves_sound_journal(
    after: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    connections: list[Interruptible] = []

    def connect(*words: Any, **options: Any) -> Interruptible:
        connections.append(Interruptible(database.connect(*words, **options)))
        return connections[-1]

    for statement in range(1, 6):
        path = tmp_path / f"{statement}.sqlite"
        with monkeypatch.context() as patch:
            patch.setattr("faintfield.rig.session.journal.connect", connect)
            journal = Journal(path, create=True)
        journal.event("first")
        journal.record(1.0, "sent", b"before")
        connections[-1].statements_left, connections[-1].after = statement, after
        interrupted = False
        try:
            journal.event("second")
        except KeyboardInterrupt:
            interrupted = True
        assert interrupted == (statement <= 4), "the statements of one entry and its traffic were counted wrongly"
        connections[-1].statements_left = 0
        journal.record(2.0, "sent", b"later")
        journal.close()
        with Journal(path) as again:
            kinds = [event.kind for event in again.events()]
            assert kinds in (["first"], ["first", "second"])
            assert interrupted or kinds == ["first", "second"]
            assert [data for _, _, data in again.traffic()] == [b"before", b"later"]
            again.event("third")
        with Journal(path, read_only=True) as last:
            assert [event.kind for event in last.events()] == [*kinds, "third"]
