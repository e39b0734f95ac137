"""The power fails at any moment of a capture: what the journal calls committed is on disk, and the capture resumes."""

import itertools
import os
from pathlib import Path

import pytest
from msgspec.structs import replace

from faintfield.rig.session.disk import set_aside, write_new
from faintfield.rig.session.durable import make_folder, sync_folder
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import StepSettings
from tests.faults.capturing import SMALL_RIG, capture_small
from tests.rig.session.power_cuts import Disk, record

FRAMES = 3
THREE_FRAMES = replace(
    SMALL_RIG,
    grid=replace(SMALL_RIG.grid, rows=1, columns=2),
    step=(StepSettings("bright", 0.1), StepSettings("dark", 0.1)),
)


class Cuts:
    """Lays out what is left by a power cut at each change, in folders of its own."""

    all_entries = False

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.remains: list[Path] = []
        self._numbers = itertools.count()

    def __call__(self, disk: Disk) -> None:
        remains = self.folder / f"{next(self._numbers):04d}"
        disk.lay_out(remains, all_entries=self.all_entries)
        self.remains.append(remains)


@pytest.fixture
def cuts(tmp_path: Path) -> Cuts:
    (tmp_path / "cuts").mkdir()
    return Cuts(tmp_path / "cuts")


def live(tmp_path: Path) -> Path:
    folder = tmp_path / "live"
    folder.mkdir()
    return folder


@pytest.mark.parametrize("all_entries", [False, True])
def test_what_is_committed_survives_a_power_cut_at_any_moment(tmp_path: Path, cuts: Cuts, all_entries: bool) -> None:
    cuts.all_entries = all_entries
    root = live(tmp_path)
    with record(root, cuts):
        capture_small(root / "new" / "session", THREE_FRAMES)
    assert len(cuts.remains) > 6 * FRAMES
    present = []
    for remains in cuts.remains:
        session = remains / "new" / "session"
        if (session / "journal.sqlite").exists():
            verdict = verify(session)
            assert verdict.problems == (), remains.name
            present.append(verdict.present)
        for path in session.glob("frames/*.tiff"):
            assert path.stat().st_size > 0  # a name is given to whole files only
    assert present == sorted(present)
    assert set(present) == set(range(FRAMES + 1))
    assert not verify(cuts.remains[-1] / "new" / "session").missing
    assert verify(cuts.remains[-1] / "new" / "session").sealed


@pytest.mark.parametrize("each", [12, pytest.param(1, marks=pytest.mark.deep)])
def test_a_capture_resumes_after_a_power_cut(tmp_path: Path, cuts: Cuts, each: int) -> None:
    root = live(tmp_path)
    with record(root, cuts):
        capture_small(root / "session", THREE_FRAMES)
    for remains in cuts.remains[::each]:
        session = remains / "session"
        if not (session / "SHA256SUMS").exists():
            capture_small(session, THREE_FRAMES)
        verdict = verify(session)
        assert (verdict.problems, verdict.present, verdict.sealed) == ((), FRAMES, True)


def test_what_is_set_aside_is_on_disk_in_one_of_the_two_places(tmp_path: Path, cuts: Cuts) -> None:
    root = live(tmp_path)
    with record(root, cuts) as disk:
        make_folder(root / "frames")
        write_new(root / "frames" / "orphan", b"orphan")
        cuts.remains.clear()
        set_aside(root / "frames" / "orphan", root / "set_aside")
        disk.lay_out(cuts.folder / "end")
    for remains in cuts.remains:
        assert any(path.read_bytes() == b"orphan" for path in remains.rglob("orphan*"))
    assert [it.relative_to(cuts.folder / "end") for it in (cuts.folder / "end").rglob("orphan*")] == [
        Path("set_aside/orphan.0")
    ]


def test_orphans_survive_a_power_cut_at_any_moment_of_a_resumed_capture(tmp_path: Path, cuts: Cuts) -> None:
    root = live(tmp_path)
    with record(root, cuts):
        capture_small(root / "session", THREE_FRAMES)
        (root / "session" / "SHA256SUMS").unlink()
        damaged = sorted((root / "session" / "frames").iterdir())[1]
        damaged.write_bytes(b"damaged")
        with damaged.open("rb") as file:
            os.fsync(file.fileno())
        sync_folder(root / "session")
        cuts.remains.clear()
        with open_session(root / "session", None):
            pass
    for remains in cuts.remains:
        assert any(path.read_bytes() == b"damaged" for path in (remains / "session").rglob(f"{damaged.name}*"))
