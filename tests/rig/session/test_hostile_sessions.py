"""A session folder that is broken or hostile: a named failure, no hang, and nothing outside the folder is touched."""

import errno
import fcntl
import os
import shutil
from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest

from faintfield.rig.cameras.protocol import Exposure
from faintfield.rig.errors import RigError, SessionBusy, SessionCorrupt, SessionUnreadable, SessionUnwritable
from faintfield.rig.plan import MAX_FRAMES
from faintfield.rig.session import disk
from faintfield.rig.session.disk import lock_session, set_aside, write_new
from faintfield.rig.session.names import is_plain_name
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, capture_small, in_process
from tests.faults.test_capture_faults import drop_rights


@pytest.fixture(scope="module")
def complete(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("complete") / "session"
    capture_small(folder)
    return folder


@pytest.fixture
def session(complete: Path, tmp_path: Path) -> Path:
    """Return a session whose frames are all there and which is not sealed."""
    copy = Path(shutil.copytree(complete, tmp_path / "session"))
    (copy / "SHA256SUMS").unlink()
    return copy


def frame_files(folder: Path) -> list[Path]:
    return sorted((folder / "frames").iterdir())


# --- Other things where a session has files and folders


def put_pipe(path: Path) -> None:
    os.mkfifo(path)


def put_folder(path: Path) -> None:
    path.mkdir()
    (path / "content").write_text("content")


def put_link_out(path: Path) -> None:
    path.symlink_to(path.parent.parent / "victim")


def put_device(path: Path) -> None:
    path.symlink_to("/dev/zero")


def put_loop(path: Path) -> None:
    path.symlink_to(path.name)


PUT = [put_pipe, put_folder, put_link_out, put_device, put_loop]


def everything_below(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()}


@pytest.mark.parametrize("put", PUT)
@pytest.mark.parametrize(
    "name", ["lock", "plan.json", *(f"journal.sqlite{suffix}" for suffix in ("", "-wal", "-shm", "-journal"))]
)
def test_other_things_in_the_place_of_files_are_named(
    session: Path, tmp_path: Path, name: str, put: Callable[[Path], None]
) -> None:
    victim = tmp_path / "victim"
    victim.write_text("important")
    (session / name).unlink(missing_ok=True)
    put(session / name)
    for use in (verify, capture_small):
        with pytest.raises((SessionCorrupt, SessionUnreadable, SessionUnwritable), match=name):
            use(session)
    assert victim.read_text() == "important"
    assert len(frame_files(session)) == FRAMES


@pytest.mark.parametrize("put", [put_pipe, put_link_out, put_device, put_loop])
@pytest.mark.parametrize("name", ["frames", "set_aside"])
def test_folders_that_are_none_or_lead_elsewhere_are_refused(
    session: Path, tmp_path: Path, name: str, put: Callable[[Path], None]
) -> None:
    victim = tmp_path / "victim"
    if (session / name).exists():
        (session / name).rename(victim)
    else:
        victim.mkdir()
        (session / "frames" / "orphan").write_bytes(b"orphan")
    put(session / name)
    before = everything_below(victim)
    with pytest.raises(SessionCorrupt, match=f"{name}: is not a folder of the session itself; "):
        capture_small(session)
    if name == "frames":
        for use in (verify, taken_frames):
            with pytest.raises(SessionCorrupt, match="frames: is not a folder of the session itself; "):
                use(session)
    assert everything_below(victim) == before


@pytest.mark.parametrize("put", PUT)
def test_what_takes_the_place_of_a_frame_is_set_aside(
    session: Path, tmp_path: Path, put: Callable[[Path], None]
) -> None:
    (tmp_path / "session" / "victim").write_text("important")
    replaced = frame_files(session)[4]
    replaced.unlink()
    put(replaced)
    verdict = verify(session)
    assert len(verdict.problems) == 1
    assert replaced.name in verdict.problems[0]
    assert verdict.present == FRAMES - 1
    capture_small(session)
    assert os.path.lexists(session / "set_aside" / f"{replaced.name}.0")
    assert (tmp_path / "session" / "victim").read_text() == "important"
    assert verify(session).problems == ()


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


@pytest.mark.parametrize("name", [b"\xff\xfe.tiff", b"line\nline.tiff", b"x" * 255, b" ", b"-rf"])
def test_an_orphan_of_any_name_is_set_aside(session: Path, name: bytes) -> None:
    path = os.path.join(os.fsencode(session / "frames"), name)
    with open(path, "wb") as file:
        file.write(b"orphan")
    assert len(verify(session).problems) == 1
    capture_small(session)
    assert [it.read_bytes() for it in (session / "set_aside").iterdir()] == [b"orphan"]
    assert verify(session).problems == ()


def test_sums_that_name_other_files_open_none(session: Path, tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "pipe")
    capture_small(session)
    with (session / "SHA256SUMS").open("ab") as file:
        file.write(b"0  ../pipe\n0  /dev/zero\n\xff\n" + b"0" * 64 + b"  \n")
    assert [it.partition(":")[0] for it in verify(session).problems] == ["", "", "../pipe", "/dev/zero"][1:]


# --- Names


@pytest.mark.parametrize("name", ["a", "00001_bright_0_r0_c1_x2.tiff", "x" * 200, "..a", "a..", ".hidden", "a b"])
def test_plain_names(name: str) -> None:
    assert is_plain_name(name)


@pytest.mark.parametrize("name", ["", ".", "..", "...", "/", "../a", "a\\b", "a\0", "a\n", "\x7f", "é", 201 * "x"])
def test_names_that_are_not_plain(name: str) -> None:
    assert not is_plain_name(name)


@pytest.mark.parametrize("suffix", ["/../../victim", ".ti\nff", ".tiff" * 60, "\0"])
def test_a_suffix_of_the_camera_that_leads_elsewhere_is_refused(session: Path, suffix: str) -> None:
    with open_session(session, None) as opened:
        frame = opened.frames[0]
        with pytest.raises(SessionUnwritable, match="is no suffix of a file; "):
            opened.write(frame, opened.intend(frame), Exposure(suffix, content=b"raw"))
    assert len(frame_files(session)) == FRAMES


# --- Locks


@pytest.mark.parametrize("code", [errno.ENOLCK, errno.EIO, errno.EOPNOTSUPP, errno.EBADF])
def test_a_lock_that_cannot_be_taken_is_named(session: Path, code: int) -> None:
    with mock.patch.object(fcntl, "flock", side_effect=OSError(code, os.strerror(code))):
        with pytest.raises(SessionUnreadable, match=rf"lock: cannot be read \({os.strerror(code)}\); "):
            verify(session)
        with pytest.raises(SessionUnwritable, match=rf"lock: {os.strerror(code)}; "):
            capture_small(session)
    assert verify(session).problems == ()


@pytest.mark.parametrize("name", ["ftruncate", "pwrite"])
def test_a_full_disk_when_the_lock_is_taken_is_named(session: Path, name: str) -> None:
    failure = OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    with (
        mock.patch.object(os, name, side_effect=failure),
        pytest.raises(SessionUnwritable, match=r"lock: .*: make room"),
    ):
        capture_small(session)


def test_a_failure_within_the_block_is_not_taken_for_one_of_the_lock(tmp_path: Path) -> None:
    with pytest.raises(FileNotFoundError), lock_session(tmp_path):
        raise FileNotFoundError("frame")


def test_a_lock_file_names_its_holder_only_if_a_capture_wrote_it(session: Path) -> None:
    with lock_session(session):
        (session / "lock").write_text("nobody); all is well\n")
        with pytest.raises(SessionBusy, match=r"a capture is under way \(another process\); wait"):
            verify(session)


# --- What cannot be read


def in_process_without_rights(task: Callable[[Path], None], folder: Path) -> None:
    """Run a task without the privileges that override permissions, and assert that it ends well."""
    process = in_process(_without_rights, task, folder)
    process.join(120.0)
    assert process.exitcode == 0


def _without_rights(task: Callable[[Path], None], folder: Path) -> None:
    drop_rights()
    task(folder)


@pytest.mark.parametrize("mode", [0o000, 0o200, 0o400])
def test_a_folder_of_frames_that_cannot_be_read_is_not_taken_for_an_empty_one(session: Path, mode: int) -> None:
    (session / "frames").chmod(mode)
    in_process_without_rights(refuse_unreadable_frames, session)
    (session / "frames").chmod(0o700)
    assert verify(session).problems == ()
    with open_session(session, None) as opened:
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


def test_a_frame_that_cannot_be_read_is_one_problem(session: Path) -> None:
    frame_files(session)[3].chmod(0o000)
    in_process_without_rights(find_one_unreadable_frame, session)
    frame_files(session)[3].chmod(0o600)
    assert verify(session).problems == ()


def find_one_unreadable_frame(folder: Path) -> None:
    verdict = verify(folder)
    name = frame_files(folder)[3].name
    assert verdict.problems == (f"frames/{name}: cannot be read (Permission denied)",)
    assert verdict.present == FRAMES - 1
    with pytest.raises(SessionUnreadable, match=rf"{name}: cannot be read \(Permission denied\); allow"):
        capture_small(folder)
    assert len(frame_files(folder)) == FRAMES


@pytest.mark.parametrize("name", ["plan.json", "journal.sqlite", "lock", "."])
def test_what_cannot_be_read_is_not_taken_for_corrupt(session: Path, name: str) -> None:
    path = session / name
    mode = path.stat().st_mode
    path.chmod(0o000)
    in_process_without_rights(refuse_unreadable, session)
    path.chmod(mode)
    assert verify(session).problems == ()


def refuse_unreadable(folder: Path) -> None:
    with pytest.raises(SessionUnreadable, match=r"Permission denied.*; "):
        verify(folder)
    with pytest.raises((SessionUnreadable, SessionUnwritable), match=r"Permission denied.*; "):
        capture_small(folder)


# --- Plans


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ('"approach_mm": 2.0', '"approach_mm": 1e999', ""),
        (
            '"approach_mm": 2.0',
            '"approach_mm": 1e300',
            r"plan\.plan\.approach_mm = 1e\+300 in size is more",
        ),
        ('"approach_mm": 2.0', '"approach_mm": NaN', ""),
        ('"approach_mm": 2.0', '"approach_mm": -2.0', "not negative"),
        ('"approach_mm": 2.0', '"approach_mm": "2.0"', "Expected `float`"),
        ('"approach_mm": 2.0', f'"approach_mm": {"[" * 100_000}', ""),
        ('"approach_mm": 2.0', f'"approach_mm": 1{"0" * 5000}', ""),
        ('"frame_bytes": ', '"frame_bytes": -', "not negative"),
        (
            '"frames_per_node": 2',
            '"frames_per_node": 1000000000',
            f"2000000012 frames, at most {MAX_FRAMES} are possible",
        ),
        ('"rows": 2', '"rows": 100000', f"300000 nodes, at most {MAX_FRAMES} are possible"),
        ('"format": 2', '"format": 3', "format 3, formats 1 to 2 are read"),
        ('"format": 2', '"format": 2, "more": 1', "unknown field `more`"),
        ('"seed": 1', '"seed": 10000000000000', r"plan\.rig\.camera\.seed = 1e\+13 in size is more"),
    ],
)
def test_a_plan_with_impossible_values_is_refused(session: Path, old: str, new: str, words: str) -> None:
    plan = session / "plan.json"
    assert old in plan.read_text()
    plan.write_text(plan.read_text().replace(old, new))
    with pytest.raises(SessionCorrupt, match=rf"plan\.json: .*{words}.*; "):
        read_plan(session)
    for use in (verify, taken_frames, capture_small):
        with pytest.raises(SessionCorrupt, match=r"plan\.json"):
            use(session)


def test_a_plan_of_hostile_stops_is_refused(session: Path) -> None:
    plan = session / "plan.json"
    text = plan.read_text()
    for node in ("[-1, 0]", f"[0, {MAX_FRAMES}]", "[0.5, 0]"):
        start = text.index('"node": [')
        plan.write_text(f'{text[:start]}"node": {node}{text[text.index("]", start) + 1 :]}')
        with pytest.raises(SessionCorrupt, match=r"plan\.json: is not a plan .*; restore"):
            read_plan(session)


def test_a_plan_larger_than_any_is_not_read(session: Path) -> None:
    with (session / "plan.json").open("ab") as file:
        file.truncate(10**12)
    with pytest.raises(SessionCorrupt, match=r"holds 1000000000000 bytes, at most 32000000 are read; restore"):
        read_plan(session)


def test_a_journal_larger_than_any_is_not_read(session: Path) -> None:
    with (session / "journal.sqlite").open("ab") as file:
        file.truncate(10**12)
    with pytest.raises(SessionCorrupt, match=r"holds 1000000000000 bytes, at most 4294967296; restore"):
        verify(session)


# --- Interrupted, or damaged


@pytest.mark.parametrize("suffix", ["", ".part"])
def test_what_an_interruption_leaves_is_no_damage(session: Path, suffix: str) -> None:
    with open_session(session, None) as opened:
        frame = opened.frames[5]
        intent = opened.intend(frame)
    name = f"{frame.name}_x{intent}.tiff{suffix}"
    (session / "frames" / name).write_bytes(b"half")
    verdict = verify(session)
    assert (verdict.problems, verdict.interrupted) == ((), (name,))
    capture_small(session)
    assert verify(session).interrupted == ()
    assert (session / "set_aside" / f"{name}.0").read_bytes() == b"half"


@pytest.mark.parametrize("name", ["x.tiff", "00005_bright_0_r1_c0_x99.tiff", "00005_bright_0_r1_c0_x6.tiff.part"])
def test_what_no_interruption_leaves_is_damage(session: Path, name: str) -> None:
    (session / "frames" / name).write_bytes(b"stranger")
    verdict = verify(session)
    assert (verdict.problems, verdict.interrupted) == ((f"frames/{name}: is not in the journal",), ())


def test_files_are_moved_under_names_of_their_own(tmp_path: Path) -> None:
    (tmp_path / "aside").mkdir()
    (tmp_path / "aside" / "frame.0").symlink_to(tmp_path / "nowhere")
    write_new(tmp_path / "frame", b"one")
    assert set_aside(tmp_path / "frame", tmp_path / "aside").name == "frame.1"


def test_every_failure_of_the_disk_has_a_remedy() -> None:
    for code in (*disk._REMEDIES, errno.EXDEV):  # noqa: SLF001
        with pytest.raises(RigError, match=r"; what was committed is safe: .*, and run the same command again"):
            with disk.translate_errors(Path("frame")):
                raise OSError(code, os.strerror(code))
