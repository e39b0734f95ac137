# mypy: disable-error-code="no-untyped-def, no-untyped-call, assignment"
"""Reduce a series of frames to sufficient statistics, with one frame in memory at a time: two passes over each frame.

The level of each frame, and the means of its rows and columns, are subtracted first and kept apart; otherwise a
jittering black level and banding would count as pixel noise. The moments of every pixel follow from those without the
last frame (Welford, Technometrics 4, 419, 1962; for the higher ones Pébay, Sandia report SAND2008-6212). No sum of
powers has to be known to more digits than its result, so that single precision holds them.
"""

import hashlib
from collections.abc import Iterable
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.series import Conditions, Series, check_darks_alike, robust_sigma, sample_index
from faintfield.calib.noise.strips import Array, Mask, compiled, map_of, over_strips, thinned, total_of

# Robust standard deviations in the first frame of a series beyond which pixels are left out of row and column means:
# the shot noise of a hot pixel would otherwise spread along its row.
_SUSPECT_SIGMA = 8.0

# Noise in DN below which most whole numbers are the median, and their median absolute deviation is zero.
_COARSE_DN = 0.75

_NONE = np.iinfo(np.int64).min


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
        self._conditions, self._saturation_dn = conditions, saturation_dn
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
            # Mean of the frames so far, and sums of the second (of darks up to fourth) powers of deviations from it
            self._mean = np.zeros(frame_dn.shape)
            powers = 3 if self._conditions.kind == "dark" else 1
            self._powers = [np.zeros(frame_dn.shape, np.float32) for _ in range(powers)]
        if frame_dn.shape != self._suspect.shape:
            raise ValueError(f"{name}: {frame_dn.shape} pixels, where the series began with {self._suspect.shape}")
        digest = hashlib.sha256(np.ascontiguousarray(frame_dn)).digest()  # which processors have instructions for
        sample = frame_dn.ravel()[self._sampled].astype(np.int32)
        self._frames.append((name, digest, sample, *self._add_residual(frame_dn)))

    def _add_residual(self, frame_dn: NDArray[Any]) -> tuple[Any, ...]:
        """Add a frame without its level, row and column means to the sums; return them and the spread of the rest."""
        level, rows, columns, highest = self._means(frame_dn)
        top, frames = max(self._top_dn, min(highest, self._saturation_dn)), float(len(self._frames) + 1)

        def work(strip: slice) -> Array:
            regular, of_rows, sums = self._regular[strip], level + rows[strip], [part[strip] for part in self._powers]
            if len(sums) == 1:
                found = _add_two(frame_dn[strip], regular, of_rows, columns, frames, self._mean[strip], sums[0], top)
            else:
                found = _add_four(frame_dn[strip], regular, of_rows, columns, frames, self._mean[strip], *sums), 0, 0
            return np.array(found, float)

        squares, at, below = total_of(work, frame_dn.shape).tolist()
        if self._conditions.kind == "flat":
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
            return _sum_lines(frame_dn[strip], self._regular[strip], rows[strip])

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
        moments: list[NDArray[Any]] = [self._mean, *self._powers]
        maps = [map_of(moment.__getitem__, moment.shape) for moment in moments]
        mean, within, cubes, fourths = maps + [np.zeros((1, 1), np.float32) for _ in range(4 - len(maps))]
        names, digests, samples, *per_frame = zip(*self._frames, strict=True)
        levels, rows, columns, spreads_dn2 = map(np.array, per_frame)
        series = Series(
            conditions=self._conditions,
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
            counted=frames * int(self._regular.sum()) if self._conditions.kind == "flat" else 0,
        )
        check_darks_alike(series)
        return series


def measure_series(
    frames: Iterable[tuple[str, NDArray[Any]]], conditions: Conditions, saturation_dn: float = np.inf
) -> Series:
    """Return the sufficient statistics of one series of frames, which are read once.

    Parameters
    ----------
    frames : iterable of (str, array (row, column))
        Name, for messages, and pixels in DN of each frame.
    conditions : Conditions
        Kind, exposure time and light of all frames.
    saturation_dn : float
        Value in DN from which a pixel is saturated.

    Returns
    -------
    Series
        Mean and sum of squared deviations of every pixel, levels of the frames, and a sample of the values.

    Raises
    ------
    LightLeak, BadFrame
        The mean or the spread of one dark differs from the others'.
    ValueError
        There is no frame, or frames differ in size.

    Examples
    --------
    Eight dark frames with an offset of 100 DN and noise of 7 DN:

    >>> import numpy as np
    >>> from faintfield import Conditions, measure_series
    >>> pixels_dn = np.random.default_rng(1).normal(100.0, 7.0, (8, 96, 96)).round().astype(np.uint16)
    >>> frames = ((f"dark {number}", frame) for number, frame in enumerate(pixels_dn))
    >>> series = measure_series(frames, Conditions("dark", exposure_s=0.1))
    >>> series.frames, round(float(series.mean_dn.mean()))
    (8, 100)
    >>> variance_dn2 = series.within_dn2.mean() / (series.frames - 1)
    >>> round(float(variance_dn2**0.5))
    7
    """
    sums = SeriesSums(conditions, saturation_dn)
    for name, frame_dn in frames:
        sums.add(name, frame_dn)
    return sums.series()


def _suspects(frame_dn: NDArray[Any]) -> Mask:
    # Medians of whole numbers, and of what is left, are multiples of a quarter, which single precision holds
    residual = frame_dn.astype(np.result_type(frame_dn, np.float32))
    _subtract_medians(residual)
    residual = np.ascontiguousarray(residual.T)
    _subtract_medians(residual)
    some = thinned(residual, np.broadcast_to(True, residual.shape))
    limit = _SUSPECT_SIGMA * max(robust_sigma(some), _COARSE_DN)
    return np.ascontiguousarray((np.abs(residual) > limit).T)


def _subtract_medians(values: NDArray[Any]) -> None:
    def work(rows: slice) -> None:
        values[rows] -= np.median(values[rows], axis=1, keepdims=True)

    over_strips(work, values.shape)


@compiled
def _sum_lines(frame, regular, row_sums):
    """Write the sums of the regular values of each row; return those of each column, the least and the highest value.

    The highest is that of the regular pixels, very low if there are none.
    """
    column_sums = np.zeros(frame.shape[1], np.int64)
    low = np.int64(frame[0, 0])
    for row in range(frame.shape[0]):
        total = np.int64(0)
        for column in range(frame.shape[1]):
            value = np.int64(frame[row, column])
            low = min(low, value)
            counted = value if regular[row, column] else np.int64(0)
            total += counted
            column_sums[column] += counted
        row_sums[row] = total
    high = _NONE
    for row in range(frame.shape[0]):
        for column in range(frame.shape[1]):
            high = max(high, np.int64(frame[row, column]) if regular[row, column] else _NONE)
    return column_sums, low, high


@compiled
def _add_two(frame, regular, of_rows, of_columns, frames, mean, squares, top):
    """Return the squares of the rest, and numbers of values at `top` or above and one below; all of regular pixels."""
    total, at, below = 0.0, 0, 0
    for row in range(frame.shape[0]):
        for column in range(frame.shape[1]):
            value = float(frame[row, column])
            rest = value - of_rows[row] - of_columns[column]
            counts = regular[row, column]
            total += rest * rest if counts else 0.0
            at += 1 if counts and value >= top else 0
            below += 1 if counts and value == top - 1 else 0
            delta = rest - mean[row, column]
            step = delta / frames
            mean[row, column] += step
            squares[row, column] += delta * step * (frames - 1)
    return total, at, below


@compiled
def _add_four(frame, regular, of_rows, of_columns, frames, mean, squares, cubes, fourths):
    total = 0.0
    for row in range(frame.shape[0]):
        for column in range(frame.shape[1]):
            rest = float(frame[row, column]) - of_rows[row] - of_columns[column]
            total += rest * rest if regular[row, column] else 0.0
            delta = rest - mean[row, column]
            step = delta / frames
            term = delta * step * (frames - 1)
            second, third = float(squares[row, column]), float(cubes[row, column])
            mean[row, column] += step
            squares[row, column] = second + term
            cubes[row, column] = third + step * (term * (frames - 2) - 3 * second)
            fourths[row, column] += step * (step * (term * (frames * frames - 3 * frames + 3) + 6 * second) - 4 * third)
    return total
