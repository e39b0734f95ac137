"""Defects and shrinkage of single pixels against their formulas."""

import numpy as np
import pytest

from faintfield.calib.noise.pixels import noisy_pixels, shrunk_variance_ratio


def ratios(variance: float) -> np.ndarray:
    """Return 10 000 ratios of mean 1 and of exactly this variance."""
    ratio = np.random.default_rng(4).normal(size=(100, 100))
    ratio -= ratio.mean()
    return np.asarray(1 + np.sqrt(variance) * ratio / ratio.std())


@pytest.mark.parametrize("freedom", [9.0, 27.0])
def test_variances_are_shrunk_once_their_scatter_exceeds_chance_by_three_standard_errors(freedom: float) -> None:
    usable = np.ones((100, 100), bool)
    chance = 2 / freedom
    se = chance * np.sqrt(2 / 10_000)
    for excess in (-se, 0.0, 2.9 * se):
        np.testing.assert_array_equal(shrunk_variance_ratio(ratios(chance + excess), freedom, usable), 1.0)
    for excess in (3.1 * se, 0.5, 4.0):
        ratio = ratios(chance + excess)
        prior = 2 / excess
        expected = (prior + freedom * ratio) / (prior + freedom)
        np.testing.assert_allclose(shrunk_variance_ratio(ratio, freedom, usable), expected, rtol=1e-9)
    np.testing.assert_array_equal(shrunk_variance_ratio(ratios(4.0), 0.0, usable), 1.0)


def test_only_usable_pixels_tell_the_scatter() -> None:
    usable = np.ones((100, 100), bool)
    usable[:, :50] = False
    ratio = ratios(2 / 9)
    ratio[:, :50] *= 100.0
    ratio[:, 50:] = ratios(2 / 9)[:, :50]
    found = shrunk_variance_ratio(ratio, 9.0, usable)
    even = shrunk_variance_ratio(ratio[:, 50:], 9.0, usable[:, 50:])
    np.testing.assert_allclose(found[:, 50:], even)


def test_a_pixel_in_a_hundred_sensors_is_noisy_by_chance() -> None:
    generator = np.random.default_rng(1)
    flagged = sum(int(noisy_pixels(generator.chisquare(20, (200, 200)) / 20, 20.0).sum()) for _ in range(50))
    assert flagged <= 4
    ratio = generator.chisquare(20, (200, 200)) / 20
    ratio[3, 4] = 4.5
    assert np.argwhere(noisy_pixels(ratio, 20.0)).tolist() == [[3, 4]]
