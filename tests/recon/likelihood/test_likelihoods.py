# mypy: disable-error-code="no-untyped-def, no-untyped-call, untyped-decorator"
"""The choice of the likelihood, the light that each reports, and each pixel model against brute-force sums."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.special import gammaln, logsumexp
from scipy.stats import norm, poisson

from faintfield.recon.likelihood.images import (
    ElementalImages,
    Image,
    LikelihoodName,
    read_noise_share,
    select_likelihood,
)
from faintfield.recon.likelihood.pixel_models import (
    LEAST_SQUARES,
    POISSON_GAUSSIAN,
    SHIFTED_POISSON,
    WORK_ROWS,
    form_ratio_of_block,
)
from faintfield.recon.numba_tools import compiled, exponential, index, logarithm, pointer


@compiled
def form_ratio(model, expected, observed, background, variance, response, level, work):
    """Replace H f of some pixels by the ratio; return their negative log-likelihood.

    `work` is scratch of shape (WORK_ROWS, pixels or more); all other arrays have one number per pixel.
    """
    maps = pointer(observed), pointer(background), pointer(variance), pointer(response)
    return form_ratio_of_block(model, index(expected.size), pointer(expected), *maps, level, pointer(work), True)


def images_of(variance_e2: object) -> ElementalImages:
    return ElementalImages(np.zeros((4, 5, 5)), 0.02, np.asarray(variance_e2, float))


@pytest.mark.parametrize(
    ("variance_e2", "name"),
    [
        (0.0, "poisson"),
        (0.1, "poisson-gaussian"),
        (8.9, "poisson-gaussian"),
        (9.1, "shifted-poisson"),
        (np.where(np.arange(25).reshape(1, 5, 5) < 2, 1.0, 12.0), "poisson-gaussian"),
    ],
)
def test_auto_selects_likelihood_by_read_noise(variance_e2: object, name: str) -> None:
    assert select_likelihood(images_of(variance_e2), "auto", 1.0).name == name


@pytest.mark.parametrize(("name", "known_e2"), [("least-squares", 12.02), ("poisson", 0.02)])
def test_known_variance_has_read_noise_unless_poisson(name: LikelihoodName, known_e2: float) -> None:
    likelihood = select_likelihood(images_of(12.0), name, 3.5)
    assert replace(images_of(12.0), likelihood=likelihood).known_variance_e2() == pytest.approx(known_e2)
    assert name == "poisson" or likelihood.level_e == 3.5


def light_at_snr(sigma_e: float) -> float:
    """Return the mean μ for which a dark-free image of uniform light has SNR 0.16: μ² + μ = 0.16 σ²."""
    return float((np.sqrt(1 + 0.64 * sigma_e**2) - 1) / 2)


def reported_e(name: LikelihoodName, mean_e: float, sigma_e: float) -> float:
    """Return the mean estimated from very many pixels: the root of the expected score, integrated over readings."""
    counts = np.arange(80)
    g = np.linspace(-9 * sigma_e, 40 + 9 * sigma_e, 20001)
    density = poisson.pmf(counts, mean_e) @ norm.pdf(g, counts[:, None], sigma_e)
    model = select_likelihood(images_of(sigma_e**2), name, mean_e).model
    variance, zero, work = np.full(g.size, sigma_e**2), np.zeros(g.size), np.empty((WORK_ROWS, g.size))

    def score(level_e: float) -> float:
        ratio = np.full(g.size, level_e)
        form_ratio(model, ratio, g, zero, variance, np.ones(g.size), 0.0, work)
        return float(np.trapezoid(density * (ratio - 1), g))

    return float(brentq(score, 1e-4, 50.0))


@pytest.mark.parametrize("sigma_e", [0.3, 2.0, 3.46])
def test_light_is_unbiased_at_snr_016(sigma_e: float) -> None:
    mean_e = light_at_snr(sigma_e)
    name = select_likelihood(images_of(sigma_e**2), "auto", mean_e).name
    assert reported_e(name, mean_e, sigma_e) == pytest.approx(mean_e, rel=0.01)


def test_shifted_model_is_biased_at_low_read_noise() -> None:
    assert reported_e("shifted-poisson", light_at_snr(1.0), 1.0) > 1.3 * light_at_snr(1.0)


PIXELS = 100
PRECISIONS = [(np.float32, 3e-6), (np.float64, 1e-10)]


def compare(
    model: int,
    expected: Image,
    observed: Image,
    variance: float | Image,
    *,
    level: float = 0.0,
    background: float = 0.25,
) -> tuple[Image, float]:
    """Return the ratio and the value, summed, of pixels of response one."""
    ratio, dtype = expected.copy(), expected.dtype
    maps = [np.full(ratio.shape, part, dtype) for part in (background, variance, 1.0)]
    work = np.empty((WORK_ROWS, ratio.size), dtype)
    value = form_ratio(model, ratio, observed.astype(dtype), *maps, level, work)
    return ratio, value


def exact(mean: Image, observed: Image, variance: float) -> tuple[Image, Image]:
    """Return E[N | g, λ]/λ and −ln p(g | λ) + ½ ln 2πσ², summed over all possible counts."""
    counts = np.arange(6000.0)
    mean, observed = mean.astype(float)[:, None], observed.astype(float)[:, None]
    terms = counts * np.log(mean) - mean - gammaln(counts + 1) - (observed - counts) ** 2 / (2 * variance)
    logarithm = logsumexp(terms, axis=1)
    return np.exp(terms - logarithm[:, None]) @ counts / mean[:, 0], -logarithm


@pytest.mark.parametrize(("dtype", "accuracy"), PRECISIONS)
@pytest.mark.parametrize("sigma_e", [0.1, 1.0, 7.0])
def test_exact_model_is_the_sum_over_all_counts(sigma_e: float, dtype: Any, accuracy: float) -> None:
    generator = np.random.default_rng(5)
    variance = float(dtype(sigma_e**2))
    expected = np.exp(generator.uniform(np.log(1e-3), np.log(1000), PIXELS)).astype(dtype)
    spread = generator.uniform(-6, 6, PIXELS) * np.sqrt(variance + expected)
    mean = expected + dtype(0.25)
    observed = np.maximum(mean + spread, -6 * sigma_e).astype(dtype)
    ratio, value = compare(POISSON_GAUSSIAN, expected, observed, variance)
    exact_ratio, exact_values = exact(mean, observed, variance)
    # A float32 exponent of 40 has an error of 3e-6, and so has the exponential
    np.testing.assert_allclose(ratio, exact_ratio, rtol=accuracy * (10 if sigma_e < 1 else 1), atol=accuracy)
    assert value == pytest.approx(exact_values.sum(), rel=max(accuracy, 2e-7))


@pytest.mark.parametrize("observed_e", [-40.0, 900.0])
def test_exact_model_stays_finite_far_from_expected_count(observed_e: float) -> None:
    expected = np.geomspace(1e-12, 1e5, PIXELS).astype(np.float32)
    for sigma_e in (0.0, 0.05, 1.0, 3.0):
        ratio, value = compare(POISSON_GAUSSIAN, expected, np.full(PIXELS, observed_e), sigma_e**2, background=0.0)
        assert np.isfinite(ratio).all()
        assert (ratio >= 0).all()
        assert np.isfinite(value)


def test_least_squares_divides_by_variance_at_stated_level() -> None:
    observed, expected = np.array([3.0, -1.0]), np.array([1.0, 2.0])
    ratio, value = compare(LEAST_SQUARES, expected, observed, 4.0, level=0.75)
    np.testing.assert_allclose(ratio, 1 + (observed - expected - 0.25) / 5.0, rtol=1e-14)
    assert value == pytest.approx(np.sum((observed - expected - 0.25) ** 2) / 10.0, rel=1e-14)


@pytest.mark.parametrize("model", [SHIFTED_POISSON, POISSON_GAUSSIAN, LEAST_SQUARES])
def test_pixels_of_response_zero_add_no_value(model: int) -> None:
    parts = np.ones((6, 2))
    parts[1, 1], parts[4, 1] = np.nan, 0.0
    alone = form_ratio(model, *(part[:1].copy() for part in parts[:5]), 1.0, np.empty((WORK_ROWS, 1)))
    assert form_ratio(model, *parts[:5].copy(), 1.0, np.empty((WORK_ROWS, 2))) == alone


def test_counts_are_impossible_where_none_are_expected() -> None:
    zero = np.zeros(1)
    assert compare(SHIFTED_POISSON, zero, np.ones(1), 0.0, background=0.0)[1] == np.inf
    assert compare(SHIFTED_POISSON, zero, zero, 0.0, background=0.0)[1] == 0.0


@pytest.mark.parametrize(("dtype", "accuracy"), PRECISIONS)
def test_logarithm_and_exponential_are_good_to_last_digits(dtype: Any, accuracy: float) -> None:
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


@pytest.mark.parametrize(("mean_e", "read_noise_e"), [(101.0, 0.1), (1.0, 3.1), (1.0, 0.03)])
def test_large_or_irrelevant_read_noise_counts_whole(mean_e: float, read_noise_e: float) -> None:
    assert read_noise_share(mean_e, read_noise_e) == 1.0


def test_chosen_likelihood_has_share_of_typical_pixel() -> None:
    electrons = np.ones((2, 4, 4))
    images = ElementalImages(electrons, background_e=0.5, read_variance_e2=np.full((1, 4, 4), 0.36))
    result = select_likelihood(images, "auto", 1.5)
    assert result.name == "poisson-gaussian"
    assert result.read_noise_share == read_noise_share(2.0, 0.6)
    assert select_likelihood(images, "least-squares", 0.0).level_e > 0


@pytest.mark.parametrize(
    ("parts", "words"),
    [
        ({"electrons": np.zeros((3, 4))}, "view, row, column"),
        ({"valid": np.ones((2, 4, 3), bool)}, "valid has shape"),
        ({"electrons": np.where(np.arange(24) == 17, np.nan, 0.0).reshape(2, 3, 4)}, "view 1 has 1 pixels"),
    ],
)
def test_images_without_numbers_or_fit_are_refused(parts: dict[str, Any], words: str) -> None:
    ElementalImages(np.zeros((2, 3, 4)))
    with pytest.raises(ValueError, match=words):
        ElementalImages(**{"electrons": np.zeros((2, 3, 4)), **parts})


def test_binned_images_are_sums_of_valid_pixels() -> None:
    generator = np.random.default_rng(4)
    electrons = generator.poisson(5, (2, 7, 9)).astype(np.float32)
    valid = np.ones(electrons.shape, bool)
    valid[1, 3, 4] = False
    background_e = generator.uniform(1, 2, (1, 7, 9))
    result = ElementalImages(electrons, background_e, 3.0, valid).binned(2)
    assert result.electrons.shape == (2, 3, 4)
    assert result.electrons[1, 2, 3] == electrons[1, 4:6, 6:8].sum()
    np.testing.assert_allclose(np.asarray(result.background_e)[0, 1, 1], background_e[0, 2:4, 2:4].sum(), rtol=1e-6)
    assert result.read_variance_e2 == 12.0
    assert result.valid is not None
    assert np.argwhere(~result.valid).tolist() == [[1, 1, 2]]
