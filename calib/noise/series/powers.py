# mypy: disable-error-code="no-untyped-def, no-untyped-call, assignment"
"""Moments of every pixel over the frames of a series: two passes over each frame, for its means and for the rest.

The moments follow from those without the last frame (Welford, Technometrics 4, 419, 1962; for the higher ones Pébay,
Sandia report SAND2008-6212). No sum of powers has to be known to more digits than its result, so that single precision
holds them.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.strips import Mask, compiled, map_of

_NONE = np.iinfo(np.int64).min


class Moments:
    """Mean of the frames so far and sums of the powers of deviations from it, arrays (row, column).

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of a frame.
    higher : bool
        Sum third and fourth powers, too.
    """

    def __init__(self, shape: tuple[int, ...], *, higher: bool) -> None:
        self.mean = np.zeros(shape)
        self.sums = [np.zeros(shape, np.float32) for _ in range(3 if higher else 1)]

    def add(self, frames: int, rows: slice, frame, regular: Mask, of_rows, of_columns, top: float):
        """Add some rows of the `frames`-th frame (row, column), less the sum of `of_rows` and `of_columns`.

        Returns
        -------
        tuple of (float, int, int)
            Squares of the rest, and numbers of values at `top` or above and one below it; all of regular pixels.
        """
        mean, sums = self.mean[rows], [power_sum[rows] for power_sum in self.sums]
        if len(sums) == 1:
            return _add_two(frame, regular, of_rows, of_columns, float(frames), mean, sums[0], top)
        return _add_four(frame, regular, of_rows, of_columns, float(frames), mean, *sums), 0, 0

    def maps(self) -> list[NDArray[np.float32]]:
        """Return the mean and the sums of second, third and fourth powers; the last two are one zero if not summed."""
        moments: list[NDArray[Any]] = [self.mean, *self.sums]
        maps = [map_of(moment.__getitem__, moment.shape) for moment in moments]
        return maps + [np.zeros((1, 1), np.float32) for _ in range(4 - len(maps))]


@compiled
def sum_lines(frame, regular, row_sums):
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
