"""The journal: whatever its file holds, it is read as it was written or refused."""

import shutil
import sqlite3
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.rig.errors import SessionCorrupt, SessionUnreadable, SessionUnwritable
from faintfield.rig.session import database
from faintfield.rig.session.journal import FrameRecord, Journal
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import FRAMES, capture_small
from tests.rig.session.forging import chain_again, columns, edit, flip, make_format_1, old_sessions

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


def content(path: Path) -> list[object]:
    """Return all that a journal says."""
    with Journal(path, read_only=True) as journal:
        return [journal.committed(), journal.uncommitted(), journal.events(), list(journal.traffic())]


@pytest.fixture
def journal_file(tmp_path: Path) -> Path:
    path = tmp_path / "journal.sqlite"
    write_journal(path)
    return path


@pytest.fixture(scope="module")
def interrupted(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the folder of a session of twelve frames that a stop has interrupted."""
    folder = tmp_path_factory.mktemp("interrupted") / "session"
    capture_small(folder)
    (folder / "SHA256SUMS").unlink()
    return folder


@pytest.fixture
def session(interrupted: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(interrupted, tmp_path / "session"))


def refused_everywhere(folder: Path) -> None:
    """Assert that nothing that reads or resumes a session uses its journal."""
    with pytest.raises(SessionCorrupt, match=r"journal\.sqlite.*; restore"):
        taken_frames(folder)
    with pytest.raises(SessionCorrupt, match=r"journal\.sqlite.*; restore"):
        capture_small(folder)


# --- The chain of hashes

# A value of each type that no row holds, given the present one
OTHER = {"INTEGER": "{0} + 1000", "TEXT": "{0} || ' '", "REAL": "{0} + 0.5", "BLOB": "CAST({0} || x'00' AS BLOB)"}
COLUMNS = [
    (table, name, kind)
    for table, names in {
        "event": "id:INTEGER at:TEXT kind:TEXT frame:INTEGER detail:TEXT",
        "intent": "id:INTEGER at:TEXT frame:INTEGER",
        "commit": "intent:INTEGER at:TEXT file:TEXT sha256:TEXT bytes:INTEGER detail:TEXT",
        "void": "intent:INTEGER at:TEXT why:TEXT",
        "traffic": "id:INTEGER at_s:REAL direction:TEXT data:BLOB",
        "chain": "id:INTEGER table:TEXT first:INTEGER last:INTEGER sha256:BLOB",
    }.items()
    for name, kind in (it.split(":") for it in names.split())
]


def test_the_columns_are_those_that_the_tests_edit(journal_file: Path) -> None:
    assert sorted(columns(journal_file)) == sorted(COLUMNS)


@pytest.mark.parametrize(("table", "name", "kind"), COLUMNS)
@pytest.mark.parametrize("row", ["min", "max"])
def test_an_edited_value_is_found(journal_file: Path, table: str, name: str, kind: str, row: str) -> None:
    value = OTHER[kind].format(f'ifnull("{name}", 0)')
    edit(journal_file, f'UPDATE "{table}" SET "{name}" = {value} WHERE rowid = (SELECT {row}(rowid) FROM "{table}")')
    with pytest.raises(SessionCorrupt, match=r"journal\.sqlite: .*; restore the journal from a copy"):
        Journal(journal_file, read_only=True)


@pytest.mark.parametrize(("table", "name", "kind"), [it for it in COLUMNS if it[0] != "chain"])
def test_an_edited_value_of_a_session_is_neither_verified_nor_resumed(
    session: Path, table: str, name: str, kind: str
) -> None:
    if table == "void":
        capture_again(session)
    value = OTHER[kind].format(f'ifnull("{name}", 0)')
    edit(
        session / "journal.sqlite",
        f'UPDATE "{table}" SET "{name}" = {value} WHERE rowid = (SELECT max(rowid) FROM "{table}")',
    )
    with pytest.raises(SessionCorrupt, match=r"journal\.sqlite"):
        verify(session)
    refused_everywhere(session)


def capture_again(session: Path) -> None:
    """Lose a frame, and take it again."""
    sorted((session / "frames").iterdir())[0].unlink()
    capture_small(session)
    (session / "SHA256SUMS").unlink()


@pytest.mark.parametrize("table", ["event", "intent", "commit", "void", "traffic", "chain"])
@pytest.mark.parametrize("row", ["min", "max"])
def test_a_removed_row_is_found(journal_file: Path, table: str, row: str) -> None:
    edit(journal_file, f'DELETE FROM "{table}" WHERE rowid = (SELECT {row}(rowid) FROM "{table}")')
    with pytest.raises(SessionCorrupt):
        Journal(journal_file)


@pytest.mark.parametrize("table", ["event", "intent", "traffic", "void"])
def test_rows_that_changed_places_are_found(journal_file: Path, table: str) -> None:
    edit(
        journal_file,
        *(f'UPDATE "{table}" SET rowid = {new} WHERE rowid = {old}' for old, new in ((1, -1), (2, 1), (-1, 2))),
    )
    with pytest.raises(SessionCorrupt):
        Journal(journal_file)


@pytest.mark.parametrize(
    "statement",
    [
        "INSERT INTO event VALUES (NULL, '', 'suspect', NULL, '{\"intents\": [1]}')",
        "INSERT INTO intent VALUES (NULL, '', 0)",
        "INSERT INTO void VALUES (4, '', 'forged')",
        "INSERT INTO traffic VALUES (NULL, 0.0, 'sent', x'00')",
    ],
)
def test_an_added_row_is_found(journal_file: Path, statement: str) -> None:
    edit(journal_file, statement)
    with pytest.raises(SessionCorrupt, match=r"rows, its chain"):
        Journal(journal_file)


def test_links_over_the_same_rows_again_and_again_end_soon(journal_file: Path) -> None:
    edit(journal_file, *('INSERT INTO chain SELECT NULL, "table", first, last, sha256 FROM chain' for _ in range(3)))
    with pytest.raises(SessionCorrupt):
        Journal(journal_file)


def test_the_chain_is_the_one_that_the_documents_describe(journal_file: Path) -> None:
    before = content(journal_file)
    chain_again(journal_file)
    assert content(journal_file) == before
    with Journal(journal_file) as journal:
        journal.event("more")
    assert len(content(journal_file)[2]) == len(before[2]) + 1  # type: ignore[arg-type]


def test_a_failed_entry_leaves_the_chain_whole(journal_file: Path) -> None:
    with Journal(journal_file) as journal:
        with pytest.raises(SessionCorrupt, match="UNIQUE"):
            journal.commit(journal.intend(0), "00001_x2.tiff", "1" * 64, 1, RECORD)
        journal.record(9.0, "sent", b"!")
        journal.event("after")
    assert content(journal_file)[1] == [(5, 0)]


# --- Names

NAMES = [
    "../../victim.txt",
    "/etc/hostname",
    "..",
    ".",
    "",
    "a/b",
    "a\\b",
    "a\0b",
    "line\nline",
    "x" * 201,
    "\u202etiff.exe",
]


@pytest.mark.parametrize("name", NAMES)
@pytest.mark.parametrize("version", [1, 2])
def test_a_name_that_leads_elsewhere_moves_nothing(session: Path, tmp_path: Path, name: str, version: int) -> None:
    victim = tmp_path / "victim.txt"
    victim.write_text("important")
    if version == 1:
        make_format_1(session)
    quoted = "||".join(f"char({ord(it)})" for it in name) or "''"
    edit(session / "journal.sqlite", f'UPDATE "commit" SET file = {quoted} WHERE intent = 3')
    if version == 2:
        chain_again(session / "journal.sqlite")
    before = sorted(tmp_path.rglob("*"))
    with pytest.raises(SessionCorrupt, match="is not the name of a frame; restore"):
        verify(session)
    refused_everywhere(session)
    assert victim.read_text() == "important"
    assert sorted(tmp_path.rglob("*")) == before


@pytest.mark.parametrize("file", ["00001_bright_0_r0_c1_x3.tiff", "00002_bright_0_r0_c2_x2.tiff", "00002_bright.tiff"])
def test_a_name_of_another_exposure_is_refused(session: Path, file: str) -> None:
    edit(session / "journal.sqlite", f"UPDATE \"commit\" SET file = '{file}' WHERE intent = 3")
    chain_again(session / "journal.sqlite")
    assert any("is not a frame of the plan" in problem for problem in verify(session).problems)
    refused_everywhere(session)


# --- Types and ranges

WRONG_VALUES = [
    ("intent", "frame", "'x'"),
    ("intent", "frame", "-1"),
    ("intent", "frame", "100000"),
    ("intent", "frame", "0.5"),
    ("intent", "frame", "9223372036854775807"),
    ("commit", "bytes", "-1"),
    ("commit", "bytes", "'many'"),
    ("commit", "sha256", "'f00'"),
    ("commit", "sha256", "zeroblob(64)"),
    ("commit", "file", "7"),
    ("commit", "detail", "'{'"),
    ("commit", "detail", "'[]'"),
    ("commit", "detail", "x'ff'"),
    ("commit", "detail", "CAST(x'ffff' AS TEXT)"),
    ("commit", "detail", '\'{"position_mm": [1, 2], "exposure_s": 7}\''),
    ("commit", "detail", "replace(hex(zeroblob(50000)), '0', '[')"),
    ("commit", "detail", "printf('%.*c', 20000000, 'x')"),
    ("void", "why", "zeroblob(3)"),
]
# Those that a strict table does not take
NOT_STORED = [
    ("intent", "frame", "'x'"),
    ("intent", "frame", "0.5"),
    ("commit", "bytes", "'many'"),
    ("commit", "sha256", "zeroblob(64)"),
    ("commit", "detail", "x'ff'"),
    ("void", "why", "zeroblob(3)"),
]


@pytest.mark.parametrize(("table", "name", "value"), WRONG_VALUES)
@pytest.mark.parametrize("version", [1, 2])
def test_a_value_of_a_wrong_type_or_size_is_refused(
    session: Path, table: str, name: str, value: str, version: int
) -> None:
    if table == "void":
        capture_again(session)
    if version == 1:
        make_format_1(session)
    statement = f'UPDATE "{table}" SET "{name}" = {value} WHERE rowid = (SELECT max(rowid) FROM "{table}")'
    if version == 2 and (table, name, value) in NOT_STORED:
        with pytest.raises(sqlite3.IntegrityError, match="cannot store"):
            edit(session / "journal.sqlite", statement)
        return
    edit(session / "journal.sqlite", statement)
    if version == 2:
        chain_again(session / "journal.sqlite")
    try:
        problems = verify(session).problems
    except SessionCorrupt as failure:
        problems = (str(failure),)
    assert problems
    refused_everywhere(session)


# --- What a file may declare

DECLARED = [
    "CREATE TRIGGER more AFTER INSERT ON intent BEGIN UPDATE \"commit\" SET file = '../../victim.txt'; END",
    "CREATE TRIGGER more AFTER UPDATE ON event BEGIN DELETE FROM event; END",
    "CREATE VIEW more AS SELECT * FROM event",
    "CREATE TABLE more (value)",
    "CREATE INDEX more ON event (kind)",
    "CREATE VIRTUAL TABLE more USING fts5(value)",
    "ALTER TABLE event ADD COLUMN more TEXT",
    "ALTER TABLE event RENAME COLUMN kind TO sort",
    "DROP TABLE void",
]


@pytest.mark.parametrize("statement", DECLARED)
@pytest.mark.parametrize("version", [1, 2])
def test_other_tables_triggers_and_views_are_refused(session: Path, statement: str, version: int) -> None:
    if version == 1:
        make_format_1(session)
    edit(session / "journal.sqlite", statement)
    with pytest.raises(SessionCorrupt, match="has other tables than a journal; restore"):
        verify(session)
    refused_everywhere(session)


def test_a_table_that_takes_the_place_of_a_view_is_refused(session: Path) -> None:
    edit(
        session / "journal.sqlite",
        "ALTER TABLE event RENAME TO hidden",
        "CREATE VIEW event AS SELECT * FROM hidden",
    )
    refused_everywhere(session)


def test_a_journal_of_another_format_than_its_plan_is_refused(session: Path) -> None:
    plan = (session / "plan.json").read_bytes()
    make_format_1(session)
    (session / "plan.json").write_bytes(plan)
    with pytest.raises(SessionCorrupt, match="has format 1, the plan 2; restore"):
        verify(session)
    refused_everywhere(session)


def test_a_rollback_journal_is_not_played_back(session: Path, tmp_path: Path) -> None:
    victim = tmp_path / "victim.txt"
    victim.write_text("important")
    (session / "journal.sqlite-journal").write_bytes(b"anything")
    with pytest.raises(SessionCorrupt, match=r"journal\.sqlite-journal: is not written by a capture; move it away"):
        verify(session)
    with pytest.raises(SessionCorrupt, match=r"is not written by a capture; move it away"):
        capture_small(session)


def test_the_wal_of_a_lost_journal_is_not_taken_for_a_new_one(tmp_path: Path) -> None:
    (tmp_path / "journal.sqlite-wal").write_bytes(b"left over")
    with pytest.raises(SessionCorrupt, match=r"is missing but journal\.sqlite-wal is not; restore"):
        Journal(tmp_path / "journal.sqlite", create=True)
    assert not (tmp_path / "journal.sqlite").exists()


def test_pages_that_lead_to_the_same_pages_again_and_again_end_soon(tmp_path: Path) -> None:
    path = tmp_path / "journal.sqlite"
    write_journal(path)
    make_bomb(path)
    with pytest.raises(SessionCorrupt, match="; restore"):
        Journal(path)


def make_bomb(path: Path, depth: int = 12, width: int = 300) -> None:
    """Put a tree of `depth` levels over the schema, in which every page leads `width` times to the same one below."""
    content = bytearray(path.read_bytes())
    size = int.from_bytes(content[16:18], "big")
    leaf = bytearray(content[:size])
    last = len(content) // size
    leaf[:size] = bytes(100) + leaf[100:]
    # The leaf is a copy of the schema's page; its header lies at the beginning of the page, not after that of the file
    leaf[:8] = leaf[100:108]
    cells = int.from_bytes(leaf[3:5], "big")
    leaf[8 : 8 + 2 * cells] = leaf[108 : 108 + 2 * cells]
    pages = [leaf]
    for level in range(depth):
        child = last + 1 + level
        offset = 100 if level == depth - 1 else 0
        page = bytearray(size)
        page[:offset] = content[:offset]
        cell = child.to_bytes(4, "big") + b"\x01"
        at = size - len(cell) * width
        page[at:] = cell * width
        page[offset : offset + 12] = (
            b"\x05\0\0" + width.to_bytes(2, "big") + at.to_bytes(2, "big") + b"\0" + child.to_bytes(4, "big")
        )
        for index in range(width):
            page[offset + 12 + 2 * index : offset + 14 + 2 * index] = (at + 5 * index).to_bytes(2, "big")
        pages.append(page)
    root = pages.pop()
    total = last + len(pages)
    root[28:32] = total.to_bytes(4, "big")
    path.write_bytes(root + content[size:] + b"".join(pages))


# --- Whose fault an error is

CODES = {
    sqlite3.SQLITE_FULL: "make room",
    sqlite3.SQLITE_IOERR_FSYNC: "check the disk",
    sqlite3.SQLITE_READONLY_DBMOVED: "make the folder writable",
    sqlite3.SQLITE_CANTOPEN: "make the folder writable",
    sqlite3.SQLITE_BUSY: "end the program that holds the journal",
    sqlite3.SQLITE_CORRUPT_VTAB: None,
    sqlite3.SQLITE_NOTADB: None,
    sqlite3.SQLITE_SCHEMA: None,
    sqlite3.SQLITE_ERROR: None,
    sqlite3.SQLITE_CONSTRAINT_CHECK: None,
    sqlite3.SQLITE_TOOBIG: None,
    sqlite3.SQLITE_INTERRUPT: None,
}


@pytest.mark.parametrize("code", CODES)
@pytest.mark.parametrize("kind", [sqlite3.OperationalError, sqlite3.DatabaseError])
def test_errors_are_classified_by_their_code(code: int, kind: type[sqlite3.Error]) -> None:
    failure = kind("it failed")
    failure.sqlite_errorcode = code
    remedy = CODES[code]
    for read_only, blames_system in ((True, SessionUnreadable), (False, SessionUnwritable)):
        with (
            pytest.raises(SessionCorrupt if remedy is None else blames_system) as caught,
            database.translate_sqlite_errors(Path("journal.sqlite"), read_only=read_only),
        ):
            raise failure
        expected = "restore the journal from a copy" if remedy is None else "folder" if read_only else remedy
        assert expected in str(caught.value).rpartition("; ")[2]


def test_a_wrong_use_of_sqlite_is_no_failure_of_the_file(journal_file: Path) -> None:
    journal = Journal(journal_file)
    journal.close()
    with pytest.raises(sqlite3.ProgrammingError):
        journal.events()


# --- Flipped bits


def content_or_failure(path: Path) -> list[object] | str:
    """Return all that a journal says, or why it is refused as damaged; any other failure is an error of the test."""
    try:
        return content(path)
    except SessionCorrupt as failure:
        return str(failure)


def is_refused(path: Path, expected: list[object]) -> bool:
    """Return whether a journal is refused; assert that it is read as written otherwise."""
    found = content_or_failure(path)
    if isinstance(found, list):
        assert found == expected
        return False
    assert path.name in found
    assert "; restore" in found
    return True


def flips(content: bytes, each: int) -> list[int]:
    """Return the bits to flip: all of the header, one of every other byte that is not 0, and each `each`-th of all."""
    generator = np.random.default_rng(1)
    of_bytes = [8 * index + int(generator.integers(8)) for index, byte in enumerate(content) if byte][::2]
    return sorted({*range(8 * 100), *of_bytes, *range(0, 8 * len(content), each)})


def test_any_flipped_bit_is_found_or_does_no_harm(journal_file: Path) -> None:
    expected, written = content(journal_file), journal_file.read_bytes()
    bits = flips(written, each=1997)
    refused = 0
    for bit in bits:
        flip(journal_file, written, bit)
        refused += is_refused(journal_file, expected)
    assert len(bits) > 2000
    assert refused > 1000


@pytest.mark.campaign
def test_any_of_many_flipped_bits_is_found_or_does_no_harm(journal_file: Path) -> None:
    expected, written = content(journal_file), journal_file.read_bytes()
    for bit in flips(written, each=61):
        flip(journal_file, written, bit)
        is_refused(journal_file, expected)


# --- Sessions of the earlier version


def test_a_complete_session_of_the_earlier_version_is_in_order(tmp_path: Path) -> None:
    folder = old_sessions(tmp_path) / "complete"
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.missing, verdict.sealed) == (FRAMES, (), True)
    assert len(taken_frames(folder)) == FRAMES
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        assert journal.format == read_plan(folder).format == 1


def test_an_interrupted_session_of_the_earlier_version_is_resumed(tmp_path: Path) -> None:
    folder = old_sessions(tmp_path) / "interrupted"
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, len(verdict.missing)) == (9, FRAMES - 9)
    assert verdict.interrupted == ("00009_dark_scene_0_r1_c2_x10.tiff",)
    capture_small(folder)
    verdict = verify(folder)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed, verdict.interrupted) == (FRAMES, True, ())
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        assert journal.format == 1


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
@pytest.mark.parametrize("statement", range(1, 12))
def test_an_interrupt_at_any_statement_leaves_a_sound_journal(
    statement: int, after: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    path = tmp_path / "journal.sqlite"
    opened: list[Interruptible] = []

    def connect(*words: Any, **options: Any) -> Interruptible:
        opened.append(Interruptible(database.connect(*words, **options)))
        return opened[-1]

    with monkeypatch.context() as patch:
        patch.setattr("faintfield.rig.session.journal.connect", connect)
        journal = Journal(path, create=True)
    journal.event("first")
    journal.record(1.0, "sent", b"before")
    opened[0].statements_left, opened[0].after = statement, after
    interrupted = False
    try:
        journal.event("second")
    except KeyboardInterrupt:
        interrupted = True
    assert interrupted == (statement <= 10), "the statements of one entry and its traffic were counted wrongly"
    opened[0].statements_left = 0
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
