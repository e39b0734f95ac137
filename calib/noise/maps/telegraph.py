"""Find telegraph pixels, which jump between two levels while a trap of an amplifier holds an electron and does not.

The values of two levels, however often each is visited, have skewness γ and kurtosis κ with γ² + 1 = κ, the least that
is possible (Pearson, Phil. Trans. R. Soc. A 216, 429, 1916); (γ² + 1)/κ is 1 for them and 1/3 for the normal law. A
pixel counts as a telegraph pixel if this quotient is larger than chance makes it of normal noise, and the pixel is
noisier than most. One frame that stands out alone, as a cosmic ray makes it, is no second level.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.maps.read_noise import PixelReadNoise
from faintfield.calib.noise.series.statistics import Series
from faintfield.calib.noise.strips import Array, Mask, map_of

# Probability that normal noise looks like two levels.
_CHANCE = 1e-3

# Standard errors by which a telegraph pixel is noisier than most, and by which factor at least.
_MIN_SIGMA, _MIN_FACTOR = 2.0, 1.1

# Kurtosis over the number of frames, of which a single frame that stands out makes 1, and two make 1/2.
_MAX_LONELY = 0.6

# Fewest frames that show two levels, and most simulated values of normal noise.
_MIN_FRAMES, _SIMULATED = 8, 4_000_000


def telegraph_pixels(darks: Sequence[Series], read: PixelReadNoise, noise_dn2: Sequence[float]) -> Mask:
    """Return the telegraph pixels (row, column).

    Parameters
    ----------
    darks, noise_dn2 : sequence (series,)
        Dark series, and the pixel noise v_j of each by the fit.
    read : PixelReadNoise
        Read noise of their pixels.
    """
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
    """Return the quotient that normal noise, rounded to whole DN, exceeds with probability `_CHANCE`."""
    rng = np.random.default_rng(1288)
    pixels = int(np.clip(_SIMULATED // frames.sum(), 2000, 20_000))
    moments = np.zeros((3, pixels))
    for count, sigma in zip(frames, sigma_dn, strict=True):
        values = np.rint(rng.random(pixels) + sigma * rng.standard_normal((count, pixels)))
        values -= values.mean(axis=0)
        moments += [np.sum(values**power, axis=0) for power in (2, 3, 4)]
    skew2, kurtosis = _shape(*(moments / frames.sum()))
    return float(np.quantile((skew2 + 1) / kurtosis, 1 - _CHANCE))
