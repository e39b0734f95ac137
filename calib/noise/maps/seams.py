"""Find the seams of a sensor: halves, quarters, or alternate rows and columns that differ because they are read apart.

A sensor with two taps reads its halves through two amplifiers, a sensor with dual gain or column amplifiers on both
sides its even and odd columns. The means of the columns (or rows) then differ by region, which an F test tells from
their scatter. A gradient across the sensor and its bend are no seam; they are fitted beside the regions.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

type Array = NDArray[np.float64]

# Probability that chance alone makes such a seam, for each of six that are looked for.
_MAX_CHANCE = 1e-4

# Fewest rows or columns beyond the numbers that are fitted.
_MIN_FREEDOM = 4


@dataclass(frozen=True)
class Seam:
    """Regions that differ.

    Attributes
    ----------
    lines : str
        "rows" or "columns".
    regions : str
        "halves", "quarters" or "alternate".
    effect : array (line,)
        By how much the region of each line differs from the mean.
    se : float
        Standard error of the largest difference between regions.
    of_response : bool
        Whether the response to light has told its size.
    """

    lines: str
    regions: str
    effect: Array
    se: float
    of_response: bool = False

    @property
    def difference(self) -> float:
        """Largest difference between two regions."""
        return float(np.ptp(self.effect))

    @property
    def map(self) -> Array:
        """The effect as an array that broadcasts to (row, column)."""
        return self.effect[:, None] if self.lines == "rows" else self.effect[None, :]

    def __str__(self) -> str:
        return {
            "halves": f"the halves of the {self.lines}",
            "quarters": f"the quarters of the {self.lines}",
            "alternate": f"even and odd {self.lines}",
        }[self.regions]


def find_seams(values: Array, weight: Array) -> list[Seam]:
    """Return the seams of values (row, column): at most one of rows and one of columns.

    Parameters
    ----------
    values : array (row, column)
        A quantity of each pixel.
    weight : array (row, column)
        Inverse variance of each value; 0 for pixels that do not count.
    """
    found = [_find_seam(*_profile(values, weight, lines), lines) for lines in ("rows", "columns")]
    return [seam for seam in found if seam]


def share_of_seam(seam: Seam, values: Array, weight: Array) -> tuple[float, float]:
    """Return how much of the effect of a seam other values (row, column) show, and its standard error."""
    profile, total = _profile(values, weight, seam.lines)
    found, covariance, _ = _fit(np.stack([seam.effect, np.ones(profile.size)], axis=1), profile, total)
    return float(found[0]), float(np.sqrt(covariance[0, 0]))


def _profile(values: Array, weight: Array, lines: str) -> tuple[Array, Array]:
    """Return the weighted means of rows or columns, and their inverse variances (line,)."""
    axis = 1 if lines == "rows" else 0
    # A line without any pixel that counts tells next to nothing
    total = np.maximum(weight.sum(axis=axis), 1e-9 * weight.max())
    return (values * weight).sum(axis=axis) / total, total


def _find_seam(profile: Array, weight: Array, lines: str) -> Seam | None:
    """Return the likeliest seam of a profile (line,), None without any."""
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
        found, covariance, after = _fit(np.concatenate([member, np.stack([x, x**2], axis=1)], axis=1), profile, weight)
        excess = max(after / freedom, 1.0)
        fewer = member.shape[1] - 1
        chance = float(stats.f.sf((before - after) / fewer / excess, fewer, freedom))
        if chance < least:
            level = found[: fewer + 1]
            low, high = int(level.argmin()), int(level.argmax())
            variance = covariance[low, low] + covariance[high, high] - 2 * covariance[low, high]
            effect = level[region] - np.average(level[region], weights=weight)
            best, least = Seam(lines, name, effect, float(np.sqrt(variance * excess))), chance
    return best


def _fit(design: Array, profile: Array, weight: Array) -> tuple[Array, Array, float]:
    """Return coefficients, their covariance and the weighted sum of squared residuals."""
    root = np.sqrt(weight)
    covariance = np.linalg.inv((design * weight[:, None]).T @ design)
    found = covariance @ (design.T @ (weight * profile))
    return found, covariance, float(np.sum((root * (profile - design @ found)) ** 2))
