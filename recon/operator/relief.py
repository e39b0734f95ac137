# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Which part of a surface each detector pixel of a view meets: the surface drawn into the view, with a depth buffer."""

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

_HIGHEST = 2**15 - 1


class Relief(NamedTuple):
    """How much nearer than a depth each pixel of each view meets a surface.

    Attributes
    ----------
    codes : int16 array (view, row, column)
        In units of `step`; `UNSEEN` where a pixel sees no part of the surface, or its edge.
    step : float
        Unit of the codes, in 1/depth.
    origin : float
        1/depth of code zero.
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

    Cells of four samples are drawn as two triangles into a depth buffer of the pitch of the samples; cells across a
    step are left out. Each pixel then reads the buffer where its ray
    passes.

    Parameters
    ----------
    inverse_depth : array (row, column)
        1/depth of each sample; NaN where there is no surface.
    grid : PlaneGrid
        The samples at unit depth.
    ray_from_surface : array (view, 3, 4)
        From (x, y, 1, 1/depth) of a sample to the ray of a view, homogeneous.
    rays : array (lattice, row, column, 2)
        Where detector pixels look.
    lattice_of_view : sequence of int
        The lattice of each view.
    """
    known = inverse_depth[np.isfinite(inverse_depth)]
    low, high = (float(known.min()), float(known.max())) if known.size else (0.0, 0.0)
    origin, step = 0.5 * (low + high), (high - low) / (2 * (_HIGHEST - 1))
    lattices, rows, columns = rays.shape[:3]
    codes = np.empty((len(ray_from_surface), rows, columns), np.int16)
    surface = np.ascontiguousarray(inverse_depth, np.float32)
    left, top = rays.reshape(-1, 2).min(axis=0)
    right, bottom = rays.reshape(-1, 2).max(axis=0)
    pitch = grid.pitch_mm
    shape = (int((bottom - top) / pitch) + 3, int((right - left) / pitch) + 3)
    corner = np.array([left - pitch, top - pitch])
    maps = [np.ascontiguousarray(part, np.float32) for part in rays]
    # Same view, same buffer: views of a mosaic appear once per lattice
    distinct, number = np.unique(ray_from_surface.reshape(len(codes), -1), axis=0, return_inverse=True)
    farthest = float(np.abs(ray_from_surface[:, :2, 3]).max())
    tear = _MAX_STEP * pitch / farthest if farthest > 0 else np.inf
    whole = _whole_cells(surface, tear)

    def work(view: int) -> None:
        buffer = np.zeros(shape, np.float32)
        matrix = distinct[view].reshape(3, 4)
        _draw(surface, whole, *grid.origin_mm, pitch, matrix, buffer, corner[0], corner[1])
        for index in np.flatnonzero(number == view):
            _read(buffer, maps[lattice_of_view[index]], corner[0], corner[1], pitch, tear, origin, step, codes[index])

    run_in_threads(work, range(len(distinct)))
    return Relief(codes, step, origin)


def _whole_cells(surface: NDArray[np.float32], tear: float) -> NDArray[np.bool_]:
    """Return which cells (row, column) of four samples no step crosses."""

    def crossed(axis: int) -> NDArray[np.bool_]:
        differences = np.abs(np.diff(surface, axis=axis))
        ends = [(1, 1) if index == axis else (0, 0) for index in range(2)]
        beside = np.pad(differences, ends, constant_values=np.inf)
        length = differences.shape[axis]
        before, after = (np.take(beside, np.arange(length) + shift, axis) for shift in (0, 2))
        return ~((differences <= tear) | (differences <= _MAX_BEND * np.minimum(before, after)))

    across, down = crossed(1), crossed(0)
    return ~(across[:-1] | across[1:] | down[:, :-1] | down[:, 1:])


@compiled
def _draw(surface, whole, x0, y0, pitch, matrix, buffer, left, top):
    """Draw all cells of a surface into the depth buffer of a view, which holds the largest 1/depth so far."""
    rows, columns = surface.shape
    above = np.empty((columns, 2))
    below = np.empty((columns, 2))
    for i in range(rows):
        above, below = below, above
        for j in range(columns):
            q = surface[i, j]
            x, y = x0 + pitch * j, y0 + pitch * i
            z = matrix[2, 0] * x + matrix[2, 1] * y + matrix[2, 2] + matrix[2, 3] * q
            below[j, 0] = ((matrix[0, 0] * x + matrix[0, 1] * y + matrix[0, 2] + matrix[0, 3] * q) / z - left) / pitch
            below[j, 1] = ((matrix[1, 0] * x + matrix[1, 1] * y + matrix[1, 2] + matrix[1, 3] * q) / z - top) / pitch
            if not z > 0:
                below[j, 0] = np.nan
        if i == 0:
            continue
        for j in range(columns - 1):
            if not whole[i - 1, j]:
                continue
            a, b, c, d = surface[i - 1, j], surface[i - 1, j + 1], surface[i, j], surface[i, j + 1]
            _fill(buffer, above[j], above[j + 1], below[j], a, b, c)
            _fill(buffer, below[j + 1], below[j], above[j + 1], d, c, b)


@compiled
def _fill(buffer, one, two, three, q1, q2, q3):
    """Draw a triangle."""
    x1, y1, x2, y2, x3, y3 = one[0], one[1], two[0], two[1], three[0], three[1]
    area = (x2 - x1) * (y3 - y1) - (x3 - x1) * (y2 - y1)
    if not area > 0:  # seen from behind, or of no size
        return
    rows, columns = buffer.shape
    first_row, last_row = max(0, int(np.ceil(min(y1, min(y2, y3)) - 1e-4))), min(rows - 1, int(np.floor(max(y1, max(y2, y3)) + 1e-4)))
    first, last = max(0, int(np.ceil(min(x1, min(x2, x3)) - 1e-4))), min(columns - 1, int(np.floor(max(x1, max(x2, x3)) + 1e-4)))
    for row in range(first_row, last_row + 1):
        for column in range(first, last + 1):
            s = ((column - x1) * (y3 - y1) - (x3 - x1) * (row - y1)) / area
            t = ((x2 - x1) * (row - y1) - (column - x1) * (y2 - y1)) / area
            if s >= -1e-3 and t >= -1e-3 and s + t <= 1 + 1e-3:
                q = np.float32(q1 + s * (q2 - q1) + t * (q3 - q1))
                if q > buffer[row, column]:
                    buffer[row, column] = q


@compiled
def _read(buffer, rays, left, top, pitch, tear, origin, step, codes):
    """Write the codes of a view's pixels; a pixel between two surfaces, or beside one, sees neither."""
    rows, columns = codes.shape
    for i in range(rows):
        for j in range(columns):
            x, y = (rays[i, j, 0] - left) / pitch, (rays[i, j, 1] - top) / pitch
            column, row = int(x), int(y)
            code = UNSEEN
            if 0 <= column < buffer.shape[1] - 1 and 0 <= row < buffer.shape[0] - 1:
                a, b = buffer[row, column], buffer[row, column + 1]
                c, d = buffer[row + 1, column], buffer[row + 1, column + 1]
                nearest, farthest = max(max(a, b), max(c, d)), min(min(a, b), min(c, d))
                if farthest > 0 and nearest - farthest <= tear:
                    right, down = x - column, y - row
                    upper, lower = a + right * (b - a), c + right * (d - c)
                    q = upper + down * (lower - upper)
                    code = int(np.rint((q - origin) / step)) if step > 0 else 0
            codes[i, j] = code
