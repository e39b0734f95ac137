# mypy: disable-error-code="no-untyped-def"
"""The memory of one worker: where the numbers of a block of pixels stand in its scratch array."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.elementary import inlined
from faintfield.recon.likelihood.pixel_models import WORK_ROWS
from faintfield.recon.pointers import index

# Pixels of a block.
BLOCK_PX = 64

# Largest numbers of taps of a block that is in step with a plane.
COLUMN_TAPS, ROW_TAPS = 4, 3

# Vectors are fastest where they do not straddle the processor's cache lines.
_LINE_BYTES = 64

# First the light that is expected of each pixel, then the largest weight that a pixel has on any plane.
EXPECTED, COUNTED = 0, BLOCK_PX

# Then the products of each tap. Each row of products has a margin on either side that stays zero.
MARGIN = 16
PRODUCT_PX = BLOCK_PX + 2 * MARGIN
PRODUCTS = 2 * BLOCK_PX + MARGIN

# Then three rows for each plane: column (less the pixel's number), row, and weight of each pixel.
_PLACES = 2 * BLOCK_PX + ROW_TAPS * COLUMN_TAPS * PRODUCT_PX
COLUMN, ROW, WEIGHT = (row * BLOCK_PX for row in range(3))
_PLACE_SIZE = 3 * BLOCK_PX


class BlockWorkspace(NamedTuple):
    """The arrays that a worker needs to itself.

    Attributes
    ----------
    scratch : array (number,)
        The rows above.
    models : array (WORK_ROWS, BLOCK_PX)
        Scratch of the pixel models.
    blocks : int array (plane × 4,)
        How the block lies on each plane, the first sample of its taps, and that sample's row and column.
    """

    scratch: NDArray[Any]
    models: NDArray[Any]
    blocks: NDArray[np.intp]


def make_workspace(planes: int, dtype: np.dtype[Any]) -> BlockWorkspace:
    """Return a workspace whose rows begin at a cache line: a vector that straddles two lines costs twice."""
    size = _PLACES + planes * _PLACE_SIZE
    raw = np.zeros(size + _LINE_BYTES // dtype.itemsize, dtype)
    skipped = -raw.ctypes.data % _LINE_BYTES // dtype.itemsize
    models = np.zeros((WORK_ROWS, BLOCK_PX), dtype)
    return BlockWorkspace(raw[skipped : skipped + size], models, np.zeros(4 * planes, np.intp))


@inlined
def place_of(plane):
    """Return where the three rows of a plane begin in the scratch."""
    return index(_PLACES) + plane * index(_PLACE_SIZE)


@inlined
def weights_of(plane):
    """Return where the weights of a block's pixels on a plane begin in the scratch."""
    return place_of(plane) + index(WEIGHT)
