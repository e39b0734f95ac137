"""Find defective pixels: hot, noisy, and telegraph pixels, which jump between two levels.

A telegraph pixel jumps while a trap of an amplifier holds an electron and does not. The values of two levels, however
often each is visited, have skewness γ and kurtosis κ with γ² + 1 = κ, the least that is possible (Pearson, Phil. Trans.
R. Soc. A 216, 429, 1916); (γ² + 1)/κ is 1 for them and 1/3 for the normal law. A pixel counts as a telegraph pixel if
this quotient is larger than chance makes it of normal noise, and the pixel is noisier than most. One frame that stands
out alone, as a cosmic ray makes it, is no second level.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.maps.read_noise_map import PixelReadNoise
from faintfield.calib.noise.series import Series, robust_sigma
from faintfield.calib.noise.strips import Array, Map, Mask, map_of

# Robust standard deviations above the median dark signal from which a pixel is hot.
_HOT_SIGMA = 5.0

# Probability of a normal value below one standard deviation above the mean.
_ONE_SIGMA = float(stats.norm.cdf(1.0))

# Expected number of pixels per sensor that are noisy by chance alone.
_NOISY_BY_CHANCE = 1e-2

# Variance over the median from which a pixel is of no use, and that of a pixel that also jumps between two levels.
_USELESS, _USELESS_TELEGRAPH = 25.0, 4.0

# Probability that normal noise looks like two levels.
_TWO_LEVELS_BY_CHANCE = 1e-3

# Standard errors by which a telegraph pixel is noisier than most, and by which factor at least.
_MIN_SIGMA, _MIN_FACTOR = 2.0, 1.1

# Kurtosis over the number of frames, of which a single frame that stands out makes 1, and two make 1/2.
_MAX_LONELY = 0.6

# Fewest frames that show two levels, and most simulated values of normal noise.
_MIN_FRAMES, _SIMULATED = 8, 4_000_000


def hot_pixels(darks: Sequence[Series]) -> Mask:
    """Return the pixels (row, column) with a large dark signal, the longest exposure minus the shortest.

    If all darks have one exposure, dark signal and offset cannot be separated, and no pixel is hot.
    """
    exposure_s = [series.conditions.dark_time_s for series in darks]
    shortest, longest = darks[int(np.argmin(exposure_s))], darks[int(np.argmax(exposure_s))]
    if shortest.conditions.dark_time_s == longest.conditions.dark_time_s:
        return np.zeros(darks[0].pattern_dn.shape, bool)
    signal_dn = map_of(lambda rows: longest.mean_of(rows) - shortest.mean_of(rows), darks[0].pattern_dn.shape)
    # Means of few frames take few values, so that the median absolute deviation can be zero.
    spread_dn = max(robust_sigma(signal_dn), 0.5 / np.sqrt(longest.frames))
    limit_dn = np.median(signal_dn) + _HOT_SIGMA * spread_dn
    return map_of(lambda rows: signal_dn[rows] > limit_dn, signal_dn.shape, bool)


def outlying_pixels(variance_ratio: Map, freedom: float) -> Mask:
    """Return the pixels (row, column) with more noise than chance allows.

    Causes are random telegraph signals, cosmic rays and loose contacts.

    Parameters
    ----------
    variance_ratio : array (row, column)
        Variance of each pixel over the frames, divided by that of the model.
    freedom : float
        Degrees of freedom of each variance if the noise is normal.
    """
    chance = _NOISY_BY_CHANCE / variance_ratio.size
    by_chance = np.log(stats.chi2.isf(chance, freedom) / freedom)
    # A population with a tail towards much noise, as sCMOS sensors have it, is no row of defects
    by_population = stats.norm.isf(chance) * _population_spread(variance_ratio, freedom)
    limit = np.exp(np.hypot(by_chance, by_population))
    return map_of(lambda rows: variance_ratio[rows] > limit, variance_ratio.shape, bool)


def _population_spread(variance_ratio: Map, freedom: float) -> float:
    """Return the standard deviation of the logarithm of the pixels' own variances.

    It is read from the median and the quantile at one standard deviation above it, which defects do not move. Those of
    χ² with `freedom` degrees of freedom, divided by it, contain no spread of the pixels.
    """
    middle, upper = np.quantile(variance_ratio, (0.5, _ONE_SIGMA))
    if middle <= 0.0:  # values so coarse that most pixels never change
        return 0.0
    chance = np.log(stats.chi2.ppf(_ONE_SIGMA, freedom) / stats.chi2.ppf(0.5, freedom))
    return float(np.sqrt(max(np.log(upper / middle) ** 2 - chance**2, 0.0)))


def noisy_pixels(outlying: Mask, variance_ratio: Map, telegraph: Mask) -> Mask:
    """Return the outlying pixels (row, column) that are too noisy to be of use; the others have a noise of their own.

    A pixel of five times the usual noise tells a twenty-fifth of what others tell. One that jumps between two levels
    is left out earlier, since its noise is not normal.
    """
    middle = max(float(np.median(variance_ratio)), 1e-12)

    def work(rows: slice) -> Mask:
        limit = np.where(telegraph[rows], _USELESS_TELEGRAPH, _USELESS)
        return np.asarray(outlying[rows] & (variance_ratio[rows] / middle > limit))

    return map_of(work, outlying.shape, bool)


def variance_ratio(darks: Sequence[Series], noise_dn2: Sequence[float]) -> tuple[NDArray[np.float32], float]:
    """Return each pixel's variance over that of the model (row, column), and its degrees of freedom."""
    freedom = float(sum(series.frames - 1 for series in darks))

    def work(rows: slice) -> Array:
        ratios = [dark.within_dn2[rows] / np.float64(v) for dark, v in zip(darks, noise_dn2, strict=True)]
        return np.asarray(np.sum(ratios, axis=0) / max(freedom, 1.0))

    return map_of(work, darks[0].within_dn2.shape), freedom


def telegraph_pixels(darks: Sequence[Series], read: PixelReadNoise, noise_dn2: Sequence[float]) -> Mask:
    """Return the telegraph pixels (row, column) by dark series, their read noise and the noise v_j of each series."""
    frames = np.array([dark.frames for dark in darks])
    if not read.resolved or frames.sum() < _MIN_FRAMES:
        return np.zeros(read.read_noise_dn.shape, bool)
    typical = np.median(read.read_noise_dn)
    limit = _normal_quotient(frames, np.sqrt(noise_dn2))

    def work(rows: slice) -> Mask:
        powers = [
            np.sum([getattr(dark, name)[rows] for dark in darks], axis=0, dtype=np.float64)
            for name in ("within_dn2", "cubes_dn3", "fourths_dn4")
        ]
        skew2, kurtosis = _shape(*(power / frames.sum() for power in powers))
        read_dn, se_dn = read.read_noise_dn[rows], read.se_dn[rows]
        noisier = (read_dn > _MIN_FACTOR * typical) & (read_dn - _MIN_SIGMA * se_dn > typical)
        lonely = kurtosis > _MAX_LONELY * frames.sum()
        return np.asarray(noisier & ~lonely & ((skew2 + 1) / kurtosis > limit))

    return map_of(work, read.read_noise_dn.shape, bool)


def _shape(second: Array, third: Array, fourth: Array) -> tuple[Array, Array]:
    second = np.maximum(second, 1e-12)
    return third**2 / second**3, np.maximum(fourth / second**2, 1.0)


def _normal_quotient(frames: NDArray[np.int64], sigma_dn: Array) -> float:
    """Return the quotient that normal noise, rounded to whole DN, exceeds with probability `_TWO_LEVELS_BY_CHANCE`."""
    rng = np.random.default_rng(1288)
    pixels = int(np.clip(_SIMULATED // frames.sum(), 2000, 20_000))
    moments = np.zeros((3, pixels))
    for count, sigma in zip(frames, sigma_dn, strict=True):
        values = np.rint(rng.random(pixels) + sigma * rng.standard_normal((count, pixels)))
        values -= values.mean(axis=0)
        moments += [np.sum(values**power, axis=0) for power in (2, 3, 4)]
    skew2, kurtosis = _shape(*(moments / frames.sum()))
    return float(np.quantile((skew2 + 1) / kurtosis, 1 - _TWO_LEVELS_BY_CHANCE))
