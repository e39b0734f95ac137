"""Maps per pixel as posterior means: what ten frames say about one pixel, tempered by what all pixels are like.

The mean of ten frames is off by 1.1 e⁻ rms at 12 e⁻² of read noise: as much as the signal to be reconstructed. Offset
and dark signal of pixel i have the prior N(μ, s²), N(d, q²) whose spreads the fit has measured, and the means m_ij of
the series measure `o_i + d_i t_j` with variance v_j/n_j. Both being Gaussian, the posterior mean is linear in the
means, with one 2 × 2 matrix for all pixels (Gelman et al., Bayesian Data Analysis, 3rd ed., §5.4).
"""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.statistics import Series


def offset_and_dark_signal(
    darks: Sequence[Series],
    values: Mapping[str, float],
    noise_dn2: Sequence[float],
    pattern_dn2: float,
    hot: NDArray[np.bool_],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return posterior means and variances of every pixel's offset and dark signal.

    Parameters
    ----------
    darks : sequence of Series
        The dark series, at least one.
    values : mapping
        `offset_dn`, `dark_signal_dn_per_s`, `dsnu_dn2`, `dcnu_dn2_per_s2` of the fit.
    noise_dn2 : sequence of float
        v_j, pixel noise of each series.
    pattern_dn2 : float
        Variance of the offsets that rows and columns add to the pixels' own.
    hot : array (row, column), bool
        Pixels that the prior of the dark signal does not describe; theirs is measured by themselves alone.

    Returns
    -------
    offset_dn, dark_signal_dn_per_s : array (row, column)
        Posterior means.
    variances : array (2, row, column)
        Of both, in DN² and DN²/s².
    """
    t = np.array([series.conditions.exposure_s for series in darks])
    weight = np.array([series.frames for series in darks]) / np.asarray(noise_dn2)
    mean = np.array([values["offset_dn"], values.get("dark_signal_dn_per_s", 0.0)])
    design = np.stack([np.ones_like(t), t])
    precision = (design * weight) @ design.T
    offset_prior = 1 / max(values["dsnu_dn2"] + pattern_dn2, 1e-6)
    typical = np.linalg.inv(precision + np.diag([offset_prior, 1 / max(values.get("dcnu_dn2_per_s2", 0.0), 1e-12)]))
    unbound = np.linalg.inv(precision + np.diag([offset_prior, 1e-12 if np.ptp(t) else 1e12]))
    information = np.zeros((2, *hot.shape))
    for j, series in enumerate(darks):
        # A series as a whole is off the straight line by its frames' jitter, which is no pixel's offset.
        deviation = series.mean_dn - series.mean_dn.mean(where=~hot)
        for row in range(2):
            information[row] += design[row, j] * weight[j] * deviation
    posterior = mean[:, None, None] + np.tensordot(typical, information, 1)
    posterior[:, hot] = mean[:, None] + unbound @ information[:, hot]
    variances = np.where(hot, np.diag(unbound)[:, None, None], np.diag(typical)[:, None, None])
    return posterior[0], posterior[1], variances


def shrunk_variance_ratio(ratio: NDArray[np.float64], freedom: float, usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return each pixel's variance over the model's, drawn towards 1 as far as its scatter is chance.

    With ν degrees of freedom chance alone scatters a ratio with variance 2/ν. What scatter there is beyond that, e,
    is the pixels' own and is worth ν₀ = 2/e degrees of freedom of prior: posterior mean (ν₀ + ν ratio)/(ν₀ + ν)
    (Smyth, Stat. Appl. Genet. Mol. Biol. 3, 3, 2004).
    """
    chance = 2 / max(freedom, 1.0)
    excess = float(ratio.var(where=usable)) - chance
    resolved = 3 * chance * np.sqrt(2 / usable.sum())
    if freedom < 1 or excess < resolved:
        return np.ones_like(ratio)
    prior = 2 / excess
    return np.asarray((prior + freedom * ratio) / (prior + freedom))
