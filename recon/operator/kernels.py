# mypy: disable-error-code="no-untyped-def"
# Compiled functions have no type hints: numba compiles them for the types of each call.
"""The sweep of the operator, compiled: gather, ratio and scatter of one block of pixels after the other.

A detector row is processed in blocks of `BLOCK_PX` pixels. The plane coordinates of a block's pixels are computed once
and used in both directions, so H and Hᵀ share their weights by construction. Only `FORWARD` writes anything of the size
views × pixels: what nearer planes leave of a plane's light is computed again for each block, from their opacities and
with the weights of H.

Rows of the detector are distributed in tiles, tile `t` to worker `t mod workers`, and each worker adds into an
accumulator of its own: sums are deterministic for a given number of workers.
"""

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.pixel_models import LEAST_SQUARES, form_ratio_of_block
from faintfield.recon.numba_tools import advanced, compiled, index, inlined, pointer, prefetch
from faintfield.recon.operator.blocks import copy, gather, hide, prefetch_block, scatter, visit_plane, weigh
from faintfield.recon.operator.placement import BLOCK_PX, COUNTED, EXPECTED, locate_on_all, unpack_relief, weights_of

# Detector rows of a tile; 4, 16 or 32 rows take as long.
TILE_ROWS = 8

# Those up to SQUARES read images, but for FORWARD and REACH.
FORWARD, ADJOINT, RATIO, VALUE, VALUE_AND_RATIO, REACH, SQUARES = range(7)
VARIANCE_OF_SQUARES, NOISE, NORMAL, PRECISION, PRECISION_OF_EACH = range(7, 12)

# The operations that do not add to the samples.
ONLY_READING = (FORWARD, VALUE, REACH)


class SceneGeometry(NamedTuple):
    """Positions where the detector pixels of every view see the planes, as the kernels read them.

    Attributes
    ----------
    homographies : array (plane × view × 9,)
        From a ray (x, y, 1) to a plane's (column, row, 1), homogeneous. For a surface, their change with 1/depth
        follows as if it were a second plane's.
    layout : int array (plane, 4)
        Index of each plane's first sample among all samples, its rows, its columns, and the columns by which a pixel
        lies about beyond the one before.
    lattice_of_view, detector : int array (view,), (int, int, int)
        The lattice of each view; rows and columns of the images, and padded columns of the maps.
    maps : array (3 × lattice × row × padded column,)
        The ray of each pixel, x and y at unit depth, and its response: the flat field, zero for pixels that do not
        count in any view. Rows are padded to whole blocks with rays of NaN, which see nothing.
    valid : uint8 array (view × row × column,)
        Zero for pixels that do not count in this view; of size zero when all do.
    relief, relief_step : int16 array (view × row × column,), float
        1/depth at which each pixel meets the surface less that of the homographies, in units of `relief_step`; `UNSEEN`
        where it sees no part of it. Of size zero for planes.
    bent : (True,) or ()
        The former for a surface: its type makes the compiler make one sweep for surfaces and one for planes.
    reach : int array (view, row, 2)
        First and past-the-last padded column at which a row's pixels see any plane. Written by `REACH`.
    """

    homographies: NDArray[Any]
    layout: NDArray[np.intp]
    lattice_of_view: NDArray[np.intp]
    detector: tuple[int, int, int]
    maps: NDArray[Any]
    valid: NDArray[np.uint8]
    relief: NDArray[np.int16]
    relief_step: Any
    bent: tuple[bool, ...]
    reach: NDArray[np.intp]


def size_of(geometry: SceneGeometry) -> int:
    """Return the number of samples of all planes."""
    return int((geometry.layout[:, 1] * geometry.layout[:, 2]).sum())


class Hiding(NamedTuple):
    """Occlusion by nearer planes, as the kernel reads it.

    `opacities` (sample,) are α of all planes, of size zero where nothing hides anything; `opaque` (row × 2,) is the
    first and the past-the-last column of each row with some opacity. Only planes of greater depth are hidden.
    """

    opacities: NDArray[Any]
    opaque: NDArray[np.intp]
    depths: NDArray[np.float64]


class PixelModel(NamedTuple):
    """The statistics of the numbers that pixels read, as the kernels read them.

    Background and read noise's variance are (lattice × row × column,), and `level` is the light at which least squares
    takes the variance. The model is one of `recon.likelihood.pixel_models`.
    """

    model: int
    background: NDArray[Any]
    variance: NDArray[Any]
    level: float


# One long function: its loops share some twenty pointers and counts, which would have to be passed for every block.
@compiled
def sweep(
    operation, planes, expected_images, accumulator, images, image_of_view, pixels, geometry, hiding, space,
    views, seed, worker, workers,
):  # fmt: skip
    """Process a worker's share of the detector pixels of `views`; return their negative log-likelihood.

    Parameters
    ----------
    operation : int
        `FORWARD`: expected_images ← H planes, where not zero. `ADJOINT`: accumulator += Hᵀ images.
        `RATIO`: accumulator += Hᵀ r, with the ratio r of the pixel model, from images and H planes.
        `VALUE`: only the returned value, which is meaningful for this operation and the next alone.
        `VALUE_AND_RATIO`: both; the logarithms of the value take a tenth of the time.
        `REACH`: geometry.reach ← where rows see the planes; it must process all views, and come first.
        `SQUARES`: accumulator += Hᵀ (images − b − H planes)², with the background b of `pixels`.
        `NORMAL`: accumulator += Hᵀ H planes.
        `VARIANCE_OF_SQUARES`: accumulator += Hᵀ( m + 2 (m + σ²)² ), with m = H planes + b and σ² of `pixels`: the
        variance of such squares, of a Poisson number and a normal one.
        `NOISE`: accumulator += Hᵀ n with n = ±√(m + σ²), where the sign of pixel `row · columns + column` of a view is
        the last bit of `scramble(pixel ^ scramble(seed · views + view))`: minus for one.
        `PRECISION`: accumulator += Hᵀ[ (H 1)/v ], where v is `pixels.variance` plus the light of the planes, at least
        `pixels.level` for each pixel, or for least squares that level times the response.
        `PRECISION_OF_EACH`: accumulator += H_zᵀ[ (H_z 1)/v ] for each plane z.
        An operation changes nothing else.
    planes, accumulator : array (sample,)
        The samples that are read, and those that are added to: all planes, one after the other.
    expected_images, images : array (image × row × column,)
        The images that are written, and those that are read; view v has image `image_of_view[v]`.
    space : BlockWorkspace
        The worker's own.
    """
    rows, columns, padded = geometry.detector
    count_of_planes, count_of_views = geometry.layout.shape[0], index(geometry.lattice_of_view.size)
    samples = accumulator.size if operation == ADJOINT else planes.size
    scratch, blocks, layout = pointer(space.scratch), pointer(space.blocks), pointer(geometry.layout)
    expected, models = scratch, pointer(space.models)
    counted = advanced(scratch, index(COUNTED) if count_of_planes > 1 else weights_of(index(0)))
    homographies, maps, layer = pointer(geometry.homographies), pointer(geometry.maps), index(geometry.maps.size // 3)
    planes_at, added_at, images_at = pointer(planes), pointer(accumulator), pointer(images)
    expected_at = pointer(expected_images)
    background_at, variance_at = pointer(pixels.background), pointer(pixels.variance)
    valid_at, masked = pointer(geometry.valid), geometry.valid.size > 0
    opacities, opaque, depths = pointer(hiding.opacities), pointer(hiding.opaque), pointer(hiding.depths)
    hides, bent, relief_at = hiding.opacities.size > 0, geometry.bent, pointer(geometry.relief)
    model, level = pixels.model, pixels.level
    value = 0.0
    for tile in range(worker * TILE_ROWS, rows, workers * TILE_ROWS):
        for view in views:
            lattice, image = geometry.lattice_of_view[view], image_of_view[view]
            for row in range(tile, min(tile + TILE_ROWS, rows)):
                begin, end = geometry.reach[view, row, 0], geometry.reach[view, row, 1]
                left, right = end, begin
                for first in range(begin, end, BLOCK_PX):
                    count = index(min(BLOCK_PX, columns - first))
                    if len(bent) > 0:
                        at = index((view * rows + row) * columns + first)
                        unpack_relief(relief_at, at, count, geometry.relief_step, scratch)
                    at = index((lattice * rows + row) * padded + first)
                    if not locate_on_all(
                        homographies, index(9 * view), count_of_views, layout, count_of_planes, samples,
                        maps, layer, at, bent, scratch, blocks,
                    ):  # fmt: skip
                        continue
                    left, right = min(left, first), first + BLOCK_PX
                    if operation == REACH:
                        continue
                    if masked:
                        at = index((view * rows + row) * columns + first)
                        prefetch(valid_at, at + index(columns))
                        weigh(valid_at, at, count_of_planes, count, scratch)
                    if hides:
                        hide(opacities, opaque, depths, layout, count_of_planes, scratch, blocks)
                    pixel = index((image * rows + row) * columns + first)
                    if operation <= SQUARES:
                        prefetch_block(images_at, pixel + index(columns))
                    if operation == ADJOINT:
                        copy(images_at, pixel, scratch, index(EXPECTED), count)
                    else:
                        gather(planes_at, layout, count_of_planes, scratch, blocks)
                    if operation == FORWARD:
                        copy(scratch, index(EXPECTED), expected_at, pixel, count)
                        continue
                    at = index((lattice * rows + row) * columns + first)
                    if ADJOINT < operation < REACH:
                        value += form_ratio_of_block(
                            model, count, expected, advanced(images_at, pixel), advanced(background_at, at),
                            advanced(variance_at, at), counted, level, models, operation != RATIO,
                        )  # fmt: skip
                    elif REACH < operation < NORMAL:
                        _form_noise(
                            operation, count, advanced(images_at, pixel), advanced(background_at, at),
                            advanced(variance_at, at), seed * count_of_views + view, row * columns + first, scratch,
                        )  # fmt: skip
                    elif operation > NORMAL:
                        response = advanced(maps, layer + layer + index((lattice * rows + row) * padded + first))
                        _form_precision(model, count, advanced(variance_at, at), response, level, scratch)
                    if operation == PRECISION:
                        _multiply_by_row_sums(count_of_planes, scratch, models)
                    if operation == PRECISION_OF_EACH:
                        _scatter_each(added_at, layout, count_of_planes, scratch, blocks, models)
                    elif operation != VALUE:
                        scatter(added_at, layout, count_of_planes, scratch, blocks)
                if operation == REACH:
                    geometry.reach[view, row, 0], geometry.reach[view, row, 1] = left, right
    return value


@compiled
def _form_noise(operation, count, observed, background, variance, draw, first, scratch):
    """Set `EXPECTED`, the light of pixels from the `first` on, to squares of residuals, their variance, or noise."""
    number, light, key = type(scratch[0]), advanced(scratch, index(EXPECTED)), scramble(np.uint32(draw))
    for k in range(count):
        mean = light[k] + background[k]
        if operation == SQUARES:
            light[k] = (observed[k] - mean) * (observed[k] - mean)
        elif operation == VARIANCE_OF_SQUARES:
            light[k] = mean + number(2) * (mean + variance[k]) * (mean + variance[k])
        else:
            deviation = math.sqrt(max(mean + variance[k], number(0)))
            light[k] = -deviation if scramble(np.uint32(first + k) ^ key) & np.uint32(1) else deviation


@inlined
def scramble(bits):
    """Return 32 bits that look random, others for each number (uint32): Wellons 2018, "lowbias32"."""
    bits = np.uint32((bits ^ (bits >> np.uint32(16))) * np.uint32(0x7FEB352D))
    bits = np.uint32((bits ^ (bits >> np.uint32(15))) * np.uint32(0x846CA68B))
    return np.uint32(bits ^ (bits >> np.uint32(16)))


@compiled
def _form_precision(model, count, known, response, level, scratch):
    """Set `EXPECTED`, the light of some pixels, to their inverse variance."""
    number = type(scratch[0])
    one, level = number(1), number(level)
    for k in range(count):
        at = index(EXPECTED) + k
        light = level * response[k] if model == LEAST_SQUARES else max(scratch[at], level)
        scratch[at] = one / (light + known[k])


@compiled
def _multiply_by_row_sums(planes, scratch, sums):
    """Multiply `EXPECTED` by the sum of a pixel's weights on all planes, H 1; `sums` is scratch."""
    for k in range(index(BLOCK_PX)):
        sums[k] = type(scratch[0])(0)
    for plane in range(index(planes)):
        for k in range(index(BLOCK_PX)):
            sums[k] += scratch[weights_of(plane) + k]
    for k in range(index(BLOCK_PX)):
        scratch[index(EXPECTED) + k] *= sums[k]


@compiled
def _scatter_each(samples, layout, planes, scratch, blocks, precision):
    """Add `EXPECTED` times a pixel's weight on a plane to that plane; `precision` is scratch."""
    copy(scratch, index(EXPECTED), precision, index(0), index(BLOCK_PX))
    for plane in range(index(planes)):
        for k in range(index(BLOCK_PX)):
            scratch[index(EXPECTED) + k] = scratch[weights_of(plane) + k] * precision[k]
        visit_plane(True, samples, layout, plane, scratch, blocks)
