# mypy: disable-error-code="no-untyped-call, untyped-decorator"
"""Each model's ratio and value against brute-force sums and closed forms."""

from typing import Any

import numpy as np
import pytest
from scipy.special import gammaln, logsumexp
from scipy.stats import norm, poisson

from faintfield.recon.likelihood.images import Image
from faintfield.recon.likelihood.pixel_models import (
    LEAST_SQUARES,
    POISSON_GAUSSIAN,
    SHIFTED_POISSON,
    WORK_ROWS,
)
from faintfield.recon.numba_tools import compiled, exponential, logarithm
from tests.recon.pixels import form_ratio

PIXELS = 100
PRECISIONS = [(np.float32, 3e-6), (np.float64, 1e-10)]


def judged(
    model: int,
    expected: Image,
    observed: Image,
    variance: float | Image,
    *,
    level: float = 0.0,
    background: float = 0.25,
) -> tuple[Image, float]:
    """The ratio and the value, summed, of pixels of response one."""
    ratio, dtype = expected.copy(), expected.dtype
    maps = [np.full(ratio.shape, part, dtype) for part in (background, variance, 1.0)]
    work = np.empty((WORK_ROWS, ratio.size), dtype)
    value = form_ratio(model, ratio, observed.astype(dtype), *maps, level, work)
    return ratio, value


def exact(mean: Image, observed: Image, variance: float) -> tuple[Image, Image]:
    """E[N | g, λ]/λ and −ln p(g | λ) + ½ ln 2πσ², summed over all possible counts."""
    counts = np.arange(6000.0)
    mean, observed = mean.astype(float)[:, None], observed.astype(float)[:, None]
    terms = counts * np.log(mean) - mean - gammaln(counts + 1) - (observed - counts) ** 2 / (2 * variance)
    logarithm = logsumexp(terms, axis=1)
    return np.exp(terms - logarithm[:, None]) @ counts / mean[:, 0], -logarithm


@pytest.mark.parametrize(("dtype", "accuracy"), PRECISIONS)
@pytest.mark.parametrize("sigma_e", [0.1, 1.0, 7.0])
def test_the_exact_model_is_the_sum_over_all_counts(sigma_e: float, dtype: Any, accuracy: float) -> None:
    generator = np.random.default_rng(5)
    variance = float(dtype(sigma_e**2))
    expected = np.exp(generator.uniform(np.log(1e-3), np.log(1000), PIXELS)).astype(dtype)
    spread = generator.uniform(-6, 6, PIXELS) * np.sqrt(variance + expected)
    mean = expected + dtype(0.25)
    observed = np.maximum(mean + spread, -6 * sigma_e).astype(dtype)
    ratio, value = judged(POISSON_GAUSSIAN, expected, observed, variance)
    exact_ratio, exact_values = exact(mean, observed, variance)
    # A float32 exponent of 40 has an error of 3e-6, and so has the exponential
    np.testing.assert_allclose(ratio, exact_ratio, rtol=accuracy * (10 if sigma_e < 1 else 1), atol=accuracy)
    assert value == pytest.approx(exact_values.sum(), rel=max(accuracy, 2e-7))


@pytest.mark.parametrize("observed_e", [-40.0, 900.0])
def test_the_exact_model_stays_finite_far_from_the_expected_count(observed_e: float) -> None:
    expected = np.geomspace(1e-12, 1e5, PIXELS).astype(np.float32)
    for sigma_e in (0.0, 0.05, 1.0, 3.0):
        ratio, value = judged(POISSON_GAUSSIAN, expected, np.full(PIXELS, observed_e), sigma_e**2, background=0.0)
        assert np.isfinite(ratio).all()
        assert (ratio >= 0).all()
        assert np.isfinite(value)


@pytest.mark.parametrize("model", [SHIFTED_POISSON, POISSON_GAUSSIAN, LEAST_SQUARES])
def test_one_minus_the_ratio_is_the_derivative_of_the_value(model: int) -> None:
    variance = 0.5
    generator = np.random.default_rng(6)
    for observed in generator.normal(2, 3, (20, 1)):
        expected = generator.uniform(0.5, 5, 1)
        ratio, _ = judged(model, expected, observed, variance, level=2.0)
        step = 1e-5
        after, before = (judged(model, expected + d, observed, variance, level=2.0)[1] for d in (step, -step))
        assert (after - before) / (2 * step) == pytest.approx(1 - ratio[0], abs=1e-7)


def test_least_squares_divides_by_the_variance_at_the_stated_level() -> None:
    observed, expected = np.array([3.0, -1.0]), np.array([1.0, 2.0])
    ratio, value = judged(LEAST_SQUARES, expected, observed, 4.0, level=0.75)
    np.testing.assert_allclose(ratio, 1 + (observed - expected - 0.25) / 5.0, rtol=1e-14)
    assert value == pytest.approx(np.sum((observed - expected - 0.25) ** 2) / 10.0, rel=1e-14)


@pytest.mark.parametrize("model", [SHIFTED_POISSON, POISSON_GAUSSIAN, LEAST_SQUARES])
def test_pixels_of_response_zero_add_nothing_to_the_value(model: int) -> None:
    parts = np.ones((6, 2))
    parts[1, 1], parts[4, 1] = np.nan, 0.0
    alone = form_ratio(model, *(part[:1].copy() for part in parts[:5]), 1.0, np.empty((WORK_ROWS, 1)))
    assert form_ratio(model, *parts[:5].copy(), 1.0, np.empty((WORK_ROWS, 2))) == alone


def test_counts_are_impossible_where_none_are_expected() -> None:
    zero = np.zeros(1)
    assert judged(SHIFTED_POISSON, zero, np.ones(1), 0.0, background=0.0)[1] == np.inf
    assert judged(SHIFTED_POISSON, zero, zero, 0.0, background=0.0)[1] == 0.0


@pytest.mark.parametrize("sigma_e", [0.3, 2.0])
def test_the_exact_model_has_no_bias_where_the_shifted_one_has(sigma_e: float) -> None:
    """The mean of the score at the true mean, integrated over g: zero for the truth."""
    mean_e, counts = 0.97, np.arange(40)
    g = np.linspace(-10 * sigma_e, 30 + 10 * sigma_e, 40000)
    density = poisson.pmf(counts, mean_e) @ norm.pdf(g, counts[:, None], sigma_e)
    expected = np.full(g.size, mean_e - 0.25)
    bias = [float(np.trapezoid(density * judged(model, expected, g, sigma_e**2)[0], g)) - 1 for model in (0, 1)]
    assert abs(bias[POISSON_GAUSSIAN]) < 1e-6
    assert bias[SHIFTED_POISSON] > 1e-3


@pytest.mark.parametrize(("dtype", "accuracy"), PRECISIONS)
def test_logarithm_and_exponential_are_good_to_the_last_digits(dtype: Any, accuracy: float) -> None:
    x = np.linspace(-80, 80, 20001).astype(dtype)
    powers, logarithms = np.empty_like(x), np.empty_like(x)
    _both(x, powers, logarithms)
    np.testing.assert_allclose(powers, np.exp(x.astype(float)), rtol=accuracy / 5)
    np.testing.assert_allclose(logarithms, np.log(powers.astype(float)), rtol=accuracy / 5, atol=accuracy / 10)


@compiled
def _both(x: Image, powers: Image, logarithms: Image) -> None:
    for k in range(x.size):
        powers[k] = exponential(x[k])
        logarithms[k] = logarithm(powers[k])
