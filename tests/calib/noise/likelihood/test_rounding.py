"""Noise of values rounded to whole DN, against rounded numbers and sums over their distribution."""

from dataclasses import replace
from itertools import count

import numpy as np
import pytest
from scipy import stats

from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.rounding import dark_roundings, flat_rounding
from tests.calib.noise.darkroom import dark_series, expose, specimen

SHAPE = (64, 80)
EVERY = np.ones(SHAPE, bool)


def rounded_darks(offset_dn: float, spread_dn: float, noise_dn: float, seed: int, frames: int = 20) -> list[Series]:
    """Return two series of darks without dark current, whose pixels' offsets differ by `spread_dn`."""
    noise = {"gain_dn_per_e": 1.0, "read_noise_e": noise_dn, "dark_current_e_per_s": 0.0, "dsnu_e": spread_dn}
    chip, rng = specimen(seed, shape=SHAPE, offset_dn=offset_dn, **noise)
    return dark_series(chip, (1.0, 10.0), frames, rng)


def variance_of_rounded(mean_dn: float, noise_dn: float) -> float:
    """Sum over the whole numbers that a rounded normal value may take."""
    values = np.arange(np.floor(mean_dn - 9), np.ceil(mean_dn + 9) + 1)
    chance = np.diff(stats.norm.cdf(np.append(values - 0.5, values[-1] + 0.5), mean_dn, noise_dn))
    return float(chance @ values**2 - (chance @ values) ** 2)


@pytest.mark.parametrize(("offset_dn", "spread_dn"), [(20.2, 0.02), (20.5, 0.02), (20.5, 0.2)])
def test_rounding_follows_the_phase_of_pixels(offset_dn: float, spread_dn: float) -> None:
    noise_dn = 0.42
    offsets = offset_dn + spread_dn * stats.norm.ppf(np.arange(0.005, 1, 0.01))
    true_excess = np.mean([variance_of_rounded(c, noise_dn) for c in offsets]) - noise_dn**2 - 1 / 12
    for rounding in dark_roundings(rounded_darks(offset_dn, spread_dn, noise_dn, 1), EVERY):
        error = rounding.error * (noise_dn**2 + 1 / 12)
        assert abs(rounding.excess_dn2 - true_excess) < min(error, 0.006)


def test_pixels_of_any_phase_have_usual_rounding() -> None:
    for rounding in dark_roundings(rounded_darks(20.0, 1.5, 0.42, 1), EVERY):
        assert abs(rounding.excess_dn2) < 1e-3
        assert rounding.error < 1e-3


def test_two_frames_leave_the_phase_unknown() -> None:
    """The error stays as large as rounding can make it."""
    series = rounded_darks(20.0, 0.02, 0.42, 1, frames=1) + rounded_darks(20.0, 0.02, 0.42, 2, frames=2)[:1]
    for rounding, dark in zip(dark_roundings(series, EVERY), series, strict=True):
        assert rounding.excess_dn2 == 0.0
        assert rounding == flat_rounding(dark, EVERY)
    assert rounding.error * (0.42**2 + 1 / 12) >= abs(variance_of_rounded(20.0, 0.42) - 0.42**2 - 1 / 12) * 0.9


def test_coarse_values_are_no_suspects() -> None:
    """At 0.6 DN of noise most values are the median; the others were left out, and the noise was 0.5 % too small."""
    assert not any(dark.suspect.any() for dark in rounded_darks(20.3, 0.2, 0.6, 3))


def test_read_noise_of_half_a_dn_is_right() -> None:
    series = [rounded_darks(20.5, 0.05, 0.5, seed) for seed in range(4)]
    estimates = [calibrate(darks, 255.0).estimates["read_noise_dn"] for darks in series]
    values = np.array([estimate.value for estimate in estimates], float)
    assert abs(values.mean() / 0.5 - 1) < 0.004
    intervals = [estimate.ci95 or (1.0, 0.0) for estimate in estimates]
    assert sum(low <= 0.5 <= high for low, high in intervals) >= 3


def coarse_camera(seed: int, drift_dn: float, offset_dn: float) -> list[Series]:
    """Measure 8 bits, 0.02 DN per electron, 12 e- of read noise: 0.24 DN, with a level that rises by frames."""
    converter = {"offset_dn": offset_dn, "gain_dn_per_e": 0.02, "ceiling_dn": 255.0}
    chip, rng = specimen(seed, shape=(96, 96), **converter, read_noise_e=12.0, dark_current_e_per_s=5.0, dsnu_e=10.0)
    levels_dn = (chip.offset_dn + drift_dn * index for index in count())

    def measured(conditions: Conditions, frames: int) -> Series:
        moving = [replace(chip, offset_dn=next(levels_dn)) for _ in range(frames)]
        photons = conditions.photons or 0.0
        named = [(f"{k}", expose(now, conditions.exposure_s, rng, photons)) for k, now in enumerate(moving)]
        return measure_series(named, conditions)

    darks = [measured(Conditions("dark", t), 6) for t in (0.01, 1.0, 10.0)]
    photons = np.linspace(1500.0, 22000.0, 12).tolist()
    return [*darks, *(measured(Conditions("flat", 0.01, level, light), 2) for level, light in enumerate(photons))]


@pytest.mark.parametrize(("drift_dn", "offset_dn"), [(0.0, 10.25), (0.03, 10.0)])
def test_noise_below_rounding_is_right_or_refused(drift_dn: float, offset_dn: float) -> None:
    estimates = calibrate(coarse_camera(1, drift_dn, offset_dn), 255.0).estimates
    for name, truth in {"gain_dn_per_e": 0.02, "read_noise_e": 12.0, "dark_current_e_per_s": 5.0}.items():
        estimate = estimates[name]
        if drift_dn:
            assert estimate.value is None
            assert "rounding to whole DN hides it" in str(estimate.why)
        else:
            assert estimate.ci95 is not None, estimate.why
            assert estimate.ci95[0] <= truth <= estimate.ci95[1]
    assert (estimates["dsnu_dn"].value is None) == (estimates["dsnu_e"].value is None) == bool(drift_dn)
