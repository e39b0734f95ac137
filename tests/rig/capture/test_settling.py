"""The measurement of settling, on a scene that is shifted by a known function of time."""

from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.settling import measure_settling
from faintfield.rig.settings import SettleSettings
from faintfield.rig.simulation.controller.wire import SimulatedClock
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import render


def shifting(shift_px: Callable[[float], float], clock: SimulatedClock, light: float) -> Callable[[float], Pixels]:
    """Return a camera that sees the paper's scene shifted by a function of time."""
    scene = paper_experiment(64, 48).grey()
    generator = np.random.default_rng(5)

    @cache
    def light_at(shift_mm: float) -> NDArray[np.float32]:
        return next(render(scene.planes, scene.optics, np.array([[0, 0, 0, shift_mm, 0.0, 0.0]]))).light

    def expose(exposure_s: float) -> Pixels:
        seen = light_at(shift_px(clock.now_s()) * 600.0 / scene.optics.fx_px)
        clock.sleep_s(exposure_s + 0.05)
        return np.asarray(generator.poisson(100.0 + light * seen), np.uint16)

    return expose


@pytest.mark.parametrize("rest_s", [0.0, 0.7])
def test_settling_ends_when_the_shift_does(rest_s: float) -> None:
    clock = SimulatedClock()
    expose = shifting(lambda now_s: 0.6 if now_s < rest_s else 0.0, clock, light=2e4)
    found = measure_settling(expose, clock, SettleSettings(exposure_s=0.05))
    assert found.settled
    assert rest_s <= found.wait_s <= rest_s + 0.2
    shifts = dict(found.curve)
    assert all(0.3 < shift < 0.9 for time, shift in shifts.items() if time < rest_s)


@pytest.mark.parametrize(("slight_px", "ends_s"), [(0.3, 1.2), (0.05, 0.4)])
def test_the_rig_swings_as_long_as_the_picture_is_off_by_more_than_the_limit(slight_px: float, ends_s: float) -> None:
    """A large shift until 0.4 s and a slight one until 1.2 s; the limit is 0.1 px."""
    clock = SimulatedClock()
    expose = shifting(lambda now_s: 2.0 if now_s < 0.4 else slight_px if now_s < 1.2 else 0.0, clock, light=2e5)
    found = measure_settling(expose, clock, SettleSettings(exposure_s=0.05, limit_px=0.1))
    assert found.settled
    assert ends_s <= found.wait_s <= ends_s + 0.2


@pytest.mark.parametrize(
    ("shift_px", "light"),
    [(lambda now_s: 0.5 * np.sin(9.0 * now_s), 2e4), (lambda now_s: 0.0, 0.0)],
    ids=["never at rest", "dark"],
)
def test_no_rest_is_not_taken_for_rest(shift_px: Callable[[float], float], light: float) -> None:
    clock = SimulatedClock()
    found = measure_settling(shifting(shift_px, clock, light), clock, SettleSettings(exposure_s=0.05))
    assert not found.settled
    assert found.wait_s == 3.0
