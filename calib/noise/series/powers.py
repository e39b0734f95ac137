"""Sums of powers of the frames of a series, which tell the mean and the central moments of every pixel in one pass."""

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.strips import over_strips

type Array = NDArray[np.float64]


class PowerSums:
    """Running sums of frames and their powers, arrays (row, column).

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of a frame.
    higher : bool
        Whether third and fourth powers are summed, too.
    """

    def __init__(self, shape: tuple[int, ...], *, higher: bool) -> None:
        self._sums = [np.zeros(shape) for _ in range(4 if higher else 2)]

    def add(self, rows: slice, values: Array) -> None:
        """Add some rows (row, column) of a frame."""
        power = values
        for index, total in enumerate(self._sums):
            power = power * values if index else values
            total[rows] += power

    def central(self, frames: int) -> list[NDArray[np.float32]]:
        """Return the mean over the frames and the sums of the second, third and fourth powers of deviations from it.

        The last two are one zero unless higher powers were summed.
        """
        shape = self._sums[0].shape
        found = [np.empty(shape, np.float32) for _ in self._sums]

        def work(rows: slice) -> None:
            mean, squares = self._sums[0][rows] / frames, self._sums[1][rows]
            found[0][rows] = mean
            found[1][rows] = np.maximum(squares - frames * mean**2, 0.0)
            if len(self._sums) > 2:
                cubes, fourths = (total[rows] for total in self._sums[2:])
                found[2][rows] = cubes - 3 * mean * squares + 2 * frames * mean**3
                found[3][rows] = fourths - 4 * mean * cubes + 6 * mean**2 * squares - 3 * frames * mean**4

        over_strips(work, shape)
        return found + [np.zeros((1, 1), np.float32) for _ in range(4 - len(found))]
