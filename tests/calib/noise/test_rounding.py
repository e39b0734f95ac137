"""Noise of values rounded to whole DN, against rounded numbers and sums over their distribution."""

from dataclasses import replace

import numpy as np
import pytest
from scipy import stats

from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.rounding import dark_roundings, flat_rounding
from faintfield.calib.noise.misfit.scatter import trend_dn2

SHAPE = (64, 80)


def dark_series(offset_dn: float, spread_dn: float, noise_dn: float, seed: int, frames: int = 20) -> list[Series]:
    """Return two series of darks without dark current, whose pixels' offsets differ by `spread_dn`."""
    rng = np.random.default_rng(seed)
    offsets = offset_dn + spread_dn * rng.standard_normal(SHAPE)
    series = []
    for exposure_s in (1.0, 10.0):
        frames_dn = [np.rint(offsets + noise_dn * rng.standard_normal(SHAPE)) for _ in range(frames)]
        taken = [(f"{exposure_s} {k}", frame.astype(np.uint16)) for k, frame in enumerate(frames_dn)]
        series.append(measure_series(taken, Conditions("dark", exposure_s)))
    return series


def variance_of_rounded(mean_dn: float, noise_dn: float) -> float:
    """Sum over the whole numbers that a rounded normal value may take."""
    values = np.arange(np.floor(mean_dn - 9), np.ceil(mean_dn + 9) + 1)
    chance = np.diff(stats.norm.cdf(np.append(values - 0.5, values[-1] + 0.5), mean_dn, noise_dn))
    return float(chance @ values**2 - (chance @ values) ** 2)


@pytest.mark.parametrize("offset_dn", [20.2, 20.5])
@pytest.mark.parametrize("spread_dn", [0.02, 0.2])
def test_what_rounding_adds_follows_the_phase_of_the_pixels(offset_dn: float, spread_dn: float) -> None:
    noise_dn = 0.42
    offsets = offset_dn + spread_dn * stats.norm.ppf(np.arange(0.005, 1, 0.01))
    true_excess = np.mean([variance_of_rounded(c, noise_dn) for c in offsets]) - noise_dn**2 - 1 / 12
    for found in dark_roundings(dark_series(offset_dn, spread_dn, noise_dn, 1), np.ones(SHAPE, bool)):
        error = found.error * (noise_dn**2 + 1 / 12)
        assert abs(found.excess_dn2 - true_excess) < min(error, 0.006)


def test_pixels_of_any_phase_have_the_usual_rounding() -> None:
    for found in dark_roundings(dark_series(20.0, 1.5, 0.42, 1), np.ones(SHAPE, bool)):
        assert abs(found.excess_dn2) < 1e-3
        assert found.error < 1e-3


def test_two_frames_do_not_tell_the_phase_and_the_error_stays_as_large_as_rounding_can_make_it() -> None:
    series = dark_series(20.0, 0.02, 0.42, 1, frames=1) + dark_series(20.0, 0.02, 0.42, 2, frames=2)[:1]
    for found, one in zip(dark_roundings(series, np.ones(SHAPE, bool)), series, strict=True):
        assert found.excess_dn2 == 0.0
        assert found == flat_rounding(one, np.ones(SHAPE, bool))
    assert found.error * (0.42**2 + 1 / 12) >= abs(variance_of_rounded(20.0, 0.42) - 0.42**2 - 1 / 12) * 0.9


def test_coarse_values_are_no_suspects() -> None:
    """At 0.6 DN of noise most values are the median; the others were left out, and the noise was 0.5 % too small."""
    found = dark_series(20.3, 0.2, 0.6, 3)
    assert not any(one.suspect.any() for one in found)


def test_read_noise_of_half_a_dn_is_right() -> None:
    offset_dn = 20.5
    found = [calibrate(dark_series(offset_dn, 0.05, 0.5, seed), 255.0).estimates["read_noise_dn"] for seed in range(6)]
    values = np.array([one.value for one in found], float)
    assert abs(values.mean() / 0.5 - 1) < 0.004
    assert sum(one.ci95 is not None and one.ci95[0] <= 0.5 <= one.ci95[1] for one in found) >= 5


def coarse_camera(seed: int, drift_dn: float, offset_dn: float) -> list[Series]:
    """8 bits, 0.02 DN per electron, 12 e- of read noise: 0.24 DN, with a level that rises from frame to frame."""
    rng, shape, taken = np.random.default_rng(seed), (96, 96), 0
    offsets = offset_dn + 0.2 * rng.standard_normal(shape)
    series = []

    def take(mean_e: float, conditions: Conditions, frames: int) -> Series:
        nonlocal taken
        found = []
        for k in range(frames):
            electrons = rng.poisson(mean_e, shape) + 12.0 * rng.standard_normal(shape)
            dn = offsets + 0.02 * electrons + drift_dn * taken
            found.append((f"{conditions} {k}", np.clip(np.rint(dn), 0, 255).astype(np.uint8)))
            taken += 1
        return measure_series(found, conditions)

    series += [take(5.0 * t, Conditions("dark", t), 6) for t in (0.01, 1.0, 10.0)]
    photons = np.linspace(1500.0, 22000.0, 12)
    series += [take(0.5 * p, Conditions("flat", 0.01, j, p), 2) for j, p in enumerate(photons)]
    return series


@pytest.mark.parametrize(("drift_dn", "offset_dn"), [(0.0, 10.25), (0.03, 10.0)])
def test_noise_below_the_rounding_is_right_or_refused(drift_dn: float, offset_dn: float) -> None:
    found = calibrate(coarse_camera(1, drift_dn, offset_dn), 255.0).estimates
    truths = {"gain_dn_per_e": 0.02, "read_noise_e": 12.0, "dark_current_e_per_s": 5.0}
    for name, truth in truths.items():
        one = found[name]
        if drift_dn:
            assert one.value is None
            assert "rounding to whole DN hides it" in str(one.why)
        else:
            assert one.ci95 is not None, one.why
            assert one.ci95[0] <= truth <= one.ci95[1]
    assert (found["dsnu_dn"].value is None) == (found["dsnu_e"].value is None) == bool(drift_dn)


@pytest.mark.parametrize("rise_dn", [0.0, 0.02])
def test_a_level_that_rises_within_all_series_drifts_between_them(rise_dn: float) -> None:
    rng = np.random.default_rng(5)
    series = []
    for j, exposure_s in enumerate((0.1, 1.0, 5.0, 10.0)):
        levels = 100 + rise_dn * (6 * j + np.arange(6)) + 0.001 * rng.standard_normal(6)
        one = dark_series(100.0, 0.5, 2.0, j, 6)[0]
        series.append(replace(one, conditions=Conditions("dark", exposure_s), levels_dn=levels))
    assert trend_dn2(series) == pytest.approx((6 * rise_dn) ** 2, rel=0.1)
