"""Mass functions against scipy, the marginal likelihood against quadrature, and fits where a Gaussian fails."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise import Conditions, Series, calibrate, measure_series
from faintfield.calib.noise.fitting import NoiseLikelihood
from faintfield.calib.noise.likelihood.marginal import (
    DARK_LOG_WEIGHTS,
    DARK_NODES,
    PARAMETERS,
    Counts,
    MarginalLikelihood,
    mass_function,
)
from tests.calib.noise.darkroom import darks, expose, specimen

EXPOSURES_S = (0.1, 1.0, 10.0, 60.0)


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
def test_mass_function_is_that_of_a_rounded_sum(gain: float, read: float, charge: float, exact: bool) -> None:
    u = np.arange(-200.0, 900.0) + 0.3
    masses = mass_function(u, 2.0, charge, exact=exact, spread=False)
    table = masses(np.log([gain, read, charge / 2.0, 1.0]))
    expected = brute_tail(u + 0.5, charge, gain, read, exact=exact) - brute_tail(
        u - 0.5, charge, gain, read, exact=exact
    )
    np.testing.assert_allclose(np.exp(table.log_mass[:, 0]), np.maximum(expected, 1e-14), rtol=1e-6, atol=1e-12)
    assert np.exp(table.log_mass).sum() == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("exact", [True, False])
def test_slopes_are_those_of_small_differences(exact: bool) -> None:
    u = np.linspace(-4, 40, 89)
    masses = mass_function(u, 3.0, 20.0, exact=exact, spread=True)
    at = np.array([np.log(2.0), np.log(0.6), np.log(2.0), 0.15])
    table = masses(at)
    for parameter in range(4):
        step = np.zeros(4)
        step[parameter] = 1e-5
        above, below = masses(at + step), masses(at - step)
        for slope, high, low in (
            (table.mass_slope[parameter], above.log_mass, below.log_mass),
            (table.tail_slope[parameter], above.log_tail, below.log_tail),
        ):
            likely = low > -14
            np.testing.assert_allclose(slope[likely], ((high - low) / 2e-5)[likely], atol=1e-3)
            assert likely.mean() > 0.3


def test_log_likelihood_is_the_integral_over_offset_and_dark_current() -> None:
    floor_dn = 97
    chip, rng = specimen(2, shape=(2, 3), read_noise_e=0.5, dcnu=0.15)
    exposures_s = (0.5, 40.0)
    frames = [np.array([expose(chip, t, rng).ravel() for _ in range(4)]).astype(np.int32) for t in exposures_s]
    frames = [np.maximum(values, floor_dn) for values in frames]
    gain, read, dark, spread, centre, width = 2.1, 0.45, 0.22, 0.12, 99.5, 3.2
    at = np.array([*np.log([gain, read, dark]), spread, centre, np.log(width)])
    offsets = np.arange(centre - 20, centre + 20, 0.02)
    total = 0.0
    for pixel in range(6):
        integrand = np.zeros(offsets.size)
        for z, weight in zip(DARK_NODES, np.exp(DARK_LOG_WEIGHTS), strict=True):
            product = np.full(offsets.size, weight)
            for t, taken in zip(exposures_s, frames, strict=True):
                for y in taken[:, pixel]:
                    charge = dark * (1 + spread * z) * t
                    product *= brute_tail(y + 0.5 - offsets, charge, gain, read, exact=True)
                    if y != floor_dn:
                        below = brute_tail(y - 0.5 - offsets, charge, gain, read, exact=True)
                        product *= 1 - below / np.maximum(
                            brute_tail(y + 0.5 - offsets, charge, gain, read, exact=True), 1e-300
                        )
            integrand += product
        total += np.log(np.trapezoid(integrand * stats.norm.pdf(offsets, centre, width), offsets))
    counts, start = Counts(exposures_s, tuple(frames), floor_dn), dict(zip(PARAMETERS, at, strict=True))
    ours, _, _ = MarginalLikelihood(counts, start, exact=True, spread=True).evaluate(at)
    assert ours == pytest.approx(total, abs=0.02)


def take(seed: int, **changes: object) -> list[Series]:
    chip, rng = specimen(seed, **changes)
    taken = darks(chip, EXPOSURES_S, 10, rng)
    return [measure_series(frames, Conditions("dark", t)) for t, frames in taken.items()]


@pytest.mark.deep
def test_below_an_electron_of_read_noise_the_exact_mass_function_reaches_the_bound() -> None:
    repeats, shape = 60, (48, 48)
    truth = {"gain_dn_per_e": 2.0, "read_noise_e": 0.3, "dark_current_e_per_s": 0.2}
    errors: dict[str, list[float]] = {name: [] for name in truth}
    for seed in range(repeats):
        result = calibrate(take(seed, shape=shape, read_noise_e=0.3))
        assert result.likelihood is NoiseLikelihood.EXACT
        for name, value in truth.items():
            found = result.estimates[name].value
            assert found is not None
            errors[name].append(np.log(found / value))
    bound = bound_of_exact(0.3, 48 * 48)
    for index, name in enumerate(truth):
        assert np.sqrt(np.mean(np.square(errors[name]))) <= 1.2 * bound[index], name


def bound_of_exact(read_noise_e: float, pixels: float) -> NDArray[np.float64]:
    """Return the Cramér-Rao bound on ln gain, ln σ, ln D from the scores at the truth of many pixels."""
    series = take(12345, shape=(192, 192), read_noise_e=read_noise_e)
    counts = Counts(EXPOSURES_S, tuple(one.sample_dn for one in series))
    truth = np.array([np.log(2.0), np.log(read_noise_e), np.log(0.2), 0.0, 100.0, np.log(3.0)])
    start = dict(zip(PARAMETERS, truth, strict=True))
    _, _, scores = MarginalLikelihood(counts, start, exact=True, spread=False).evaluate(truth)
    free = [i for i, name in enumerate(PARAMETERS) if name != "dcnu"]
    sampled = series[0].sample_dn.shape[1]
    return np.sqrt(np.diag(np.linalg.inv(scores[np.ix_(free, free)] * pixels / sampled)))[:3]


@pytest.mark.deep
def test_values_cut_off_at_black_leave_no_bias() -> None:
    """A third of the short darks' values are; moments would have the gain half as large again."""
    truth = {"gain_dn_per_e": 2.0, "read_noise_e": 12.0**0.5, "dark_current_e_per_s": 0.2}
    errors: dict[str, list[float]] = {name: [] for name in truth}
    for seed in range(24):
        result = calibrate(take(seed, offset_dn=3.0))
        assert result.likelihood is NoiseLikelihood.CENSORED
        for name, value in truth.items():
            found = result.estimates[name].value
            assert found is not None
            errors[name].append(found / value - 1)
    for name in truth:
        assert abs(np.mean(errors[name])) < 0.005, name


def test_values_cut_off_give_no_maps_and_a_warning() -> None:
    result = calibrate(take(1, offset_dn=3.0))
    assert np.ptp(result.maps.offset_dn) == 0
    assert any("cut off" in warning for warning in result.warnings)
    assert result.estimates["frame_jitter_dn"].value is None


def test_banding_that_blurs_single_electrons_keeps_the_gaussian() -> None:
    result = calibrate(take(3, read_noise_e=0.3, banding_dn=0.5, jitter_dn=0.3))
    assert result.likelihood is NoiseLikelihood.GAUSSIAN
    for name, truth in (("gain_dn_per_e", 2.0), ("read_noise_e", 0.3)):
        assert result.estimates[name].value == pytest.approx(truth, rel=0.05)


def test_subtle_read_noise_at_a_single_repeated_exposure_still_gives_an_answer() -> None:
    chip, rng = specimen(6, read_noise_e=0.2)
    series = [measure_series(darks(chip, [t], n, rng)[t], Conditions("dark", t)) for t, n in ((1.0, 10), (60.0, 1))]
    result = calibrate(series)
    assert result.estimates["gain_dn_per_e"].value is None
    assert result.estimates["offset_dn"].value == pytest.approx(100, abs=0.5)
