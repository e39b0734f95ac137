"""Darks at several temperatures tell their dark current and its growth, with or without a stated doubling."""

from dataclasses import replace

import numpy as np
import pytest

from faintfield.calib.noise import Conditions, NoiseCalibration, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import gather_moments
from faintfield.calib.noise.misfit.temperature import Warmth, settle_temperature, with_doubling_error
from faintfield.calib.noise.result import Estimate
from tests.calib.noise.darkroom import expose, specimen

CURRENT, DOUBLING_K = 10.0, 6.0


def take(
    stated_k: float | None, warmth: tuple[float, ...] = (10.0, 20.0, 30.0), current: float = CURRENT
) -> list[Series]:
    """Darks of 3 exposures at each temperature; a dark exposure is longer by as much as its current is larger."""
    chip, rng = specimen(5, dark_current_e_per_s=current, gain_dn_per_e=0.5, read_noise_e=8.0, shape=(48, 48))
    series = []
    for kelvin in warmth:
        growth = 2 ** ((kelvin - 20) / DOUBLING_K)
        factor = 1.0 if stated_k is None else 2 ** ((kelvin - 20) / stated_k)
        for t in (0.01, 1.0, 10.0):
            frames = [(f"{kelvin} {t} {k}", expose(chip, t * growth, rng)) for k in range(4)]
            series.append(measure_series(frames, Conditions("dark", t, dark_factor=factor, temperature_c=kelvin)))
    flats = [(f"flat{k}", expose(chip, 0.01, rng, 8000.0)) for k in range(6)]
    return [*series, measure_series(flats, Conditions("flat", 0.01))]


def current_of(result: NoiseCalibration) -> tuple[float, float]:
    found = result.estimates["dark_current_e_per_s"]
    assert found.ci95 is not None, found.why
    return found.ci95


@pytest.mark.parametrize("stated_k", [DOUBLING_K, None])
def test_the_dark_current_is_that_at_the_mean_temperature_and_no_jitter_is_invented(stated_k: float | None) -> None:
    result = calibrate(take(stated_k))
    low, high = current_of(result)
    assert low < CURRENT < high
    assert high - low < 0.08 * CURRENT
    jitter = result.estimates["frame_jitter_dn"]
    assert jitter.value is not None
    assert jitter.value < 0.1
    told = [warning for warning in result.warnings if "doubling" in warning]
    assert len(told) == (stated_k is None)
    assert all("doubles every 6" in warning for warning in told)


def test_a_stated_doubling_that_the_darks_contradict_is_named_with_theirs() -> None:
    result = calibrate(take(9.0))
    (told,) = (warning for warning in result.warnings if "dark_current_doubling_k = 9 " in warning)
    assert "doubles every 6 ±" in told or "doubles every 5.9" in told or "doubles every 6.0" in told
    assert result.estimates["dark_current_e_per_s"].value is None


def test_temperatures_that_show_no_doubling_widen_the_dark_current() -> None:
    """Two kelvins leave 10 % of the dark current open: half a range either way, at 10 % per kelvin."""
    series = take(None, (20.0, 22.0))
    result, settled = calibrate(series), settle_temperature(series)
    assert settled[0] is series
    assert any("nothing tells how their dark current grows" in warning for warning in result.warnings)
    found = result.estimates["dark_signal_dn_per_s"]
    assert found.value is not None
    assert found.se is not None
    assert found.se >= 0.1 * found.value


def test_the_error_of_the_doubling_is_that_of_the_slope() -> None:
    """Levels that follow the line: the slope at other factors, by finite differences of a fit by numpy."""
    series = take(None)
    darks, warmth = settle_temperature(series)
    assert warmth.doubling is not None
    moments = gather_moments(list(darks[:9]), [], np.ones((48, 48), bool))
    fit = NoiseFit({"offset_dn": 100.0, "dark_signal_dn_per_s": 5.0}, np.diag([1.0, 1e-6]), 0.0)
    far = replace(warmth, doubling=Estimate(DOUBLING_K, 0.1))
    grown = with_doubling_error(fit, moments, list(darks[:9]), far)
    level = np.array([one.levels_dn.mean() for one in series[:9]])
    kelvin = np.repeat([10.0, 20.0, 30.0], 3) - 20
    slopes = [np.polyfit(np.tile([0.01, 1.0, 10.0], 3) * 2 ** (kelvin / k), level, 1)[0] for k in (5.9, 6.1)]
    assert grown.covariance[1, 1] - 1e-6 == pytest.approx((0.5 * (slopes[1] - slopes[0])) ** 2, rel=0.05)
    assert with_doubling_error(fit, moments, list(darks[:9]), Warmth()) is fit
