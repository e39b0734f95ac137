"""The Gaussian likelihood against densities of scipy; its maximum against the Cramér-Rao bound."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise import Series, calibrate
from faintfield.calib.noise.likelihood.gaussian_fit import (
    GaussianProblem,
    NoiseFit,
    main_quantities,
    negative_log_likelihood,
)
from faintfield.calib.noise.likelihood.moments import NO_EXCESS, Excess, Moments, SeriesMoments, gather_moments
from tests.calib.noise.cramer_rao import Sensor, cramer_rao
from tests.calib.noise.darkroom import EXPOSURES_S, TRUTH, dark_series, specimen
from tests.calib.noise.likelihood.slopes import slopes

_SCATTER = np.random.default_rng(1).multivariate_normal(np.zeros(4), 7.3 + np.diag([1.4, 1.9, 1.2, 20.0]), 1100)
SCATTER_DN2 = _SCATTER.T @ _SCATTER
SERIES = SeriesMoments(
    exposure_s=np.array([0.1, 2.0, 10.0, 60.0, 0.1, 0.1]),
    frames=np.array([5.0, 4.0, 6.0, 1.0, 4.0, 3.0]),
    mean_dn=np.array([100.2, 101.0, 104.5, 124.0, 2100.0, 9100.0]),
    within_dn2=np.array([41_000.0, 32_000.0, 60_000.0, 0.0, 9e6, 3e7]),
    level_scatter_dn2=np.array([0.6, 0.4, 1.1, 0.0, 0.0, 0.0]),
    rounding2=np.zeros(6),
    evenness=np.array([1.0, 1.0, 1.0, 1.0, 0.95, 0.9]),
)

HERE = {
    "offset_dn": 100.0, "log_read_dn2": np.log(8.0), "dsnu_dn2": 7.0, "jitter_dn2": 0.1,
    "dark_signal_dn_per_s": 0.4, "dcnu_dn2_per_s2": 0.003, "log_gain": np.log(2.0), "nonlinearity_per_dn": 2e-6,
}  # fmt: skip
THERE = {
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
    total += float(stats.wishart.logpdf(moments.scatter_dn2[several], moments.freedom, scale[several]))
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


@pytest.mark.parametrize("series", [SERIES, SERIES.part(slice(4))], ids=["with flats", "darks alone"])
def test_likelihood_is_that_of_scipys_densities(series: SeriesMoments) -> None:
    moments = Moments(1200.0, 1100.0, series, SCATTER_DN2)
    rise = by_scipy(THERE, moments) - by_scipy(HERE, moments)
    ours = float(negative_log_likelihood(HERE, moments)) - float(negative_log_likelihood(THERE, moments))
    assert ours == pytest.approx(rise, rel=1e-9, abs=1e-7)


def test_derivatives_of_quantities_are_small_differences() -> None:
    at = np.array(list(HERE.values()))

    def values(x: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.array([value for value, _ in main_quantities(dict(zip(HERE, x.tolist(), strict=True))).values()])

    quantities = main_quantities(HERE)
    assert quantities["gain_dn_per_e"][0] == pytest.approx(2.0)
    assert quantities["read_noise_e"][0] == pytest.approx(np.sqrt(8.0) / 2.0)
    assert quantities["dark_current_e_per_s"][0] == pytest.approx(0.2)
    for row, (_, derivatives) in zip(slopes(values, at), quantities.values(), strict=True):
        np.testing.assert_allclose(row, [derivatives.get(name, 0.0) for name in HERE], atol=1e-8)


def test_bound_of_a_bright_flat_pair() -> None:
    """With read noise out of sight a pair's variance is the gain times the signal: relative error sqrt(2 / P)."""
    sensor = Sensor(2.0, 10.0, 1e-3, dsnu_e=1.0)
    bound = cramer_rao(sensor, (0.0, 60.0), 10, 10_000, flat_signals_dn=(1e9,))["gain_dn_per_e"]
    assert bound / 2.0 == pytest.approx(np.sqrt(2 / 10_000), rel=0.02)


def errors_and_stated(
    all_series: list[list[Series]],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return errors and stated errors (set, quantity), and in which share of sets intervals hold the truth."""
    errors, stated, covered = [], [], []
    for series in all_series:
        result = calibrate(series)
        for name, truth in TRUTH.items():
            estimate = result.estimates[name]
            assert estimate.value is not None
            assert estimate.se is not None
            assert estimate.ci95 is not None
            errors.append(estimate.value - truth)
            stated.append(estimate.se)
            covered.append(estimate.ci95[0] <= truth <= estimate.ci95[1])
    shape = (len(all_series), len(TRUTH))
    return np.reshape(errors, shape), np.reshape(stated, shape), np.reshape(covered, shape).mean(axis=0)


def test_stated_errors_are_those_made_and_the_bound() -> None:
    """12 sets of two unlike numbers know the mean square of errors within 0.64, and stated errors differ by 3 %.

    Scatter between series that comes about by chance widens some sets, and narrows none.
    """
    side, seeds = 48, range(1000, 1012)
    specimens = (specimen(seed, shape=(side, side)) for seed in seeds)
    all_series = [dark_series(chip, EXPOSURES_S, 10, rng) for chip, rng in specimens]
    errors, stated, _ = errors_and_stated(all_series)
    # Means of rows and columns are subtracted
    bounds = cramer_rao(Sensor(**TRUTH, dsnu_e=1.5), EXPOSURES_S, 10, (side - 1) ** 2)
    plain = []
    for series in all_series:
        fit = GaussianProblem(gather_moments(series, [], np.ones((side, side), bool))).fit(NO_EXCESS)
        quantities = main_quantities(fit.values)
        gradients = np.array([[quantities[name][1].get(key, 0.0) for key in fit.values] for name in TRUTH])
        plain.append(np.sqrt(np.diag(gradients @ fit.covariance @ gradients.T)))
    np.testing.assert_allclose(np.mean(plain, axis=0), [bounds[name] for name in TRUTH], rtol=0.06)
    assert (stated > 0.999 * np.array(plain)).all()
    np.testing.assert_allclose(np.median(stated / plain, axis=0), 1.0, rtol=1e-3)
    assert np.mean((errors / stated) ** 2) == pytest.approx(1.0, abs=0.45)


@pytest.mark.deep
@pytest.mark.parametrize("rough", [False, True], ids=["plain", "jitter, banding, hot pixels, DCNU"])
def test_errors_reach_the_bound_and_intervals_cover(rough: bool) -> None:
    faults = {"jitter_dn": 1.0, "banding_dn": 1.0, "hot_fraction": 0.005, "dcnu": 0.1} if rough else {}
    sensor = Sensor(**TRUTH, dsnu_e=1.5, dcnu_e_per_s=0.02 * rough, jitter_dn=1.0 * rough)
    bound = cramer_rao(sensor, EXPOSURES_S, 10, 64 * 64)
    specimens = (specimen(seed, **faults) for seed in range(1000, 1200))
    errors, _, covered = errors_and_stated([dark_series(chip, EXPOSURES_S, 10, rng) for chip, rng in specimens])
    assert (np.sqrt(np.mean(errors**2, axis=0)) <= [1.1 * bound[name] for name in TRUTH]).all()
    assert ((covered >= 0.92) & (covered <= 0.98)).all()


def test_unit_of_time_scales_only_the_dark_current() -> None:
    chip, rng = specimen(9)
    series = dark_series(chip, EXPOSURES_S, 10, rng)
    slower = [replace(s, conditions=replace(s.conditions, exposure_s=s.conditions.exposure_s * 60)) for s in series]
    in_seconds, in_minutes = calibrate(series).estimates, calibrate(slower).estimates
    for name, factor in [("gain_dn_per_e", 1), ("read_noise_e", 1), ("offset_dn", 1), ("dark_current_e_per_s", 60)]:
        assert in_seconds[name].value == pytest.approx(factor * (in_minutes[name].value or 0.0), rel=1e-5)


def test_jitter_at_its_bound_leaves_other_errors() -> None:
    """Beside drift the likelihood is curved the wrong way just above zero, where the search ends."""
    chip, rng = specimen(3)
    moments = gather_moments(dark_series(chip, EXPOSURES_S, 10, rng), [], np.ones(chip.sensor.shape, bool))
    problem, drift = GaussianProblem(moments), Excess(drift_dn2=0.01)
    fit = problem.fit(drift)
    scale = float(moments.darks.level_scatter_dn2.sum()) / 36
    bound, above = (problem.covariance(fit.values | {"jitter_dn2": share * scale}, drift) for share in (0.0, 5e-6))
    np.testing.assert_allclose(above, bound, rtol=1e-3, atol=1e-12)


def test_parameter_without_a_fit_has_infinite_error() -> None:
    fit = NoiseFit({"offset_dn": 1.0, "log_gain": 2.0}, np.diag([4.0, 9.0]), 0.0)
    assert (fit.standard_error("log_gain"), fit.standard_error("jitter_dn2")) == (3.0, np.inf)


def test_quantile_has_satterthwaites_degrees_of_freedom() -> None:
    fit = NoiseFit({"a": 1.0, "b": 2.0}, np.diag([4.0, 1.0]), 0.0, sources=((np.diag([4.0, 0.0]), 3),))
    assert fit.quantile(np.array([1.0, 0.0])) == pytest.approx(stats.t.ppf(0.975, 3))
    assert fit.quantile(np.array([0.0, 1.0])) == pytest.approx(stats.norm.ppf(0.975))
    # Half of the variance rests on 3 degrees of freedom: Satterthwaite's are 2² 3 = 12
    assert fit.quantile(np.array([0.5, 1.0])) == pytest.approx(stats.t.ppf(0.975, 12))
    # A share that rounding makes negative is none
    shrunk = replace(fit, sources=((np.diag([-1e9, 0.0]), 3),))
    assert shrunk.quantile(np.array([1.0, 0.0])) == pytest.approx(stats.norm.ppf(0.975))
