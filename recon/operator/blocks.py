# mypy: disable-error-code="no-untyped-def"
"""A block of pixels of one detector row, compiled: what it sees of all planes, and the adjoint.

On a plane whose pitch is about depth / f, pixels advance almost in step with the samples: pixel k of a block sees
column `c₀ + k + t[k]` and row `r₀ + u[k]`, with small t and u. Where 0 ≤ t < `COLUMN_TAPS` − 1 and
0 ≤ u < `ROW_TAPS` − 1 hold for the whole block, bilinear interpolation is a sum over taps, each a tent function times
*neighbouring* samples,

    (H f)[k] = Σᵢ Σⱼ tent(u[k] − i) tent(t[k] − j) f[r₀ + i, c₀ + j + k],    tent(x) = max(0, 1 − |x|),

in which all but four weights are zero. The sum reads more samples than necessary, but is many times faster: it has no
branches and no index tables, and it loads, adds and stores vectors in both directions. Blocks that are not in step are
done pixel by pixel.

All arrays are flat and indexed with offsets: making a slice per block would cost more than the block's arithmetic.
"""

from faintfield.recon.elementary import compiled, inlined
from faintfield.recon.operator.block_layout import (
    BLOCK_PX,
    COUNTED,
    EXPECTED,
    ROW_TAPS,
    WEIGHT,
    place_of,
    weights_of,
)
from faintfield.recon.operator.interpolation import gather_in_step, gather_scattered, scatter_in_step, scatter_scattered
from faintfield.recon.operator.placement import OUTSIDE, SCATTERED
from faintfield.recon.pointers import index, prefetch

# Numbers per cache line of 64 bytes in float32.
_LINE_PX = 16


@compiled
def weigh(factors, pixel, to_next_plane, planes, count, scratch):
    """Multiply the weights of a block's pixels on every plane."""
    for plane in range(index(planes)):
        weight = weights_of(plane)
        for k in range(count):
            scratch[weight + k] *= type(scratch[0])(factors[pixel + k])
        pixel += to_next_plane


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
        block, place, width = index(4) * plane, place_of(plane), layout[index(3) * plane + index(2)]
        if blocks[block] == OUTSIDE:
            continue
        if planes > 1:
            for k in range(index(BLOCK_PX)):
                at = index(COUNTED) + k
                scratch[at] = max(scratch[at], scratch[place + index(WEIGHT) + k])
        if blocks[block] > SCATTERED:
            start, row, column = blocks[block + index(1)], blocks[block + index(2)], blocks[block + index(3)]
            prefetch_block(samples, start + ROW_TAPS * width)
            gather_in_step(blocks[block], samples, start, width, row, column, scratch, place)
        else:
            start, height = layout[index(3) * plane], layout[index(3) * plane + index(1)]
            gather_scattered(samples, start, height, width, scratch, place)


@compiled
def scatter(samples, layout, planes, scratch, blocks):
    """Add `EXPECTED` to all planes."""
    for plane in range(index(planes)):
        block, place, width = index(4) * plane, place_of(plane), layout[index(3) * plane + index(2)]
        if blocks[block] > SCATTERED:
            start, row, column = blocks[block + index(1)], blocks[block + index(2)], blocks[block + index(3)]
            prefetch_block(samples, start + ROW_TAPS * width)
            scatter_in_step(blocks[block], samples, start, width, row, column, scratch, place)
        elif blocks[block] == SCATTERED:
            start, height = layout[index(3) * plane], layout[index(3) * plane + index(1)]
            scatter_scattered(samples, start, height, width, scratch, place)


@compiled
def copy(source, at, target, to, count):
    """Copy `count` numbers from an offset of one array to an offset of another."""
    for k in range(count):
        target[to + k] = source[at + k]
