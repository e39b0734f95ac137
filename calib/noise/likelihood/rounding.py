"""Rounding to whole DN: what it adds to the noise of a series, and how far that is known.

A value of mean c and normal noise σ, rounded to whole DN, has the variance (Widrow, Kollár and Liu, IEEE Trans.
Instrum. Meas. 45, 353, 1996)

    σ² + 1/12 − a(σ) cos(2πc),    a(σ) = (4σ² + 1/π²) exp(−2π²σ²)

to the first harmonic. The cosine averages out over pixels whose means differ by a DN or more. Where they do not, as in
the darks of an 8-bit camera, its mean is taken from the pixels' own means, with the offsets of all darks together.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array, Mask, total_of

# Variance in DN² that rounding to whole DN adds on average over the phases.
ROUNDING_DN2 = 1 / 12

# Relative error of a noise that makes no difference.
_NEGLIGIBLE = 1e-6

# Logarithm of the largest factor by which the noise of the pixels' means may blur the mean cosine.
_MAX_BLUR = 0.7


@dataclass(frozen=True)
class Rounding:
    """Effect of rounding on the variance of a series' values beyond 1/12 DN².

    Attributes
    ----------
    excess_dn2 : float
        Mean excess over the pixels in use; zero if it is not known.
    error : float
        Error of the noise of the series that remains, relative to its variance.
    """

    excess_dn2: float
    error: float


def flat_rounding(series: Series, used: Mask) -> Rounding:
    """Return the rounding of a series whose pixels `used`, (row, column), have means of any phase."""
    if series.frames < 2:
        return Rounding(0.0, 0.0)
    total = _variance_dn2(series, used)
    pattern = max(_pattern_dn2(series, used) - total / series.frames, 0.0)
    return Rounding(0.0, float(_amplitude(max(total - ROUNDING_DN2, 0.0)) * np.exp(-2 * np.pi**2 * pattern) / total))


def dark_roundings(darks: Sequence[Series], used: Mask) -> list[Rounding]:
    """Return the rounding of every dark series; the arguments are as for `flat_rounding`."""
    roundings = [flat_rounding(dark, used) for dark in darks]
    if max(rounding.error for rounding in roundings) < _NEGLIGIBLE:
        return roundings
    weight = np.array([dark.frames for dark in darks], np.float64)
    phase = np.zeros(int(used.sum()))
    for dark, share in zip(darks, weight / weight.sum(), strict=True):
        mean = dark.mean_dn[used]
        phase += share * (mean - mean.mean())
    measured = [_dark_rounding(dark, phase, float(weight.sum()), used) for dark in darks]
    return [min(both, key=lambda rounding: rounding.error) for both in zip(roundings, measured, strict=True)]


def _dark_rounding(series: Series, phase_dn: Array, frames: float, used: Mask) -> Rounding:
    """Return the rounding by the offsets `phase_dn` (pixel,) about their mean, each determined by so many frames."""
    if series.frames < 2:
        return Rounding(0.0, np.inf)
    total = _variance_dn2(series, used)
    blur = 2 * np.pi**2 * total / frames
    if blur > _MAX_BLUR:
        return Rounding(0.0, np.inf)
    sharpening = float(np.exp(blur))
    level = float(series.mean_dn.mean(where=used)) + series.levels_dn - series.levels_dn.mean()
    variance, excess = total, 0.0
    for _ in range(3):  # the amplitude depends on the noise before rounding
        noise = max(variance - ROUNDING_DN2, 0.0)
        # Rounding also draws means towards whole numbers
        shift = np.exp(-2 * np.pi**2 * noise) / np.pi * np.sin(2 * np.pi * (phase_dn + level.mean()))
        wave = np.exp(2j * np.pi * (phase_dn + shift)).mean() * np.exp(2j * np.pi * level).mean()
        excess = -_amplitude(noise) * float(np.clip(wave.real * sharpening, -1.0, 1.0))
        variance = max(total - excess, ROUNDING_DN2)
    # What the pixels' means leave open: their noise, their number and the second harmonic
    left = sharpening - 1 + np.sqrt(0.5 / phase_dn.size) + np.exp(-2 * np.pi**2 * noise)
    return Rounding(excess, float(_amplitude(noise) * left / total))


def _variance_dn2(series: Series, used: Mask) -> float:
    """Return the mean variance of the pixels over the frames; their levels, rows and columns took a share of it."""
    pixels = used.sum()
    total = total_of(lambda rows: series.within_dn2[rows].sum(where=used[rows], dtype=np.float64), used.shape)
    return max(float(total) / pixels / (series.frames - 1) / max(1 - sum(used.shape) / pixels, 0.1), 1e-6)


def _pattern_dn2(series: Series, used: Mask) -> float:
    def work(rows: slice) -> Array:
        pattern = series.pattern_dn[rows][used[rows]].astype(np.float64)
        return np.array([pattern.sum(), pattern @ pattern])

    mean, square = total_of(work, used.shape) / used.sum()
    return float(square - mean**2)


def _amplitude(noise_dn2: float) -> float:
    return float((4 * noise_dn2 + 1 / np.pi**2) * np.exp(-2 * np.pi**2 * noise_dn2))
