"""A complete session is one set of files that SHA256SUMS covers, whatever else reads the journal meanwhile."""

import shutil
import sqlite3
import subprocess
import sys
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path
from unittest import mock

import pytest

from faintfield.rig.errors import SessionUnwritable
from faintfield.rig.session import database, journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.verify import repair, verify
from tests.faults.capturing import FRAMES, SMALL_RIG, Operator, assert_complete, capture_small, frozen_plan
from tests.rig.session.forging import contents, flip, frame_files

SKIPPED = 4  # frames of the last step


def begin(folder: Path) -> sqlite3.Connection:
    """Begin a session, and read its journal as another program does that leaves its transaction open."""
    with open_session(folder, frozen_plan(SMALL_RIG)):
        pass
    reader = sqlite3.connect(f"{(folder / 'journal.sqlite').as_uri()}?mode=ro", uri=True, check_same_thread=False)
    reader.execute("BEGIN")
    reader.execute("SELECT * FROM event").fetchall()
    return reader


@pytest.fixture
def of_0_2_0(tmp_path: Path) -> Iterator[Path]:
    """A session whose last step was left out, sealed as by version 0.2.0 while a program read the journal."""
    folder = tmp_path / "session"
    operator = Operator({"step": ["go", "go", "skip"], "skipped": ["keep"]})
    with closing(begin(folder)):
        with mock.patch.object(journal, "leave_wal_mode"):
            capture_small(folder, operator=operator)
        yield folder


def assert_one_file(folder: Path) -> None:
    """A program that opens the journal for writing changes no byte, and finds all frames."""
    with closing(sqlite3.connect(folder / "journal.sqlite")) as db:
        assert db.execute('SELECT count(*) FROM "commit"').fetchone()[0] >= FRAMES - SKIPPED
        assert not list(folder.glob("journal.sqlite-*"))
    assert verify(folder).problems == ()


def test_frames_left_out_stay_so_when_sealing_failed(tmp_path: Path) -> None:
    folder = tmp_path / "session"
    operator = Operator({"step": ["go", "go", "skip"], "skipped": ["keep"]})
    with mock.patch.object(journal, "leave_wal_mode", side_effect=SessionUnwritable("held")):
        for again in (operator, Operator()):
            with pytest.raises(SessionUnwritable):
                capture_small(folder, operator=again)
            assert [prompt.key for prompt in again.prompts].count("skipped") == (again is operator)
    capture_small(folder)
    assert_one_file(folder)
    assert len(verify(folder).left_out) == SKIPPED


def test_sealing_waits_until_readers_are_gone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    reader = begin(tmp_path / "session")
    monkeypatch.setattr("faintfield.rig.session.database.time.sleep", lambda s: reader.close())
    capture_small(tmp_path / "session")
    assert_complete(tmp_path / "session")
    assert_one_file(tmp_path / "session")


def test_session_with_held_journal_is_sealed_later(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    folder = tmp_path / "session"
    begin(folder).close()
    hold = f"import sqlite3; db = sqlite3.connect({str(folder / 'journal.sqlite')!r}); " + (
        "db.execute('BEGIN'); db.execute('SELECT * FROM event').fetchall(); print(flush=True); input()"
    )
    monkeypatch.setattr(database, "_RETRY_S", 0.0)
    with subprocess.Popen([sys.executable, "-c", hold], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as reader:
        assert reader.stdout is not None
        reader.stdout.readline()
        user = rf"(process {reader.pid} \(python.*\)|another program)"  # where Linux does not list locks
        with pytest.raises(SessionUnwritable, match=rf"journal\.sqlite: is open in {user}, .* cannot be sealed; .*: c"):
            capture_small(folder)
        reader.communicate(b"\n")
    verdict = verify(folder)
    assert (verdict.problems, verdict.present, verdict.sealed) == ((), FRAMES, False)
    capture_small(folder)
    assert_complete(folder)


def test_records_outside_the_sums_are_repaired(of_0_2_0: Path) -> None:
    (problem,) = verify(of_0_2_0).problems
    assert "journal.sqlite-wal: holds records that SHA256SUMS does not cover" in problem
    assert "--repair" in problem
    copy = Path(shutil.copytree(of_0_2_0, of_0_2_0.parent / "copy"))  # which no program reads
    before = verify(copy)
    verdict = repair(copy)
    assert (verdict.problems, verdict.sealed, len(verdict.left_out)) == ((), True, SKIPPED)
    assert verdict.left_out == before.left_out
    assert_one_file(copy)
    sums = (copy / "set_aside" / "SHA256SUMS.0").read_bytes()
    assert sums == (of_0_2_0 / "SHA256SUMS").read_bytes()
    sealed = contents(copy)
    assert repair(copy) == verdict
    assert contents(copy) == sealed  # there is nothing more to do


def test_copy_without_the_wal_is_recognised(of_0_2_0: Path, tmp_path: Path) -> None:
    names = [line.split("  ")[1] for line in (of_0_2_0 / "SHA256SUMS").read_text().splitlines()]
    for name in ("SHA256SUMS", *names):
        (tmp_path / "copy" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(of_0_2_0 / name, tmp_path / "copy" / name)
    assert any("copy journal.sqlite-wal too" in problem for problem in verify(tmp_path / "copy").problems)


def test_damaged_session_is_not_repaired(of_0_2_0: Path) -> None:
    frame = frame_files(of_0_2_0)[0]
    flip(frame, frame.read_bytes(), 3000)
    before = contents(of_0_2_0)
    assert len(repair(of_0_2_0).problems) > 1
    assert {path: content for path, content in contents(of_0_2_0).items() if path.suffix != ".sqlite-shm"} == {
        path: content for path, content in before.items() if path.suffix != ".sqlite-shm"
    }


def test_repair_while_held_can_be_repeated(of_0_2_0: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(database, "_RETRY_S", 0.0)
    copy = Path(shutil.copytree(of_0_2_0, of_0_2_0.parent / "copy"))
    with closing(sqlite3.connect(copy / "journal.sqlite")) as reader:
        reader.execute("SELECT * FROM event").fetchall()
        with pytest.raises(SessionUnwritable, match="cannot be sealed"):
            repair(copy)
    assert not verify(copy).sealed
    verdict = repair(copy)
    assert (verdict.problems, verdict.sealed, len(verdict.left_out)) == ((), True, SKIPPED)
