# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""The part of a surface that each detector pixel of a view meets: the surface drawn into the view by a depth buffer."""

from collections.abc import Sequence
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.numba_tools import compiled
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.placement import UNSEEN
from faintfield.recon.threads import run_in_threads

# Differences of parallax between neighbouring samples, in samples of the view farthest away: up to the first all is one
# surface. Beyond it, a difference that is this many times those beside it is a step, with nothing between the two.
_MAX_STEP, _MAX_BEND = 1.0, 2.5

# The surface is continued by so many samples on each side: pixels on its outermost samples must not miss a neighbour.
_BORDER = 2

# Codes run from minus this to this.
LARGEST_CODE = 2**15 - 1

# Cells may be drawn this much too large (in cells), so that rounding leaves no cracks between them.
_OVERLAP = np.float32(1e-3)

# Samples must be this far in front of a view, relative to their depth in the reference view.
_NEAREST = 1e-6


class Relief(NamedTuple):
    """Inverse depth, relative to an origin, at which each pixel of each view meets a surface.

    Attributes
    ----------
    codes : int16 array (view, row, column)
        In units of `step`; `UNSEEN` where a pixel sees no part of the surface, or its edge.
    step, origin : float
        Unit of the codes, and 1/depth of code zero, midway between the nearest sample and the farthest.

    Notes
    -----
    Rounding to codes moves the place that a pixel sees by at most 1/131 064 of the parallax between the nearest sample
    and the farthest: by less than 0.01 px up to a parallax of 1310 px.
    """

    codes: NDArray[np.int16]
    step: float
    origin: float


def draw_relief(
    inverse_depth: NDArray[np.floating],
    grid: PlaneGrid,
    ray_from_surface: NDArray[np.float64],
    rays: NDArray[np.floating],
    lattice_of_view: Sequence[int],
    workers: int | None = None,
) -> Relief:
    """Draw a surface into every view.

    Cells of four samples, but for those across a step, are drawn as two triangles into a depth buffer, which has the
    pitch of the samples and keeps the nearest. Each pixel interpolates 1/depth between the four numbers around its ray;
    it sees nothing where one of these is missing, or where they belong to two surfaces.

    Parameters
    ----------
    inverse_depth, grid : array (row, column), PlaneGrid
        1/depth of each sample in 1/mm, NaN where there is no surface; the samples at unit depth.
    ray_from_surface : array (view, 3, 4)
        From (x, y, 1, 1/depth) of a sample to the ray of a view, homogeneous.
    rays, lattice_of_view : array (lattice, row, column, 2), sequence of int
        Direction of each detector pixel, x, y at unit depth; the lattice of each view.
    workers : int, optional
        Number of threads; as many as the process may use by default. The result does not depend on it.
    """
    known = inverse_depth[np.isfinite(inverse_depth)].astype(np.float64)
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    codes = np.empty((len(ray_from_surface), *rays.shape[1:3]), np.int16)
    relief = Relief(codes, (high - low) / (2 * (LARGEST_CODE - 1)), 0.5 * (low + high))
    farthest = float(np.abs(ray_from_surface[:, :2, 3]).max())
    tear = _MAX_STEP * grid.pitch_mm / farthest if farthest > 0 else np.inf
    whole = np.pad(_whole_cells(inverse_depth, tear), _BORDER, mode="edge")
    heights = _continued(inverse_depth - relief.origin).astype(np.float32)
    (left, top), (right, bottom) = (
        (of(rays.reshape(-1, 2), axis=0) - grid.pitch_mm).astype(float).tolist() for of in (np.min, np.max)
    )
    shape = (int((bottom - top) / grid.pitch_mm) + 3, int((right - left) / grid.pitch_mm) + 3)
    buffer_grid = PlaneGrid(shape, grid.pitch_mm, (left, top))
    maps = [np.ascontiguousarray(lattice, np.float32) for lattice in rays]
    # Views of a mosaic appear once per lattice, but are drawn once
    distinct, drawing = np.unique(ray_from_surface.reshape(-1, 12), axis=0, return_inverse=True)
    workers = min(workers or int(numba.config.NUMBA_NUM_THREADS), len(distinct))

    def work(worker: int) -> None:
        buffer = np.empty(shape, np.float32)
        for number in range(worker, len(distinct), workers):
            buffer.fill(-np.inf)
            matrix = _buffer_from_sample(distinct[number].reshape(3, 4), grid, buffer_grid, relief.origin)
            _draw(heights, whole, matrix, buffer)
            for view in np.flatnonzero(drawing == number).tolist():
                of_lattice = maps[lattice_of_view[view]]
                _read(buffer, of_lattice, left, top, 1 / grid.pitch_mm, 2 * tear, relief.step, relief.codes[view])

    run_in_threads(work, range(workers))
    return relief


def _whole_cells(inverse_depth: NDArray[np.floating], tear: float) -> NDArray[np.bool_]:
    """Return which cells (row, column) of four samples no step crosses."""

    def crossed(axis: int) -> NDArray[np.bool_]:
        differences = np.abs(np.diff(inverse_depth, axis=axis))
        ends = [(1, 1) if index == axis else (0, 0) for index in range(2)]
        beside = np.pad(differences, ends, constant_values=np.inf)
        length = differences.shape[axis]
        before, after = (np.take(beside, np.arange(length) + shift, axis) for shift in (0, 2))
        return np.asarray(~((differences <= tear) | (differences <= _MAX_BEND * np.minimum(before, after))))

    across, down = crossed(1), crossed(0)
    return np.asarray(~(across[:-1] | across[1:] | down[:, :-1] | down[:, 1:]))


def _continued(heights: NDArray[np.floating]) -> NDArray[np.floating]:
    for _ in range(_BORDER):
        heights = np.pad(heights, 1, mode="reflect", reflect_type="odd")
    return heights


def _buffer_from_sample(
    ray_from_surface: NDArray[np.float64], grid: PlaneGrid, buffer_grid: PlaneGrid, origin: float
) -> NDArray[np.float64]:
    """Return the matrix (3, 4) from (column, row, 1, height) of a continued sample to the buffer's (column, row, 1)."""
    first = np.array([[1, 0, -_BORDER], [0, 1, -_BORDER], [0, 0, 1]])
    at_origin = ray_from_surface[:, :3] + origin * np.outer(ray_from_surface[:, 3], [0, 0, 1])
    matrix = np.column_stack([at_origin @ np.linalg.inv(grid.index_from_plane()) @ first, ray_from_surface[:, 3]])
    return np.asarray(buffer_grid.index_from_plane() @ matrix)


@compiled
def _draw(heights, whole, matrix, buffer):
    """Draw all cells of a surface into the depth buffer of a view, which holds the largest height so far."""
    rows, columns = heights.shape
    above, below = np.empty((2, columns), np.float32), np.empty((2, columns), np.float32)
    for i in range(rows):
        above, below = below, above
        _project(heights[i], i, matrix, below[0], below[1])
        if i == 0:
            continue
        for j in range(columns - 1):
            if whole[i - 1, j]:
                a, b, c, d = heights[i - 1, j], heights[i - 1, j + 1], heights[i, j], heights[i, j + 1]
                _fill(
                    buffer, above[0, j], above[1, j], above[0, j + 1], above[1, j + 1],
                    below[0, j], below[1, j], below[0, j + 1], below[1, j + 1], a, b, c, d,
                )  # fmt: skip


@compiled
def _project(heights, row, matrix, x, y):
    """Set x and y to where the samples of a row lie in the buffer; NaN for those that are not in front of the view."""
    x0, x1, x3 = matrix[0, 1] * row + matrix[0, 2], matrix[0, 0], matrix[0, 3]
    y0, y1, y3 = matrix[1, 1] * row + matrix[1, 2], matrix[1, 0], matrix[1, 3]
    z0, z1, z3 = matrix[2, 1] * row + matrix[2, 2], matrix[2, 0], matrix[2, 3]
    for j in range(heights.size):
        z = z0 + z1 * j + z3 * heights[j]
        inverse = 1 / z if z > _NEAREST else np.nan
        x[j], y[j] = (x0 + x1 * j + x3 * heights[j]) * inverse, (y0 + y1 * j + y3 * heights[j]) * inverse


@compiled
def _fill(buffer, xa, ya, xb, yb, xc, yc, xd, yd, a, b, c, d):
    """Draw a cell with the corners a b above c d: the triangle a b c, and d c b."""
    one, zero = np.float32(1), np.float32(0)
    upper = (xb - xa) * (yc - ya) - (xc - xa) * (yb - ya)
    lower = (xc - xd) * (yb - yd) - (xb - xd) * (yc - yd)
    if not (upper > zero or lower > zero) or np.isnan(upper + lower):  # seen from behind, or from a view within it
        return
    rows, columns = buffer.shape
    first = max(0, int(np.ceil(min(min(xa, xb), min(xc, xd)) - _OVERLAP)))
    last = min(columns - 1, int(np.floor(max(max(xa, xb), max(xc, xd)) + _OVERLAP)))
    first_row = max(0, int(np.ceil(min(min(ya, yb), min(yc, yd)) - _OVERLAP)))
    last_row = min(rows - 1, int(np.floor(max(max(ya, yb), max(yc, yd)) + _OVERLAP)))
    per_upper, per_lower = one / upper, one / lower
    for row in range(first_row, last_row + 1):
        for column in range(first, last + 1):
            x, y, q = np.float32(column), np.float32(row), buffer[row, column]
            s = ((x - xa) * (yc - ya) - (xc - xa) * (y - ya)) * per_upper
            t = ((xb - xa) * (y - ya) - (x - xa) * (yb - ya)) * per_upper
            if upper > zero and s >= -_OVERLAP and t >= -_OVERLAP and s + t <= one + _OVERLAP:
                q = max(q, a + s * (b - a) + t * (c - a))
            s = ((x - xd) * (yb - yd) - (xb - xd) * (y - yd)) * per_lower
            t = ((xc - xd) * (y - yd) - (x - xd) * (yc - yd)) * per_lower
            if lower > zero and s >= -_OVERLAP and t >= -_OVERLAP and s + t <= one + _OVERLAP:
                q = max(q, d + s * (c - d) + t * (b - d))
            buffer[row, column] = q


@compiled
def _read(buffer, rays, left, top, per_mm, tear, step, codes):
    """Write the codes of a view's pixels; a pixel between two surfaces, or beside one, sees neither."""
    rows, columns = codes.shape
    last_row, last_column = buffer.shape[0] - 2, buffer.shape[1] - 2
    per_step = 1 / step if step > 0 else 0.0
    for i in range(rows):
        for j in range(columns):
            x, y = (rays[i, j, 0] - left) * per_mm, (rays[i, j, 1] - top) * per_mm
            column, row = min(max(int(x), 0), last_column), min(max(int(y), 0), last_row)
            a, b = buffer[row, column], buffer[row, column + 1]
            c, d = buffer[row + 1, column], buffer[row + 1, column + 1]
            nearest, farthest = max(max(a, b), max(c, d)), min(min(a, b), min(c, d))
            code = UNSEEN
            if farthest > -np.inf and nearest - farthest <= tear:
                right, down = x - column, y - row
                upper, lower = a + right * (b - a), c + right * (d - c)
                code = int(np.rint((upper + down * (lower - upper)) * per_step))
                code = min(max(code, -LARGEST_CODE), LARGEST_CODE)
            codes[i, j] = code
