# mypy: disable-error-code="no-untyped-def"
"""A block of pixels of one detector row, compiled: where it lies on each plane, what it sees there, what it gives back.

A plane whose pitch is about depth / f is met almost in step: pixel k of a block at column `c₀ + k + t[k]` and row
`r₀ + u[k]`, with t and u small. Where 0 ≤ t < `COLUMN_TAPS` − 1 and 0 ≤ u < `ROW_TAPS` − 1 all over a block, bilinear
interpolation is a sum over taps, each a tent's weight times *neighbouring* samples,

    (H f)[k] = Σᵢ Σⱼ tent(u[k] − i) tent(t[k] − j) f[r₀ + i, c₀ + j + k],    tent(x) = max(0, 1 − |x|),

in which all but four weights are zero. It reads more samples than it needs and is many times faster: no branch, no
index to look up, and vector loads, sums and stores in both directions. Blocks that are not in step go pixel by pixel.

All arrays are flat and are indexed with offsets: a slice made per block costs more than the block's arithmetic.
"""

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.elementary import compiled, inlined
from faintfield.recon.likelihood.pixel_models import WORK_ROWS
from faintfield.recon.pointers import advanced, index, wanted_soon

BLOCK_PX = 64
COLUMN_TAPS, ROW_TAPS = 4, 3

# A pixel this far outside the samples (in samples) still meets their edge: rounding must not decide whether the border
# of a plane that overlays a view pixel for pixel is seen. Float32 places a pixel of a large detector within 3e-4.
EDGE_TOLERANCE = 1e-3

# How a block lies on a plane; in step with it, by how many rows and columns of taps it needs.
_OUTSIDE, _SCATTERED, _IN_STEP_2_2, _IN_STEP_2_3, _IN_STEP_3_3, _IN_STEP_3_4 = 0, 1, 2, 3, 4, 5

# Vectors are fastest where they do not straddle the processor's cache lines.
_LINE_BYTES = 64
_LINE_PX = 16

# Where the rows of the scratch begin. Rows of shifted products have a margin on either side that stays zero.
EXPECTED, COUNTED = 0, BLOCK_PX
_MARGIN = 16
_PRODUCT_PX = BLOCK_PX + 2 * _MARGIN
_PRODUCTS = 2 * BLOCK_PX + _MARGIN
_PLACES = 2 * BLOCK_PX + ROW_TAPS * COLUMN_TAPS * _PRODUCT_PX
_COLUMN, _ROW, _WEIGHT = (row * BLOCK_PX for row in range(3))
_PLACE_SIZE = 3 * BLOCK_PX


@compiled
def _locate(homographies, matrix, maps, layer, pixel, height, width, scratch, place):
    """Find where a block's rays meet a plane; return the least and greatest of row and of column less pixel.

    Rows `_COLUMN` (less the pixel's number), `_ROW` and `_WEIGHT` of `place` are written. The weight is the pixel's
    response, zero where it does not see the plane: all four samples must exist, so that no plane edge dims the model,
    but `EDGE_TOLERANCE` outside them is on their edge. Without any such pixel the least exceeds the greatest.
    """
    number = type(scratch[0])  # plain numbers would promote float32 to float64
    zero, one, margin = number(0), number(1), number(EDGE_TOLERANCE)
    last_row, last_column = number(height - 1), number(width - 1)
    greatest, least = np.int32(2**30), np.int32(-(2**30))
    row_from, row_to, column_from, column_to = greatest, least, greatest, least
    # Held in registers: stores to the scratch would make the compiler load them again for every pixel
    a, b, c = homographies[matrix], homographies[matrix + index(1)], homographies[matrix + index(2)]
    d, e, f = homographies[matrix + index(3)], homographies[matrix + index(4)], homographies[matrix + index(5)]
    g, h, i = homographies[matrix + index(6)], homographies[matrix + index(7)], homographies[matrix + index(8)]
    for k in range(index(BLOCK_PX)):
        at = pixel + k
        x, y, response = maps[at], maps[at + layer], maps[at + layer + layer]
        scale = g * x + h * y + i
        inverse = one / scale
        column, row = (a * x + b * y + c) * inverse, (d * x + e * y + f) * inverse
        # Comparisons are so written that NaN becomes zero, and is not seen
        within_column = column if column > zero else zero
        within_column = within_column if within_column < last_column else last_column
        within_row = row if row > zero else zero
        within_row = within_row if within_row < last_row else last_row
        # scale > 0 also says that the plane is met in front of the camera
        sees = (scale > zero) & (abs(column - within_column) <= margin) & (abs(row - within_row) <= margin)
        advance = within_column - number(np.int32(k))
        scratch[place + index(_COLUMN) + k] = advance
        scratch[place + index(_ROW) + k] = within_row
        scratch[place + index(_WEIGHT) + k] = response if sees else zero
        whole_column, whole_row = np.int32(np.floor(advance)), np.int32(within_row)
        row_from, row_to = min(row_from, whole_row if sees else greatest), max(row_to, whole_row if sees else least)
        column_from = min(column_from, whole_column if sees else greatest)
        column_to = max(column_to, whole_column if sees else least)
    return row_from, row_to, column_from, column_to


@inlined
def _arrangement(row_from, row_to, column_from, column_to, start, stride, samples):
    """Return how a block lies on a plane.

    Around the pixels that see the plane, taps may lie beside it: they have no weight there, and need only exist.
    """
    if row_to < row_from:
        return _OUTSIDE
    rows, columns = row_to - row_from + 2, column_to - column_from + 2
    end = start + (ROW_TAPS - 1) * stride + BLOCK_PX + _MARGIN
    if rows > ROW_TAPS or columns > COLUMN_TAPS or start < 0 or end > samples:
        return _SCATTERED
    if columns > 3:
        return _IN_STEP_3_4
    if rows > 2:
        return _IN_STEP_3_3
    return _IN_STEP_2_3 if columns > 2 else _IN_STEP_2_2


@inlined
def _tent(distance):
    height = type(distance)(1) - abs(distance)
    return height if height > type(distance)(0) else type(distance)(0)


@inlined
def _row_weights(down, rows):
    """Return the tents of the rows; they sum to one."""
    number = type(down)
    zero, one = number(0), number(1)
    if rows == 2:
        return one - down, down, zero
    upper = one - down if down < one else zero
    lower = down - one if down > one else zero
    return upper, one - upper - lower, lower


@inlined
def _gather_taps(rows, columns, samples, stride, row_from, column_from, scratch, place):
    """Add to `EXPECTED` what the block's pixels see: the plane, interpolated bilinearly, times the weight."""
    number = type(scratch[0])
    row, column = number(row_from), number(column_from)
    across, down = advanced(scratch, place + index(_COLUMN)), advanced(scratch, place + index(_ROW))
    weights = advanced(scratch, place + index(_WEIGHT))
    for k in range(index(BLOCK_PX)):
        along = across[k] - column
        u0, u1, u2 = _row_weights(down[k] - row, rows)
        seen = u0 * _along_row(columns, along, samples, k)
        seen += u1 * _along_row(columns, along, samples, index(stride) + k)
        if rows > 2:
            seen += u2 * _along_row(columns, along, samples, index(2 * stride) + k)
        scratch[index(EXPECTED) + k] += weights[k] * seen


@inlined
def _along_row(columns, along, samples, at):
    """Return a row of the plane, interpolated."""
    number = type(along)
    if columns == 2:
        return samples[at] + along * (samples[at + index(1)] - samples[at])
    seen = _tent(along) * samples[at] + _tent(along - number(1)) * samples[at + index(1)]
    seen += _tent(along - number(2)) * samples[at + index(2)]
    if columns > 3:
        seen += _tent(along - number(3)) * samples[at + index(3)]
    return seen


@inlined
def _scatter_taps(rows, columns, samples, stride, row_from, column_from, scratch, place):
    """Add `EXPECTED` to the plane with the weights that `_gather_taps` reads it with.

    Products of all taps are formed first and then added, shifted, once per row of samples: stores that overlap loads
    soon after would make the processor wait. A pixel that does not count may hold anything, a NaN as well.
    """
    number = type(scratch[0])
    row, column, zero = number(row_from), number(column_from), number(0)
    across, down = advanced(scratch, place + index(_COLUMN)), advanced(scratch, place + index(_ROW))
    weights = advanced(scratch, place + index(_WEIGHT))
    size = index(_PRODUCT_PX)
    upper = advanced(scratch, index(_PRODUCTS))
    middle, lower = advanced(upper, index(columns) * size), advanced(upper, index(2 * columns) * size)
    for k in range(index(BLOCK_PX)):
        value = weights[k] * scratch[index(EXPECTED) + k] if weights[k] != zero else zero
        along = across[k] - column
        u0, u1, u2 = _row_weights(down[k] - row, rows)
        for tap in range(columns):
            share = value * _tent(along - number(tap))
            upper[index(tap) * size + k] = u0 * share
            middle[index(tap) * size + k] = u1 * share
            if rows > 2:
                lower[index(tap) * size + k] = u2 * share
    for r in range(rows):
        products, target = advanced(upper, index(r * columns) * size), advanced(samples, index(r * stride))
        for k in range(index(BLOCK_PX + _MARGIN)):
            added = products[k]
            for tap in range(1, columns):
                added += products[index(tap) * (size - index(1)) + k]
            target[k] += added


@compiled
def _gather_in_step(how, samples, start, stride, row_from, column_from, scratch, place):
    """Interpolate with as few taps as the block's lie allows; each number of taps is compiled by itself."""
    samples = advanced(samples, index(start))
    if how == _IN_STEP_2_2:
        _gather_taps(2, 2, samples, stride, row_from, column_from, scratch, place)
    elif how == _IN_STEP_2_3:
        _gather_taps(2, 3, samples, stride, row_from, column_from, scratch, place)
    elif how == _IN_STEP_3_3:
        _gather_taps(3, 3, samples, stride, row_from, column_from, scratch, place)
    else:
        _gather_taps(3, 4, samples, stride, row_from, column_from, scratch, place)


@compiled
def _scatter_in_step(how, samples, start, stride, row_from, column_from, scratch, place):
    """Scatter with the taps of `_gather_in_step`."""
    samples = advanced(samples, index(start))
    if how == _IN_STEP_2_2:
        _scatter_taps(2, 2, samples, stride, row_from, column_from, scratch, place)
    elif how == _IN_STEP_2_3:
        _scatter_taps(2, 3, samples, stride, row_from, column_from, scratch, place)
    elif how == _IN_STEP_3_3:
        _scatter_taps(3, 3, samples, stride, row_from, column_from, scratch, place)
    else:
        _scatter_taps(3, 4, samples, stride, row_from, column_from, scratch, place)


@inlined
def _corner(scratch, place, k, start, height, stride):
    """Return the upper left of the four samples around a pixel's point, and the fractions down and right of it."""
    number = type(scratch[0])
    column = scratch[place + index(_COLUMN) + k] + number(np.int32(k))
    row = scratch[place + index(_ROW) + k]
    left, upper = min(np.int32(column), np.int32(stride - 2)), min(np.int32(row), np.int32(height - 2))
    return index(start + np.intp(upper) * stride + np.intp(left)), row - number(upper), column - number(left)


@compiled
def _gather_scattered(samples, start, height, stride, scratch, place):
    """Do as `_gather_in_step` does, pixel by pixel."""
    zero, one, below = type(scratch[0])(0), index(1), index(stride)
    for k in range(index(BLOCK_PX)):
        weight = scratch[place + index(_WEIGHT) + k]
        if weight != zero:
            at, down, right = _corner(scratch, place, k, start, height, stride)
            upper, lower = samples[at], samples[at + below]
            upper += right * (samples[at + one] - upper)
            lower += right * (samples[at + below + one] - lower)
            scratch[index(EXPECTED) + k] += weight * (upper + down * (lower - upper))


@compiled
def _scatter_scattered(samples, start, height, stride, scratch, place):
    """Do as `_scatter_in_step` does, pixel by pixel."""
    zero, one, below = type(scratch[0])(0), index(1), index(stride)
    for k in range(index(BLOCK_PX)):
        weight = scratch[place + index(_WEIGHT) + k]
        if weight != zero:
            at, down, right = _corner(scratch, place, k, start, height, stride)
            value = weight * scratch[index(EXPECTED) + k]
            lower = value * down
            upper = value - lower
            samples[at] += upper - upper * right
            samples[at + one] += upper * right
            samples[at + below] += lower - lower * right
            samples[at + below + one] += lower * right


@compiled
def locate_on_all(homographies, matrix, views, layout, planes, samples, maps, layer, pixel, scratch, blocks):
    """Find where a block of pixels meets every plane; return whether it meets any.

    `blocks` (plane × 4,) receives how it lies there, the first sample of its taps, and that one's row and column.
    """
    meets = False
    for plane in range(index(planes)):
        start, height, width = (
            layout[index(3) * plane],
            layout[index(3) * plane + index(1)],
            layout[index(3) * plane + index(2)],
        )
        row_from, row_to, column_from, column_to = _locate(
            homographies, matrix + index(9) * plane * views, maps, layer, pixel, height, width, scratch, _place(plane)
        )
        start += row_from * width + column_from
        how = _arrangement(row_from, row_to, column_from, column_to, start, width, samples)
        block = index(4) * plane
        blocks[block], blocks[block + index(1)] = how, start
        blocks[block + index(2)], blocks[block + index(3)] = row_from, column_from
        meets |= how != _OUTSIDE
    return meets


@inlined
def _place(plane):
    return index(_PLACES) + plane * index(_PLACE_SIZE)


@inlined
def weights_of(plane):
    """Return where the weights of a block's pixels on a plane begin in the scratch."""
    return _place(plane) + index(_WEIGHT)


@compiled
def weigh(factors, pixel, to_next_plane, planes, count, scratch):
    """Multiply the weights of a block's pixels on every plane."""
    for plane in range(index(planes)):
        weight = weights_of(plane)
        for k in range(count):
            scratch[weight + k] *= type(scratch[0])(factors[pixel + k])
        pixel += to_next_plane


@inlined
def row_wanted_soon(numbers, at):
    """Ask for the numbers of a block in a later row: processors look ahead within one page of memory only."""
    for k in range(index(0), index(BLOCK_PX), index(_LINE_PX)):
        wanted_soon(numbers, index(at) + k)


@compiled
def gather(samples, layout, planes, scratch, blocks):
    """Set `EXPECTED` to what a block's pixels see of all planes, and `COUNTED` to their greatest weight.

    Of one plane alone, the weights themselves say which pixels count.
    """
    zero = type(scratch[0])(0)
    for k in range(index(BLOCK_PX)):
        scratch[index(EXPECTED) + k] = zero
    if planes > 1:
        for k in range(index(BLOCK_PX)):
            scratch[index(COUNTED) + k] = zero
    for plane in range(index(planes)):
        block, place, width = index(4) * plane, _place(plane), layout[index(3) * plane + index(2)]
        if blocks[block] == _OUTSIDE:
            continue
        if planes > 1:
            for k in range(index(BLOCK_PX)):
                at = index(COUNTED) + k
                scratch[at] = max(scratch[at], scratch[place + index(_WEIGHT) + k])
        if blocks[block] > _SCATTERED:
            start, row, column = blocks[block + index(1)], blocks[block + index(2)], blocks[block + index(3)]
            row_wanted_soon(samples, start + ROW_TAPS * width)
            _gather_in_step(blocks[block], samples, start, width, row, column, scratch, place)
        else:
            start, height = layout[index(3) * plane], layout[index(3) * plane + index(1)]
            _gather_scattered(samples, start, height, width, scratch, place)


@compiled
def scatter(samples, layout, planes, scratch, blocks):
    """Add `EXPECTED` to all planes."""
    for plane in range(index(planes)):
        block, place, width = index(4) * plane, _place(plane), layout[index(3) * plane + index(2)]
        if blocks[block] > _SCATTERED:
            start, row, column = blocks[block + index(1)], blocks[block + index(2)], blocks[block + index(3)]
            row_wanted_soon(samples, start + ROW_TAPS * width)
            _scatter_in_step(blocks[block], samples, start, width, row, column, scratch, place)
        elif blocks[block] == _SCATTERED:
            start, height = layout[index(3) * plane], layout[index(3) * plane + index(1)]
            _scatter_scattered(samples, start, height, width, scratch, place)


@compiled
def copy(source, at, target, to, count):
    """Copy some numbers from an offset to another."""
    for k in range(count):
        target[to + k] = source[at + k]


class Workspace(NamedTuple):
    """What a worker needs to itself: rows of a block's numbers, room for the pixel models, and how the block lies."""

    scratch: NDArray[Any]
    models: NDArray[Any]
    blocks: NDArray[np.intp]


def workspace(planes: int, dtype: np.dtype[Any]) -> Workspace:
    """Return a workspace whose rows begin with a cache line: vectors that straddle two cost twice."""
    size = _PLACES + planes * _PLACE_SIZE
    raw = np.zeros(size + _LINE_BYTES // dtype.itemsize, dtype)
    skipped = -raw.ctypes.data % _LINE_BYTES // dtype.itemsize
    models = np.zeros((WORK_ROWS, BLOCK_PX), dtype)
    return Workspace(raw[skipped : skipped + size], models, np.zeros(4 * planes, np.intp))
