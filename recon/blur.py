"""Blur of pictures by means of three samples, compiled.

scipy.ndimage has blurs, but would add 20 MB to the memory of every reconstruction; numpy takes four times as long.
"""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.numba_tools import compiled
from faintfield.recon.threads import run_in_threads, strips


def blurred(image: NDArray[np.floating], spacings: Sequence[int]) -> NDArray[np.floating]:
    """Return an image (row, column) averaged with its neighbours; edges are repeated.

    For each spacing d in turn, every sample becomes the mean of the samples d before it, itself and d after it, with
    weights ¼, ½ and ¼, along rows and columns. The result is nearly that of a Gaussian of variance `Σ d²/2`.
    """
    image = np.ascontiguousarray(image)
    for spacing in spacings:
        image = _averaged(image, spacing)
    return image


def _averaged(image: NDArray[np.floating], spacing: int) -> NDArray[np.floating]:
    mean = np.empty_like(image)
    run_in_threads(lambda strip: _average(*strip, image, spacing, mean), strips(image))
    return mean


@compiled
def _average(first: int, stop: int, image: NDArray[np.floating], spacing: int, mean: NDArray[np.floating]) -> None:
    """Set rows to the means of three rows, then of three columns, a spacing apart."""
    rows, columns = image.shape
    half, quarter = image.dtype.type(0.5), image.dtype.type(0.25)
    padded = np.empty(columns + 2 * spacing, image.dtype)
    middle, after = padded[spacing:], padded[2 * spacing :]
    for row in range(first, stop):
        above, here, below = image[max(row - spacing, 0)], image[row], image[min(row + spacing, rows - 1)]
        for j in range(columns):
            middle[j] = half * here[j] + quarter * (above[j] + below[j])
        for j in range(spacing):
            padded[j], after[columns - spacing + j] = middle[0], middle[columns - 1]
        out = mean[row]
        for j in range(columns):
            out[j] = half * middle[j] + quarter * (padded[j] + after[j])
