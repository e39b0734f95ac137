"""Figures of EMVA 1288 against closed forms, and patterns and spectrograms of images made of known parts."""

import re

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.noise import Conditions, Estimate, Series, measure_series
from faintfield.calib.noise.emva.nonuniformity import (
    TemporalNoise,
    accumulated_histogram,
    high_pass,
    nonuniformity,
    spectrogram,
    temporal_noise,
)
from faintfield.calib.noise.emva.quantities import (
    Inputs,
    dark_noise_e,
    derived_quantities,
    gather_inputs,
    propagate,
    snr,
    threshold_e,
)
from faintfield.calib.noise.temperature import dark_current_doubling

GAIN, READ_E, CURRENT, EFFICIENCY, FULL_E = 0.5, 8.0, 0.2, 0.6, 10_000.0


def estimate(value: float, se: float, z: float = 1.959964) -> Estimate:
    return Estimate(value, se, (value - z * se, value + z * se))


MEASURED = {
    "gain_dn_per_e": estimate(GAIN, 0.005),
    "read_noise_e": estimate(READ_E, 0.1),
    "dark_current_e_per_s": estimate(CURRENT, 0.01),
    "quantum_efficiency": estimate(EFFICIENCY, 0.008),
    "saturation_e": estimate(FULL_E, 150.0),
}


def inputs(
    *, full_well: bool = False, charge_error: float = 0.0, wider: dict[str, Estimate] | None = None, **whys: str
) -> Inputs:
    known = MEASURED | (wider or {}) | {name: Estimate(None, why=why) for name, why in whys.items()}
    names = ("offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s")
    covariance = np.diag([0.1, 0.005, 0.1, 0.01]) ** 2
    covariance[1, 2] = covariance[2, 1] = -0.8 * 0.005 * 0.1
    kept = [index for index, name in enumerate(names) if name not in whys]
    joint = ([names[i] for i in kept], covariance[np.ix_(kept, kept)])
    return gather_inputs(known, joint, full_well=full_well, charge_error=charge_error)


def test_snr_is_one_at_the_threshold() -> None:
    at = threshold_e(GAIN, READ_E)
    assert at == pytest.approx(np.sqrt(64 + (1 / 12) / 0.25 + 0.25) + 0.5)
    assert snr(np.array([at]), GAIN, READ_E) == pytest.approx(1, rel=1e-12)


def test_snr_of_shot_noise_and_prnu() -> None:
    charge = np.array([100.0, 1e12])
    assert snr(charge, 1e9, 0.0) == pytest.approx(np.sqrt(charge))
    assert snr(charge[1:], GAIN, READ_E, dsnu_e=3.0, prnu=0.01) == pytest.approx(100, rel=1e-4)
    assert snr(np.array([1.0]), 1e9, 0.0, dsnu_e=3.0) == pytest.approx(1 / np.sqrt(10))


def test_each_quantity_is_its_formula() -> None:
    quantities = derived_quantities(inputs(), 10.0)
    noise = np.sqrt(READ_E**2 + CURRENT * 10)
    least = np.sqrt(noise**2 + 1 / 12 / GAIN**2 + 0.25) + 0.5
    assert {name: quantity.value for name, quantity in quantities.items()} == pytest.approx(
        {
            "dark_noise_e": noise,
            "responsivity_dn_per_photon": GAIN * EFFICIENCY,
            "threshold_e": least,
            "threshold_photons": least / EFFICIENCY,
            "saturation_photons": FULL_E / EFFICIENCY,
            "snr_max": np.sqrt(FULL_E),
            "dynamic_range": FULL_E / least,
        }
    )
    assert dark_noise_e(READ_E, -1.0, 100.0) == READ_E, "a dark current below zero takes no noise away"


def test_errors_shared_with_the_gain_cancel() -> None:
    """R = K η is known as well as the levels; so is μ_p.sat = μ_e.sat/η at the end of the converter, unlike in a well.

    An efficiency without any error of its own still rests on the bend of the response.
    """
    own_efficiency = np.sqrt(0.008**2 - (EFFICIENCY / GAIN * 0.005) ** 2) / EFFICIENCY
    own_full = np.sqrt(150**2 - (FULL_E / GAIN * 0.005) ** 2) / FULL_E
    photons = FULL_E / EFFICIENCY
    quantities = derived_quantities(inputs(), 0.0)
    responsivity = quantities["responsivity_dn_per_photon"]
    assert responsivity.se == pytest.approx(GAIN * EFFICIENCY * own_efficiency, rel=1e-3)
    assert quantities["saturation_photons"].se == pytest.approx(photons * np.hypot(own_efficiency, own_full), rel=1e-3)
    well = derived_quantities(inputs(full_well=True), 0.0)["saturation_photons"]
    assert well.se == pytest.approx(photons * np.sqrt(0.015**2 - (0.008 / EFFICIENCY) ** 2), rel=1e-3)
    shared = {"quantum_efficiency": estimate(EFFICIENCY, 0.01 * EFFICIENCY)}
    for wider in (shared, shared | {"gain_dn_per_e": estimate(GAIN, 0.005, z=4.0)}):
        bent = derived_quantities(inputs(wider=wider, charge_error=1e-3), 0.0)["responsivity_dn_per_photon"]
        assert bent.se == pytest.approx(1e-3 * GAIN * EFFICIENCY, rel=1e-3)


def test_propagated_errors_are_those_of_draws() -> None:
    joint = inputs()
    draws = np.random.default_rng(1).multivariate_normal(list(joint.values.values()), joint.covariance, 20_000)
    gain, read, _, efficiency, full = draws.T
    least = np.sqrt(read**2 + 1 / 12 / gain**2 + 0.25) + 0.5
    quantities = derived_quantities(joint, 0.0)
    for name, drawn in (("threshold_photons", least / efficiency), ("dynamic_range", full / least)):
        assert quantities[name].se == pytest.approx(drawn.std(), rel=0.02)
        low, high = quantities[name].ci95 or (np.nan, np.nan)
        assert np.mean((drawn > low) & (drawn < high)) == pytest.approx(0.95, abs=0.006)
    value, se = propagate(lambda a, b: a**3 / b, np.array([2.0, 5.0]), np.diag([0.02**2, 0.1**2]))
    assert (value, se) == pytest.approx((1.6, 1.6 * np.hypot(3 * 0.01, 0.02)), rel=1e-4)


def test_wide_intervals_stay_wide() -> None:
    wide = Estimate(READ_E, 0.1, (READ_E - 0.3, READ_E + 0.3))
    interval = derived_quantities(inputs(wider={"read_noise_e": wide}), 0.0)["dark_noise_e"].ci95
    assert interval is not None
    assert np.ptp(interval) == pytest.approx(0.6, rel=1e-3)


def test_missing_input_is_the_reason() -> None:
    quantities = derived_quantities(inputs(quantum_efficiency="no photons", saturation_e="not reached"), 0.0)
    assert quantities["threshold_photons"].why == quantities["responsivity_dn_per_photon"].why == "no photons"
    assert quantities["snr_max"].why == quantities["dynamic_range"].why == "not reached"
    assert quantities["threshold_e"].value is not None


SHAPE = (80, 100)
EVERY = np.ones(SHAPE, bool)
NONE = TemporalNoise(np.zeros(3), np.zeros(3))


def patterned(rng: np.random.Generator, pixel: float, row: float, column: float) -> NDArray[np.float64]:
    return np.asarray(
        100
        + pixel * rng.standard_normal(SHAPE)
        + row * rng.standard_normal((SHAPE[0], 1))
        + column * rng.standard_normal(SHAPE[1])
    )


def darks_of(frames: list[NDArray[np.float64]]) -> Series:
    return measure_series([(str(k), np.rint(frame)) for k, frame in enumerate(frames)], Conditions("dark", 1.0))


def test_parts_of_a_pattern_lie_within_intervals() -> None:
    """So in 95 of 100 images, and their mean squares without bias."""
    truth = {"pixel": 3.0, "row": 1.0, "column": 0.6, "total": np.sqrt(9 + 1 + 0.36)}
    rng = np.random.default_rng(1)
    held, squares = dict.fromkeys(truth, 0), dict.fromkeys(truth, 0.0)
    for _ in range(200):
        parts = nonuniformity(patterned(rng, 3.0, 1.0, 0.6), EVERY, NONE)
        for name, true in truth.items():
            part = getattr(parts, name)
            held[name] += part.ci95[0] <= true <= part.ci95[1]
            squares[name] += part.value**2 / 200
    assert all(0.90 <= count / 200 <= 0.99 for count in held.values())
    assert {name: np.sqrt(square) for name, square in squares.items()} == pytest.approx(truth, rel=0.02)


def test_temporal_noise_is_subtracted() -> None:
    """Pixels, rows and columns all flicker from frame to frame; what frames share in truth remains."""
    rng = np.random.default_rng(2)
    fixed = patterned(rng, 2.0, 1.5, 0.0)
    series = darks_of([fixed + patterned(rng, 6.0, 2.0, 1.0) for _ in range(8)])
    noise = temporal_noise(series, EVERY)
    assert noise.variances[0] == pytest.approx((36 + 1 / 12) / 8, rel=0.03)
    assert noise.variances[1] == pytest.approx((4 + 36 / 100) / 8, rel=0.2)
    parts = nonuniformity(series.mean_dn, EVERY, noise)
    assert parts.pixel.value == pytest.approx(2.0, rel=0.04)
    assert parts.row.value == pytest.approx(1.5, rel=0.3)
    assert parts.column.ci95 is not None
    assert parts.column.ci95[0] == 0


def test_unusable_pixels_do_not_count() -> None:
    rng = np.random.default_rng(3)
    image, used = patterned(rng, 3.0, 0.0, 0.0), rng.random(SHAPE) > 0.05
    assert nonuniformity(np.where(used, image, 1e6), used, NONE, 0.5).pixel.value == pytest.approx(1.5, rel=0.03)


@pytest.mark.parametrize("axis", [0, 1])
def test_spectrogram_of_white_noise_is_level(axis: int) -> None:
    spectrum = spectrogram(patterned(np.random.default_rng(4), 3.0, 0.0, 0.0), EVERY, axis)
    assert (spectrum.power.mean(), spectrum.white) == pytest.approx((9, 9), rel=0.05)
    assert spectrum.frequency.size == SHAPE[axis] // 2
    assert spectrum.frequency[[0, -1]] == pytest.approx([1 / SHAPE[axis], 0.5])


def test_wave_along_rows_peaks_in_one_spectrogram() -> None:
    """A wave of amplitude A in lines of N pixels has the power A² N/4."""
    wave = np.broadcast_to(2.0 * np.cos(2 * np.pi * 0.2 * np.arange(SHAPE[1])), SHAPE)
    across, along = spectrogram(wave, EVERY, 1), spectrogram(wave, EVERY, 0)
    assert across.frequency[across.power.argmax()] == pytest.approx(0.2)
    assert across.power.max() == pytest.approx(4 * SHAPE[1] / 4)
    assert along.power.max() < 1e-20


def test_accumulated_histogram_counts_pixels_beyond() -> None:
    image = patterned(np.random.default_rng(5), 2.0, 0.0, 0.0)
    image[3, 4] = 200.0
    histogram = accumulated_histogram(image, EVERY)
    deviation = np.abs(image - image.mean())
    assert histogram.percent == pytest.approx([100 * np.mean(deviation >= at) for at in histogram.deviation], rel=1e-12)
    assert histogram.percent[[0, -1]] == pytest.approx([100, 100 / image.size])
    assert histogram.sigma == pytest.approx(2.0, rel=0.03)


def test_high_pass_removes_slopes_and_leaves_pixels() -> None:
    spot = np.add.outer(np.arange(80.0), 2 * np.arange(100.0))
    spot[40, 50] += 25.0
    filtered = high_pass(spot, EVERY)
    assert np.abs(filtered[5:-5, 5:45]).max() < 1e-9
    assert filtered[40, 50:52] == pytest.approx([24.0, -1.0])
    hidden = EVERY.copy()
    hidden[40, 50] = False
    assert high_pass(spot, hidden)[40, 50] == 0


def test_clean_frames_are_seldom_refused() -> None:
    """Of pairs of frames of white noise, the pattern and the noise taken out of it are known equally well."""
    rng, refused, above, sets = np.random.default_rng(6), dict.fromkeys(("row", "column", "pixel", "total"), 0), 0, 400
    used = np.ones((32, 40), bool)
    for _ in range(sets):
        series = darks_of(list(100 + 3 * rng.standard_normal((2, 32, 40))))
        parts = nonuniformity(series.mean_dn, used, temporal_noise(series, used))
        for name in refused:
            refused[name] += getattr(parts, name).value is None
        above += (parts.row.ci95 or (0.0, 0.0))[0] > 0
    assert all(count <= sets / 200 for count in refused.values()), refused
    assert above < 0.05 * sets, "intervals hold zero"


def test_rows_that_turn_their_sign_are_refused() -> None:
    rng = np.random.default_rng(7)
    turning = 2.0 * rng.standard_normal((SHAPE[0], 1))
    series = darks_of([patterned(rng, 1.0, 0.0, 0.0) + sign * turning for sign in (1, -1, 1, -1)])
    parts = nonuniformity(series.mean_dn, EVERY, temporal_noise(series, EVERY))
    assert parts.row.value is None
    assert "less scatter" in str(parts.row.why)
    assert parts.column.value is not None


T = np.tile([0.1, 10.0, 60.0], 12)
WARMTH = np.repeat([10.0, 15.0, 20.0, 25.0], 9)


def levels(rng: np.random.Generator, doubling_k: float = 7.0, noise_dn: float = 0.05) -> NDArray[np.float64]:
    """Return levels whose offset drifts by 0.3 DN per kelvin; long exposures are noisier."""
    level = 100 + 0.3 * WARMTH + 2.0 * T * 2 ** ((WARMTH - 17.5) / doubling_k)
    return np.asarray(level + noise_dn * np.sqrt(1 + T) * rng.standard_normal(T.size))


def test_doubling_temperature_lies_within_its_interval() -> None:
    rng, held, values = np.random.default_rng(1), 0, []
    for _ in range(100):
        doubling = dark_current_doubling(levels(rng), T, WARMTH)
        low, high = doubling.ci95 or (np.nan, np.nan)
        held += low <= 7.0 <= high
        values.append(doubling.value or np.nan)
    assert 88 <= held <= 100
    assert np.mean(values) == pytest.approx(7.0, rel=1e-3)
    assert doubling.se == pytest.approx(np.std(values), rel=0.4)


@pytest.mark.parametrize(
    ("warmth", "noise_dn", "words"),
    [
        (np.full(T.size, np.nan), 0.05, "states its temperature"),
        (20 + 0.01 * WARMTH, 0.05, r"differ by 0\.15 K \(limit 5 K\)"),
        (WARMTH, 500.0, "too little dark current"),
    ],
)
def test_invisible_doubling_has_a_reason(warmth: NDArray[np.float64], noise_dn: float, words: str) -> None:
    doubling = dark_current_doubling(levels(np.random.default_rng(1), noise_dn=noise_dn), T, warmth)
    assert doubling.value is None
    assert re.search(words, doubling.why or "")


def test_frames_without_a_temperature_do_not_count() -> None:
    level, warmth = levels(np.random.default_rng(1)), WARMTH.copy()
    level[3], warmth[3] = 1e6, np.nan
    assert dark_current_doubling(level, T, warmth).value == pytest.approx(7.0, rel=0.02)
