"""Reduce a series of frames to sufficient statistics in one pass, with one frame in memory at a time.

A *series* is all frames of one kind, exposure and light level. Its frames differ only by noise, so that the
sufficient statistics are the mean and the sum of squared deviations of every pixel over the frames. The level of each
frame, and the means of its rows and columns, are subtracted first and kept separately; otherwise a jittering black
level and banding would count as pixel noise.
"""

import hashlib
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.errors import BadFrame, LightLeak
from faintfield.calib.noise.series.powers import Moments, sum_lines
from faintfield.calib.noise.strips import Array, Mask, over_strips, total_of

# Robust standard deviations in the first frame of a series beyond which pixels are left out of row and column means:
# the shot noise of a hot pixel would otherwise spread along its row.
_SUSPECT_SIGMA = 8.0

# Noise in DN below which most whole numbers are the median, and their median absolute deviation is zero.
_COARSE_DN = 0.75

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

    Attributes
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
    """Sufficient statistics of one series.

    Attributes
    ----------
    conditions : Conditions
        Kind, exposure and light level.
    names : tuple of str
        Names of the frames for messages.
    digests : tuple of bytes
        Hash of each frame's pixels, which reveals copies.
    levels_dn : array (frame,)
        Mean of each frame.
    row_dn, column_dn : array (row,), array (column,)
        Mean profile over the frames, minus the mean level.
    row_noise_dn2, column_noise_dn2 : float
        Variance over the frames of a row's and a column's mean, which includes pixel noise.
    pattern_dn : array (row, column), float32
        Mean over the frames of each pixel minus level and profiles.
    within_dn2 : array (row, column), float32
        Sum over the frames of the squared deviations from `pattern_dn`.
    cubes_dn3, fourths_dn4 : array (row, column), float32
        Likewise of their third and fourth powers; of one zero for flats.
    suspect : array (row, column), bool
        Pixels left out of levels and profiles.
    sample_dn : array (frame, pixel), int32
        Values of the pixels `sample_index(shape)`.
    floor_dn : int
        Lowest value of all frames.
    spreads_dn2 : array (frame,)
        Variance over each frame's pixels, level and profiles subtracted.
    top_dn : float
        Highest value of all frames, or the stated end of the range if it was reached.
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


class SeriesSums:
    """Running sums of one series, to which frames (row, column) in DN are added one by one.

    Parameters
    ----------
    conditions : Conditions
        Conditions of all frames.
    saturation_dn : float
        Value from which a pixel is saturated.
    """

    def __init__(self, conditions: Conditions, saturation_dn: float = np.inf) -> None:
        self.conditions = conditions
        self.saturation_dn = saturation_dn
        # Of each frame: its name, hash and sample, the mean level, rows and columns, and the spread of the rest
        self._frames: list[tuple[Any, ...]] = []
        self._floor_dn = np.iinfo(np.int64).max
        self._top_dn, self._at_top, self._below_top = -np.inf, 0, 0

    def add(self, name: str, frame_dn: NDArray[Any]) -> None:
        """Add one frame.

        Raises
        ------
        ValueError
            The frame differs in size from earlier ones.
        """
        if not self._frames:
            self._suspect = _suspects(frame_dn)
            self._regular = ~self._suspect
            self._suspect_at = np.nonzero(self._suspect)
            self._row_count, self._column_count = self._regular.sum(1), self._regular.sum(0)
            self._sampled = sample_index(frame_dn.shape)
            self._moments = Moments(frame_dn.shape, higher=self.conditions.kind == "dark")
        if frame_dn.shape != self._suspect.shape:
            raise ValueError(f"{name}: {frame_dn.shape} pixels, where the series began with {self._suspect.shape}")
        digest = hashlib.blake2b(np.ascontiguousarray(frame_dn), digest_size=16).digest()
        sample = frame_dn.ravel()[self._sampled].astype(np.int32)
        self._frames.append((name, digest, sample, *self._add_residual(frame_dn)))

    def _add_residual(self, frame_dn: NDArray[Any]) -> tuple[Any, ...]:
        """Add a frame without its level, row and column means to the sums; return them and the spread of the rest."""
        level, rows, columns, highest = self._means(frame_dn)
        top, frames = max(self._top_dn, min(highest, self.saturation_dn)), len(self._frames) + 1

        def work(strip: slice) -> Array:
            regular, of_rows = self._regular[strip], level + rows[strip]
            return np.array(self._moments.add(frames, strip, frame_dn[strip], regular, of_rows, columns, top), float)

        squares, at, below = total_of(work, frame_dn.shape).tolist()
        if self.conditions.kind == "flat":
            if top == self._top_dn:
                at, below = at + self._at_top, below + self._below_top
            elif top == self._top_dn + 1:
                below += self._at_top
            self._top_dn, self._at_top, self._below_top = top, int(at), int(below)
        return level, rows, columns, squares / self._row_count.sum()

    def _means(self, frame_dn: NDArray[Any]) -> tuple[float, Array, Array, float]:
        """Return the level of the regular pixels, the means of rows and columns about it, and the highest value."""
        rows = np.zeros(len(frame_dn), np.int64)

        def work(strip: slice) -> Any:
            return sum_lines(frame_dn[strip], self._regular[strip], rows[strip])

        parts, lows, highs = zip(*over_strips(work, frame_dn.shape), strict=True)
        self._floor_dn = min(self._floor_dn, *lows)
        columns, total = np.sum(parts, axis=0), rows.sum()
        level = float(total / self._row_count.sum())
        means = (rows - level * self._row_count) / np.maximum(self._row_count, 1)
        row, column = self._suspect_at
        shared = (level + means).sum() - np.bincount(column, (level + means)[row], frame_dn.shape[1])
        return level, means, (columns - shared) / np.maximum(self._column_count, 1), float(max(*highs, min(lows)))

    def series(self) -> Series:
        """Return the statistics of the frames so far.

        Raises
        ------
        LightLeak, BadFrame
            The mean or the spread of one dark differs from the others'.
        ValueError
            No frame was given.
        """
        if not (frames := len(self._frames)):
            raise ValueError("a series needs at least one frame, got none")
        mean, within, cubes, fourths = self._moments.maps()
        names, digests, samples, *per_frame = zip(*self._frames, strict=True)
        levels, rows, columns, spreads_dn2 = map(np.array, per_frame)
        series = Series(
            conditions=self.conditions,
            names=names,
            digests=digests,
            levels_dn=levels,
            row_dn=rows.mean(0),
            column_dn=columns.mean(0),
            row_noise_dn2=float(rows.var(0, ddof=1).mean()) if frames > 1 else 0.0,
            column_noise_dn2=float(columns.var(0, ddof=1).mean()) if frames > 1 else 0.0,
            pattern_dn=mean,
            within_dn2=within,
            cubes_dn3=cubes,
            fourths_dn4=fourths,
            suspect=self._suspect,
            sample_dn=np.array(samples),
            floor_dn=self._floor_dn,
            spreads_dn2=spreads_dn2,
            top_dn=self._top_dn,
            at_top=self._at_top,
            below_top=self._below_top,
            counted=frames * int(self._regular.sum()) if self.conditions.kind == "flat" else 0,
        )
        _check_alike(series)
        return series


def measure_series(
    frames: Iterable[tuple[str, NDArray[Any]]], conditions: Conditions, saturation_dn: float = np.inf
) -> Series:
    """Return the sufficient statistics of one series, given as (name, frame) pairs; see `SeriesSums`."""
    sums = SeriesSums(conditions, saturation_dn)
    for name, frame_dn in frames:
        sums.add(name, frame_dn)
    return sums.series()


def any_suspect(series: Sequence[Series]) -> Mask:
    """Return the pixels (row, column) that are suspect in any series."""
    return np.asarray(np.logical_or.reduce([item.suspect for item in series]))


def sample_index(shape: tuple[int, ...]) -> NDArray[np.int64]:
    """Return the flat indices of the pixels whose values are kept: all, or `SAMPLE_PX` at random places."""
    pixels = int(np.prod(shape))
    if pixels <= SAMPLE_PX:
        return np.arange(pixels)
    return np.sort(np.random.default_rng(1288).choice(pixels, SAMPLE_PX, replace=False))


def _suspects(frame_dn: NDArray[Any]) -> Mask:
    """Return the pixels that differ much from their row and column."""
    # Medians of whole numbers, and of what is left, are multiples of a quarter, which single precision holds
    residual = frame_dn.astype(np.result_type(frame_dn, np.float32))
    _subtract_medians(residual)
    residual = np.ascontiguousarray(residual.T)
    _subtract_medians(residual)
    limit = _SUSPECT_SIGMA * max(robust_sigma(residual), _COARSE_DN)
    return np.ascontiguousarray((np.abs(residual) > limit).T)


def _subtract_medians(values: NDArray[Any]) -> None:

    def work(rows: slice) -> None:
        values[rows] -= np.median(values[rows], axis=1, keepdims=True)

    over_strips(work, values.shape)


def robust_sigma(values: NDArray[Any]) -> float:
    """Return the standard deviation of a normal distribution with the same median absolute deviation."""
    deviations = values - np.median(values)
    return float(1.4826 * np.median(np.abs(deviations, out=deviations), overwrite_input=True))


def _check_alike(series: Series) -> None:
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
