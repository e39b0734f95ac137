"""Find defective pixels: hot, noisy or dead."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.statistics import Series, robust_sigma

# Robust standard deviations above the median dark signal from which a pixel is hot.
_HOT_SIGMA = 5.0

# Expected number of pixels per sensor that are noisy by chance alone.
_NOISY_BY_CHANCE = 1e-2

# Response over that of the neighbourhood below which a pixel is dead.
_MIN_RESPONSE = 0.5


def hot_pixels(darks: Sequence[Series]) -> NDArray[np.bool_]:
    """Return the pixels (row, column) with a large dark signal, the longest exposure minus the shortest.

    Parameters
    ----------
    darks : sequence of Series
        If all have one exposure, dark signal and offset cannot be separated, and no pixel is hot.
    """
    exposure_s = [series.conditions.exposure_s for series in darks]
    shortest, longest = darks[int(np.argmin(exposure_s))], darks[int(np.argmax(exposure_s))]
    if shortest.conditions.exposure_s == longest.conditions.exposure_s:
        return np.zeros(darks[0].pattern_dn.shape, bool)
    signal_dn = longest.mean_dn - shortest.mean_dn
    # Means of few frames take few values, so that the median absolute deviation can be zero.
    spread_dn = max(robust_sigma(signal_dn), 0.5 / np.sqrt(longest.frames))
    return np.asarray(signal_dn > np.median(signal_dn) + _HOT_SIGMA * spread_dn)


def noisy_pixels(variance_ratio: NDArray[np.floating], freedom: float) -> NDArray[np.bool_]:
    """Return the pixels (row, column) with more noise than chance allows.

    Causes are random telegraph signals, cosmic rays and loose contacts.

    Parameters
    ----------
    variance_ratio : array (row, column)
        Variance of each pixel over the frames, divided by that of the model.
    freedom : float
        Degrees of freedom of each variance if the noise is normal.
    """
    # Single electrons, and pixels that differ, scatter variances more than normal noise does.
    freedom = min(freedom, 2 / max(robust_sigma(variance_ratio) ** 2, 1e-12))
    chance = _NOISY_BY_CHANCE / variance_ratio.size
    return np.asarray(variance_ratio * freedom > stats.chi2.isf(chance, freedom))


def dead_pixels(response: NDArray[np.floating], neighbourhood: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the pixels (row, column) that respond to a flat less than half as much as their neighbourhood."""
    return np.asarray(response < _MIN_RESPONSE * neighbourhood)


def variance_ratio(darks: Sequence[Series], noise_dn2: Sequence[float]) -> tuple[NDArray[np.float64], float]:
    """Return each pixel's variance over that of the model (row, column), and its degrees of freedom."""
    freedom = float(sum(series.frames - 1 for series in darks))
    ratio = np.zeros(darks[0].within_dn2.shape)
    for series, variance in zip(darks, noise_dn2, strict=True):
        ratio += series.within_dn2 / variance
    return ratio / max(freedom, 1.0), freedom
