"""Measure what differs from pixel to pixel: defects, offset and dark signal, noise, and response to light.

Offset and dark signal are posterior means. The mean of ten frames of a pixel is off by 1.1 e⁻ rms at 12 e⁻² of read
noise: as much as the signal to be reconstructed. So offset and dark signal of pixel i get the priors N(μ, s²) and
N(d, q²), whose spreads the fit has measured; the means m_ij of the series measure `o_i + d_i t_j` with variance
v_j/n_j. Since both are Gaussian, the posterior mean is linear in the means, with one 2 × 2 matrix for all pixels
(Gelman et al., Bayesian Data Analysis, 3rd ed., §5.4).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage, stats

from faintfield.calib.noise.statistics import Series, robust_sigma

type Array = NDArray[np.float64]

# Robust standard deviations above the median dark signal from which a pixel is hot.
_HOT_SIGMA = 5.0

# Expected number of pixels per sensor that are noisy by chance alone.
_NOISY_BY_CHANCE = 1e-2

# Variances on the grid of the prior, and steps of expectation and maximization that find their weights.
_GRID, _EM_STEPS = 80, 200

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


def variance_ratio(darks: Sequence[Series], noise_dn2: Sequence[float]) -> tuple[NDArray[np.float64], float]:
    """Return each pixel's variance over that of the model (row, column), and its degrees of freedom."""
    freedom = float(sum(series.frames - 1 for series in darks))
    ratio = np.zeros(darks[0].within_dn2.shape)
    for series, variance in zip(darks, noise_dn2, strict=True):
        ratio += series.within_dn2 / variance
    return ratio / max(freedom, 1.0), freedom


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
    """Return each pixel's variance over the model's, shrunk towards those of other pixels as far as chance scatters it.

    With ν degrees of freedom chance alone scatters a ratio r with variance 2 r²/ν. Any excess is real, and the result
    is the posterior mean under the prior that the pixels themselves suggest: the distribution of variances on a grid
    that makes their scatter the likeliest (Kiefer and Wolfowitz, Annals of Mathematical Statistics 27, 887, 1956).
    Halves of a sensor that differ, and a few pixels that flicker, keep their own variance, where a prior of one centre
    would pull them to a mean that no pixel has.
    """
    chance = 2 / max(freedom, 1.0)
    excess = float(ratio.var(where=usable)) - chance
    resolved = 3 * chance * np.sqrt(2 / usable.sum())
    if freedom < 1 or excess < resolved:
        return np.ones_like(ratio)
    bins, weight = np.unique(_coarse(ratio[usable]), return_counts=True)
    grid = np.geomspace(max(float(bins[0]), 1e-3), float(bins[-1]) * 1.05, _GRID)
    # χ² density of each bin's ratio under each variance of the grid, up to a factor that all variances share.
    logs = -0.5 * freedom * (np.log(grid) + bins[:, None] / grid)
    likelihood = np.exp(logs - logs.max(1, keepdims=True))
    prior = np.full(_GRID, 1 / _GRID)
    for _ in range(_EM_STEPS):
        posterior = likelihood * prior
        posterior /= posterior.sum(1, keepdims=True)
        prior = weight @ posterior / weight.sum()
    posterior = likelihood * prior
    mean = posterior @ grid / posterior.sum(1)
    return np.asarray(np.interp(ratio, bins, mean))


def _coarse(ratio: Array) -> Array:
    """Return ratios rounded to 2 %, of which there are few different ones."""
    return np.exp(np.round(np.log(np.maximum(ratio, 1e-3)) / 0.02) * 0.02)


@dataclass(frozen=True)
class Response:
    """Response of the sensor to even light.

    Attributes
    ----------
    relative, vignetting : array (row, column)
        Response over its mean, and its smooth part.
    prnu, prnu_se : float
        Standard deviation of the rest relative to the mean (EMVA 1288's PRNU after its high-pass filter), and its
        standard error.
    dead : array (row, column), bool
        Pixels that respond less than half as much as their neighbourhood.
    """

    relative: NDArray[np.float64]
    vignetting: NDArray[np.float64]
    prnu: float
    prnu_se: float
    dead: NDArray[np.bool_]


def measure_response(
    signals_dn: Sequence[NDArray[np.float64]], noise_dn2: Sequence[float], usable: NDArray[np.bool_]
) -> Response:
    """Separate vignetting from PRNU, and shrink the latter by its share of noise.

    Parameters
    ----------
    signals_dn : sequence of arrays (row, column)
        Mean of each flat series minus offset and dark signal.
    noise_dn2 : sequence of float
        Variance of these means for a pixel of mean signal.
    usable : array (row, column), bool
        Pixels in use.
    """
    total = np.sum(signals_dn, axis=0)
    mean = float(total.mean(where=usable))
    raw = total / mean
    dead = (raw < _MIN_RESPONSE * _smooth(raw, usable)) & usable
    usable = usable & ~dead
    vignetting = _smooth(raw, usable)
    pixel = raw / np.maximum(vignetting, 1e-6) - 1
    # Shot noise grows less than the signal, so that brighter pixels have less of it in relation to their signal.
    noise = float(np.sum(noise_dn2)) / mean**2 / np.maximum(vignetting, 1e-6)
    spread2 = max(float(pixel.var(where=usable)) - float(noise.mean(where=usable)), 0.0)
    kept = spread2 / (spread2 + noise)
    error2 = (spread2 + float(noise.mean(where=usable))) * np.sqrt(2 / usable.sum())
    return Response(
        relative=vignetting * (1 + np.where(usable, kept * pixel, 0.0)),
        vignetting=vignetting,
        prnu=float(np.sqrt(spread2)),
        prnu_se=float(np.sqrt(spread2 + error2) - np.sqrt(spread2)),
        dead=dead,
    )


def _smooth(response: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the running mean over the usable pixels of a neighbourhood, a sixteenth of the frame wide."""
    window = max(15, min(response.shape) // 16) | 1
    weight = ndimage.uniform_filter(usable.astype(float), window, mode="nearest")
    mean = ndimage.uniform_filter(np.where(usable, response, 0.0), window, mode="nearest")
    return np.asarray(mean / np.maximum(weight, 1e-6))


def quantum_efficiency(
    flats: Sequence[Series], charges_e: Sequence[float], gain_relative_se: float
) -> tuple[float, float] | None:
    """Return electrons per photon with the standard error, from the flats that state their photons; None without any.

    EMVA 1288's η = R/K is the slope of charge over photons through the origin. Its error is that of the gain and of the
    light's steadiness.
    """
    stated = [
        (series.conditions.photons, charge)
        for series, charge in zip(flats, charges_e, strict=True)
        if series.conditions.photons
    ]
    if not stated:
        return None
    photons, charge = np.array(stated, float).T
    slope = float(charge @ photons / (photons @ photons))
    scatter = float(np.sum((charge - slope * photons) ** 2)) / max(len(stated) - 1, 1) / float(photons @ photons)
    return slope, float(np.hypot(slope * gain_relative_se, np.sqrt(scatter)))
