"""The sufficient statistics of a series: all frames of one kind, exposure and light level, which differ only by noise.

They are the mean and the sum of squared deviations of every pixel over the frames; `sums` makes them.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.errors import BadFrame, LightLeak
from faintfield.calib.noise.strips import Array, Mask

# A dark has seen light if brighter than its series by the first multiple of the noise, or by the second beyond chance.
_CERTAIN_LEAK, _MIN_LEAK = 5.0, 0.25

# A dark has another pattern if its variance exceeds that of its series by these fractions, likewise.
_CERTAIN_EXCESS, _MIN_EXCESS = 1.0, 0.2

# Probability below which a value is no chance.
MAX_CHANCE = 1e-7

# Pixels whose values are kept for histograms and for the likelihood of single values.
SAMPLE_PX = 65_536


@dataclass(frozen=True)
class Conditions:
    """Conditions that the frames of one series share.

    Parameters
    ----------
    kind : {"dark", "flat"}
        A dark has the lens covered, a flat is evenly lit.
    exposure_s : float
        Exposure time.
    level : int
        Index of the light level of a flat; 0 for darks.
    photons : float, optional
        Mean photons per pixel and exposure, if measured by a radiometer.
    dark_factor : float
        Dark current at the temperature of the frames over that at the temperature of reference.
    temperature_c : float, optional
        Mean temperature of the frames, stated where the temperatures of a set differ.

    Examples
    --------
    >>> from faintfield import Conditions
    >>> print(Conditions("flat", exposure_s=0.1, level=2))
    flats of 0.1 s at level 2
    >>> warm = Conditions("dark", exposure_s=10.0, dark_factor=1.5)  # 1.5 times the dark current
    >>> warm.dark_time_s
    15.0
    """

    kind: Literal["dark", "flat"]
    exposure_s: float
    level: int = 0
    photons: float | None = None
    dark_factor: float = 1.0
    temperature_c: float | None = None

    @property
    def dark_time_s(self) -> float:
        """Exposure in which the sensor would collect the same dark charge at the temperature of reference."""
        return self.exposure_s * self.dark_factor

    def __str__(self) -> str:
        light = f" at level {self.level}" if self.kind == "flat" else ""
        warmth = f" at {self.temperature_c:.1f} °C" if self.kind == "dark" and self.temperature_c is not None else ""
        return f"{self.kind}s of {self.exposure_s:g} s{light}{warmth}"


@dataclass(frozen=True)
class Series:
    """Sufficient statistics of one series; maps are arrays (row, column).

    Attributes
    ----------
    conditions : Conditions
        Kind, exposure and light level.
    names, digests : tuple of str, tuple of bytes
        Names of the frames for messages, and the hash of their pixels, which reveals copies.
    levels_dn, spreads_dn2 : array (frame,)
        Mean of each frame, and variance over its pixels, level and profiles subtracted.
    row_dn, column_dn : array (row,), array (column,)
        Mean profile over the frames, minus the mean level.
    row_noise_dn2, column_noise_dn2 : float
        Variance over the frames of a row's and a column's mean, which includes pixel noise.
    pattern_dn : float32 map
        Mean over the frames of each pixel minus level and profiles.
    within_dn2, cubes_dn3, fourths_dn4 : float32 map
        Sum over the frames of the second, third and fourth powers of deviations from `pattern_dn`; the latter two of
        darks only.
    suspect : bool map
        Pixels left out of levels and profiles.
    sample_dn : array (frame, pixel), int32
        Values of the pixels `sample_index(shape)`.
    floor_dn, top_dn : int, float
        Lowest and highest value of all frames; the stated end of the range if it was reached.
    at_top, below_top, counted : int
        Number of values of regular pixels at `top_dn` or above, one below it, and of all; flats only.
    """

    conditions: Conditions
    names: tuple[str, ...]
    digests: tuple[bytes, ...]
    levels_dn: Array
    row_dn: Array
    column_dn: Array
    row_noise_dn2: float
    column_noise_dn2: float
    pattern_dn: NDArray[np.float32]
    within_dn2: NDArray[np.float32]
    cubes_dn3: NDArray[np.float32]
    fourths_dn4: NDArray[np.float32]
    suspect: Mask
    sample_dn: NDArray[np.int32]
    floor_dn: int
    spreads_dn2: Array
    top_dn: float
    at_top: int
    below_top: int
    counted: int

    @property
    def frames(self) -> int:
        """Number of frames."""
        return len(self.names)

    @property
    def mean_dn(self) -> Array:
        """Mean over the frames (row, column), with level and profiles."""
        return self.mean_of(slice(None))

    def mean_of(self, rows: slice) -> Array:
        """Return some rows of `mean_dn`."""
        mean = self.pattern_dn[rows] + (self.row_dn[rows] + self.levels_dn.mean())[:, None]
        mean += self.column_dn
        return mean

    def clipped_share(self, ceiling_dn: float) -> float:
        """Return the share of the regular pixels' values at the end of the range."""
        if self.top_dn < ceiling_dn:
            return 0.0
        return (self.at_top + (self.below_top if self.top_dn - 1 >= ceiling_dn else 0)) / max(self.counted, 1)


def any_suspect(series: Sequence[Series]) -> Mask:
    """Return the pixels (row, column) that are suspect in any series."""
    return np.asarray(np.logical_or.reduce([item.suspect for item in series]))


def sample_index(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the flat indices of the pixels whose values are kept: all, or `SAMPLE_PX` at random places."""
    pixels = int(np.prod(shape))
    if pixels <= SAMPLE_PX:
        return np.arange(pixels)
    return np.sort(np.random.default_rng(1288).choice(pixels, SAMPLE_PX, replace=False))


def robust_sigma(values: NDArray[Any]) -> float:
    """Return the standard deviation of a normal distribution with the same median absolute deviation."""
    deviations = values - np.median(values)
    return float(1.4826 * np.median(np.abs(deviations, out=deviations), overwrite_input=True))


def check_darks_alike(series: Series) -> None:
    """Refuse a series of darks of which one has seen light or has another pattern."""
    if series.conditions.kind != "dark" or series.frames < 2:
        return
    noise_dn = float(np.sqrt(np.median(series.within_dn2) / (series.frames - 1)))
    worst, excess_dn = outlier(series.levels_dn, _MIN_LEAK * noise_dn, _CERTAIN_LEAK * noise_dn)
    if excess_dn > 0:
        raise LightLeak(
            f"{series.names[worst]}: mean {series.levels_dn[worst]:.1f} DN, {excess_dn:.1f} DN above the other "
            f"{series.conditions} (their pixels are {noise_dn:.1f} DN rms noisy): light leaked in; cover the lens and "
            "record it again, or leave it out"
        )
    odd, excess = outlier(series.spreads_dn2 / np.median(series.spreads_dn2), _MIN_EXCESS, _CERTAIN_EXCESS)
    if excess > 0:
        raise BadFrame(
            f"{series.names[odd]}: its pixels spread {np.sqrt(1 + excess):.2f} times as far as in the other "
            f"{series.conditions}: light leaked in or the readout failed; record it again, or leave it out"
        )


def outlier(values: Array, min_excess: float, certain_excess: float) -> tuple[int, float]:
    """Return the index of the largest value, and its excess over the mean of the others; 0 if it can be chance.

    An excess above `certain_excess` always counts. One above `min_excess` counts if its probability, by Student's t
    from the scatter of the others, is below `MAX_CHANCE`.
    """
    largest = int(values.argmax())
    rest = np.delete(values, largest)
    excess = float(values[largest] - rest.mean())
    if excess > certain_excess:
        return largest, excess
    if excess < min_excess or rest.size < 2:
        return largest, 0.0
    t = excess / max(float(rest.std(ddof=1)) * np.sqrt(1 + 1 / rest.size), 1e-12)
    return largest, excess if stats.t.sf(t, rest.size - 1) < MAX_CHANCE else 0.0
