# mypy: disable-error-code="no-untyped-def"
"""A block of pixels of one detector row, compiled: what it sees of all planes, and the adjoint.

On a plane whose pitch is about depth / f, pixels advance almost in step with the samples: pixel k of a block sees
column `c₀ + a k + t[k]` and row `r₀ + u[k]`, with small t and u and the advance a = 1, or 2 for a lattice of a mosaic.
Where 0 ≤ t < `COLUMN_TAPS` − 1 and 0 ≤ u < `ROW_TAPS` − 1 hold for the whole block, bilinear interpolation is a sum
over taps, each a tent function times samples that lie side by side, or every other one,

    (H f)[k] = Σᵢ Σⱼ tent(u[k] − i) tent(t[k] − j) f[r₀ + i, c₀ + j + a k],    tent(x) = max(0, 1 − |x|),

in which all but four weights are zero. The sum reads more samples than necessary, but is many times faster: it has no
branches and no index tables, and it loads, adds and stores vectors in both directions. Blocks that are not in step are
tried as two halves, as the edges of a distorted picture are, and else done pixel by pixel.

All arrays are flat and indexed with offsets: making a slice per block would cost more than the block's arithmetic.
"""

import numpy as np

from faintfield.recon.numba_tools import advanced, compiled, index, inlined, prefetch
from faintfield.recon.operator.placement import (
    BLOCK_PX,
    COLUMN,
    COLUMN_TAPS,
    COUNTED,
    EXPECTED,
    HALF_PX,
    IN_STEP_2_2,
    IN_STEP_2_3,
    IN_STEP_3_3,
    LAYOUT_SIZE,
    MARGIN,
    OUTSIDE,
    PRODUCT_PX,
    PRODUCTS,
    ROW,
    ROW_TAPS,
    SCATTERED,
    WEIGHT,
    half_of,
    place_of,
    weights_of,
)

# Numbers per cache line of 64 bytes in float32.
_LINE_PX = 16

# Smallest weight that α is divided by.
_TINY = 1e-37


@compiled
def weigh(factors, pixel, planes, count, scratch):
    """Multiply the weights of a block's pixels on every plane."""
    for plane in range(index(planes)):
        weight = weights_of(plane)
        for k in range(count):
            scratch[weight + k] *= type(scratch[0])(factors[pixel + k])


@inlined
def prefetch_block(numbers, at):
    """Prefetch the numbers of a block in a later row: processors look ahead only within one page of memory."""
    for k in range(index(0), index(BLOCK_PX), index(_LINE_PX)):
        prefetch(numbers, index(at) + k)


@compiled
def gather(samples, layout, planes, scratch, blocks):
    """Set `EXPECTED` to what a block's pixels see of all planes, and `COUNTED` to their largest weight.

    `COUNTED` is not set for a single plane, whose weights themselves say which pixels count.
    """
    zero = type(scratch[0])(0)
    for k in range(index(BLOCK_PX)):
        scratch[index(EXPECTED) + k] = zero
    if planes > 1:
        for k in range(index(BLOCK_PX)):
            scratch[index(COUNTED) + k] = zero
    for plane in range(index(planes)):
        if planes > 1 and meets(plane, blocks):
            for k in range(index(BLOCK_PX)):
                at = index(COUNTED) + k
                scratch[at] = max(scratch[at], scratch[weights_of(plane) + k])
        visit_plane(False, samples, layout, plane, scratch, blocks)


@compiled
def scatter(samples, layout, planes, scratch, blocks):
    """Add `EXPECTED` to all planes."""
    for plane in range(index(planes)):
        visit_plane(True, samples, layout, plane, scratch, blocks)


@inlined
def meets(plane, blocks):
    """Return whether a block's pixels see a plane."""
    return blocks[half_of(plane, index(0))] != OUTSIDE or blocks[half_of(plane, index(1))] != OUTSIDE


@compiled
def visit_plane(scatters, samples, layout, plane, scratch, blocks):
    """Add `EXPECTED` to one plane if `scatters`; else add to `EXPECTED` what a block's pixels see of the plane."""
    place, on_plane = place_of(plane), advanced(layout, index(LAYOUT_SIZE) * plane)
    for number in range(2):
        half, first = advanced(blocks, half_of(plane, index(number))), index(number * HALF_PX)
        scheme, start, width = half[index(0)], half[index(1)], on_plane[index(2)]
        if scheme > SCATTERED:
            prefetch_block(samples, start + ROW_TAPS * width)
            taps = advanced(samples, index(start))
            if scatters:
                _scatter_in_step(scheme, on_plane[index(3)], taps, width, half, scratch, place, first)
            else:
                _gather_in_step(scheme, on_plane[index(3)], taps, width, half, scratch, place, first)
        elif scheme == SCATTERED:
            _visit_scattered(scatters, samples, on_plane, scratch, place, first)


@compiled
def copy(source, at, target, to, count):
    """Copy `count` numbers from an offset of one array to an offset of another."""
    for k in range(count):
        target[to + k] = source[at + k]


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
            visit_plane(False, opacities, layout, near, scratch, blocks)
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
def _gather_in_step(scheme, advance, samples, stride, half, scratch, place, first):
    """Interpolate with as few rows and columns of taps as the pixels need, each number compiled separately."""
    if advance > 1 and scheme <= IN_STEP_2_3:
        _gather_taps(2, 3, 2, samples, stride, half, scratch, place, first)
    elif advance > 1:
        _gather_taps(3, 4, 2, samples, stride, half, scratch, place, first)
    elif scheme == IN_STEP_2_2:
        _gather_taps(2, 2, 1, samples, stride, half, scratch, place, first)
    elif scheme == IN_STEP_2_3:
        _gather_taps(2, 3, 1, samples, stride, half, scratch, place, first)
    elif scheme == IN_STEP_3_3:
        _gather_taps(3, 3, 1, samples, stride, half, scratch, place, first)
    else:
        _gather_taps(3, 4, 1, samples, stride, half, scratch, place, first)


@compiled
def _scatter_in_step(scheme, advance, samples, stride, half, scratch, place, first):
    """Scatter with the taps of `_gather_in_step`."""
    if advance > 1 and scheme <= IN_STEP_2_3:
        _scatter_taps(2, 3, 2, samples, stride, half, scratch, place, first)
    elif advance > 1:
        _scatter_taps(3, 4, 2, samples, stride, half, scratch, place, first)
    elif scheme == IN_STEP_2_2:
        _scatter_taps(2, 2, 1, samples, stride, half, scratch, place, first)
    elif scheme == IN_STEP_2_3:
        _scatter_taps(2, 3, 1, samples, stride, half, scratch, place, first)
    elif scheme == IN_STEP_3_3:
        _scatter_taps(3, 3, 1, samples, stride, half, scratch, place, first)
    else:
        _scatter_taps(3, 4, 1, samples, stride, half, scratch, place, first)


@inlined
def _tent(distance):
    height = type(distance)(1) - abs(distance)
    return height if height > type(distance)(0) else type(distance)(0)


@inlined
def _row_weights(down, rows):
    """Return the tent weights of the rows, which sum to one."""
    number = type(down)
    zero, one = number(0), number(1)
    if rows == 2:
        return one - down, down, zero
    upper = one - down if down < one else zero
    lower = down - one if down > one else zero
    return upper, one - upper - lower, lower


@inlined
def _gather_taps(rows, columns, advance, samples, stride, half, scratch, place, first):
    """Add to `EXPECTED` what the pixels see: the plane, interpolated bilinearly, times the weight."""
    number = type(scratch[0])
    row, column = number(half[index(2)]), number(half[index(3)])
    across, down = advanced(scratch, place + index(COLUMN) + first), advanced(scratch, place + index(ROW) + first)
    weights, expected = advanced(scratch, place + index(WEIGHT) + first), advanced(scratch, index(EXPECTED) + first)
    for k in range(index(half[index(4)])):
        along, at = across[k] - column, index(advance) * k
        u0, u1, u2 = _row_weights(down[k] - row, rows)
        light = u0 * _along_row(columns, along, samples, at)
        light += u1 * _along_row(columns, along, samples, index(stride) + at)
        if rows > 2:
            light += u2 * _along_row(columns, along, samples, index(2 * stride) + at)
        expected[k] += weights[k] * light


@inlined
def _along_row(columns, along, samples, at):
    """Return the value of a row of the plane, interpolated along it."""
    number = type(along)
    if columns == 2:
        return samples[at] + along * (samples[at + index(1)] - samples[at])
    light = _tent(along) * samples[at] + _tent(along - number(1)) * samples[at + index(1)]
    light += _tent(along - number(2)) * samples[at + index(2)]
    if columns > 3:
        light += _tent(along - number(3)) * samples[at + index(3)]
    return light


@inlined
def _scatter_taps(rows, columns, advance, samples, stride, half, scratch, place, first):
    """Add `EXPECTED` to the plane with the weights that `_gather_taps` reads it with.

    The products of all taps are formed first and then added, shifted, once per row of samples: the processor would
    have to wait for stores that overlap with loads soon after. A pixel that does not count may hold anything, even NaN.
    """
    number = type(scratch[0])
    row, column, zero = number(half[index(2)]), number(half[index(3)]), number(0)
    across, down = advanced(scratch, place + index(COLUMN) + first), advanced(scratch, place + index(ROW) + first)
    weights, expected = advanced(scratch, place + index(WEIGHT) + first), advanced(scratch, index(EXPECTED) + first)
    size, pixels = index(PRODUCT_PX), index(half[index(4)])
    upper = advanced(scratch, index(PRODUCTS))
    middle, lower = advanced(upper, index(columns) * size), advanced(upper, index(2 * columns) * size)
    for k in range(pixels):
        value = weights[k] * expected[k] if weights[k] != zero else zero
        along = across[k] - column
        u0, u1, u2 = _row_weights(down[k] - row, rows)
        for tap in range(columns):
            share = value * _tent(along - number(tap))
            upper[index(tap) * size + k] = u0 * share
            middle[index(tap) * size + k] = u1 * share
            if rows > 2:
                lower[index(tap) * size + k] = u2 * share
    if pixels < index(BLOCK_PX):  # an earlier block has left its products behind those of half a block
        for tap in range(rows * columns):
            for k in range(index(MARGIN)):
                upper[index(tap) * size + pixels + k] = zero
    for r in range(rows):
        products, target = advanced(upper, index(r * columns) * size), advanced(samples, index(r * stride))
        for k in range(pixels + index(MARGIN)):
            if advance == 1:
                added = products[k]
                for tap in range(1, columns):
                    added += products[index(tap) * (size - index(1)) + k]
                target[k] += added
            else:
                even, odd = products[k], products[size + k]
                if columns > 2:
                    even += products[index(2) * size - index(1) + k]
                if columns > 3:
                    odd += products[index(3) * size - index(1) + k]
                target[index(2) * k] += even
                target[index(2) * k + index(1)] += odd


@compiled
def _visit_scattered(scatters, samples, layout, scratch, place, first):
    """Scatter or interpolate pixel by pixel, with the same weights."""
    start, height, stride = layout[index(0)], layout[index(1)], layout[index(2)]
    number, advance = type(scratch[0]), type(scratch[0])(layout[index(3)])
    zero, one, below = number(0), index(1), index(stride)
    for k in range(first, first + index(HALF_PX)):
        weight = scratch[place + index(WEIGHT) + k]
        if weight == zero:
            continue
        column = scratch[place + index(COLUMN) + k] + number(np.int32(k)) * advance
        row = scratch[place + index(ROW) + k]
        left, top = min(np.int32(column), np.int32(stride - 2)), min(np.int32(row), np.int32(height - 2))
        at, down, right = index(start + np.intp(top) * stride + np.intp(left)), row - number(top), column - number(left)
        if scatters:
            value = weight * scratch[index(EXPECTED) + k]
            lower = value * down
            upper = value - lower
            samples[at] += upper - upper * right
            samples[at + one] += upper * right
            samples[at + below] += lower - lower * right
            samples[at + below + one] += lower * right
        else:
            upper, lower = samples[at], samples[at + below]
            upper += right * (samples[at + one] - upper)
            lower += right * (samples[at + below + one] - lower)
            scratch[index(EXPECTED) + k] += weight * (upper + down * (lower - upper))
