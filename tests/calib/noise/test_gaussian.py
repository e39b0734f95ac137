"""The marginal likelihood against dense covariances and closed forms; its fit against the Cramér-Rao bound."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import linalg, stats

from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.likelihood.gaussian import dark_variances_dn2, negative_log_likelihood
from faintfield.calib.noise.likelihood.maximum import GaussianProblem
from faintfield.calib.noise.likelihood.moments import DarkMoments, Excess, FlatMoments, Moments, gather_moments
from tests.calib.noise.cramer_rao import Sensor, cramer_rao
from tests.calib.noise.darkroom import Chip, darks, expose, specimen

EXPOSURES_S = (0.1, 1.0, 10.0, 60.0)
TRUTH = {"gain_dn_per_e": 2.0, "read_noise_e": 12.0**0.5, "dark_current_e_per_s": 0.2}
NO_FLATS = FlatMoments(np.zeros(0), np.zeros(0), np.zeros(0), np.zeros(0))


def take_darks(chip: Chip, rng: np.random.Generator, frames: int = 10) -> list[Series]:
    taken = darks(chip, EXPOSURES_S, frames, rng)
    return [measure_series(series, Conditions("dark", t)) for t, series in taken.items()]


T_S, FRAMES, PIXELS = np.array([0.0, 2.0, 7.0]), np.array([2, 3, 4]), 40
FRAME_T_S, SERIES_OF = np.repeat(T_S, FRAMES), np.repeat(np.arange(3), FRAMES)


def moments_of(contrasts: NDArray[np.float64], levels: NDArray[np.float64]) -> Moments:
    """Return the statistics of frames as pixel contrasts (contrast, frame) and levels (frame,)."""
    means = np.array([contrasts[:, SERIES_OF == j].mean(1) for j in range(3)])
    darks = DarkMoments(
        T_S,
        FRAMES.astype(float),
        np.array([levels[SERIES_OF == j].mean() for j in range(3)]),
        np.array([contrasts[:, SERIES_OF == j].var(1).sum() * FRAMES[j] for j in range(3)]),
        np.array([levels[SERIES_OF == j].var() * FRAMES[j] for j in range(3)]),
        means @ means.T,
    )
    return Moments(float(PIXELS), PIXELS - 1.0, darks, NO_FLATS)


def dense_log_likelihood(
    values: dict[str, float], contrasts: NDArray[np.float64], levels: NDArray[np.float64]
) -> float:
    v = np.array(dark_variances_dn2(values, T_S), float)[SERIES_OF]
    covariance = np.diag(v) + values["dsnu_dn2"] + values["dcnu_dn2_per_s2"] * np.outer(FRAME_T_S, FRAME_T_S)
    total = stats.multivariate_normal(np.zeros(FRAMES.sum()), covariance).logpdf(contrasts).sum()
    level = values["jitter_dn2"] + v / PIXELS
    line = values["offset_dn"] + values["dark_signal_dn_per_s"] * FRAME_T_S
    design = np.stack([np.ones_like(FRAME_T_S), FRAME_T_S])
    restricted = np.linalg.slogdet((design / level) @ design.T)[1]
    return float(total + stats.norm(line, np.sqrt(level)).logpdf(levels).sum() - 0.5 * restricted)


def test_likelihood_is_that_of_the_dense_covariance() -> None:
    """P pixels rotated into P − 1 contrasts and a mean: each contrast is an independent normal vector."""
    rng = np.random.default_rng(0)
    y = rng.normal(0, 3, (PIXELS, FRAMES.sum())) + rng.normal(0, 2, (PIXELS, 1))
    y += rng.normal(1, 0.4, (PIXELS, 1)) * FRAME_T_S
    contrasts, levels = linalg.helmert(PIXELS) @ y, y.mean(0)
    moments = moments_of(contrasts, levels)
    one = {
        "offset_dn": 0.1,
        "log_read_dn2": 2.0,
        "dsnu_dn2": 3.0,
        "jitter_dn2": 0.05,
        "dark_signal_dn_per_s": 0.9,
        "dcnu_dn2_per_s2": 0.1,
        "log_gain": 0.3,
    }
    other = one | {
        "dsnu_dn2": 5.0,
        "dcnu_dn2_per_s2": 0.3,
        "log_gain": 0.8,
        "log_read_dn2": 2.4,
        "jitter_dn2": 0.2,
        "offset_dn": 0.3,
    }
    ours = negative_log_likelihood(other, moments) - negative_log_likelihood(one, moments)
    dense = dense_log_likelihood(one, contrasts, levels) - dense_log_likelihood(other, contrasts, levels)
    assert float(ours) == pytest.approx(dense, rel=1e-9)


def test_bound_on_the_gain_from_one_bright_flat_pair() -> None:
    """With read noise out of sight a pair's variance is the gain times the signal: relative error sqrt(2 / P)."""
    sensor = Sensor(2.0, 10.0, 1e-3, dsnu_e=1.0)
    bound = cramer_rao(sensor, (0.0, 60.0), 10, 10_000, flat_signals_dn=(1e9,))["gain_dn_per_e"]
    assert bound / 2.0 == pytest.approx(np.sqrt(2 / 10_000), rel=0.02)


def errors_and_stated(
    repeats: int, **changes: object
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return errors and stated errors (repeat, quantity), and in which share of repeats intervals hold the truth."""
    errors, stated, covered = [], [], []
    for seed in range(1000, 1000 + repeats):
        result = calibrate(take_darks(*specimen(seed, **changes)))
        for name, truth in TRUTH.items():
            estimate = result.estimates[name]
            assert estimate.value is not None
            assert estimate.se is not None
            assert estimate.ci95 is not None
            errors.append(estimate.value - truth)
            stated.append(estimate.se)
            covered.append(estimate.ci95[0] <= truth <= estimate.ci95[1])
    shape = (repeats, len(TRUTH))
    return np.reshape(errors, shape), np.reshape(stated, shape), np.reshape(covered, shape).mean(axis=0)


def test_stated_errors_are_those_of_repeated_calibrations() -> None:
    """Squares of errors over stated errors have mean one; 24 repeats of two unlike numbers know it within 0.45."""
    errors, stated, _ = errors_and_stated(24, shape=(48, 48))
    assert np.mean((errors / stated) ** 2) == pytest.approx(1.0, abs=0.45)
    # The median, since series that scatter by chance widen what some calibrations state
    bound = cramer_rao(Sensor(**TRUTH, dsnu_e=1.5), EXPOSURES_S, 10, 48 * 48)
    np.testing.assert_allclose(np.median(stated, axis=0), [bound[name] for name in TRUTH], rtol=0.1)


@pytest.mark.deep
@pytest.mark.parametrize("rough", [False, True], ids=["plain", "jitter, banding, hot pixels, DCNU"])
def test_errors_reach_the_bound_and_intervals_cover(rough: bool) -> None:
    faults = {"jitter_dn": 1.0, "banding_dn": 1.0, "hot_fraction": 0.005, "dcnu": 0.1} if rough else {}
    sensor = Sensor(**TRUTH, dsnu_e=1.5, dcnu_e_per_s=0.02 * rough, jitter_dn=1.0 * rough)
    bound = cramer_rao(sensor, EXPOSURES_S, 10, 64 * 64)
    errors, _, covered = errors_and_stated(200, **faults)
    assert (np.sqrt(np.mean(errors**2, axis=0)) <= [1.1 * bound[name] for name in TRUTH]).all()
    assert ((covered >= 0.92) & (covered <= 0.98)).all()


def test_gain_and_read_noise_from_flats_are_sharper_and_right() -> None:
    chip, rng = specimen(8)
    series = take_darks(chip, rng)
    flats = [
        measure_series(
            [(f"f{level}{k}", expose(chip, 0.1, rng, photons)) for k in range(8)], Conditions("flat", 0.1, level)
        )
        for level, photons in enumerate((400.0, 4000.0, 20000.0))
    ]
    dark_only, both = calibrate(series), calibrate([*series, *flats])
    for name in ("gain_dn_per_e", "read_noise_e"):
        estimate, alone = both.estimates[name], dark_only.estimates[name]
        assert estimate.value is not None
        assert estimate.se is not None
        assert alone.se is not None
        assert abs(estimate.value - TRUTH[name]) < 3.5 * estimate.se
        assert estimate.se < 0.6 * alone.se


def test_scaling_the_time_unit_changes_nothing_but_the_dark_current() -> None:
    series = take_darks(*specimen(9))
    slower = [replace(s, conditions=replace(s.conditions, exposure_s=s.conditions.exposure_s * 60)) for s in series]
    one, other = calibrate(series), calibrate(slower)
    for name, factor in [("gain_dn_per_e", 1), ("read_noise_e", 1), ("offset_dn", 1), ("dark_current_e_per_s", 60)]:
        a, b = one.estimates[name].value, other.estimates[name].value
        assert a is not None
        assert b is not None
        assert a == pytest.approx(b * factor, rel=1e-5)


def test_a_jitter_at_its_bound_leaves_the_other_errors_alone() -> None:
    """Beside drift the likelihood is curved the wrong way just above zero, where the search ends."""
    chip, rng = specimen(3)
    moments = gather_moments(take_darks(chip, rng), [], np.ones(chip.sensor.shape, bool))
    problem, drift = GaussianProblem(moments), Excess(drift_dn2=0.01)
    fit = problem.fit(drift)
    scale = float(moments.darks.level_scatter_dn2.sum()) / 36
    bound, above = (problem.covariance(fit.values | {"jitter_dn2": share * scale}, drift) for share in (0.0, 5e-6))
    np.testing.assert_allclose(above, bound, rtol=1e-3, atol=1e-12)
