"""Mass functions against scipy, the marginal likelihood against quadrature, and fits where a Gaussian fails."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise import calibrate
from faintfield.calib.noise.likelihood.exact import _flat_part, _in_gaussian_terms
from faintfield.calib.noise.likelihood.gaussian_fit import Bend, NoiseFit
from faintfield.calib.noise.likelihood.marginal import (
    DARK_LOG_WEIGHTS,
    DARK_NODES,
    PARAMETERS,
    Counts,
    MarginalLikelihood,
    mass_function,
)
from faintfield.calib.noise.likelihood.moments import Moments, SeriesMoments
from faintfield.calib.noise.sensor_fit import NoiseLikelihood
from tests.calib.noise.darkroom import EXPOSURES_S, TRUTH, dark_series, expose, specimen
from tests.calib.noise.likelihood.slopes import slopes


def brute_tail(u: NDArray[np.float64], charge: float, gain: float, read: float, *, exact: bool) -> NDArray[np.float64]:
    if not exact:
        return np.asarray(stats.norm.cdf(u, gain * charge, gain * np.sqrt(read**2 + charge)))
    k = np.arange(int(charge + 12 * np.sqrt(charge) + 20))
    return np.asarray(stats.norm.cdf(u[:, None], gain * k, gain * read) @ stats.poisson.pmf(k, charge))


@settings(max_examples=20)
@given(
    gain=st.floats(0.3, 8.0),
    read=st.floats(0.15, 6.0),
    charge=st.floats(0.01, 40.0),
    exact=st.booleans(),
)
def test_mass_function_is_that_of_rounded_sums(gain: float, read: float, charge: float, exact: bool) -> None:
    u = np.arange(-200.0, 900.0) + 0.3
    masses = mass_function(u, 2.0, charge, exact=exact, spread=False)
    (log_mass, _), _ = masses(np.log([gain, read, charge / 2.0, 1.0]))
    expected = np.diff(brute_tail(np.append(u - 0.5, u[-1] + 0.5), charge, gain, read, exact=exact))
    np.testing.assert_allclose(np.exp(log_mass[:, 0]), np.maximum(expected, 1e-14), rtol=1e-6, atol=1e-12)
    assert np.exp(log_mass).sum() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("exact", [True, False])
def test_slopes_are_those_of_small_differences(exact: bool) -> None:
    u = np.linspace(-4, 40, 89)
    masses = mass_function(u, 3.0, 20.0, exact=exact, spread=True)
    at = np.array([np.log(2.0), np.log(0.6), np.log(2.0), 0.15])
    differences = slopes(lambda x: masses(x)[0], at)
    for logarithm, slope, difference in zip(*masses(at), differences, strict=True):
        likely = logarithm > -14
        np.testing.assert_allclose(slope[:, likely], difference[likely].T, atol=1e-3)
        assert likely.mean() > 0.3


def test_log_likelihood_is_an_integral_by_quadrature() -> None:
    floor_dn = 97
    chip, rng = specimen(2, shape=(2, 2), read_noise_e=0.5, dcnu=0.15)
    exposures_s = (0.5, 40.0)
    frames = [np.array([expose(chip, t, rng).ravel() for _ in range(3)]).astype(np.int32) for t in exposures_s]
    frames = [np.maximum(values, floor_dn) for values in frames]
    gain, read, dark, spread, centre, width = 2.1, 0.45, 0.22, 0.12, 99.5, 3.2
    offsets = np.arange(centre - 20, centre + 20, 0.04)
    integrand = np.zeros((4, offsets.size))
    for z, weight in zip(DARK_NODES, np.exp(DARK_LOG_WEIGHTS), strict=True):
        product = np.full((4, offsets.size), weight)
        for t, values in zip(exposures_s, frames, strict=True):
            charge = dark * (1 + spread * z) * t
            for (_, pixel), y in np.ndenumerate(values):
                mass = brute_tail(y + 0.5 - offsets, charge, gain, read, exact=True)
                if y != floor_dn:
                    mass = mass - brute_tail(y - 0.5 - offsets, charge, gain, read, exact=True)
                product[pixel] *= mass
        integrand += product
    expected = np.log(np.trapezoid(integrand * stats.norm.pdf(offsets, centre, width), offsets)).sum()
    at = np.array([*np.log([gain, read, dark]), spread, centre, np.log(width)])
    counts, start = Counts(exposures_s, tuple(frames), floor_dn), dict(zip(PARAMETERS, at, strict=True))
    assert MarginalLikelihood(counts, start, exact=True, spread=True).evaluate(at)[0] == pytest.approx(
        expected, abs=0.02
    )


@pytest.mark.parametrize(("sets", "error"), [(1, 0.05), pytest.param(24, 0.005, marks=pytest.mark.deep)])
def test_values_below_black_leave_no_bias(sets: int, error: float) -> None:
    """A third of the short darks' values are cut off; moments would have the gain half as large again."""
    errors = []
    for seed in range(sets):
        chip, rng = specimen(seed, offset_dn=3.0)
        result = calibrate(dark_series(chip, EXPOSURES_S, 10, rng))
        assert result.likelihood is NoiseLikelihood.CENSORED
        assert np.ptp(result.maps.offset_dn) == 0
        assert any("cut off" in warning for warning in result.warnings)
        assert result.estimates["frame_jitter_dn"].value is None
        errors.append([(result.estimates[name].value or np.nan) / value - 1 for name, value in TRUTH.items()])
    assert np.abs(np.mean(errors, axis=0)).max() < error


def test_single_repeated_exposure_gives_an_offset() -> None:
    chip, rng = specimen(6, read_noise_e=0.2)
    result = calibrate([*dark_series(chip, (1.0,), 10, rng), *dark_series(chip, (60.0,), 1, rng)])
    assert result.estimates["gain_dn_per_e"].value is None
    assert result.estimates["offset_dn"].value == pytest.approx(100, abs=0.5)


def in_gaussian_terms(x: NDArray[np.float64], covariance: NDArray[np.float64]) -> NoiseFit:
    return _in_gaussian_terms(NoiseFit(dict(zip(PARAMETERS, x.tolist(), strict=True)), covariance, 0.0))


def test_covariance_passes_on_by_slopes_of_parameters() -> None:
    at = np.array([np.log(2.0), np.log(0.5), np.log(0.2), 0.15, 100.0, np.log(3.0)])
    gaussian = in_gaussian_terms(at, np.eye(6)).values
    gain, dark = 2.0, 0.2
    assert gaussian["log_read_dn2"] == pytest.approx(np.log((gain * 0.5) ** 2))
    assert gaussian["dsnu_dn2"] == pytest.approx(9.0)
    assert gaussian["dark_signal_dn_per_s"] == pytest.approx(gain * dark)
    assert gaussian["dcnu_dn2_per_s2"] == pytest.approx((0.15 * gain * dark) ** 2)
    by_difference = slopes(lambda x: np.array(list(in_gaussian_terms(x, np.eye(6)).values.values())), at)
    root = np.random.default_rng(1).normal(size=(6, 6))
    expected = by_difference @ root @ root.T @ by_difference.T
    np.testing.assert_allclose(in_gaussian_terms(at, root @ root.T).covariance, expected, rtol=1e-6, atol=1e-6)


def test_likelihood_of_flats_has_slopes_and_information() -> None:
    at, straight = np.array([np.log(2.0), np.log(1.4), np.log(0.2), 0.0, 100.0, np.log(3.0)]), Bend({}, np.eye(0))
    frames, mean_dn, within_dn2 = np.array([4.0, 3.0]), np.array([2100.0, 9100.0]), np.array([9e6, 3e7])
    evenness, zeros = np.array([0.95, 0.9]), np.zeros(2)
    flats = SeriesMoments(zeros, frames, mean_dn, within_dn2, zeros, zeros, evenness)
    degrees = (frames - 1) * 1000.0 * evenness

    def by_hand(x: NDArray[np.float64]) -> NDArray[np.float64]:
        v = np.exp(x[0]) * (mean_dn - x[4]) + np.exp(2 * (x[0] + x[1])) + 1 / 12
        return np.array([-0.5 * np.sum(degrees * np.log(v) + within_dn2 * evenness / v), *np.log(v)])

    value, gradient, information = _flat_part(at, Moments(1100.0, 1000.0, flats, np.zeros((0, 0))), straight)
    derivative = slopes(by_hand, at)
    assert value == pytest.approx(by_hand(at)[0], rel=1e-12)
    np.testing.assert_allclose(gradient, derivative[0], rtol=1e-5, atol=1e-4)
    # The Fisher information of s² ~ v χ²_ν is ν/2 for ln v
    expected = derivative[1:].T @ np.diag(degrees / 2) @ derivative[1:]
    np.testing.assert_allclose(information, expected, rtol=1e-5, atol=1e-6)
