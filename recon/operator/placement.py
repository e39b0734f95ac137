# mypy: disable-error-code="no-untyped-def"
"""Placement of a block of pixels of one detector row on each plane, compiled, and the memory of one worker."""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.pixel_models import WORK_ROWS
from faintfield.recon.numba_tools import advanced, compiled, index, inlined

# Pixels of a block, and of the halves that a block is divided into where it is not in step with a plane.
BLOCK_PX, HALF_PX = 64, 32

# Largest numbers of taps of a block that is in step with a plane.
COLUMN_TAPS, ROW_TAPS = 4, 3

# Vectors are fastest where they do not straddle the processor's cache lines.
_LINE_BYTES = 64

# First the light that is expected of each pixel, then the largest weight that a pixel has on any plane.
EXPECTED, COUNTED = 0, BLOCK_PX

# Then the products of each tap. Each row of products has a margin on either side that stays zero.
MARGIN = 8
PRODUCT_PX = BLOCK_PX + 2 * MARGIN
PRODUCTS = 2 * BLOCK_PX + MARGIN

# Then three rows for each plane: column (less the pixel's number), row, and weight of each pixel.
_PLACES = 2 * BLOCK_PX + ROW_TAPS * COLUMN_TAPS * PRODUCT_PX
COLUMN, ROW, WEIGHT = (row * BLOCK_PX for row in range(3))
_PLACE_SIZE = 3 * BLOCK_PX

# Then, for a surface, how much nearer in 1/depth each pixel meets it than the depth of its homographies.
NEARER = _PLACES + _PLACE_SIZE

# A pixel this far outside the samples (in samples) still sees their edge: rounding must not decide whether the border
# of a plane that overlays a view pixel for pixel is seen. Float32 places a pixel of a large detector within 3e-4.
EDGE_TOLERANCE = 1e-3

# Code of a pixel that sees no part of a surface.
UNSEEN = -(2**15)

# Schemes by which a block visits a plane; the last four are in step with it, with so many rows and columns of taps.
OUTSIDE, SCATTERED, IN_STEP_2_2, IN_STEP_2_3, IN_STEP_3_3, IN_STEP_3_4 = 0, 1, 2, 3, 4, 5

# Columns of `layout`: a plane's first sample, rows, columns, and the samples that it advances by from pixel to pixel.
LAYOUT_SIZE = 4
LARGEST_ADVANCE = 2

# Numbers of each half in `blocks`: the scheme, the first sample of its taps, that sample's row and column, and its
# pixels. Where the block is in step as a whole, the first half stands for both.
_HALF_SIZE = 5


class BlockWorkspace(NamedTuple):
    """The arrays that a worker needs to itself: the rows above, scratch of the pixel models, and numbers of each half.

    They are (number,), (WORK_ROWS, BLOCK_PX) and (plane × half × 5,).
    """

    scratch: NDArray[Any]
    models: NDArray[Any]
    blocks: NDArray[np.intp]


def make_workspace(planes: int, dtype: np.dtype[Any]) -> BlockWorkspace:
    """Return a workspace whose rows begin at a cache line: a vector that straddles two lines costs twice."""
    size = _PLACES + planes * _PLACE_SIZE + BLOCK_PX
    raw = np.zeros(size + _LINE_BYTES // dtype.itemsize, dtype)
    skipped = -raw.ctypes.data % _LINE_BYTES // dtype.itemsize
    models = np.zeros((WORK_ROWS, BLOCK_PX), dtype)
    return BlockWorkspace(raw[skipped : skipped + size], models, np.zeros(2 * _HALF_SIZE * planes, np.intp))


@inlined
def place_of(plane):
    """Return the begin of the three rows of a plane in the scratch."""
    return index(_PLACES) + plane * index(_PLACE_SIZE)


@inlined
def weights_of(plane):
    """Return the begin of the weights of a block's pixels on a plane in the scratch."""
    return place_of(plane) + index(WEIGHT)


@inlined
def half_of(plane, half):
    """Return the begin of the numbers of half a block in `blocks`."""
    return index(_HALF_SIZE) * (index(2) * plane + half)


@compiled
def locate_on_all(homographies, matrix, views, layout, planes, samples, maps, layer, pixel, bent, scratch, blocks):
    """Find where a block of pixels lies on every plane; return whether it sees any.

    `blocks` (plane × half × 5,) receives the scheme of each half.
    """
    meets = False
    for plane in range(index(planes)):
        on_plane = advanced(layout, index(LAYOUT_SIZE) * plane)
        matrices = advanced(homographies, matrix + index(9) * plane * views)
        place, first_half, second_half = place_of(plane), half_of(plane, index(0)), half_of(plane, index(1))
        whole = _locate(matrices, index(9) * views, maps, layer, pixel, bent, on_plane, scratch, place)
        _arrange(whole, on_plane, samples, blocks, first_half, index(0), index(BLOCK_PX))
        blocks[second_half] = OUTSIDE
        meets |= blocks[first_half] != OUTSIDE
        if blocks[first_half] == SCATTERED:
            for half in range(2):
                first = index(half * HALF_PX)
                ranges = _ranges(scratch, place + first)
                _arrange(ranges, on_plane, samples, blocks, half_of(plane, index(half)), first, index(HALF_PX))
    return meets


@compiled
def _locate(homographies, to_slopes, maps, layer, pixel, bent, layout, scratch, place):
    """Find where the rays of a block meet a plane; return the ranges of rows, and of columns less the advance.

    Rows `COLUMN` (less the pixel's number times the advance), `ROW` and `WEIGHT` of `place` are written. The weight is
    the pixel's response, or zero where it does not see the plane: all four samples must exist, so that no edge of the
    plane dims the model, but points up to `EDGE_TOLERANCE` outside count as on the edge. If no pixel sees it, ranges
    are empty.
    """
    number = type(scratch[0])  # Python numbers would promote float32 to float64
    zero, one, margin = number(0), number(1), number(EDGE_TOLERANCE)
    last_row, last_column = number(layout[index(1)] - 1), number(layout[index(2)] - 1)
    advance = number(layout[index(3)])
    greatest, least = np.int32(2**30), np.int32(-(2**30))
    row_from, row_to, column_from, column_to = greatest, least, greatest, least
    # In local variables, or the compiler would load them again for every pixel, after each store to the scratch
    a, b, c = homographies[index(0)], homographies[index(1)], homographies[index(2)]
    d, e, f = homographies[index(3)], homographies[index(4)], homographies[index(5)]
    g, h, i = homographies[index(6)], homographies[index(7)], homographies[index(8)]
    p, q, r, s, t, u = zero, zero, zero, zero, zero, zero
    if len(bent) > 0:
        slopes = advanced(homographies, to_slopes)
        p, q, r = slopes[index(0)], slopes[index(1)], slopes[index(2)]
        s, t, u = slopes[index(3)], slopes[index(4)], slopes[index(5)]
    for k in range(index(BLOCK_PX)):
        at = pixel + k
        x, y, response = maps[at], maps[at + layer], maps[at + layer + layer]
        scale = g * x + h * y + i
        inverse = one / scale
        column, row = (a * x + b * y + c) * inverse, (d * x + e * y + f) * inverse
        if len(bent) > 0:
            nearer = scratch[index(NEARER) + k] * inverse
            column += (p * x + q * y + r) * nearer
            row += (s * x + t * y + u) * nearer
        # Comparisons with NaN are false: such a pixel is placed at zero, and does not see the plane
        within_column = column if column > zero else zero
        within_column = within_column if within_column < last_column else last_column
        within_row = row if row > zero else zero
        within_row = within_row if within_row < last_row else last_row
        # scale > 0 also means that the plane is in front of the camera
        sees = (scale > zero) & (abs(column - within_column) <= margin) & (abs(row - within_row) <= margin)
        beyond = within_column - number(np.int32(k)) * advance
        scratch[place + index(COLUMN) + k] = beyond
        scratch[place + index(ROW) + k] = within_row
        scratch[place + index(WEIGHT) + k] = response if sees else zero
        whole_column, whole_row = np.int32(np.floor(beyond)), np.int32(within_row)
        row_from, row_to = min(row_from, whole_row if sees else greatest), max(row_to, whole_row if sees else least)
        column_from = min(column_from, whole_column if sees else greatest)
        column_to = max(column_to, whole_column if sees else least)
    return row_from, row_to, column_from, column_to


@compiled
def _ranges(scratch, place):
    """Return the ranges of `_locate` for half a block that it has placed."""
    zero, greatest, least = type(scratch[0])(0), np.int32(2**30), np.int32(-(2**30))
    row_from, row_to, column_from, column_to = greatest, least, greatest, least
    for k in range(index(HALF_PX)):
        counts = scratch[place + index(WEIGHT) + k] != zero
        row = np.int32(scratch[place + index(ROW) + k])
        column = np.int32(np.floor(scratch[place + index(COLUMN) + k]))
        row_from, row_to = min(row_from, row if counts else greatest), max(row_to, row if counts else least)
        column_from = min(column_from, column if counts else greatest)
        column_to = max(column_to, column if counts else least)
    return row_from, row_to, column_from, column_to


@compiled
def unpack_relief(relief, at, count, step, scratch):
    """Set `NEARER` of a block's pixels from the codes of a relief; NaN, which sees nothing, where it is `UNSEEN`."""
    number = type(scratch[0])
    for k in range(index(BLOCK_PX)):
        scratch[index(NEARER) + k] = number(np.nan)
    for k in range(count):
        code = relief[at + k]
        scratch[index(NEARER) + k] = number(code) * step if code != UNSEEN else number(np.nan)


@inlined
def _arrange(ranges, layout, samples, blocks, half, first, pixels):
    """Set how some pixels of a block lie on a plane, given the ranges of their rows and columns.

    Taps of pixels that do not see the plane may lie outside it: their weights are zero, but the samples must exist.
    """
    row_from, row_to, column_from, column_to = ranges
    stride, advance = layout[index(2)], layout[index(3)]
    start = layout[index(0)] + row_from * stride + column_from + np.intp(first) * advance
    end = start + (ROW_TAPS - 1) * stride + np.intp(pixels + index(MARGIN)) * advance
    rows, columns = row_to - row_from + 2, column_to - column_from + 2
    scheme = IN_STEP_3_4
    if row_to < row_from:
        scheme = OUTSIDE
    elif rows > ROW_TAPS or columns > COLUMN_TAPS or start < 0 or end > samples:
        scheme = SCATTERED
    elif columns <= 3:
        if rows > 2:
            scheme = IN_STEP_3_3
        else:
            scheme = IN_STEP_2_3 if columns > 2 else IN_STEP_2_2
    blocks[half], blocks[half + index(1)] = scheme, start
    blocks[half + index(2)], blocks[half + index(3)] = row_from, column_from
    blocks[half + index(4)] = np.intp(pixels)
