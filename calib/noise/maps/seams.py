"""Find the seams of a sensor: halves, quarters, or alternate rows and columns that differ because they are read apart.

A sensor with two taps reads its halves through two amplifiers, a sensor with dual gain or column amplifiers on both
sides its even and odd columns. The means of the columns (or rows) then differ by region, which an F test tells from
their scatter. A gradient across the sensor and its bend are no seam; they are fitted beside the regions.
"""

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.strips import Array, over_strips

# Probability that chance alone makes such a seam, for each of six that are looked for.
_MAX_CHANCE = 1e-4

# Fewest rows or columns beyond the numbers that are fitted.
_MIN_FREEDOM = 4


@dataclass(frozen=True)
class Seam:
    """Regions that differ.

    Attributes
    ----------
    lines, regions : str
        "rows" or "columns"; "halves", "quarters" or "alternate".
    effect : array (line,)
        By how much the region of each line differs from the mean.
    se : float
        Standard error of the largest difference between regions.
    """

    lines: str
    regions: str
    effect: Array
    se: float

    @property
    def difference(self) -> float:
        """Largest difference between two regions."""
        return float(np.ptp(self.effect))

    def of(self, rows: slice) -> Array:
        """Return the effect on some rows as an array that broadcasts to (row, column)."""
        return self.effect[rows, None] if self.lines == "rows" else self.effect[None, :]

    def __str__(self) -> str:
        return (
            f"even and odd {self.lines}" if self.regions == "alternate" else f"the {self.regions} of the {self.lines}"
        )


def find_seams(values: NDArray[Any], weight: NDArray[Any], precision: float = 1.0) -> list[Seam]:
    """Return the seams of values (row, column): at most one of rows and one of columns.

    Parameters
    ----------
    values : array (row, column)
        A quantity of each pixel.
    weight : array (row, column)
        Inverse variance of each value over `precision`; 0 for pixels that do not count.
    precision : float
        Factor on the weights.
    """
    profiles = _profiles(values, weight, precision)
    return [seam for lines, profile in profiles.items() if (seam := _find_seam(*profile, lines))]


def mean_effect(seam: Seam, values: NDArray[Any], weight: NDArray[Any]) -> Array:
    """Return by how much the means of a seam's regions differ from the mean of all values (row, column): (line,)."""
    profile, total = _profiles(values, weight, 1.0)[seam.lines]
    region = np.unique(seam.effect, return_inverse=True)[1]
    means = np.bincount(region, total * profile) / np.bincount(region, total)
    return np.asarray(means[region] - np.average(profile, weights=total))


def share_of_seam(
    seam: Seam, values: NDArray[Any], weight: NDArray[Any], precision: float = 1.0
) -> tuple[float, float]:
    """Return how much of the effect of a seam other values (row, column) show, and its standard error."""
    profile, total = _profiles(values, weight, precision)[seam.lines]
    share, covariance, _ = _fit(np.stack([seam.effect, np.ones(profile.size)], axis=1), profile, total)
    return float(share[0]), float(np.sqrt(covariance[0, 0]))


def _profiles(values: NDArray[Any], weight: NDArray[Any], precision: float) -> dict[str, tuple[Array, Array]]:
    """Return the weighted means of rows and columns, and their inverse variances (line,)."""

    def work(rows: slice) -> tuple[Array, Array, float]:
        weights = weight[rows].astype(np.float64)
        both = np.stack([weights * values[rows], weights])
        return both.sum(2), both.sum(1), float(weights.max())

    of_rows, of_columns, highest = zip(*over_strips(work, values.shape), strict=True)
    profiles = {}
    for lines, (mean, total) in (("rows", np.concatenate(of_rows, axis=1)), ("columns", np.sum(of_columns, axis=0))):
        # A line without any pixel that counts tells next to nothing
        counted = np.maximum(total, 1e-9 * max(highest))
        profiles[lines] = mean / counted, counted * precision
    return profiles


def _find_seam(profile: Array, weight: Array, lines: str) -> Seam | None:
    count = profile.size
    x = np.linspace(-1, 1, count)
    before = _fit(np.stack([np.ones(count), x, x**2], axis=1), profile, weight)[2]
    at = np.arange(count)
    best, least = None, _MAX_CHANCE
    for name, region in (("halves", 2 * at // count), ("quarters", 4 * at // count), ("alternate", at % 2)):
        member = np.eye(region.max() + 1)[region]
        freedom = count - member.shape[1] - 2
        if freedom < _MIN_FREEDOM:
            continue
        level, covariance, after = _fit(np.concatenate([member, np.stack([x, x**2], axis=1)], axis=1), profile, weight)
        excess = max(after / freedom, 1.0)
        fewer = member.shape[1] - 1
        chance = float(stats.f.sf((before - after) / fewer / excess, fewer, freedom))
        if chance < least:
            level = level[: fewer + 1]
            low, high = int(level.argmin()), int(level.argmax())
            variance = covariance[low, low] + covariance[high, high] - 2 * covariance[low, high]
            effect = level[region] - np.average(level[region], weights=weight)
            best, least = Seam(lines, name, effect, float(np.sqrt(variance * excess))), chance
    return best


def _fit(design: Array, profile: Array, weight: Array) -> tuple[Array, Array, float]:
    """Return coefficients, their covariance and the weighted sum of squared residuals."""
    root = np.sqrt(weight)
    covariance = np.linalg.inv((design * weight[:, None]).T @ design)
    coefficients = covariance @ (design.T @ (weight * profile))
    return coefficients, covariance, float(np.sum((root * (profile - design @ coefficients)) ** 2))
