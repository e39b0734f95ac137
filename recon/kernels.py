# mypy: disable-error-code="no-untyped-def, no-untyped-call"
# The types of compiled functions are numba's business: each call compiles them for what it is given.
"""The three sweeps of the operator, compiled: gather, scatter, and gather-ratio-scatter in one.

A detector row is worked through in blocks. For each block the plane coordinates of its pixels are computed once and
used by both directions, so H and Hᵀ share their weights by construction. Where a block's plane coordinates advance by
one sample per pixel along one plane row (a plane pitch of about depth / f), gather and scatter are plain vector loads
and stores; elsewhere they go pixel by pixel. Nothing of the size views × pixels is written except by `FORWARD`.

Rows of the detector are dealt out in tiles, tile `t` to worker `t mod workers`, and each worker adds into an
accumulator of its own: sums are deterministic for a given number of workers.
"""

from typing import Any, NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from recon.elementary import compiled
from recon.pixel_models import WORK_ROWS, form_ratio

BLOCK_PX = 128
TILE_ROWS = 8

# A pixel this far outside the samples (in samples) still meets their edge: rounding must not decide whether the border
# of a plane that overlays a view pixel for pixel is seen. Float32 places a pixel of a large detector within 3e-4.
EDGE_TOLERANCE = 1e-3

FORWARD, ADJOINT, RATIO, VALUE = 0, 1, 2, 3
_SCATTERED, _CONTIGUOUS, _OUTSIDE = 0, 1, 2

_inlined = numba.njit(inline="always", error_model="numpy", fastmath={"contract", "nsz", "arcp", "reassoc"})


class Geometry(NamedTuple):
    """Where the detector pixels of every view meet the plane, as the kernels read it.

    Attributes
    ----------
    homographies : array (view, 3, 3)
        From a ray (x, y, 1) to the plane's (column, row, 1), homogeneous.
    lattice_of_view : int array (view,)
        Which lattice of detector pixels a view's image has.
    ray_x, ray_y : array (lattice, row, column)
        The ray of each pixel, at unit depth.
    response : array (lattice, row, column)
        Flat field, zero for pixels that do not count in any view.
    valid : bool array (view, row, column)
        False for pixels that do not count in this view; of size zero when all do.
    """

    homographies: NDArray[Any]
    lattice_of_view: NDArray[np.intp]
    ray_x: NDArray[Any]
    ray_y: NDArray[Any]
    response: NDArray[Any]
    valid: NDArray[np.bool_]


class PixelModel(NamedTuple):
    """What is known of the numbers that pixels read, as the kernels read it.

    Attributes
    ----------
    model : int
        One of `recon.pixel_models`.
    background, variance : array (lattice, row, column)
        Expected electrons that are not light, and variance of the read noise.
    level : float
        Light level at which least squares takes the variance.
    """

    model: int
    background: NDArray[Any]
    variance: NDArray[Any]
    level: float


@_inlined
def _locate(homography, ray_x, ray_y, response, shape, place, weights):
    """Find where a block's rays meet the plane; return how they lie there.

    `place` (2, block) receives the plane row and column of the upper left of the four samples around each point,
    `weights` (3, block) the fractions along row and column, and the pixel's response (zero: it does not count).
    A pixel counts only when all four samples exist, so that no plane edge dims the model; `EDGE_TOLERANCE` outside
    them is on their edge.
    """
    count = ray_x.size
    number = weights.dtype.type  # plain ints would promote float32 to float64
    zero, last_row, last_column = number(0), number(shape[0] - 1), number(shape[1] - 1)
    margin = number(EDGE_TOLERANCE)
    least, most_row, most_column = -margin, last_row + margin, last_column + margin
    # Held in registers: stores to `place` and `weights` would make the compiler load them again for every pixel
    a, b, c = homography[0, 0], homography[0, 1], homography[0, 2]
    d, e, f = homography[1, 0], homography[1, 1], homography[1, 2]
    g, h, i = homography[2, 0], homography[2, 1], homography[2, 2]
    for k in range(count):
        scale = g * ray_x[k] + h * ray_y[k] + i
        column = (a * ray_x[k] + b * ray_y[k] + c) / scale
        row = (d * ray_x[k] + e * ray_y[k] + f) / scale
        # scale > 0 also says that the plane is met in front of the camera
        inside = (scale > zero) & (column >= least) & (column <= most_column) & (row >= least) & (row <= most_row)
        column = min(max(column, zero), last_column) if inside else zero
        row = min(max(row, zero), last_row) if inside else zero
        upper = min(np.floor(row), last_row - number(1))
        left = min(np.floor(column), last_column - number(1))
        place[0, k] = np.int32(upper)
        place[1, k] = np.int32(left)
        weights[0, k] = row - upper
        weights[1, k] = column - left
        weights[2, k] = response[k] if inside else zero
    first_row, first_column = place[0, 0], place[1, 0]
    stray = np.int32(0)
    counted = False
    for k in range(count):
        stray |= (place[0, k] ^ first_row) | (place[1, k] ^ (first_column + np.int32(k)))
        counted |= weights[2, k] != zero
    if not counted:
        return _OUTSIDE
    return _CONTIGUOUS if stray == 0 else _SCATTERED


@_inlined
def _gather_block(plane, how, place, weights, values):
    """Set `values` to what the block's pixels see: the plane, interpolated bilinearly, times the response."""
    count = values.size
    if how == _OUTSIDE:
        values[:] = 0
        return
    one = plane.dtype.type(1)
    if how == _CONTIGUOUS:
        upper = plane[place[0, 0], place[1, 0] : place[1, 0] + count + 1]
        lower = plane[place[0, 0] + 1, place[1, 0] : place[1, 0] + count + 1]
        for k in range(count):
            down, right = weights[0, k], weights[1, k]
            above = (one - right) * upper[k] + right * upper[k + 1]
            below = (one - right) * lower[k] + right * lower[k + 1]
            values[k] = weights[2, k] * ((one - down) * above + down * below)
        return
    for k in range(count):
        row, column = np.uintp(place[0, k]), np.uintp(place[1, k])
        down, right = weights[0, k], weights[1, k]
        above = (one - right) * plane[row, column] + right * plane[row, column + np.uintp(1)]
        below = (one - right) * plane[row + np.uintp(1), column]
        below += right * plane[row + np.uintp(1), column + np.uintp(1)]
        values[k] = weights[2, k] * ((one - down) * above + down * below)


@_inlined
def _scatter_block(plane, how, place, weights, values):
    """Add the block's pixels to the plane with the weights that `_gather_block` reads it with.

    A pixel that does not count may hold anything, a NaN as well.
    """
    count = values.size
    zero, one = plane.dtype.type(0), plane.dtype.type(1)
    if how == _CONTIGUOUS:
        upper = plane[place[0, 0], place[1, 0] : place[1, 0] + count + 1]
        lower = plane[place[0, 0] + 1, place[1, 0] : place[1, 0] + count + 1]
        for k in range(count):
            values[k] = values[k] * weights[2, k] if weights[2, k] != zero else zero
        # A loop per sample: each adds at its own places, so each is a vector add
        for k in range(count):
            upper[k] += values[k] * (one - weights[0, k]) * (one - weights[1, k])
        for k in range(count):
            upper[k + 1] += values[k] * (one - weights[0, k]) * weights[1, k]
        for k in range(count):
            lower[k] += values[k] * weights[0, k] * (one - weights[1, k])
        for k in range(count):
            lower[k + 1] += values[k] * weights[0, k] * weights[1, k]
        return
    for k in range(count):
        if weights[2, k] != zero:
            value = values[k] * weights[2, k]
            row, column = np.uintp(place[0, k]), np.uintp(place[1, k])
            down, right = weights[0, k], weights[1, k]
            plane[row, column] += value * (one - down) * (one - right)
            plane[row, column + np.uintp(1)] += value * (one - down) * right
            plane[row + np.uintp(1), column] += value * down * (one - right)
            plane[row + np.uintp(1), column + np.uintp(1)] += value * down * right


@compiled
def sweep(operation, plane, seen, accumulator, images, image_of_view, pixels, geometry, views, worker, workers):
    """Go once over a worker's share of the detector pixels of `views`; return their negative log-likelihood.

    Parameters
    ----------
    operation : int
        `FORWARD`: seen ← H plane. `ADJOINT`: accumulator += Hᵀ images.
        `RATIO`: accumulator += Hᵀ r, with the ratio r that the model of the pixels makes of images and H plane.
        `VALUE`: only what is returned, which is zero unless the operation is this or `RATIO`.
        What an operation does not name, it leaves alone.
    plane, accumulator : array (row, column)
        What is read, and what is added to.
    seen, images : array (image, row, column)
        What is written, and what is read; view v has image `image_of_view[v]`.
    pixels : PixelModel
        What is known of the pixels' numbers.
    """
    rows, columns = geometry.ray_x.shape[1:]
    shape = accumulator.shape if operation == ADJOINT else plane.shape
    place = np.empty((2, BLOCK_PX), np.int32)
    weights = np.empty((3, BLOCK_PX), plane.dtype)
    values = np.empty(BLOCK_PX, plane.dtype)
    work = np.empty((WORK_ROWS, BLOCK_PX), plane.dtype)
    value = 0.0
    for tile in range(worker * TILE_ROWS, rows, workers * TILE_ROWS):
        for view in views:
            lattice = geometry.lattice_of_view[view]
            for row in range(tile, min(tile + TILE_ROWS, rows)):
                image = image_of_view[view]
                for first in range(0, columns, BLOCK_PX):
                    block = slice(first, min(first + BLOCK_PX, columns))
                    count = block.stop - first
                    how = _locate(
                        geometry.homographies[view],
                        geometry.ray_x[lattice, row, block],
                        geometry.ray_y[lattice, row, block],
                        geometry.response[lattice, row, block],
                        shape,
                        place,
                        weights,
                    )
                    if geometry.valid.size:
                        weights[2, :count] *= geometry.valid[view, row, block]
                    if operation == FORWARD:
                        _gather_block(plane, how, place, weights, seen[image, row, block])
                    elif how != _OUTSIDE:
                        if operation == ADJOINT:
                            values[:count] = images[image, row, block]
                        else:
                            _gather_block(plane, how, place, weights, values[:count])
                            value += form_ratio(
                                pixels.model,
                                values[:count],
                                images[image, row, block],
                                pixels.background[lattice, row, block],
                                pixels.variance[lattice, row, block],
                                weights[2, :count],
                                pixels.level,
                                work,
                            )
                        if operation != VALUE:
                            _scatter_block(accumulator, how, place, weights, values[:count])
    return value
