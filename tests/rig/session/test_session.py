"""The session on disk: all changes are noticed, nothing is overwritten or deleted."""

import os
import sqlite3
from datetime import UTC, datetime, timedelta
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import SessionBusy, SessionCorrupt, SessionUnwritable
from faintfield.rig.session import journal as journal_module
from faintfield.rig.session import session as session_module
from faintfield.rig.session.disk import set_aside, write_new
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, SMALL_RIG, capture_small, frozen_plan
from tests.rig.session.forging import contents, flip, frame_files


@pytest.mark.parametrize("lock", [True, False])
def test_complete_session_is_sound_and_unchanged_by_verify(sealed: Path, lock: bool) -> None:
    if not lock:  # as in a copy
        (sealed / "lock").unlink()
    before = contents(sealed)
    verdict = verify(sealed)
    assert verdict.problems == ()
    assert (verdict.planned, verdict.present, verdict.missing, verdict.sealed) == (FRAMES, FRAMES, (), True)
    assert before == contents(sealed)
    lines = (sealed / "SHA256SUMS").read_text().splitlines()
    assert len(lines) == FRAMES + 2
    assert all(len(line.split("  ")[0]) == 64 for line in lines)


@pytest.mark.parametrize("name", ["plan.json", "journal.sqlite", "SHA256SUMS", "frame"])
def test_any_flipped_bit_is_noticed(sealed: Path, name: str) -> None:
    for seed in range(3):
        generator = np.random.default_rng(seed)
        path = generator.choice(np.array(frame_files(sealed))) if name == "frame" else sealed / name
        content = path.read_bytes()
        flip(path, content, int(generator.integers(8 * len(content))))
        try:
            problems = verify(sealed).problems
        except SessionCorrupt as failure:
            problems = (str(failure),)
        assert any(path.name in problem for problem in problems), seed
        path.write_bytes(content)


@pytest.mark.parametrize("with_sums", [True, False])
def test_missing_and_extra_files_are_noticed(sealed: Path, with_sums: bool) -> None:
    if not with_sums:
        (sealed / "SHA256SUMS").unlink()
    deleted, renamed = frame_files(sealed)[3:5]
    deleted.unlink()
    renamed.rename(sealed / "frames" / "stranger.tiff")
    verdict = verify(sealed)
    for problem in (
        f"{deleted.name}: is missing",
        f"{renamed.name}: is missing",
        "stranger.tiff: is not in the journal",
    ):
        assert any(problem in text for text in verdict.problems)
    assert verdict.present == FRAMES - 2
    assert any("does not agree" in problem for problem in verdict.problems) is with_sums


def test_exchanged_frames_are_noticed(unsealed: Path) -> None:
    first, second = frame_files(unsealed)[:2]
    content = first.read_bytes()
    first.write_bytes(second.read_bytes())
    second.write_bytes(content)
    assert len(verify(unsealed).problems) == 2


@pytest.mark.parametrize("with_sums", [True, False])
def test_edited_plan_is_noticed_and_not_resumed(sealed: Path, with_sums: bool) -> None:
    if not with_sums:
        (sealed / "SHA256SUMS").unlink()
    plan = sealed / "plan.json"
    plan.write_text(plan.read_text().replace("50.0", "51.0"))
    assert any("plan.json" in problem for problem in verify(sealed).problems)
    (sealed / "SHA256SUMS").unlink(missing_ok=True)
    with pytest.raises(SessionCorrupt, match=r"plan\.json: was changed after the session was begun; restore it"):
        capture_small(sealed)


@pytest.mark.parametrize("name", ["plan.json", "journal.sqlite"])
def test_lost_plan_or_journal_is_not_replaced(unsealed: Path, name: str) -> None:
    (unsealed / name).unlink()
    with pytest.raises(SessionCorrupt):
        verify(unsealed)
    with pytest.raises(SessionCorrupt, match="; "):
        capture_small(unsealed)
    assert len(frame_files(unsealed)) == FRAMES


def test_second_capture_is_refused(unsealed: Path) -> None:
    with open_session(unsealed, None):
        for _ in range(2):  # the first refusal leaves the lock as it is
            with pytest.raises(SessionBusy, match="a capture is under way"), open_session(unsealed, None):
                pass
        with pytest.raises(SessionBusy, match=f"process {os.getpid()}"):
            verify(unsealed)
    assert verify(unsealed).problems == ()


def test_folder_of_other_things_is_refused(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("important")
    with pytest.raises(SessionCorrupt, match=r"holds thesis\.tex and no session"):
        capture_small(tmp_path)
    with pytest.raises(SessionCorrupt, match="holds no session"), open_session(tmp_path / "empty", None):
        pass


@pytest.mark.parametrize("altered", [None, "plan.json", "frames"])
def test_complete_session_is_not_written_to(sealed: Path, altered: str | None) -> None:
    if altered is not None:  # whatever else is wrong with it
        path = frame_files(sealed)[0] if altered == "frames" else sealed / altered
        path.write_bytes(b"altered" + path.read_bytes())
    before = contents(sealed)
    with pytest.raises(SessionCorrupt, match="is complete and is not written to"):
        capture_small(sealed)
    assert before == contents(sealed)


def test_orphans_are_set_aside_not_deleted(unsealed: Path) -> None:
    for name in ("stranger.tiff", "00001_bright_0_r0_c1_x99.tiff.part"):
        (unsealed / "frames" / name).write_bytes(b"orphan")
    (unsealed / "set_aside").mkdir()
    (unsealed / "set_aside" / "stranger.tiff.0").write_bytes(b"older orphan")
    with open_session(unsealed, None) as resumed:
        assert resumed.missing() == []
        assert {event.detail["file"] for event in resumed.journal.events("set_aside")} == {
            "stranger.tiff", "00001_bright_0_r0_c1_x99.tiff.part",
        }  # fmt: skip
    assert {path.name: path.read_bytes() for path in (unsealed / "set_aside").iterdir()} == {
        "stranger.tiff.0": b"older orphan",
        "stranger.tiff.1": b"orphan",
        "00001_bright_0_r0_c1_x99.tiff.part.0": b"orphan",
    }


def test_damaged_and_lost_frames_are_taken_again(unsealed: Path) -> None:
    damaged, lost = frame_files(unsealed)[2], frame_files(unsealed)[5]
    damaged.write_bytes(b"damaged")
    lost.unlink()
    with open_session(unsealed, None) as resumed:
        assert [frame.number for frame in resumed.missing()] == [2, 5]
    capture_small(unsealed)
    verdict = verify(unsealed)
    assert verdict.problems == ()
    assert (verdict.present, verdict.sealed) == (FRAMES, True)
    assert (unsealed / "set_aside" / f"{damaged.name}.0").read_bytes() == b"damaged"


def test_frame_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "frame.tiff"
    write_new(path, b"first")
    with pytest.raises(SessionUnwritable, match="never overwritten"):
        write_new(path, b"second")
    assert path.read_bytes() == b"first"
    assert set_aside(path, tmp_path / "aside").read_bytes() == b"first"


def test_failed_write_releases_the_picture(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    contents: list[memoryview] = []

    def fail(path: Path, content: memoryview) -> None:
        contents.append(content)
        raise SessionUnwritable(f"{path}: the disk is full")

    with open_session(tmp_path / "session", frozen_plan(SMALL_RIG)) as session:
        frame = session.missing()[0]
        monkeypatch.setattr(session_module, "write_new", fail)
        with pytest.raises(SessionUnwritable):
            session.write(frame, session.intend(frame), Exposure(".tiff", pixels=np.zeros((4, 4), np.uint16)))
    with pytest.raises(ValueError, match="released"):  # else Python complains when the failure is gone
        bytes(contents[0])


def test_interrupted_write_leaves_no_part(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("os.fsync", mock.Mock(side_effect=KeyboardInterrupt))
    with pytest.raises(KeyboardInterrupt):
        write_new(tmp_path / "plan.json", b"{}")
    assert not list(tmp_path.iterdir())


def test_order_does_not_depend_on_the_clock(tmp_path: Path) -> None:
    backwards = iter(datetime(2030, 1, 1, tzinfo=UTC) - timedelta(days=day) for day in range(10_000))
    with mock.patch.object(journal_module, "datetime") as clock:
        clock.now.side_effect = lambda zone: next(backwards)
        capture_small(tmp_path / "session")
        assert clock.now.call_count > 2 * FRAMES
    assert verify(tmp_path / "session").problems == ()
    with Journal(tmp_path / "session" / "journal.sqlite", read_only=True) as journal:
        times = [event.at for event in journal.events()]
        assert times == sorted(times, reverse=True)
        assert [committed.frame for committed in journal.committed()] == list(range(FRAMES))


def test_journal_is_as_durable_as_sqlite_allows(tmp_path: Path) -> None:
    with Journal(tmp_path / "journal.sqlite", create=True) as journal:
        pragmas = [journal._db.execute(f"PRAGMA {name}").fetchone()[0] for name in ("journal_mode", "synchronous")]  # noqa: SLF001
        assert pragmas == ["wal", 2]  # FULL
        journal.record(1.5, "sent", b"?\n\xff")
        journal.event("any", number=1)
        reader = sqlite3.connect(tmp_path / "journal.sqlite")
        assert reader.execute("SELECT at_s, direction, data FROM traffic").fetchall() == [(1.5, "sent", b"?\n\xff")]
        reader.close()
