"""Pixels that are not like the others: hot, noisy, stuck or dead."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.statistics import Series, robust_sigma

# Hot: this many robust standard deviations above the median dark signal.
_HOT_SIGMA = 5.0

# Noisy: a variance that chance would give to one pixel of so many sensors.
_NOISY_CHANCE = 1e-2

# Dead: a response below this fraction of the neighbourhood's.
_DEAD_RESPONSE = 0.5


def hot_pixels(darks: Sequence[Series]) -> NDArray[np.bool_]:
    """Return where the dark signal stands out, from the longest exposure less the shortest.

    Parameters
    ----------
    darks : sequence of Series
        With a single exposure among them nothing can be told from the offset, and no pixel is hot.
    """
    exposure_s = [series.conditions.exposure_s for series in darks]
    shortest, longest = darks[int(np.argmin(exposure_s))], darks[int(np.argmax(exposure_s))]
    if shortest.conditions.exposure_s == longest.conditions.exposure_s:
        return np.zeros(darks[0].pattern_dn.shape, bool)
    signal_dn = longest.mean_dn - shortest.mean_dn
    # Means of few whole numbers can lie on so few values that half of the pixels have no deviation at all.
    spread_dn = max(robust_sigma(signal_dn), 0.5 / np.sqrt(longest.frames))
    return np.asarray(signal_dn > np.median(signal_dn) + _HOT_SIGMA * spread_dn)


def noisy_pixels(variance_ratio: NDArray[np.floating], freedom: float) -> NDArray[np.bool_]:
    """Return where the noise is too large to be chance: random telegraph signals, cosmic rays, loose contacts.

    Parameters
    ----------
    variance_ratio : array (row, column)
        Each pixel's variance over the frames, over that of the model.
    freedom : float
        Degrees of freedom behind each, if its noise is normal.
    """
    # Single electrons, or pixels that differ, scatter variances further than normal noise does.
    freedom = min(freedom, 2 / max(robust_sigma(variance_ratio) ** 2, 1e-12))
    chance = _NOISY_CHANCE / variance_ratio.size
    return np.asarray(variance_ratio * freedom > stats.chi2.isf(chance, freedom))


def dead_pixels(response: NDArray[np.floating], neighbourhood: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return where a flat is answered by less than half of what the neighbourhood answers."""
    return np.asarray(response < _DEAD_RESPONSE * neighbourhood)


def variance_ratio(darks: Sequence[Series], noise_dn2: Sequence[float]) -> tuple[NDArray[np.float64], float]:
    """Return each pixel's variance over that of the model (row, column), and the degrees of freedom behind it."""
    freedom = float(sum(series.frames - 1 for series in darks))
    ratio = np.zeros(darks[0].within_dn2.shape)
    for series, variance in zip(darks, noise_dn2, strict=True):
        ratio += series.within_dn2 / variance
    return ratio / max(freedom, 1.0), freedom
