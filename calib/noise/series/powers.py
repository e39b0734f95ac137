"""Sums of powers of the frames of a series, which tell the mean and the central moments of every pixel in one pass."""

import numpy as np
from numpy.typing import NDArray

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

    def add(self, frame: Array) -> None:
        """Add a frame (row, column)."""
        power = frame.copy()
        for index, total in enumerate(self._sums):
            if index:
                power *= frame
            total += power

    def central(self, frames: int) -> tuple[Array, Array, Array, Array]:
        """Return the mean over the frames and the sums of the second, third and fourth powers of deviations from it.

        The last two are one zero unless higher powers were summed.
        """
        mean, squares = self._sums[0] / frames, self._sums[1]
        within = np.maximum(squares - frames * mean**2, 0.0)
        if len(self._sums) == 2:
            return mean, within, np.zeros((1, 1)), np.zeros((1, 1))
        cubes, fourths = self._sums[2:]
        third = cubes - 3 * mean * squares + 2 * frames * mean**3
        return mean, within, third, fourths - 4 * mean * cubes + 6 * mean**2 * squares - 3 * frames * mean**4
