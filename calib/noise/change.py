"""Has a sensor changed? Two measurements of a quantity, or of a map, compared in units of their errors."""

from dataclasses import dataclass

import numpy as np
from scipy import stats

from faintfield.calib.noise.strips import Array

_QUANTILE = float(stats.norm.ppf(0.975))

# Smallest growth of the difference of two maps over what their errors make that counts: the errors are known no better.
_MIN_GROWTH = 0.1


def difference_in_sigma(
    first: float, first_ci95: tuple[float, float], second: float, second_ci95: tuple[float, float]
) -> float:
    """Return second − first over its standard error; NaN where neither has one.

    Each error is that of the side of the interval that faces the other value: intervals near a limit are lopsided.
    """
    (low, high) = (first_ci95, second_ci95) if second >= first else (second_ci95, first_ci95)
    below, above = min(first, second), max(first, second)
    error = float(np.hypot(low[1] - below, above - high[0])) / _QUANTILE
    return (second - first) / error if error > 0 else float("nan")


def chance(sigma: float) -> float:
    """Return the probability that two measurements of one value differ by so many standard errors or more."""
    return float(2 * stats.norm.sf(abs(sigma)))


@dataclass(frozen=True)
class MapDifference:
    """Difference of two maps of one quantity, their mean difference taken out.

    Attributes
    ----------
    pixels : int
        Pixels that were compared.
    rms, expected : float
        Its rms, and what the errors of both maps make of it.
    chance : float
        Probability of so large an rms without a change.
    """

    pixels: int
    rms: float
    expected: float
    chance: float

    @property
    def grown(self) -> bool:
        """True if the rms exceeds its expectation by more than the errors are known."""
        return self.rms > (1 + _MIN_GROWTH) * self.expected


def compare_maps(first: Array, first_variance: Array, second: Array, second_variance: Array) -> MapDifference:
    """Return how two maps of posterior means differ, arrays (pixel,), each with the variance of its errors.

    A map with a spread s² over the pixels, whose errors have the variance V, is w times a measurement, w = 1 − V/s²,
    with noise of variance w V. The difference of two maps of the same pixels thus has the variance
    w₁ V₁ + w₂ V₂ + (w₁ − w₂)² s².
    """
    difference = second - first
    pixels = difference.size
    spreads = np.array([first.var() + first_variance.mean(), second.var() + second_variance.mean()])
    errors = np.array([first_variance.mean(), second_variance.mean()])
    weights = 1 - errors / np.maximum(spreads, 1e-300)
    expected2 = float(weights @ errors + (weights[0] - weights[1]) ** 2 * spreads.mean())
    rms2 = float(difference.var(ddof=1)) if pixels > 1 else 0.0
    ratio = (pixels - 1) * rms2 / expected2 if expected2 > 0 else (np.inf if rms2 > 0 else 0.0)
    chance_of = float(stats.chi2.sf(ratio, max(pixels - 1, 1)))
    return MapDifference(pixels, float(np.sqrt(rms2)), float(np.sqrt(expected2)), chance_of)
