"""The measurement of settling, on a scene that is shifted by a known function of time."""

import math
from collections.abc import Callable
from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import measure_settling
from faintfield.rig.settings import SettleSettings
from faintfield.rig.simulation.controller.kinematics import SimulatedClock
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.scene import render


def noisy_camera(clock: SimulatedClock, shift_px: Callable[[float], float], light: float) -> Callable[[float], Pixels]:
    """Return a camera that sees the paper's scene shifted by a function of time."""
    scene = paper_experiment(64, 48).grey()
    generator = np.random.default_rng(5)

    @cache
    def light_at(shift_mm: float) -> NDArray[np.float32]:
        return next(render(scene.planes, scene.optics, np.array([[0, 0, 0, shift_mm, 0.0, 0.0]]))).light

    def expose(exposure_s: float) -> Pixels:
        photons = light * light_at(shift_px(clock.now_s()) * 600.0 / scene.optics.fx_px)
        clock.sleep_s(exposure_s + 0.05)
        return np.asarray(generator.poisson(100.0 + photons), np.uint16)

    return expose


@pytest.mark.parametrize(
    ("shift_px", "light", "rest_s"),
    [
        (lambda now_s: 0.6 if now_s < 0.7 else 0.0, 2e4, 0.7),
        (lambda now_s: 2.0 if now_s < 0.4 else 0.3 if now_s < 1.2 else 0.0, 2e5, 1.2),
        (lambda now_s: 2.0 if now_s < 0.4 else 0.05 if now_s < 1.2 else 0.0, 2e5, 0.4),
    ],
    ids=["one shift", "slight shift above the limit", "slight shift below the limit"],
)
def test_settling_ends_when_the_shift_does(shift_px: Callable[[float], float], light: float, rest_s: float) -> None:
    clock, settings = SimulatedClock(), SettleSettings(exposure_s=0.05, limit_px=0.1)
    settling = measure_settling(noisy_camera(clock, shift_px, light), clock, settings)
    measured_s = settling.rest_s("bright", settings)
    assert measured_s is not None
    assert rest_s <= measured_s <= rest_s + 0.2


@pytest.mark.parametrize(
    ("shift_px", "light"),
    [(lambda now_s: 0.5 * np.sin(9.0 * now_s), 2e4), (lambda now_s: 0.0, 0.0)],
    ids=["never at rest", "dark"],
)
def test_motion_and_darkness_are_not_rest(shift_px: Callable[[float], float], light: float) -> None:
    clock, settings = SimulatedClock(), SettleSettings(exposure_s=0.05)
    settling = measure_settling(noisy_camera(clock, shift_px, light), clock, settings)
    assert settling.rest_s("bright", settings) is None


def shifted(x_px: float, y_px: float) -> NDArray[np.float64]:
    """Return a smooth scene shifted along columns and rows."""
    rows, columns = np.indices((64, 80), float)
    x, y = columns - x_px, rows - y_px
    return np.asarray(1000 + 300 * np.sin(x / 5) * np.cos(y / 7) + 200 * np.sin((x + y) / 6))


def test_curve_shows_the_shift_of_each_frame() -> None:
    clock = SimulatedClock()
    shifts_px = [(0.5, 0.0), (0.0, -0.4), (0.3, 0.4), (0.05, 0.0), *[(0.0, 0.0)] * 5]
    waiting = iter(shifts_px)

    def expose(exposure_s: float) -> NDArray[np.float64]:
        clock.sleep_s(exposure_s + 0.09)
        return shifted(*next(waiting))

    settings = SettleSettings(exposure_s=0.01, longest_s=0.85)
    settling = measure_settling(expose, clock, settings)
    times_s, curve_px = zip(*settling.curve, strict=True)
    assert times_s == pytest.approx([0.1 * k for k in range(9)], abs=1e-6)
    assert curve_px == pytest.approx([math.hypot(*shift) for shift in shifts_px], abs=0.03)
    assert settling.rest_s("bright", settings) == pytest.approx(0.3)  # 0.05 px after it do no harm
    assert settling.rest_s("charuco", settings) == pytest.approx(0.4)  # but to the corners of a board
    assert settling.scatter_px == pytest.approx(0.0, abs=1e-4)


def test_slow_camera_takes_six_frames_at_least() -> None:
    clock = SimulatedClock()
    frames = [shifted(1.0, 0.0)] * 4 + [shifted(0.0, 0.0)] * 2  # the last third is the picture at rest

    def expose(exposure_s: float) -> NDArray[np.float64]:
        clock.sleep_s(1.0)
        return frames.pop(0)

    settings = SettleSettings(longest_s=2.0)
    settling = measure_settling(expose, clock, settings)
    assert frames == []
    assert settling.rest_s("bright", settings) == pytest.approx(4.0)
