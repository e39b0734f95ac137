"""Permutation test of views at their places against shuffled views."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

# Relative difference between views of one point beyond noise, and the largest squared deviation that counts, in
# variances, as in `agreement`.
_MODEL_ERROR, _MAX_SQUARES = 0.04, 16.0

# Fewest views of a sample, as a share of all.
_MIN_SEEN = 0.3

# Statistics closer than this, relative to their size, are equal: sums of the same numbers in another order.
_EQUAL = 1e-5


@dataclass(frozen=True)
class Significance:
    """Share of shuffled orders that agree at least as well as the true one.

    Attributes
    ----------
    p_value : float
        (1 + the number of shuffles that agree at least as well) / (1 + shuffles). If places meant nothing, it would be
        α or less in at most a share α of all sets.
    z : float
        By how many standard deviations of the shuffled the stated are better than their mean; 0 if one of them is
        infinite, since views that see nothing together cannot be compared.
    shuffles : int
        Number of shuffles.
    """

    p_value: float
    z: float
    shuffles: int


def disagreement(
    light_e: NDArray[np.floating], visible: NDArray[np.bool_], places: NDArray[np.intp], known_variance_e2: float
) -> float:
    """Return the mean over samples of how much the views disagree at the best depth of each.

    It is the least, over the depths, of the squared deviations from the mean of the views per degree of freedom, in
    variances. The search for the depth is part of it: of shuffled views, the best depth is taken, too.

    Parameters
    ----------
    light_e : float array (place, view, depth, sample)
        What each view shows of each sample if it was taken from each place.
    visible : bool array (place, depth, sample)
        Whether the sample is in view from there.
    places : int array (view,)
        The place of each view.
    known_variance_e2 : float
        Variance of a number without that of the light.
    """
    weight = visible[places].astype(np.float32)
    light = light_e[places, np.arange(len(places))]
    views = weight.sum(axis=0)
    mean = np.einsum("vds,vds->ds", light, weight) / np.maximum(views, 1)
    level = np.maximum(mean, 0)
    variance = np.maximum(level + known_variance_e2 + (_MODEL_ERROR * level) ** 2, 1e-6)
    light -= mean
    np.square(light, out=light)
    light /= variance
    np.minimum(light, _MAX_SQUARES, out=light)
    reduced = np.einsum("vds,vds->ds", light, weight) / np.maximum(views - 1, 1)
    least = np.where(views >= max(_MIN_SEEN * len(places), 2), reduced, np.inf).min(axis=0)
    known = np.isfinite(least)
    return float(least[known].mean(dtype=np.float64)) if known.any() else float("inf")


def significance(statistic: float, shuffled: Sequence[float]) -> Significance:
    """Return how a statistic that is small where views agree compares with those of shuffled views.

    Equal values count as agreeing as well: where shuffling changes nothing, p is 1.

    >>> significance(1.0, [2.0, 3.0, 1.0]).p_value
    0.5
    """
    if not np.isfinite(statistic):  # nothing is seen by enough views
        return Significance(1.0, 0.0, len(shuffled))
    values = np.asarray(shuffled, float)
    as_good = int(np.count_nonzero(values <= statistic + _EQUAL * abs(statistic)))
    known = values[np.isfinite(values)]
    z = 0.0
    if np.isfinite(statistic) and known.size:
        z = float((known.mean() - statistic) / max(float(known.std()), _EQUAL * abs(statistic), 1e-30))
    return Significance((1 + as_good) / (1 + len(values)), z, len(values))
