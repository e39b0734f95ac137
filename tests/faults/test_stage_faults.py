"""Faults of a stage at every moment of a capture: a named failure or a recovery, no frame from a wrong place."""

import tempfile
from collections.abc import Callable
from functools import partial
from pathlib import Path

import msgspec
import numpy as np
import pytest

from faintfield.rig.errors import StageLost
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import is_sealed, taken_frames
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import DriftSettings
from faintfield.rig.simulation.controller.bench import Bench, PtyLink
from tests.faults.capturing import DRIFTING, SMALL_RIG
from tests.faults.laboratory import ON_TARGET_MM, Lab, MakeLink, Prepare, TruthfulCamera, at_exposures, error_mm
from tests.faults.stage_faults import FAULTS, Fault, faults_of, unplug_for
from tests.rig.stages.benches import CONTROLLERS, Controller
from tests.rig.stages.socket_link import SocketLink

FRAMES_ON_GRID = 12  # of SMALL_RIG; the last frames, at the centre, are dark
FAULTS_PER_CAPTURE = 6
LONGEST_S = 900.0  # of the simulated clock


MOMENTS: dict[str, Callable[[Fault], Prepare]] = {
    "connecting": lambda fault: lambda bench, camera: bench.clock.after(1.02, lambda: fault.strike(bench)),
    "homing": lambda fault: lambda bench, camera: bench.clock.after(5.0, lambda: fault.strike(bench)),
    "exposing": lambda fault: at_exposures([3], fault.strike),
    "moving": lambda fault: at_exposures([3], fault.strike, 0.35),
}


def capture_with(lab: Lab, prepare: Prepare) -> None:
    """Capture with a fault, resume without if that fails, and assert that every frame is from its node."""
    failure = lab.run(prepare)
    assert lab.ended_s < LONGEST_S
    if failure is not None:
        assert "; " in str(failure), "a failure says what is wrong; and what to do"
        assert not is_sealed(lab.folder)
        assert lab.run() is None
    lab.assert_true_positions()


@pytest.mark.deep
@pytest.mark.parametrize("moment", MOMENTS)
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_each_fault_spoils_no_frame(controller: Controller, moment: str, tmp_path: Path) -> None:
    wrong = {}
    for number, fault in enumerate(faults_of(controller)):
        if fault.nature != "mechanics":
            try:
                capture_with(Lab(tmp_path / str(number), controller), MOMENTS[moment](fault))
            except AssertionError as failure:
                wrong[fault.name] = str(failure)
    assert wrong == {}


@pytest.mark.deep
@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("link", [PtyLink, SocketLink])
@pytest.mark.parametrize("name", ["unplugged", "restart", "noise", "controller mute"])
def test_faults_of_a_real_port(controller: Controller, link: MakeLink, name: str, tmp_path: Path) -> None:
    fault = next(fault for fault in FAULTS if fault.name == name)
    capture_with(Lab(tmp_path / "session", controller, link=link), at_exposures([3], fault.strike, 0.35))


@pytest.mark.parametrize(("controller", "gone_s"), [*zip(CONTROLLERS, (3.0, 30.0, 3.0), strict=True)])
def test_port_that_returns_ends_no_capture(tmp_path: Path, controller: Controller, gone_s: float) -> None:
    lab = Lab(tmp_path / "session", controller, msgspec.structs.replace(SMALL_RIG, drift=DriftSettings(every_nodes=2)))
    assert lab.run(at_exposures([3], unplug_for(gone_s), 0.4)) is None
    lab.assert_true_positions()


def test_port_that_stays_away_is_given_up(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", CONTROLLERS[0])
    assert isinstance(lab.run(at_exposures([3], Bench.unplug)), StageLost)
    assert 120.0 < lab.ended_s < 240.0
    assert lab.run() is None
    lab.assert_true_positions()


def test_stage_jogged_during_exposure_repeats_frame(tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", CONTROLLERS[0])
    jog = b"$J=G91 G21 X-0.5 F6000\n"
    assert lab.run(at_exposures([3], lambda bench: bench.firmware.receive(jog))) is None
    lab.assert_true_positions()
    with Journal(lab.folder / "journal.sqlite", read_only=True) as journal:
        assert [frame for _, frame in journal.uncommitted()] == [2]
        assert len(journal.events("stage_failed")) == 1


def capture_with_random_faults(controller: Controller, generator: np.random.Generator, usual_s: float) -> None:
    """Capture with faults at random times, and resume without; judge the frames by where the stage truly was."""
    faults = faults_of(controller)
    loud = [fault for fault in faults if fault.nature != "mechanics"]
    silent = [fault for fault in faults if fault.nature == "mechanics"]
    drawn = [loud[index] for index in generator.integers(len(loud), size=FAULTS_PER_CAPTURE)]
    # Two drifts between two checks may cancel, which no check can find: so one at most
    hidden = generator.random() < 0.3
    if hidden:
        drawn[0] = silent[generator.integers(len(silent))]
    times_s = generator.uniform(0.0, usual_s, FAULTS_PER_CAPTURE).tolist()
    story = ", ".join(f"{fault} at {at_s:.3f} s" for at_s, fault in zip(times_s, drawn, strict=True))

    def prepare(bench: Bench, camera: TruthfulCamera) -> None:
        for at_s, fault in zip(times_s, drawn, strict=True):
            bench.clock.after(at_s, partial(fault.strike, bench))

    # In memory if possible, since journals flush after each entry
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        lab = Lab(Path(folder) / "session", controller, DRIFTING)
        failure = lab.run(prepare)
        assert failure is None or "; " in str(failure), story
        for _ in range(3):
            if not is_sealed(lab.folder):
                lab.run()
        verdict = verify(lab.folder)
        assert (verdict.problems, verdict.sealed) == ((), True), story
        # Lost steps show in no report: the next drift check finds those beyond its limit. None follows the dark frames
        limit_mm = ON_TARGET_MM + (DriftSettings().limit_mm if hidden else 0.0)
        for frame, committed, path in taken_frames(lab.folder):
            if not hidden or (frame.number < FRAMES_ON_GRID and committed.file not in verdict.suspect):
                assert error_mm(path, frame.stop.target) <= limit_mm, f"{committed.file}; {story}"


@pytest.mark.parametrize("captures", [2, pytest.param(60, marks=pytest.mark.deep)])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_random_faults_spoil_no_frame(controller: Controller, captures: int, tmp_path: Path) -> None:
    lab = Lab(tmp_path / "session", controller, DRIFTING)
    assert lab.run() is None
    lab.assert_true_positions()
    assert verify(lab.folder).suspect == ()
    generator = np.random.default_rng(20)
    for _ in range(captures):
        capture_with_random_faults(controller, generator, lab.ended_s)
