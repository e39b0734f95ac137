"""A near square in front of a far plane, seen by pinhole cameras, cast ray by ray: truth for the operator of a surface.

Nothing of the code under test is used.
"""

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

NEAR, FAR, NEITHER = 1, 2, 0
NEAR_MM, FAR_MM = 400.0, 700.0
SHAPE, FOCAL_PX, AXIS = (60, 90), 80.0, (43.2, 28.7)  # rows and columns; column and row of the axis

# First and past-the-last column and row of the square in the reference view, half-way between two samples
EDGES_PX = (24.5, 51.5, 12.5, 36.5)


class Sight(NamedTuple):
    """Surface that pixels (row, column) of a view see, and the light of its point; zero for `NEITHER`."""

    what: NDArray[np.int_]
    light: NDArray[np.float64]


def rays(shift_px: tuple[float, float] = (0.0, 0.0)) -> NDArray[np.float64]:
    """Return the rays (row, column, 2) of pixels, or of points this far beside them."""
    column, row = np.meshgrid(np.arange(SHAPE[1]) + shift_px[0], np.arange(SHAPE[0]) + shift_px[1])
    return np.stack([column - AXIS[0], row - AXIS[1]], axis=-1) / FOCAL_PX


def cast(rt: NDArray[np.float64], shift_px: tuple[float, float] = (0.0, 0.0)) -> Sight:
    """Return what each pixel of a view of pose (R, t) sees."""
    back = Rotation.from_rotvec(rt[:3]).as_matrix().T
    centre = -back @ rt[3:]
    directions = np.concatenate([rays(shift_px), np.ones((*SHAPE, 1))], axis=-1) @ back.T
    to_near, to_far = (centre + directions * (depth - centre[2]) / directions[..., 2:] for depth in (NEAR_MM, FAR_MM))
    near, hidden = _in_square(to_near), _in_square(to_far)  # as the reference camera, at the origin, sees them
    inside = _in_picture(np.where(near[..., np.newaxis], to_near, to_far))
    what = np.where(near, NEAR, np.where(hidden, NEITHER, FAR))
    what[~inside] = NEITHER
    return Sight(what, np.choose(what, [np.zeros(SHAPE), light(NEAR, to_near), light(FAR, to_far)]))


def light(what: int, points: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the light of points (…, 3), linear in their direction: bilinear interpolation between samples keeps it."""
    x, y = points[..., 0] / points[..., 2], points[..., 1] / points[..., 2]
    return np.asarray(9 + 3 * x + 2 * y if what == NEAR else 3 + x - 2 * y)


def picture() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the light and the 1/depth of each sample (row, column) of the reference view."""
    sight = cast(np.zeros(6))
    return sight.light, np.where(sight.what == NEAR, 1 / NEAR_MM, 1 / FAR_MM)


def _pixel(points: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the column and row at which the reference camera sees points."""
    column = FOCAL_PX * points[..., 0] / points[..., 2] + AXIS[0]
    return column, FOCAL_PX * points[..., 1] / points[..., 2] + AXIS[1]


def _in_square(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether points are of the square, or hidden by it."""
    column, row = _pixel(points)
    left, right, top, bottom = EDGES_PX
    return (column > left) & (column < right) & (row > top) & (row < bottom)


def _in_picture(points: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Return whether the reference view has samples around points."""
    column, row = _pixel(points)
    tiny = 1e-9
    return (column >= -tiny) & (column <= SHAPE[1] - 1 + tiny) & (row >= -tiny) & (row <= SHAPE[0] - 1 + tiny)
