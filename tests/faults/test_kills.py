"""Kill captures at every step of a frame and at random instants: nothing is lost, at most one frame is taken again."""

import signal
from pathlib import Path

import numpy as np
import pytest

from faintfield.rig.session.journal import Journal
from faintfield.rig.session.verify import verify
from tests.faults.capturing import FRAMES, STEPS, capture_and_die, capture_small, in_process
from tests.patience import HANG_S


def assert_whole(folder: Path, kills: int) -> None:
    """Assert that the frames are those of the plan, and that each kill cost at most one exposure."""
    verdict = verify(folder)
    assert verdict.problems == ()
    assert verdict.sealed
    assert (verdict.present, verdict.missing, verdict.superseded) == (FRAMES, (), 0)
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        committed = journal.committed()
        assert sorted(it.frame for it in committed) == list(range(FRAMES))
        assert [it.frame for it in committed] == sorted(it.frame for it in committed)
        assert len(journal.uncommitted()) <= kills
        frames = [frame for _, frame in journal.uncommitted()]
        aside = list((folder / "set_aside").glob("*"))
        assert len(aside) <= len(frames)
        assert len(list((folder / "frames").iterdir())) == FRAMES


def capture_until_killed(folder: Path, step: str, *, after: bool, countdown: int) -> None:
    """Let a process capture until it is killed at a step."""
    process = in_process(capture_and_die, folder, step, after=after, countdown=countdown)
    process.join(HANG_S)
    assert process.exitcode == -signal.SIGKILL


# Each step with whether the kill is after it; these are quick
SMOKE = (("writing", False), ("naming", True))
MOMENTS = [
    pytest.param(step, after, marks=() if (step, after) in SMOKE else pytest.mark.deep)
    for step in STEPS
    for after in (False, True)
]


@pytest.mark.parametrize(("step", "after"), MOMENTS)
def test_capture_killed_at_a_step(tmp_path: Path, step: str, after: bool) -> None:
    folder = tmp_path / "session"
    # Some steps occur twice for each frame: these numbers hit both
    for kills, countdown in enumerate((1, 2), start=1):
        capture_until_killed(folder, step, after=after, countdown=countdown)
        with Journal(folder / "journal.sqlite") as journal:
            assert len(journal.uncommitted()) <= kills
    capture_small(folder)
    assert_whole(folder, kills=2)


def kill_at_random(folder: Path, kills: int, generator: np.random.Generator, max_life_s: float) -> int:
    """Kill captures of one session at random instants until it is complete, and return the number of kills."""
    for kill in range(kills):
        if (folder / "SHA256SUMS").exists():
            return kill
        process = in_process(capture_small, folder)
        process.join(generator.uniform(0.0, max_life_s))
        if process.exitcode is not None:
            assert process.exitcode == 0
            return kill
        process.kill()
        process.join()
        assert process.exitcode in (-signal.SIGKILL, 0)
    return kills


@pytest.mark.deep
def test_capture_killed_at_random_instants(tmp_path: Path) -> None:
    """Kill sixty processes, over as many sessions as needed, and check each session."""
    kills = 60
    generator = np.random.default_rng(2)
    done = session = 0
    while done < kills:
        folder = tmp_path / f"session{session}"
        session += 1
        here = kill_at_random(folder, min(kills - done, 8), generator, max_life_s=0.5)
        done += here
        if not (folder / "SHA256SUMS").exists():
            capture_small(folder)
        assert_whole(folder, here)
    assert done == kills
