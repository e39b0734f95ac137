"""The session on disk: all changes are noticed, nothing is overwritten or deleted."""

import os
import sqlite3
from collections.abc import Callable
from datetime import UTC, datetime, timedelta
from pathlib import Path
from unittest import mock

import numpy as np
import pytest

from faintfield.rig.capture.survey import survey
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import SessionBusy, SessionCorrupt, SessionUnwritable
from faintfield.rig.plan import CapturePlan, planned_frames
from faintfield.rig.session import journal as journal_module
from faintfield.rig.session.disk import set_aside, write_new
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, SMALL_RIG, capture_small, in_process
from tests.patience import HANG_S


def frame_files(folder: Path) -> list[Path]:
    return sorted((folder / "frames").iterdir())


def test_a_complete_session_is_in_order(sealed: Path) -> None:
    before = {path: path.read_bytes() for path in sealed.rglob("*") if path.is_file()}
    verdict = verify(sealed)
    assert verdict.problems == ()
    assert (verdict.planned, verdict.present, verdict.missing, verdict.sealed) == (FRAMES, FRAMES, (), True)
    assert before == {path: path.read_bytes() for path in sealed.rglob("*") if path.is_file()}
    lines = (sealed / "SHA256SUMS").read_text().splitlines()
    assert len(lines) == FRAMES + 2
    assert all(len(line.split("  ")[0]) == 64 for line in lines)


def test_frames_follow_the_plan() -> None:
    frames = planned_frames(read_plan_of_small_rig())
    assert [frame.number for frame in frames] == list(range(FRAMES))
    assert [(frame.kind, frame.stop.node) for frame in frames[:6]] == [
        ("bright", node) for node in [(0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 0)]
    ]
    assert [(frame.exposure_s, frame.repeat) for frame in frames[-4:]] == [(0.1, 0), (0.1, 1), (1.0, 0), (1.0, 1)]
    assert len({frame.name for frame in frames}) == FRAMES


def read_plan_of_small_rig() -> CapturePlan:
    return survey(open_rig(SMALL_RIG), SMALL_RIG).plan


@pytest.mark.parametrize("seed", range(3))
@pytest.mark.parametrize("name", ["plan.json", "journal.sqlite", "SHA256SUMS", "frame"])
def test_any_flipped_bit_is_found(sealed: Path, name: str, seed: int) -> None:
    generator = np.random.default_rng(seed)
    path = generator.choice(np.array(frame_files(sealed))) if name == "frame" else sealed / name
    content = bytearray(path.read_bytes())
    content[generator.integers(len(content))] ^= 1 << generator.integers(8)
    path.write_bytes(content)
    try:
        problems = verify(sealed).problems
    except SessionCorrupt as failure:
        problems = (str(failure),)
    assert problems
    assert any(path.name in problem for problem in problems)


@pytest.mark.parametrize("with_sums", [True, False])
def test_missing_and_extra_files_are_found(sealed: Path, with_sums: bool) -> None:
    if not with_sums:
        (sealed / "SHA256SUMS").unlink()
    gone, renamed = frame_files(sealed)[3:5]
    gone.unlink()
    renamed.rename(sealed / "frames" / "stranger.tiff")
    verdict = verify(sealed)
    for expected in (f"{gone.name}: is missing", f"{renamed.name}: is missing", "stranger.tiff: is not in the journal"):
        assert any(expected in problem for problem in verdict.problems)
    assert verdict.present == FRAMES - 2
    assert not any("does not agree" in problem for problem in verdict.problems) or with_sums


def test_frames_that_changed_places_are_found(unsealed: Path) -> None:
    first, second = frame_files(unsealed)[:2]
    one, other = first.read_bytes(), second.read_bytes()
    first.write_bytes(other)
    second.write_bytes(one)
    assert len(verify(unsealed).problems) == 2


@pytest.mark.parametrize("with_sums", [True, False])
def test_an_edited_plan_is_found_and_not_resumed(sealed: Path, with_sums: bool) -> None:
    if not with_sums:
        (sealed / "SHA256SUMS").unlink()
    plan = sealed / "plan.json"
    plan.write_text(plan.read_text().replace("50.0", "51.0"))
    assert any("plan.json" in problem for problem in verify(sealed).problems)
    (sealed / "SHA256SUMS").unlink(missing_ok=True)
    with pytest.raises(SessionCorrupt, match=r"plan\.json: was changed after the session was begun; restore it"):
        capture_small(sealed)


def test_verify_reads_a_write_protected_session(sealed: Path) -> None:
    for path in (*sealed.rglob("*"), sealed):
        path.chmod(0o500 if path.is_dir() else 0o400)
    process = in_process(verify_without_rights, sealed)
    process.join(HANG_S)
    assert process.exitcode == 0


def verify_without_rights(folder: Path) -> None:
    """Verify without the privileges that override permissions."""
    from tests.faults.test_capture_faults import drop_rights

    drop_rights()
    assert verify(folder).problems == ()


@pytest.mark.parametrize("name", ["plan.json", "journal.sqlite"])
def test_a_lost_plan_or_journal_is_not_replaced(unsealed: Path, name: str) -> None:
    (unsealed / name).unlink()
    with pytest.raises(SessionCorrupt):
        verify(unsealed)
    with pytest.raises(SessionCorrupt, match="; "):
        capture_small(unsealed)
    assert len(frame_files(unsealed)) == FRAMES


def test_a_second_capture_is_refused(unsealed: Path) -> None:
    with open_session(unsealed, None):
        for _ in range(2):
            process = in_process(refused, unsealed)
            process.join(HANG_S)
            assert process.exitcode == 0
        with pytest.raises(SessionBusy, match=f"process {os.getpid()}"):
            verify(unsealed)
    assert verify(unsealed).problems == ()


def refused(folder: Path) -> None:
    """Fail unless the session is refused."""
    with pytest.raises(SessionBusy, match="a capture is under way"), open_session(folder, None):
        pass


def test_a_folder_with_other_things_is_no_place_for_a_session(tmp_path: Path) -> None:
    (tmp_path / "thesis.tex").write_text("important")
    with pytest.raises(SessionCorrupt, match=r"holds thesis\.tex and no session"):
        capture_small(tmp_path)
    with pytest.raises(SessionCorrupt, match="holds no session"), open_session(tmp_path / "other", None):
        pass


@pytest.mark.parametrize("altered", [None, "plan.json", "frames"])
def test_a_complete_session_is_not_written_to(sealed: Path, altered: str | None) -> None:
    if altered is not None:  # whatever else is wrong with it
        path = frame_files(sealed)[0] if altered == "frames" else sealed / altered
        path.write_bytes(b"altered" + path.read_bytes())
    before = {path: path.read_bytes() if path.is_file() else None for path in sealed.rglob("*")}
    with pytest.raises(SessionCorrupt, match="is complete and is not written to"):
        capture_small(sealed)
    assert before == {path: path.read_bytes() if path.is_file() else None for path in sealed.rglob("*")}
    assert altered is not None or verify(sealed).problems == ()


def test_orphans_are_set_aside_and_nothing_is_deleted(unsealed: Path) -> None:
    frames = unsealed / "frames"
    for name in ("stranger.tiff", "00001_bright_0_r0_c1_x99.tiff.part"):
        (frames / name).write_bytes(b"orphan")
    (unsealed / "set_aside").mkdir()
    (unsealed / "set_aside" / "stranger.tiff.0").write_bytes(b"older orphan")
    with open_session(unsealed, None) as resumed:
        assert resumed.missing() == []
        assert {event.detail["file"] for event in resumed.journal.events("set_aside")} == {
            "stranger.tiff", "00001_bright_0_r0_c1_x99.tiff.part",
        }  # fmt: skip
    kept = {path.name: path.read_bytes() for path in (unsealed / "set_aside").iterdir()}
    assert kept == {
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


def test_a_frame_is_never_overwritten(tmp_path: Path) -> None:
    path = tmp_path / "frame.tiff"
    write_new(path, b"one")
    with pytest.raises(SessionUnwritable, match="never overwritten"):
        write_new(path, b"two")
    assert path.read_bytes() == b"one"
    assert set_aside(path, tmp_path / "aside").read_bytes() == b"one"


def test_order_does_not_depend_on_the_clock(tmp_path: Path) -> None:
    backwards = iter(datetime(2030, 1, 1, tzinfo=UTC) - timedelta(days=day) for day in range(10_000))
    with mock.patch.object(journal_module, "datetime") as clock:
        clock.now.side_effect = lambda zone: next(backwards)
        capture_small(tmp_path / "session")
        assert clock.now.call_count > 2 * FRAMES
    assert verify(tmp_path / "session").problems == ()
    with Journal(tmp_path / "session" / "journal.sqlite", read_only=True) as journal:
        events = journal.events()
        assert [event.at for event in events] == sorted((event.at for event in events), reverse=True)
        assert [it.frame for it in journal.committed()] == list(range(FRAMES))


def test_the_journal_is_as_durable_as_sqlite_can_be(tmp_path: Path) -> None:
    with Journal(tmp_path / "journal.sqlite", create=True) as journal:
        pragma: Callable[[str], object] = lambda name: journal._db.execute(f"PRAGMA {name}").fetchone()[0]  # noqa: SLF001, E731
        assert pragma("journal_mode") == "wal"
        assert pragma("synchronous") == 2  # FULL
        journal.record(1.5, "sent", b"?\n\xff")
        journal.event("any", number=1)
        other = sqlite3.connect(tmp_path / "journal.sqlite")
        assert other.execute("SELECT at_s, direction, data FROM traffic").fetchall() == [(1.5, "sent", b"?\n\xff")]
        other.close()


def test_the_stage_s_traffic_is_in_the_journal(sealed: Path) -> None:
    with Journal(sealed / "journal.sqlite", read_only=True) as journal:
        sent = b"".join(data for _, direction, data in journal.traffic() if direction == "sent")
        received = b"".join(data for _, direction, data in journal.traffic() if direction == "received")
    assert b"$H" in sent
    assert sent.count(b"$J=") >= FRAMES - 4
    assert b"Grbl 1.1" in received
