"""Maps per pixel as posterior means: the mean of ten frames of a pixel, combined with the distribution over all pixels.

The mean of ten frames is off by 1.1 e⁻ rms at 12 e⁻² of read noise: as much as the signal to be reconstructed. Offset
and dark signal of pixel i have the priors N(μ, s²) and N(d, q²), whose spreads the fit has measured, and the means m_ij
of the series measure `o_i + d_i t_j` with variance v_j/n_j. Since both are Gaussian, the posterior mean is linear in
the means, with one 2 × 2 matrix for all pixels (Gelman et al., Bayesian Data Analysis, 3rd ed., §5.4).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.statistics import Series

type Array = NDArray[np.float64]


@dataclass(frozen=True)
class PixelLevels:
    """Offset and dark signal of every pixel, arrays (row, column), with the variances of their errors."""

    offset_dn: Array
    dark_signal_dn_per_s: Array
    offset_variance_dn2: Array
    dark_signal_variance_dn2_per_s2: Array


def pixel_levels(
    darks: Sequence[Series],
    values: Mapping[str, float],
    noise_dn2: Sequence[float],
    pattern_dn2: float,
    hot: NDArray[np.bool_],
) -> PixelLevels:
    """Return the posterior means of every pixel's offset and dark signal.

    Parameters
    ----------
    darks : sequence of Series
        Dark series, at least one.
    values : mapping
        `offset_dn`, `dark_signal_dn_per_s`, `dsnu_dn2`, `dcnu_dn2_per_s2` of the fit.
    noise_dn2 : sequence of float
        v_j, the pixel noise of each series.
    pattern_dn2 : float
        Variance that the patterns of rows and columns add to the offsets.
    hot : array (row, column), bool
        Pixels whose dark signal the prior does not describe; only their own values determine it.
    """
    t = np.array([series.conditions.exposure_s for series in darks])
    weight = np.array([series.frames for series in darks]) / np.asarray(noise_dn2)
    mean = np.array([values["offset_dn"], values.get("dark_signal_dn_per_s", 0.0)])
    design = np.stack([np.ones_like(t), t])
    precision = (design * weight) @ design.T
    # The floors stand for spreads that are zero or were not fitted.
    offset_prior = 1 / max(values["dsnu_dn2"] + pattern_dn2, 1e-6)
    typical = np.linalg.inv(precision + np.diag([offset_prior, 1 / max(values.get("dcnu_dn2_per_s2", 0.0), 1e-12)]))
    unbound = np.linalg.inv(precision + np.diag([offset_prior, 1e-12 if np.ptp(t) else 1e12]))
    information = _information(darks, design * weight, hot)
    posterior = mean[:, None, None] + np.tensordot(typical, information, 1)
    posterior[:, hot] = mean[:, None] + unbound @ information[:, hot]
    variances = np.where(hot, np.diag(unbound)[:, None, None], np.diag(typical)[:, None, None])
    return PixelLevels(posterior[0], posterior[1], variances[0], variances[1])


def _information(darks: Sequence[Series], weights: Array, hot: NDArray[np.bool_]) -> Array:
    """Return the sums (2, row, column) of the pixels' deviations over the series, by `weights` (2, series)."""
    information = np.zeros((2, *hot.shape))
    for series, weight in zip(darks, weights.T, strict=True):
        # Jitter moves the mean of a whole series off the straight line; that is no pixel's offset.
        deviation = series.mean_dn - series.mean_dn.mean(where=~hot)
        for row in range(2):
            information[row] += weight[row] * deviation
    return information


def shrunk_variance_ratio(ratio: Array, freedom: float, usable: NDArray[np.bool_]) -> Array:
    """Return each pixel's variance over the model's, shrunk towards 1 by as much as its scatter is chance.

    With ν degrees of freedom chance alone scatters a ratio with variance 2/ν. Any excess e is real, and corresponds to
    a prior of ν₀ = 2/e degrees of freedom: the posterior mean is (ν₀ + ν ratio)/(ν₀ + ν) (Smyth, Stat. Appl. Genet.
    Mol. Biol. 3, 3, 2004).
    """
    chance = 2 / max(freedom, 1.0)
    excess = float(ratio.var(where=usable)) - chance
    resolved = 3 * chance * np.sqrt(2 / usable.sum())
    if freedom < 1 or excess < resolved:
        return np.ones_like(ratio)
    prior = 2 / excess
    return np.asarray((prior + freedom * ratio) / (prior + freedom))
