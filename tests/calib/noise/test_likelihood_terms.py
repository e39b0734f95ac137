"""The terms of the noise likelihoods against scipy's densities, and their derivatives against small differences."""

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise import measure_series
from faintfield.calib.noise.likelihood.exact import Bent, _flat_part, _Maximum
from faintfield.calib.noise.likelihood.gaussian import main_quantities, negative_log_likelihood
from faintfield.calib.noise.likelihood.marginal import PARAMETERS
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import DarkMoments, FlatMoments, Moments
from faintfield.calib.noise.maps.pixels import quantum_efficiency
from faintfield.calib.noise.series.statistics import Conditions, Series
from tests.calib.noise.darkroom import darks, specimen

type Function = Callable[[NDArray[np.float64]], NDArray[np.float64]]

DARKS = DarkMoments(
    exposure_s=np.array([0.1, 2.0, 10.0, 60.0]),
    frames=np.array([5.0, 4.0, 6.0, 1.0]),
    mean_dn=np.array([100.2, 101.0, 104.5, 124.0]),
    within_dn2=np.array([41_000.0, 32_000.0, 60_000.0, 0.0]),
    level_scatter_dn2=np.array([0.6, 0.4, 1.1, 0.0]),
    scatter_dn2=np.array(
        [
            [9500.0, 8000.0, 8200.0, 8100.0],
            [8000.0, 9900.0, 8300.0, 8300.0],
            [8200.0, 8300.0, 9800.0, 8900.0],
            [8100.0, 8300.0, 8900.0, 30_000.0],
        ]
    ),
)
FLATS = FlatMoments(
    frames=np.array([4.0, 3.0]),
    mean_dn=np.array([2100.0, 9100.0]),
    within_dn2=np.array([9e6, 3e7]),
    evenness=np.array([0.95, 0.9]),
)
STRAIGHT = Bent({}, np.zeros((0, 0)))
NO_FLATS = FlatMoments(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))
HERE = {
    "offset_dn": 100.0, "log_read_dn2": np.log(8.0), "dsnu_dn2": 7.0, "jitter_dn2": 0.1,
    "dark_signal_dn_per_s": 0.4, "dcnu_dn2_per_s2": 0.003, "log_gain": np.log(2.0), "nonlinearity_per_dn": 2e-6,
}  # fmt: skip
THERE = HERE | {
    "offset_dn": 100.7, "log_read_dn2": np.log(9.5), "dsnu_dn2": 8.5, "jitter_dn2": 0.16,
    "dark_signal_dn_per_s": 0.43, "dcnu_dn2_per_s2": 0.007, "log_gain": np.log(2.2), "nonlinearity_per_dn": -1e-6,
}  # fmt: skip


def by_scipy(values: dict[str, float], moments: Moments) -> float:
    """Return ln L from the densities of chi-squared, Wishart and normal variables."""
    gain, read, kappa = np.exp(values["log_gain"]), np.exp(values["log_read_dn2"]), values["nonlinearity_per_dn"]
    of_darks, t = moments.darks, moments.darks.exposure_s
    v = read + gain * values["dark_signal_dn_per_s"] * t + 1 / 12
    total = 0.0
    repeated = of_darks.frames > 1
    for n, squares, variance in zip(of_darks.frames[repeated], of_darks.within_dn2[repeated], v[repeated], strict=True):
        total += stats.chi2.logpdf(squares / variance, (n - 1) * moments.freedom) - np.log(variance)
    scale = np.diag(v / of_darks.frames) + values["dsnu_dn2"] + values["dcnu_dn2_per_s2"] * np.outer(t, t)
    several = np.ix_(repeated, repeated)
    total += float(stats.wishart.logpdf(of_darks.scatter_dn2[several], moments.freedom, scale[several]))
    level = values["jitter_dn2"] + v / moments.pixels
    line = values["offset_dn"] + values["dark_signal_dn_per_s"] * t
    total += float(np.sum(stats.norm.logpdf(of_darks.mean_dn, line, np.sqrt(level / of_darks.frames))))
    for n, squares, variance in zip(
        of_darks.frames[repeated], of_darks.level_scatter_dn2[repeated], level[repeated], strict=True
    ):
        total += stats.chi2.logpdf(squares / variance, n - 1) - np.log(variance)
    design = np.stack([np.ones_like(t), t], axis=1)
    total -= 0.5 * np.linalg.slogdet(design.T @ (design * (of_darks.frames / level)[:, None]))[1]
    of_flats = moments.flats
    for n, mean, squares, evenness in zip(
        of_flats.frames, of_flats.mean_dn, of_flats.within_dn2, of_flats.evenness, strict=True
    ):
        s = mean - values["offset_dn"]
        variance = (gain * s * (1 + kappa * s) + read) / (1 + 2 * kappa * s) ** 2 + 1 / 12
        degrees = (n - 1) * moments.freedom * evenness
        total += stats.chi2.logpdf(squares * evenness / variance, degrees) - np.log(variance)
    return float(total)


@pytest.mark.parametrize("flats", [FLATS, NO_FLATS], ids=["with flats", "darks alone"])
def test_the_gaussian_likelihood_is_that_of_chi_squared_wishart_and_normal_variables(
    flats: FlatMoments,
) -> None:
    moments = Moments(1200.0, 1100.0, DARKS, flats)
    rise = by_scipy(THERE, moments) - by_scipy(HERE, moments)
    ours = float(negative_log_likelihood(HERE, moments)) - float(negative_log_likelihood(THERE, moments))
    assert ours == pytest.approx(rise, rel=1e-9, abs=1e-7)


def slopes(
    function: Callable[[NDArray[np.float64]], NDArray[np.float64]], at: NDArray[np.float64]
) -> NDArray[np.float64]:
    """Return the derivative (value, parameter) by central differences."""
    columns = []
    for index in range(len(at)):
        step = np.zeros(len(at))
        step[index] = 1e-5
        columns.append((function(at + step) - function(at - step)) / 2e-5)
    return np.stack(columns, axis=-1)


def test_derivatives_of_the_main_quantities_are_those_of_small_differences() -> None:
    names = list(HERE)
    at = np.array(list(HERE.values()))

    def values(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([value for value, _ in main_quantities(dict(zip(names, x.tolist(), strict=True))).values()])

    by_difference = slopes(values, at)
    found = main_quantities(HERE)
    assert found["gain_dn_per_e"][0] == pytest.approx(2.0)
    assert found["read_noise_e"][0] == pytest.approx(np.sqrt(8.0) / 2.0)
    assert found["dark_current_e_per_s"][0] == pytest.approx(0.2)
    for row, (_, derivatives) in zip(by_difference, found.values(), strict=True):
        np.testing.assert_allclose(row, [derivatives.get(name, 0.0) for name in names], atol=1e-8)


def test_a_parameter_that_was_not_fitted_has_an_infinite_error() -> None:
    fit = NoiseFit({"offset_dn": 1.0, "log_gain": 2.0}, np.diag([4.0, 9.0]), 0.0)
    assert fit.standard_error("offset_dn") == 2.0
    assert fit.standard_error("log_gain") == 3.0
    assert fit.standard_error("jitter_dn2") == np.inf


def in_gaussian_terms(x: NDArray[np.float64]) -> dict[str, float]:
    size = len(PARAMETERS)
    return _Maximum(x, np.zeros((size, size)), 0.0).fit().values


def test_the_exact_fit_passes_its_covariance_on_by_the_slopes_of_the_parameters() -> None:
    at = np.array([np.log(2.0), np.log(0.5), np.log(0.2), 0.15, 100.0, np.log(3.0)])
    gaussian = in_gaussian_terms(at)
    gain, dark = 2.0, 0.2
    assert gaussian["log_read_dn2"] == pytest.approx(np.log((gain * 0.5) ** 2))
    assert gaussian["dsnu_dn2"] == pytest.approx(9.0)
    assert gaussian["dark_signal_dn_per_s"] == pytest.approx(gain * dark)
    assert gaussian["dcnu_dn2_per_s2"] == pytest.approx((0.15 * gain * dark) ** 2)
    by_difference = slopes(lambda x: np.array(list(in_gaussian_terms(x).values())), at)
    root = np.random.default_rng(1).normal(size=(6, 6))
    covariance = root @ root.T
    found = _Maximum(at, covariance, 0.0).fit().covariance
    np.testing.assert_allclose(found, by_difference @ covariance @ by_difference.T, rtol=1e-6, atol=1e-6)


def test_the_flats_part_of_the_exact_likelihood_has_the_right_slopes_and_information() -> None:
    at = np.array([np.log(2.0), np.log(1.4), np.log(0.2), 0.0, 100.0, np.log(3.0)])

    def by_hand(x: NDArray[np.float64]) -> NDArray[np.float64]:
        gain, read_dn2 = np.exp(x[0]), np.exp(2 * (x[0] + x[1]))
        v = gain * (FLATS.mean_dn - x[4]) + read_dn2 + 1 / 12
        degrees = (FLATS.frames - 1) * 1000.0 * FLATS.evenness
        return np.array([-0.5 * np.sum(degrees * np.log(v) + FLATS.within_dn2 * FLATS.evenness / v), *np.log(v)])

    value, gradient, information = _flat_part(at, Moments(1100.0, 1000.0, DARKS, FLATS), STRAIGHT)
    expected, derivative = by_hand(at), slopes(by_hand, at)
    assert value == pytest.approx(expected[0], rel=1e-12)
    np.testing.assert_allclose(gradient, derivative[0], rtol=1e-5, atol=1e-4)
    # The Fisher information of s² ~ v χ²_ν is ν/2 for ln v
    weights = 0.5 * (FLATS.frames - 1) * 1000.0 * FLATS.evenness
    np.testing.assert_allclose(information, derivative[1:].T @ np.diag(weights) @ derivative[1:], rtol=1e-5, atol=1e-6)
    nothing = _flat_part(at, Moments(1100.0, 1000.0, DARKS, NO_FLATS), STRAIGHT)
    assert nothing[0] == 0.0
    assert not nothing[1].any()
    assert nothing[2].shape == (6, 6)


def flat_of(photons: float | None) -> Series:
    chip, rng = specimen(1, shape=(16, 16))
    return measure_series(darks(chip, [1.0], 3, rng)[1.0], Conditions("flat", 1.0, photons=photons))


def test_the_quantum_efficiency_is_the_line_through_the_origin_with_the_error_of_its_scatter() -> None:
    photons, charges = np.array([100.0, 200.0, 400.0]), np.array([52.0, 98.0, 203.0])
    flats = [flat_of(value) for value in (*photons, None)]
    slope, se = quantum_efficiency(flats, [*charges, 77.0], 0.01) or (0.0, 0.0)
    fit = np.linalg.lstsq(photons[:, None], charges)
    assert slope == pytest.approx(fit[0][0])
    of_scatter = np.sqrt(fit[1][0] / 2 / np.sum(photons**2))
    assert se == pytest.approx(np.hypot(0.01 * slope, of_scatter))
    assert quantum_efficiency(flats[:1], [52.0], 0.01) == pytest.approx((0.52, 0.0052))
    assert quantum_efficiency(flats[3:], [77.0], 0.01) is None
