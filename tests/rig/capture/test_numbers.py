"""The numbers that a capture shows: values of frames, warnings about boards, settling, and the remaining time."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from faintfield.rig.capture.checks import board_warnings, check_frame
from faintfield.rig.capture.pace import Pace
from faintfield.rig.capture.settling import measure_settling
from faintfield.rig.plan import PlannedFrame, StepKind, Stop
from faintfield.rig.settings import CheckSettings, SettleSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.wire import SimulatedClock
from faintfield.rig.stages.protocol import Point
from tests.rig.stages.benches import homed

LIMITS = CheckSettings()


def picture(high: float = 4000.0) -> NDArray[np.uint16]:
    """Return a picture with detail, of values from 1000 DN on."""
    shares = np.random.default_rng(5).uniform(0, 1, (60, 80))
    return np.asarray(1000 + (high - 1000) * shares, np.uint16)


@pytest.mark.parametrize(("count", "warns"), [(48, False), (49, True)])
def test_one_pixel_in_a_hundred_may_be_saturated(count: int, warns: bool) -> None:
    frame = picture()
    frame.flat[:count] = 65535
    found = check_frame(frame, "flat", LIMITS)
    assert found.values["saturated_share"] == pytest.approx(count / 4800, abs=1e-5)
    assert any("saturated" in warning for warning in found.warnings) is warns


def test_pixels_at_the_stated_saturation_count_as_saturated() -> None:
    frame = picture()
    frame.flat[:480] = 3900
    frame.flat[480:960] = 3899
    frame.flat[960:] = 2000
    assert check_frame(frame, "flat", CheckSettings(saturation_dn=3900.0)).values["saturated_share"] == 0.1
    floating = frame.astype(np.float32)
    assert check_frame(floating, "flat", LIMITS).values["saturated_share"] == 0.0


def test_contrast_is_the_range_without_the_outermost_hundredths() -> None:
    frame = np.arange(10_000, dtype=np.uint16).reshape(100, 100)
    assert check_frame(frame, "bright", LIMITS).values["contrast_dn"] == pytest.approx(0.98 * 9999)
    for span, warns in ((101.0, True), (104.0, False)):  # 98 % of it against the limit of 100 DN
        faint = np.tile(np.linspace(500, 500 + span, 100), (100, 1)).astype(np.float32)
        assert any("contrast" in it for it in check_frame(faint, "bright", LIMITS).warnings) is warns


def test_sharpness_is_the_spread_of_the_laplacian_of_every_second_pixel_over_that_of_the_picture() -> None:
    frame = picture()
    samples = frame[::2, ::2].astype(np.float64)
    laplacian = ndimage.laplace(samples, mode="mirror")
    expected = laplacian.std() / samples.std()
    found = check_frame(frame, "bright", LIMITS).values["sharpness"]
    assert found == pytest.approx(expected, rel=1e-4)
    assert check_frame(np.full((20, 20), 700, np.uint16), "bright", LIMITS).values["sharpness"] == 0.0
    earlier = [0.5 * found, 1.9 * found, 5.0 * found]
    assert not any("sharpness" in it for it in check_frame(frame, "bright", LIMITS, (), earlier).warnings)
    earlier[1] = 2.1 * found
    assert any("sharpness" in it for it in check_frame(frame, "bright", LIMITS, (), earlier).warnings)


def test_colours_are_judged_by_their_mean() -> None:
    colours = np.stack([picture(), 2 * picture(), 3 * picture()], axis=2)
    grey = colours.mean(axis=2)
    found, expected = check_frame(colours, "bright", LIMITS).values, check_frame(grey, "bright", LIMITS).values
    assert found["contrast_dn"] == expected["contrast_dn"]
    assert found["sharpness"] == expected["sharpness"]


@pytest.mark.parametrize(("median_dn", "warns"), [(300, False), (299, True)])
def test_a_flat_has_to_be_bright(median_dn: int, warns: bool) -> None:
    frame = np.full((20, 20), median_dn, np.uint16)
    assert any("median" in it for it in check_frame(frame, "flat", LIMITS).warnings) is warns
    assert not check_frame(frame, "dark_scene", LIMITS).warnings


def test_the_leak_is_the_range_of_an_eighths_means_less_that_of_chance() -> None:
    dark = np.full((80, 165), 100.0)
    dark[70:, :20] += 30.0  # one part of 10 x 20 pixels; five columns are left over
    dark[:, 160:] = 5000.0
    assert check_frame(dark, "dark", LIMITS).values["leak_dn"] == pytest.approx(30.0)
    assert check_frame(dark, "noise_reference", LIMITS).warnings
    leaks = []
    for seed in range(40):
        noisy = np.random.default_rng(seed).normal(100.0, 20.0, (80, 160))
        leaks.append(check_frame(noisy, "dark", LIMITS).values["leak_dn"])
        parts = noisy.reshape(8, 10, 8, 20)
        chance = 4.7 * np.median(parts.std(axis=(1, 3))) / np.sqrt(200)
        assert leaks[-1] == pytest.approx(max(0.0, np.ptp(parts.mean(axis=(1, 3))) - chance), abs=1e-5)
    assert 10 < sum(leak > 0 for leak in leaks) < 30, "the expected range is exceeded about every other time"


def board_frames(sweeps: int = 2, nodes: int = 6) -> list[PlannedFrame]:
    """Return the frames of board sweeps, and one bright frame after them."""
    frames: list[PlannedFrame] = []
    for sweep in range(sweeps):
        for column in range(nodes):
            stop = Stop((0, column), Point(float(column), 0.0))
            frames.append(PlannedFrame(len(frames), sweep, "charuco", sweep, stop, 0.1, 0))
    frames.append(PlannedFrame(len(frames), sweeps, "bright", 0, Stop((0, 0), Point(0.0, 0.0)), 0.1, 0))
    return frames


@pytest.mark.parametrize(
    ("corners", "words"),
    [
        ([0, 5, 3], ["board sweep 1: none of its first 3 frames shows 6 board corners, the most is 5"]),
        ([0, 5, 6, 9, 9, 0], []),  # three of six are not more than half
        ([0, 5, 6, 9, 0, 0], ["board sweep 1: 4 of 6 frames show fewer than 6 board corners"]),
        ([9, 9, 9, 9, 0, 0, 9, 9, 9, 9, 0, 5], ["2 of 6 nodes see 6 board corners in no sweep ([0, 4], [0, 5])"]),
        ([9, 9, 9, 9, 0, 0, 9, 9, 9, 0, 6, 6], []),
    ],
)
def test_boards_out_of_view_are_told_when_it_is_sure(corners: list[int], words: list[str]) -> None:
    frames = board_frames()
    found = board_warnings(frames[len(corners) - 1], frames, dict(enumerate(corners)), 6)
    assert [warning.split(",")[0].split("; ")[0] for warning in found if "nodes" not in warning] == [
        word.split(",")[0] for word in words if "nodes" not in word
    ]
    assert [warning for warning in found if "nodes" in warning] == [
        next(it for it in found if it.startswith(word)) for word in words if "nodes" in word
    ]


def shifted(shift: tuple[float, float]) -> NDArray[np.float64]:
    """Return a smooth scene shifted by a fraction of a pixel along columns and rows."""
    rows, columns = np.indices((64, 80), float)
    x, y = columns - shift[0], rows - shift[1]
    return np.asarray(1000 + 300 * np.sin(x / 5) * np.cos(y / 7) + 200 * np.sin((x + y) / 6))


def test_the_curve_of_settling_shows_the_shift_of_each_frame_in_pixels() -> None:
    clock = SimulatedClock()
    shifts = [(0.5, 0.0), (0.0, -0.4), (0.3, 0.4), (0.05, 0.0), *[(0.0, 0.0)] * 5]
    waiting = iter(shifts)

    def expose(exposure_s: float) -> NDArray[np.float64]:
        clock.sleep_s(exposure_s + 0.09)
        return shifted(next(waiting))

    found = measure_settling(expose, clock, SettleSettings(exposure_s=0.01, longest_s=0.85))
    times, seen = zip(*found.curve, strict=True)
    assert times == pytest.approx([0.1 * k for k in range(9)], abs=1e-6)
    assert seen == pytest.approx([math.hypot(*shift) for shift in shifts], abs=0.03)
    assert found.settled
    assert found.wait_s == pytest.approx(0.3)  # 0.05 px after it do no harm
    assert found.scatter_px == pytest.approx(0.0, abs=1e-4)


def test_the_picture_at_rest_is_the_last_third_of_six_frames_at_least() -> None:
    clock = SimulatedClock()
    taken: list[float] = []

    def expose(exposure_s: float) -> NDArray[np.float64]:
        clock.sleep_s(1.0)
        taken.append(clock.now_s())
        return shifted((1.0 if len(taken) <= 4 else 0.0, 0.0))

    found = measure_settling(expose, clock, SettleSettings(longest_s=2.0))
    assert len(taken) == 6
    assert found.settled
    assert found.wait_s == pytest.approx(4.0)


def frame(number: int, step: int, target: Point, exposure_s: float, kind: StepKind = "bright") -> PlannedFrame:
    return PlannedFrame(number, step, kind, 0, Stop((0, number), target), exposure_s, 0)


def test_the_remaining_time_is_the_sum_of_motions_stops_exposures_and_checks() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    pace = Pace(stage, bench.clock, rest_s=0.7, readout_s=0.3)
    a, b = Point(-100.0, -100.0), Point(-50.0, -100.0)
    frames = [frame(0, 0, a, 2.0), frame(1, 0, a, 3.0), frame(2, 0, b, 5.0), frame(3, 1, b, 7.0)]
    pace.check_s = 11.0
    # At first: a stop takes half a second and the rest, a frame a fifth of a second and the readout
    motion_s = pace.remaining_s(frames[1:3], 0) - (2 * (0.5 + 0.7) + 2 * (0.2 + 0.3) + 3.0 + 5.0)
    rate, acceleration = stage.feed_mm_per_s(), stage.identify().motion.acceleration_mm_per_s2[0]
    assert motion_s == pytest.approx(50.0 / rate + rate / acceleration)  # upwards, straight to the place
    expected = 3 * (0.5 + 0.7) + 4 * (0.2 + 0.3) + 17.0 + motion_s
    assert pace.remaining_s(frames, 2) == pytest.approx(expected + 2 * 11.0)
    # Measured times replace the guesses; the first frame of a stop is told from the next
    pace.here = a
    pace.depart()
    assert pace.here is None
    bench.clock.sleep_s(motion_s + 4.0)
    pace.arrive(b, timed=True)
    assert pace.here == b
    for exposure_s, besides_s in ((5.0, 0.9), (5.0, 0.4), (7.0, 0.6)):
        begun_s = bench.clock.now_s()
        bench.clock.sleep_s(exposure_s + besides_s)
        pace.finish_frame(begun_s, exposure_s)
    assert pace.remaining_s([frame(3, 1, b, 7.0)], 0) == pytest.approx(4.0 + 0.9 + 7.0)
    again = [frame(3, 1, b, 7.0), frame(4, 1, b, 7.0)]
    assert pace.remaining_s(again, 0) == pytest.approx(4.0 + 0.9 + 7.0 + 0.5 + 7.0)
    # A stop that was not timed, or began nowhere, teaches nothing
    for timed in (False, True):
        pace.here = b if not timed else None
        pace.depart()
        bench.clock.sleep_s(100.0)
        pace.arrive(b, timed=timed)
    assert pace.remaining_s(again, 0) == pytest.approx(4.0 + 0.9 + 7.0 + 0.5 + 7.0)
