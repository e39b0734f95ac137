"""The checks of frames: good frames pass, each fault gives its warning, and values are what their names say."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import ndimage

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.capture.checks import board_warnings, check_frame
from faintfield.rig.capture.guide import TITLES
from faintfield.rig.plan import PlannedFrame, StepKind, Stop
from faintfield.rig.settings import CheckSettings
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import BOARD


def values(frame: Pixels, kind: StepKind, limits: CheckSettings = CheckSettings()) -> dict[str, float]:  # noqa: B008
    return dict(check_frame(frame, kind, limits).values)


def warns(word: str, frame: Pixels, kind: StepKind, earlier: list[float] | None = None) -> bool:
    findings = check_frame(frame, kind, CheckSettings(), (), [{"sharpness": value} for value in earlier or []])
    return any(word in warning for warning in findings.warnings)


def scene(kind: str) -> Pixels:
    """Return a good frame of a kind."""
    noise = np.random.default_rng(3).normal(100.0, 3.0, (120, 160))
    if kind == "charuco":
        board = np.kron(BOARD.in_opencv().generateImage((160, 106)), np.ones((3, 3)))
        noise = 100.0 + 20.0 * np.pad(board, 20, constant_values=255)
    elif kind in ("bright", "flat"):
        noise += 2000.0 + (1500.0 * (np.indices(noise.shape).sum(axis=0) % 24 < 12) if kind == "bright" else 0.0)
    return noise.astype(np.uint16)


@pytest.mark.parametrize("kind", TITLES)
def test_good_frames_give_no_warning(kind: StepKind) -> None:
    findings = check_frame(scene(kind), kind, CheckSettings(), (BOARD,), [{"sharpness": 0.1}])
    assert findings.warnings == ()
    if kind == "charuco":
        assert findings.values["board_corners"] == 8 * 5


def detailed() -> NDArray[np.uint16]:
    """Return a picture with detail, of values from 1000 DN on."""
    return np.asarray(1000 + 3000 * np.random.default_rng(5).uniform(0, 1, (60, 80)), np.uint16)


@pytest.mark.parametrize("count", [48, 49])
def test_one_pixel_in_a_hundred_may_be_saturated(count: int) -> None:
    frame = detailed()
    frame.flat[:count] = 65535
    assert values(frame, "flat")["saturated_share"] == pytest.approx(count / 4800, abs=1e-5)
    assert warns("saturated", frame, "flat") is (count > 48)


def test_pixels_at_given_saturation_count_as_saturated() -> None:
    frame = detailed()
    frame.flat[:480] = 3900
    frame.flat[480:960] = 3899
    frame.flat[960:] = 2000
    assert values(frame, "flat", CheckSettings(saturation_dn=3900.0))["saturated_share"] == 0.1
    assert values(frame.astype(np.float32), "flat")["saturated_share"] == 0.0


def test_contrast_is_range_without_outermost_hundredths() -> None:
    frame = np.arange(10_000, dtype=np.uint16).reshape(100, 100)
    assert values(frame, "bright")["contrast_dn"] == 9899.5 - 99.5
    for span, expected in ((101.0, True), (104.0, False)):  # 98 % of it against the limit of 100 DN
        faint = np.tile(np.linspace(500, 500 + span, 100), (100, 1)).astype(np.float32)
        assert warns("contrast", faint, "bright") is expected


def test_sharpness_is_relative_laplacian_of_every_second_pixel() -> None:
    frame = detailed()
    samples = frame[::2, ::2].astype(np.float64)
    expected = ndimage.laplace(samples, mode="mirror").std() / samples.std()
    sharpness = values(frame, "bright")["sharpness"]
    assert sharpness == pytest.approx(expected, rel=1e-4)
    assert values(np.full((20, 20), 700, np.uint16), "bright")["sharpness"] == 0.0
    for factor, blurred in ((1.9, False), (2.1, True)):  # the median of the earlier ones counts
        assert warns("sharpness", frame, "bright", [0.5 * sharpness, factor * sharpness, 5 * sharpness]) is blurred


def test_colours_are_judged_by_their_mean() -> None:
    colours = np.stack([detailed(), 2 * detailed(), 3 * detailed()], axis=2)
    coloured, grey = values(colours, "bright"), values(colours.mean(axis=2), "bright")
    assert coloured["contrast_dn"] == grey["contrast_dn"]
    assert coloured["sharpness"] == grey["sharpness"]


@pytest.mark.parametrize("median_dn", [299, 300])
def test_flat_must_be_bright(median_dn: int) -> None:
    frame = np.full((20, 20), median_dn, np.uint16)
    assert warns("median", frame, "flat") is (median_dn < 300)
    assert not warns("", frame, "dark_scene")


def test_leak_is_range_of_eighths_beyond_chance() -> None:
    dark = np.full((80, 165), 100.0)
    dark[70:, :20] += 30.0  # one part of 10 x 20 pixels; five columns are left over
    dark[:, 160:] = 5000.0
    assert values(dark, "dark")["leak_dn"] == pytest.approx(30.0)
    assert warns("", dark, "noise_reference")
    leaks_dn = []
    for seed in range(40):
        noisy = np.random.default_rng(seed).normal(100.0, 20.0, (80, 160))
        leaks_dn.append(values(noisy, "dark")["leak_dn"])
        parts = noisy.reshape(8, 10, 8, 20)
        chance_dn = 4.7 * np.median(parts.std(axis=(1, 3))) / np.sqrt(200)
        expected_dn = max(0.0, np.ptp(parts.mean(axis=(1, 3))) - chance_dn)
        assert leaks_dn[-1] == pytest.approx(expected_dn, abs=1e-5)
    assert 10 < np.count_nonzero(leaks_dn) < 30, "the expected range is exceeded about every other time"


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
    ("corners", "warning"),
    [
        ([0, 5, 3], "board sweep 1: none of its first 3 frames shows 6 board corners, the most is 5"),
        ([0, 5, 6, 9, 9, 0], None),  # three of six are not more than half
        ([0, 5, 6, 9, 0, 0], "board sweep 1: 4 of 6 frames show fewer than 6 board corners"),
        ([9, 9, 9, 9, 0, 0, 9, 9, 9, 9, 0, 5], "2 of 6 nodes see 6 board corners in no sweep ([0, 4], [0, 5])"),
        ([9, 9, 9, 9, 0, 0, 9, 9, 9, 0, 6, 6], None),
    ],
)
def test_warning_of_boards_out_of_view(corners: list[int], warning: str | None) -> None:
    frames = board_frames()
    warnings = board_warnings(frames[len(corners) - 1], frames, dict(enumerate(corners)), 6)
    assert len(warnings) == (warning is not None)
    assert all(text.startswith(warning or "") for text in warnings)


def test_dark_scene_states_snr_and_new_light() -> None:
    """The light of one part has the power of eq. (4), and evenly spread light counts from the darkest frame on."""
    generator = np.random.default_rng(8)
    frame = generator.normal(100.0, 7.0, (480, 640))
    frame[120:180, 320:400] += generator.normal(2.0, 0.7, (60, 80))
    first = check_frame(frame, "dark_scene", CheckSettings()).values
    assert first["snr"] == pytest.approx((2.0**2 + 0.7**2) / 7.0**2, abs=0.06)
    assert first["darkest_dn"] == pytest.approx(100.0, abs=0.5)
    assert first["stray_dn"] == 0.0
    later = check_frame(frame + 5.0, "dark_scene", CheckSettings(), (), [first, {"darkest_dn": 110.0}])
    assert later.values["stray_dn"] == pytest.approx(5.0)
    assert later.values["snr"] == pytest.approx(first["snr"])
    assert later.warnings == ()


@pytest.mark.parametrize("wanted_px", [0.0, -0.1, float("inf"), float("nan")])
def test_wanted_transfer_error_is_positive(wanted_px: float) -> None:
    with pytest.raises(ValueError, match="an error is positive"):
        CheckSettings(transfer_px=wanted_px)
