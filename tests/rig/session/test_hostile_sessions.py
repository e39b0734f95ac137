"""A session folder that is broken or hostile: a named failure, no hang, and nothing outside the folder is touched."""

import errno
import fcntl
import os
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import SessionBusy, SessionCorrupt, SessionUnreadable, SessionUnwritable
from faintfield.rig.files import is_plain_name
from faintfield.rig.plan import MAX_FRAMES
from faintfield.rig.session.disk import lock_session
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, capture_small, drop_rights, in_process
from tests.patience import HANG_S
from tests.rig.session.forging import contents, frame_files, put_link_out, put_pipe

PUT = [put_pipe, put_link_out]

type Put = Callable[[Path], None]


@pytest.mark.parametrize("put", PUT)
@pytest.mark.parametrize("name", ["lock", "plan.json", "journal.sqlite", "journal.sqlite-wal"])
def test_pipe_or_link_for_a_file_is_refused(unsealed: Path, tmp_path: Path, name: str, put: Put) -> None:
    victim = tmp_path / "victim"
    victim.write_text("important")
    (unsealed / name).unlink(missing_ok=True)
    put(unsealed / name)
    for use in (verify, capture_small):
        with pytest.raises((SessionCorrupt, SessionUnreadable, SessionUnwritable), match=name):
            use(unsealed)
    assert victim.read_text() == "important"
    assert len(frame_files(unsealed)) == FRAMES


@pytest.mark.parametrize("put", PUT)
@pytest.mark.parametrize("name", ["frames", "set_aside"])
def test_pipe_or_link_for_a_folder_is_refused(unsealed: Path, tmp_path: Path, name: str, put: Put) -> None:
    victim = tmp_path / "victim"
    if name == "frames":
        (unsealed / name).rename(victim)
    else:
        victim.mkdir()
        (unsealed / "frames" / "orphan").write_bytes(b"orphan")
    put(unsealed / name)
    before = contents(victim)
    for use in (verify, taken_frames, capture_small) if name == "frames" else (capture_small,):
        with pytest.raises(SessionCorrupt, match=f"{name}: is not a folder of the session itself; "):
            use(unsealed)
    assert contents(victim) == before


@pytest.mark.parametrize("put", PUT)
def test_pipe_or_link_for_frame_is_set_aside(unsealed: Path, put: Put) -> None:
    (unsealed / "victim").write_text("important")
    frame = frame_files(unsealed)[4]
    frame.unlink()
    put(frame)
    verdict = verify(unsealed)
    (problem,) = verdict.problems
    assert frame.name in problem
    assert verdict.present == FRAMES - 1
    capture_small(unsealed)
    assert os.path.lexists(unsealed / "set_aside" / f"{frame.name}.0")
    assert (unsealed / "victim").read_text() == "important"
    assert verify(unsealed).problems == ()


def test_link_for_a_partial_file_is_not_followed(tmp_path: Path) -> None:
    victim, folder = tmp_path / "victim", tmp_path / "session"
    victim.write_text("important")
    folder.mkdir()
    for name in ("plan.json", "SHA256SUMS"):
        (folder / name).unlink(missing_ok=True)
        (folder / f"{name}.part").symlink_to(victim)
        capture_small(folder)
        assert victim.read_text() == "important"
        assert verify(folder).problems == ()


@pytest.mark.parametrize("name", [b"\xff\xfe.tiff", b"line\nline.tiff", b"x" * 255])
def test_orphan_of_any_name_is_set_aside(unsealed: Path, name: bytes) -> None:
    Path(os.fsdecode(os.path.join(os.fsencode(unsealed / "frames"), name))).write_bytes(b"orphan")
    assert len(verify(unsealed).problems) == 1
    capture_small(unsealed)
    assert [path.read_bytes() for path in (unsealed / "set_aside").iterdir()] == [b"orphan"]
    assert verify(unsealed).problems == ()


def test_plain_names_are_told_from_paths() -> None:
    for name in ("a", "00001_bright_0_r0_c1_x2.tiff", "x" * 200, "..a", "a..", ".hidden", "a b"):
        assert is_plain_name(name)
    for name in ("", ".", "..", "/", "../a", "a\\b", "a\0b", "a\n", "\x7f", "é", 201 * "x"):
        assert not is_plain_name(name)


@pytest.mark.parametrize("suffix", ["/../../victim", ".tiff" * 60])
def test_suffix_that_leads_elsewhere_is_refused(unsealed: Path, suffix: str) -> None:
    with open_session(unsealed, None) as session:
        frame = session.frames[0]
        with pytest.raises(SessionUnwritable, match="is no suffix of a file; "):
            session.write(frame, session.intend(frame), Exposure(suffix, content=b"raw"))
    assert len(frame_files(unsealed)) == FRAMES


def test_lock_that_cannot_be_taken_is_named(unsealed: Path) -> None:
    with mock.patch.object(fcntl, "flock", side_effect=OSError(errno.ENOLCK, "no locks")):
        with pytest.raises(SessionUnreadable, match=r"lock: cannot be read \(no locks\); "):
            verify(unsealed)
        with pytest.raises(SessionUnwritable, match=r"lock: no locks; "):
            capture_small(unsealed)
    with (
        mock.patch.object(os, "write", side_effect=OSError(errno.ENOSPC, "disk full")),
        pytest.raises(SessionUnwritable, match=r"lock: .*: make room"),
    ):
        capture_small(unsealed)
    assert verify(unsealed).problems == ()


def test_failure_while_locked_passes_unchanged(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), lock_session(tmp_path):
        raise FileNotFoundError("frame")


def test_foreign_text_in_the_lock_is_not_repeated(unsealed: Path) -> None:
    with lock_session(unsealed):
        (unsealed / "lock").write_text("nobody); all is well\n")
        with pytest.raises(SessionBusy, match=r"a capture is under way \(another process\); wait"):
            verify(unsealed)


def run_without_rights(task: Callable[[Path], None], folder: Path) -> None:
    """Run a task without the privileges that override permissions, and assert that it ends well."""
    process = in_process(_without_rights, task, folder)
    process.join(HANG_S)
    assert process.exitcode == 0


def _without_rights(task: Callable[[Path], None], folder: Path) -> None:
    drop_rights()
    task(folder)


@pytest.mark.parametrize(
    ("name", "mode"),
    [
        ("frames", 0o000),
        ("frames", 0o400),
        ("frames/00003_bright_0_r1_c2_x4.tiff", 0),
        ("plan.json", 0),
        ("journal.sqlite", 0),
        (".", 0),
    ],
)
def test_unreadable_is_not_taken_for_corrupt(unsealed: Path, name: str, mode: int) -> None:
    path = unsealed / name
    before = path.stat().st_mode
    path.chmod(mode)
    run_without_rights(refuse_unreadable, unsealed)
    path.chmod(before)
    assert verify(unsealed).problems == ()
    with open_session(unsealed, None) as session:
        assert session.missing() == []


def refuse_unreadable(folder: Path) -> None:
    try:
        problems = verify(folder).problems
    except SessionUnreadable as failure:
        problems = (str(failure),)
    assert "Permission denied" in problems[0]
    with pytest.raises((SessionUnreadable, SessionUnwritable), match="; "):
        capture_small(folder)


def test_write_protected_session_is_verified(sealed: Path) -> None:
    for path in (*sealed.rglob("*"), sealed):
        path.chmod(0o500 if path.is_dir() else 0o400)
    run_without_rights(find_no_problem, sealed)


def find_no_problem(folder: Path) -> None:
    assert verify(folder).problems == ()


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"approach_mm": 2.0', '"approach_mm": 1e300', r"plan\.plan\.approach_mm = 1e\+300 in size is more"),
        ('"approach_mm": 2.0', '"approach_mm": -2.0', "not negative"),
        ('"approach_mm": 2.0', f'"approach_mm": {"[" * 100_000}', ""),
        ('"frames_per_node": 2', '"frames_per_node": 1000000000', f"2000000012 frames, at most {MAX_FRAMES} are "),
        ('"format": 3', '"format": 4', "format 4, formats 1 to 3 are read"),
        ('"seed": 1', '"seed": 10000000000000', r"plan\.rig\.camera\.seed = 1e\+13 in size is more"),
    ],
)
def test_plan_with_impossible_values_is_refused(unsealed: Path, old: str, new: str, words: str) -> None:
    plan = unsealed / "plan.json"
    assert old in plan.read_text()
    plan.write_text(plan.read_text().replace(old, new))
    with pytest.raises(SessionCorrupt, match=rf"plan\.json: .*{words}.*; "):
        read_plan(unsealed)
    for use in (verify, taken_frames, capture_small):
        with pytest.raises(SessionCorrupt, match=r"plan\.json"):
            use(unsealed)


@pytest.mark.parametrize(("name", "limit"), [("plan.json", 32_000_000), ("journal.sqlite", 1 << 32)])
def test_file_larger_than_any_is_not_read(unsealed: Path, name: str, limit: int) -> None:
    with (unsealed / name).open("ab") as file:
        file.truncate(10**12)
    with pytest.raises(SessionCorrupt, match=rf"holds 1000000000000 bytes, at most {limit}.*; restore"):
        verify(unsealed)


@pytest.mark.parametrize("suffix", ["", ".part"])
def test_remains_of_an_interruption_are_no_damage(unsealed: Path, suffix: str) -> None:
    with open_session(unsealed, None) as session:
        frame = session.frames[5]
        intent = session.intend(frame)
    name = f"{frame.name}_x{intent}.tiff{suffix}"
    (unsealed / "frames" / name).write_bytes(b"half")
    verdict = verify(unsealed)
    assert (verdict.problems, verdict.interrupted) == ((), (name,))
    capture_small(unsealed)
    assert verify(unsealed).interrupted == ()
    assert (unsealed / "set_aside" / f"{name}.0").read_bytes() == b"half"
