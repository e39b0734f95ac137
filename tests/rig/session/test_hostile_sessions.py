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
from faintfield.rig.plan import MAX_FRAMES
from faintfield.rig.session.disk import lock_session
from faintfield.rig.session.names import is_plain_name
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, capture_small, in_process
from tests.faults.test_capture_faults import drop_rights


def frame_files(folder: Path) -> list[Path]:
    return sorted((folder / "frames").iterdir())


# --- Other things where a session has files and folders


def put_pipe(path: Path) -> None:
    os.mkfifo(path)


def put_link_out(path: Path) -> None:
    path.symlink_to(path.parent.parent / "victim")


PUT = [put_pipe, put_link_out]


def everything_below(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("put", PUT)
@pytest.mark.parametrize("name", ["lock", "plan.json", "journal.sqlite", "journal.sqlite-wal"])
def test_other_things_in_the_place_of_files_are_named(
    unsealed: Path, tmp_path: Path, name: str, put: Callable[[Path], None]
) -> None:
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
def test_folders_that_are_none_or_lead_elsewhere_are_refused(
    unsealed: Path, tmp_path: Path, name: str, put: Callable[[Path], None]
) -> None:
    victim = tmp_path / "victim"
    if (unsealed / name).exists():
        (unsealed / name).rename(victim)
    else:
        victim.mkdir()
        (unsealed / "frames" / "orphan").write_bytes(b"orphan")
    put(unsealed / name)
    before = everything_below(victim)
    with pytest.raises(SessionCorrupt, match=f"{name}: is not a folder of the session itself; "):
        capture_small(unsealed)
    if name == "frames":
        for use in (verify, taken_frames):
            with pytest.raises(SessionCorrupt, match="frames: is not a folder of the session itself; "):
                use(unsealed)
    assert everything_below(victim) == before


@pytest.mark.parametrize("put", PUT)
def test_what_takes_the_place_of_a_frame_is_set_aside(
    unsealed: Path, tmp_path: Path, put: Callable[[Path], None]
) -> None:
    (tmp_path / "session" / "victim").write_text("important")
    replaced = frame_files(unsealed)[4]
    replaced.unlink()
    put(replaced)
    verdict = verify(unsealed)
    assert len(verdict.problems) == 1
    assert replaced.name in verdict.problems[0]
    assert verdict.present == FRAMES - 1
    capture_small(unsealed)
    assert os.path.lexists(unsealed / "set_aside" / f"{replaced.name}.0")
    assert (tmp_path / "session" / "victim").read_text() == "important"
    assert verify(unsealed).problems == ()


@pytest.mark.parametrize("name", ["plan.json.part", "SHA256SUMS.part"])
def test_a_link_in_the_place_of_a_partial_file_is_not_followed(tmp_path: Path, name: str) -> None:
    victim = tmp_path / "victim"
    victim.write_text("important")
    folder = tmp_path / "session"
    folder.mkdir()
    if name == "SHA256SUMS.part":
        capture_small(folder)
        (folder / "SHA256SUMS").unlink()
    (folder / name).symlink_to(victim)
    capture_small(folder)
    assert victim.read_text() == "important"
    assert verify(folder).problems == ()


@pytest.mark.parametrize("name", [b"\xff\xfe.tiff", b"line\nline.tiff", b"x" * 255])
def test_an_orphan_of_any_name_is_set_aside(unsealed: Path, name: bytes) -> None:
    path = os.path.join(os.fsencode(unsealed / "frames"), name)
    with open(path, "wb") as file:
        file.write(b"orphan")
    assert len(verify(unsealed).problems) == 1
    capture_small(unsealed)
    assert [it.read_bytes() for it in (unsealed / "set_aside").iterdir()] == [b"orphan"]
    assert verify(unsealed).problems == ()


# --- Names


def test_plain_names() -> None:
    for name in ("a", "00001_bright_0_r0_c1_x2.tiff", "x" * 200, "..a", "a..", ".hidden", "a b"):
        assert is_plain_name(name)
    for name in ("", ".", "..", "/", "../a", "a\\b", "a\0b", "a\n", "\x7f", "é", 201 * "x"):
        assert not is_plain_name(name)


@pytest.mark.parametrize("suffix", ["/../../victim", ".tiff" * 60])
def test_a_suffix_of_the_camera_that_leads_elsewhere_is_refused(unsealed: Path, suffix: str) -> None:
    with open_session(unsealed, None) as opened:
        frame = opened.frames[0]
        with pytest.raises(SessionUnwritable, match="is no suffix of a file; "):
            opened.write(frame, opened.intend(frame), Exposure(suffix, content=b"raw"))
    assert len(frame_files(unsealed)) == FRAMES


# --- Locks


def test_a_lock_that_cannot_be_taken_is_named(unsealed: Path) -> None:
    code = errno.ENOLCK
    with mock.patch.object(fcntl, "flock", side_effect=OSError(code, os.strerror(code))):
        with pytest.raises(SessionUnreadable, match=rf"lock: cannot be read \({os.strerror(code)}\); "):
            verify(unsealed)
        with pytest.raises(SessionUnwritable, match=rf"lock: {os.strerror(code)}; "):
            capture_small(unsealed)
    assert verify(unsealed).problems == ()


def test_a_full_disk_when_the_lock_is_taken_is_named(unsealed: Path) -> None:
    failure = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with (
        mock.patch.object(os, "pwrite", side_effect=failure),
        pytest.raises(SessionUnwritable, match=r"lock: .*: make room"),
    ):
        capture_small(unsealed)


def test_a_failure_within_the_block_is_not_taken_for_one_of_the_lock(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), lock_session(tmp_path):
        raise FileNotFoundError("frame")


def test_a_lock_file_names_its_holder_only_if_a_capture_wrote_it(unsealed: Path) -> None:
    with lock_session(unsealed):
        (unsealed / "lock").write_text("nobody); all is well\n")
        with pytest.raises(SessionBusy, match=r"a capture is under way \(another process\); wait"):
            verify(unsealed)


# --- What cannot be read


def in_process_without_rights(task: Callable[[Path], None], folder: Path) -> None:
    """Run a task without the privileges that override permissions, and assert that it ends well."""
    process = in_process(_without_rights, task, folder)
    process.join(120.0)
    assert process.exitcode == 0


def _without_rights(task: Callable[[Path], None], folder: Path) -> None:
    drop_rights()
    task(folder)


@pytest.mark.parametrize("mode", [0o000, 0o400])
def test_a_folder_of_frames_that_cannot_be_read_is_not_taken_for_an_empty_one(unsealed: Path, mode: int) -> None:
    (unsealed / "frames").chmod(mode)
    in_process_without_rights(refuse_unreadable_frames, unsealed)
    (unsealed / "frames").chmod(0o700)
    assert verify(unsealed).problems == ()
    with open_session(unsealed, None) as opened:
        assert opened.missing() == []


def refuse_unreadable_frames(folder: Path) -> None:
    for use in (verify_without_problem, capture_small):
        with pytest.raises((SessionUnreadable, SessionUnwritable), match=r"frames.*; "):
            use(folder)


def verify_without_problem(folder: Path) -> None:
    """Verify, and fail with the first problem."""
    for problem in verify(folder).problems:
        assert "cannot be read (Permission denied)" in problem
        raise SessionUnreadable(f"{problem}; allow it to be read")


def test_a_frame_that_cannot_be_read_is_one_problem(unsealed: Path) -> None:
    frame_files(unsealed)[3].chmod(0o000)
    in_process_without_rights(find_one_unreadable_frame, unsealed)
    frame_files(unsealed)[3].chmod(0o600)
    assert verify(unsealed).problems == ()


def find_one_unreadable_frame(folder: Path) -> None:
    verdict = verify(folder)
    name = frame_files(folder)[3].name
    assert verdict.problems == (f"frames/{name}: cannot be read (Permission denied)",)
    assert verdict.present == FRAMES - 1
    with pytest.raises(SessionUnreadable, match=rf"{name}: cannot be read \(Permission denied\); allow"):
        capture_small(folder)
    assert len(frame_files(folder)) == FRAMES


@pytest.mark.parametrize("name", ["plan.json", "journal.sqlite", "."])
def test_what_cannot_be_read_is_not_taken_for_corrupt(unsealed: Path, name: str) -> None:
    path = unsealed / name
    mode = path.stat().st_mode
    path.chmod(0o000)
    in_process_without_rights(refuse_unreadable, unsealed)
    path.chmod(mode)
    assert verify(unsealed).problems == ()


def refuse_unreadable(folder: Path) -> None:
    with pytest.raises(SessionUnreadable, match=r"Permission denied.*; "):
        verify(folder)
    with pytest.raises((SessionUnreadable, SessionUnwritable), match=r"Permission denied.*; "):
        capture_small(folder)


# --- Plans


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (
            '"approach_mm": 2.0',
            '"approach_mm": 1e300',
            r"plan\.plan\.approach_mm = 1e\+300 in size is more",
        ),
        ('"approach_mm": 2.0', '"approach_mm": -2.0', "not negative"),
        ('"approach_mm": 2.0', f'"approach_mm": {"[" * 100_000}', ""),
        (
            '"frames_per_node": 2',
            '"frames_per_node": 1000000000',
            f"2000000012 frames, at most {MAX_FRAMES} are possible",
        ),
        ('"format": 2', '"format": 3', "format 3, formats 1 to 2 are read"),
        ('"seed": 1', '"seed": 10000000000000', r"plan\.rig\.camera\.seed = 1e\+13 in size is more"),
    ],
)
def test_a_plan_with_impossible_values_is_refused(unsealed: Path, old: str, new: str, words: str) -> None:
    plan = unsealed / "plan.json"
    assert old in plan.read_text()
    plan.write_text(plan.read_text().replace(old, new))
    with pytest.raises(SessionCorrupt, match=rf"plan\.json: .*{words}.*; "):
        read_plan(unsealed)
    for use in (verify, taken_frames, capture_small):
        with pytest.raises(SessionCorrupt, match=r"plan\.json"):
            use(unsealed)


def test_a_plan_larger_than_any_is_not_read(unsealed: Path) -> None:
    with (unsealed / "plan.json").open("ab") as file:
        file.truncate(10**12)
    with pytest.raises(SessionCorrupt, match=r"holds 1000000000000 bytes, at most 32000000 are read; restore"):
        read_plan(unsealed)


def test_a_journal_larger_than_any_is_not_read(unsealed: Path) -> None:
    with (unsealed / "journal.sqlite").open("ab") as file:
        file.truncate(10**12)
    with pytest.raises(SessionCorrupt, match=r"holds 1000000000000 bytes, at most 4294967296; restore"):
        verify(unsealed)


# --- Interrupted, or damaged


@pytest.mark.parametrize("suffix", ["", ".part"])
def test_what_an_interruption_leaves_is_no_damage(unsealed: Path, suffix: str) -> None:
    with open_session(unsealed, None) as opened:
        frame = opened.frames[5]
        intent = opened.intend(frame)
    name = f"{frame.name}_x{intent}.tiff{suffix}"
    (unsealed / "frames" / name).write_bytes(b"half")
    verdict = verify(unsealed)
    assert (verdict.problems, verdict.interrupted) == ((), (name,))
    capture_small(unsealed)
    assert verify(unsealed).interrupted == ()
    assert (unsealed / "set_aside" / f"{name}.0").read_bytes() == b"half"
