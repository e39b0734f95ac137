# mypy: disable-error-code="no-untyped-def"
"""A block of pixels that see planes, compiled: what nearer planes hide, and the precision of what pixels read.

What nearer planes leave of a plane's light is computed again for each block, from their opacities and with the weights
of H. Beside the images there is thus no array of their size.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.pixel_models import LEAST_SQUARES
from faintfield.recon.numba_tools import advanced, compiled, index
from faintfield.recon.operator.blocks import copy, gather_plane, scatter_plane
from faintfield.recon.operator.placement import (
    BLOCK_PX,
    COLUMN_TAPS,
    EXPECTED,
    HALF_PX,
    LAYOUT_SIZE,
    OUTSIDE,
    ROW_TAPS,
    SCATTERED,
    half_of,
    weights_of,
)

# Smallest weight that α is divided by.
_TINY = 1e-37


class Hiding(NamedTuple):
    """Occlusion by nearer planes, as the kernel reads it.

    Attributes
    ----------
    opacities : array (sample,)
        α of all planes; of size zero where nothing hides anything.
    opaque : int array (row × 2,)
        First and past-the-last column of each row, of all planes, that has some opacity.
    depths : array (plane,)
        Only planes that are farther are hidden.
    """

    opacities: NDArray[Any]
    opaque: NDArray[np.intp]
    depths: NDArray[np.float64]


@compiled
def hide(opacities, opaque, depths, layout, planes, scratch, blocks):
    """Multiply the weights of a block's pixels on every plane by `Π (1 − α)` over the nearer planes that they see.

    The weights of a plane are divided out of what they gather of its α. Where they are zero, so are those of all
    farther planes, or the pixel does not see the plane.
    """
    number = type(scratch[0])
    zero, one, tiny = number(0), number(1), number(_TINY)
    first_row = 0
    for near in range(index(planes)):
        on_plane = advanced(layout, index(LAYOUT_SIZE) * near)
        if _may_hide(opaque, first_row, on_plane, near, blocks):
            weight = weights_of(near)
            for k in range(index(BLOCK_PX)):
                scratch[index(EXPECTED) + k] = zero
            gather_plane(opacities, layout, near, scratch, blocks)
            for k in range(index(BLOCK_PX)):
                alpha = scratch[index(EXPECTED) + k] / max(scratch[weight + k], tiny)
                scratch[index(EXPECTED) + k] = max(one - alpha, zero)
            for far in range(index(planes)):
                if depths[far] > depths[near]:
                    weight = weights_of(far)
                    for k in range(index(BLOCK_PX)):
                        scratch[weight + k] *= scratch[index(EXPECTED) + k]
        first_row += on_plane[index(1)]


@compiled
def _may_hide(opaque, first_row, layout, near, blocks):
    """Return whether a block's pixels may see something opaque; of pixels in step, whether their taps reach it."""
    height, advance = layout[index(1)], layout[index(3)]
    for number in range(2):
        half = advanced(blocks, half_of(near, index(number)))
        if half[index(0)] == SCATTERED:
            return True
        if half[index(0)] == OUTSIDE:
            continue
        row, column = half[index(2)], half[index(3)] + number * HALF_PX * advance
        for tap in range(row, min(row + ROW_TAPS, height)):
            at = index(2 * (first_row + tap))
            if opaque[at] < column + half[index(4)] * advance + COLUMN_TAPS and column < opaque[at + index(1)]:
                return True
    return False


@compiled
def form_precision(model, count, known, response, level, scratch):
    """Set `EXPECTED`, the light of some pixels, to their inverse variance."""
    number = type(scratch[0])
    one, level = number(1), number(level)
    for k in range(count):
        at = index(EXPECTED) + k
        light = level * response[k] if model == LEAST_SQUARES else max(scratch[at], level)
        scratch[at] = one / (light + known[k])


@compiled
def multiply_by_row_sums(planes, scratch, sums):
    """Multiply `EXPECTED` by the sum of a pixel's weights on all planes, H 1; `sums` is scratch."""
    for k in range(index(BLOCK_PX)):
        sums[k] = type(scratch[0])(0)
    for plane in range(index(planes)):
        for k in range(index(BLOCK_PX)):
            sums[k] += scratch[weights_of(plane) + k]
    for k in range(index(BLOCK_PX)):
        scratch[index(EXPECTED) + k] *= sums[k]


@compiled
def scatter_each(samples, layout, planes, scratch, blocks, precision):
    """Add `EXPECTED` times a pixel's weight on a plane to that plane; `precision` is scratch."""
    copy(scratch, index(EXPECTED), precision, index(0), index(BLOCK_PX))
    for plane in range(index(planes)):
        for k in range(index(BLOCK_PX)):
            scratch[index(EXPECTED) + k] = scratch[weights_of(plane) + k] * precision[k]
        scatter_plane(samples, layout, plane, scratch, blocks)
