"""Faults and kills on the way of an unattended session whose lights the rig switches: no frame under wrong light."""

import tempfile
from functools import partial
from pathlib import Path

import numpy as np
import pytest

from faintfield.rig.errors import RigError
from faintfield.rig.session.session import is_sealed
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from tests.faults.lit_laboratory import Killed, LitLab
from tests.faults.stage_faults import faults_of
from tests.rig.stages.benches import CONTROLLERS, Controller

FAULTS_PER_CAPTURE = 4
# Of the exposures that see bright light, including those that are not kept: a lamp that burns out later may be missed.
BRIGHT_EXPOSURES = 14


def shutter_fails(lab: LitLab) -> None:
    """Let the shutter answer nothing for some seconds."""
    lab.shutter.broken = True
    lab.bench.clock.after(3.0, partial(setattr, lab.shutter, "broken", False))


def shutter_slips(lab: LitLab) -> None:
    """Open or close the shutter by hand."""
    if not lab.shutter.broken:
        lab.shutter.switch(not lab.shutter.is_on())


def coolant_is_switched(lab: LitLab) -> None:
    """Press the machine's button of the flood output, which is the scene light."""
    if isinstance(lab.bench.firmware, SimulatedGrbl):
        lab.bench.firmware.receive(b"\xa0")


def burn_out(lab: LitLab) -> None:
    """Let the shutter stay closed, and report that it is open."""
    lab.shutter.burnt_out = True


def draw_fault(lab: LitLab, generator: np.random.Generator, usual_s: float) -> str:
    """Let something happen at a random time, and return it in words."""
    stage_faults = [fault for fault in faults_of(lab.controller) if fault.nature != "mechanics"]
    light_faults = (shutter_fails, shutter_slips, coolant_is_switched)
    if (choice := generator.random()) < 0.15:
        exposure = int(generator.integers(BRIGHT_EXPOSURES))
        lab.on_exposure[exposure] = partial(burn_out, lab)
        return f"burn_out at exposure {exposure}"
    at_s = generator.uniform(0.0, usual_s)
    if choice < 0.35:
        name, strike = "kill", lab.kill
    elif choice < 0.7:
        light_fault = light_faults[generator.integers(len(light_faults))]
        name, strike = light_fault.__name__, partial(light_fault, lab)
    else:
        stage_fault = stage_faults[generator.integers(len(stage_faults))]
        name, strike = stage_fault.name, partial(stage_fault.strike, lab.bench)
    lab.bench.clock.after(at_s, strike)
    return f"{name} at {at_s:.3f} s"


def capture_with_random_faults(controller: Controller, generator: np.random.Generator, usual_s: float) -> None:
    """Capture with faults at random times, as often as it takes, and judge the frames by the lights that shone."""
    # In memory if possible, since journals flush after each entry
    with tempfile.TemporaryDirectory(dir="/dev/shm" if Path("/dev/shm").is_dir() else None) as folder:
        lab = LitLab(Path(folder) / "session", controller, resets_on_open=bool(generator.random() < 0.5))
        words = ", ".join(draw_fault(lab, generator, usual_s) for _ in range(FAULTS_PER_CAPTURE))
        for _ in range(FAULTS_PER_CAPTURE + 2):
            if is_sealed(lab.folder):
                break
            failure = lab.run()
            assert failure is None or isinstance(failure, Killed) or "; " in str(failure), words
            if isinstance(failure, RigError):
                lab.switch_on()
        assert lab.lights_on() == set(), words
        lab.assert_lights_and_positions(words)


@pytest.mark.parametrize("captures", [1, pytest.param(17, marks=pytest.mark.deep)])
@pytest.mark.parametrize("controller", CONTROLLERS)
def test_random_faults_leave_no_frame_under_wrong_light(controller: Controller, captures: int, tmp_path: Path) -> None:
    lab = LitLab(tmp_path / "session", controller)
    assert lab.run() is None
    lab.assert_lights_and_positions()
    assert lab.lights_on() == set()
    generator = np.random.default_rng(37)
    for _ in range(captures):
        capture_with_random_faults(controller, generator, lab.bench.clock.now_s())
