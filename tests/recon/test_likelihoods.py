"""The choice of the likelihood, and the light that each reports without a penalty."""

from dataclasses import replace
from itertools import pairwise

import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.stats import norm, poisson

from faintfield.recon.likelihood.images import ElementalImages, LikelihoodName, read_noise_share, select_likelihood
from faintfield.recon.likelihood.pixel_models import WORK_ROWS
from tests.recon.pixels import form_ratio

SIGMAS_E = [0.3, 2.0, 3.46]


def images(variance_e2: object) -> ElementalImages:
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
def test_auto_selects_the_likelihood_by_read_noise(variance_e2: object, name: str) -> None:
    assert select_likelihood(images(variance_e2), "auto", 1.0).name == name


def test_least_squares_takes_the_variance_at_the_typical_light() -> None:
    likelihood = select_likelihood(images(12.0), "least-squares", 3.5)
    assert likelihood.level_e == 3.5
    assert replace(images(12.0), likelihood=likelihood).known_variance_e2() == pytest.approx(12.02)


def test_poisson_ignores_read_noise() -> None:
    assert replace(images(12.0), likelihood=select_likelihood(images(12.0), "poisson", 1.0)).known_variance_e2() == 0.02


def light_at_snr(sigma_e: float) -> float:
    """The mean μ for which a dark-free image of uniform light has SNR 0.16: μ² + μ = 0.16 σ²."""
    return float((np.sqrt(1 + 0.64 * sigma_e**2) - 1) / 2)


def reported_e(name: LikelihoodName, mean_e: float, sigma_e: float) -> float:
    """The mean estimated from very many pixels: the root of the expected score, integrated over their readings."""
    counts = np.arange(80)
    g = np.linspace(-9 * sigma_e, 40 + 9 * sigma_e, 60001)
    density = poisson.pmf(counts, mean_e) @ norm.pdf(g, counts[:, None], sigma_e)
    model = select_likelihood(images(sigma_e**2), name, mean_e).model
    variance, zero, work = np.full(g.size, sigma_e**2), np.zeros(g.size), np.empty((WORK_ROWS, g.size))

    def score(level_e: float) -> float:
        ratio = np.full(g.size, level_e)
        form_ratio(model, ratio, g, zero, variance, np.ones(g.size), 0.0, work)
        return float(np.trapezoid(density * (ratio - 1), g))

    return float(brentq(score, 1e-4, 50.0))


@pytest.mark.parametrize("sigma_e", SIGMAS_E)
def test_light_is_reported_without_bias_at_snr_016(sigma_e: float) -> None:
    mean_e = light_at_snr(sigma_e)
    name = select_likelihood(images(sigma_e**2), "auto", mean_e).name
    assert reported_e(name, mean_e, sigma_e) == pytest.approx(mean_e, rel=0.01)


def test_the_shifted_model_is_strongly_biased_at_low_read_noise() -> None:
    assert reported_e("shifted-poisson", light_at_snr(1.0), 1.0) > 1.3 * light_at_snr(1.0)


@pytest.mark.parametrize("mean_e", [0.05, 1.0, 20.0])
def test_read_noise_counts_where_it_hides_single_electrons(mean_e: float) -> None:
    shares = [read_noise_share(mean_e, sigma_e) for sigma_e in (0.1, 0.3, 0.6, 1.0, 2.9)]
    assert all(after >= before - 0.01 for before, after in pairwise(shares))
    assert shares[0] < 0.01
    assert shares[-1] > 0.75
