"""Row, column and pixel parts, spectrograms and accumulated histograms of images that are made of known parts."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, measure_series
from faintfield.calib.noise.emva.nonuniformity import (
    TemporalNoise,
    accumulated_histogram,
    high_pass,
    nonuniformity,
    spectrogram,
    temporal_noise,
)

SHAPE = (80, 100)
EVERY = np.ones(SHAPE, bool)
NONE = TemporalNoise(0.0, 0.0, 0.0)


def patterned(rng: np.random.Generator, pixel: float, row: float, column: float) -> NDArray[np.float64]:
    return np.asarray(
        100
        + pixel * rng.standard_normal(SHAPE)
        + row * rng.standard_normal((SHAPE[0], 1))
        + column * rng.standard_normal(SHAPE[1])
    )


def test_parts_are_found_within_their_intervals() -> None:
    """So in 95 of 100 images, and their mean squares without bias."""
    truth = {"pixel": 3.0, "row": 1.0, "column": 0.6, "total": np.sqrt(9 + 1 + 0.36)}
    rng = np.random.default_rng(1)
    held, squares = dict.fromkeys(truth, 0), dict.fromkeys(truth, 0.0)
    for _ in range(200):
        found = nonuniformity(patterned(rng, 3.0, 1.0, 0.6), EVERY, NONE)
        for name, true in truth.items():
            part = getattr(found, name)
            held[name] += part.ci95[0] <= true <= part.ci95[1]
            squares[name] += part.value**2 / 200
    assert all(0.90 <= count / 200 <= 0.99 for count in held.values())
    assert {name: np.sqrt(it) for name, it in squares.items()} == pytest.approx(truth, rel=0.02)


def test_temporal_noise_is_taken_out() -> None:
    """Of frames whose pixels, rows and columns all flicker; what they share in truth remains."""
    rng = np.random.default_rng(2)
    fixed = patterned(rng, 2.0, 1.5, 0.0)
    frames = [fixed + patterned(rng, 6.0, 2.0, 1.0) for _ in range(8)]
    series = measure_series([(str(k), np.rint(frame)) for k, frame in enumerate(frames)], Conditions("dark", 1.0))
    noise = temporal_noise(series, EVERY)
    assert noise.pixel == pytest.approx((36 + 1 / 12) / 8, rel=0.03)
    assert noise.row == pytest.approx((4 + 36 / 100) / 8, rel=0.2)
    found = nonuniformity(series.mean_dn, EVERY, noise)
    assert found.pixel.value == pytest.approx(2.0, rel=0.04)
    assert found.row.value == pytest.approx(1.5, rel=0.3)
    assert found.column.ci95 is not None
    assert found.column.ci95[0] == 0


def test_unusable_pixels_do_not_count_and_a_scale_does() -> None:
    rng = np.random.default_rng(3)
    image = patterned(rng, 3.0, 0.0, 0.0)
    used = rng.random(SHAPE) > 0.05
    spoilt = np.where(used, image, 1e6)
    assert nonuniformity(spoilt, used, NONE, 0.5).pixel.value == pytest.approx(1.5, rel=0.03)


@pytest.mark.parametrize("axis", [0, 1])
def test_white_noise_has_a_level_spectrogram_at_its_variance(axis: int) -> None:
    spectrum = spectrogram(patterned(np.random.default_rng(4), 3.0, 0.0, 0.0), EVERY, axis)
    assert spectrum.power.mean() == pytest.approx(9, rel=0.05)
    assert spectrum.white == pytest.approx(9, rel=0.05)
    assert spectrum.frequency.size == SHAPE[axis] // 2
    assert spectrum.frequency[[0, -1]] == pytest.approx([1 / SHAPE[axis], 0.5])


def test_a_wave_along_the_rows_is_a_peak_of_the_horizontal_spectrogram_alone() -> None:
    """A wave of amplitude A in lines of N pixels has the power A² N/4."""
    wave = np.broadcast_to(2.0 * np.cos(2 * np.pi * 0.2 * np.arange(SHAPE[1])), SHAPE)
    across, along = spectrogram(wave, EVERY, 1), spectrogram(wave, EVERY, 0)
    assert across.frequency[across.power.argmax()] == pytest.approx(0.2)
    assert across.power.max() == pytest.approx(4 * SHAPE[1] / 4)
    assert along.power.max() < 1e-20


def test_the_accumulated_histogram_counts_pixels_beyond() -> None:
    image = patterned(np.random.default_rng(5), 2.0, 0.0, 0.0)
    image[3, 4] = 200.0
    found = accumulated_histogram(image, EVERY)
    deviation = np.abs(image - image.mean())
    assert found.percent == pytest.approx([100 * np.mean(deviation >= at) for at in found.deviation], rel=1e-12)
    assert found.percent[0] == 100
    assert found.percent[-1] == 100 / image.size
    assert found.sigma == pytest.approx(2.0, rel=0.03)


def test_high_pass_takes_slopes_out_and_leaves_single_pixels() -> None:
    slope = np.add.outer(np.arange(80.0), 2 * np.arange(100.0))
    spot = slope.copy()
    spot[40, 50] += 25.0
    filtered = high_pass(spot, EVERY)
    assert np.abs(filtered[5:-5, 5:45]).max() < 1e-9
    assert filtered[40, 50] == pytest.approx(24.0)
    hidden = EVERY.copy()
    hidden[40, 50] = False
    assert filtered[40, 51] == pytest.approx(-1.0)
    assert high_pass(spot, hidden)[40, 50] == 0


def test_clean_frames_are_refused_less_than_once_in_two_hundred_sets_and_their_intervals_hold_zero() -> None:
    """Of pairs of frames of white noise, the pattern and the noise taken out of it are known equally well."""
    rng, refused, above, sets = np.random.default_rng(6), dict.fromkeys(("row", "column", "pixel", "total"), 0), 0, 600
    for _ in range(sets):
        frames = np.rint(100 + 3 * rng.standard_normal((2, 32, 40)))
        series = measure_series([(str(k), frame) for k, frame in enumerate(frames)], Conditions("dark", 1.0))
        used = np.ones(frames[0].shape, bool)
        found = nonuniformity(series.mean_dn, used, temporal_noise(series, used))
        for name in refused:
            refused[name] += getattr(found, name).value is None
        above += (found.row.ci95 or (0.0, 0.0))[0] > 0
    assert all(count <= sets / 200 for count in refused.values()), refused
    assert above < 0.05 * sets


def test_rows_whose_pattern_turns_its_sign_are_refused() -> None:
    rng = np.random.default_rng(7)
    turning = 2.0 * rng.standard_normal((SHAPE[0], 1))
    frames = [np.rint(patterned(rng, 1.0, 0.0, 0.0) + sign * turning) for sign in (1, -1, 1, -1)]
    series = measure_series([(str(k), frame) for k, frame in enumerate(frames)], Conditions("dark", 1.0))
    found = nonuniformity(series.mean_dn, EVERY, temporal_noise(series, EVERY))
    assert found.row.value is None
    assert "less scatter" in str(found.row.why)
    assert found.column.value is not None
