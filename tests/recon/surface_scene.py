"""A textured square in front of a textured wall, seen by 25 cameras, cast pixel by pixel: truth for the depth search.

Nothing of the code under test renders it. The views are sheared, as rectified light fields are, so that the wall and
the square move little from view to view although 2 % of their depths is almost a pixel in the outermost view.
"""

from functools import cache

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.surface.pinhole_views import PinholeViews

SHAPE, FOCAL_PX, AXIS = (60, 80), 64.0, (38.7, 30.2)  # rows and columns; column and row of the axis
PITCH = 1 / FOCAL_PX
GRID = PlaneGrid(SHAPE, PITCH, (-AXIS[0] * PITCH, -AXIS[1] * PITCH))
NODES = np.array([(row, column) for row in range(5) for column in range(5)])
NODE_MM = 140.0

# Centres of the cameras (view, 2), x and y in mm; not quite regular, or else all views would look between their pixels
# alike, and interpolation would favour the depths at which they need none
CENTRES_MM = NODE_MM * (NODES[:, ::-1] - 2) + np.random.default_rng(16).uniform(-25, 25, (25, 2))
CENTRES_MM -= CENTRES_MM[12]

# 1/depth of the wall, the square, and what the views are sheared to
FAR, NEAR, UNMOVED = 1 / 600, 1 / 500, 1 / 560

# First and past-the-last column and row of the square in the reference view
EDGES_PX = (17.5, 57.5, 12.5, 46.5)
READ_VARIANCE_E2 = 2.0

# Light in electrons per pixel: its detail, 40 % of it, has about 1.4 times the noise's deviation
LEVEL_E = 20.0

# 1/depth of the search, fewer than `equal_steps` would take, for speed
FARTHEST, NEAREST = 1 / 650, 1 / 465
DEPTHS = np.linspace(FARTHEST, NEAREST, 24)


def matrices() -> NDArray[np.float64]:
    """Return matrices from (x, y, 1, 1/depth) to the ray of each view (view, 3, 4)."""
    result = np.zeros((len(NODES), 3, 4))
    result[:, :3, :3] = np.eye(3)
    result[:, :2, 3], result[:, :2, 2] = -CENTRES_MM, UNMOVED * CENTRES_MM
    return result


def inverse_depth() -> NDArray[np.float64]:
    """Return the 1/depth of each sample of the reference view."""
    row, column = np.indices(SHAPE, float)
    return np.where(_in_square(column, row), NEAR, FAR)


@cache
def expected_light(level_e: float) -> NDArray[np.float64]:
    """Return light (view, row, column) of a mean of about `level_e`, without noise."""
    row, column = np.indices(SHAPE, float)
    views = []
    for right, down in FOCAL_PX * CENTRES_MM:
        near, far = ((column + right * (q - UNMOVED), row + down * (q - UNMOVED)) for q in (NEAR, FAR))
        views.append(np.where(_in_square(*near), texture(1, *near), texture(2, *far)))
    return level_e * np.array(views)


def drawn_views(level_e: float) -> PinholeViews:
    return noisy_views_of(expected_light(level_e), 5)


def noisy_views_of(light: NDArray[np.floating], seed: int) -> PinholeViews:
    """Return views with Poisson light and read noise."""
    generator = np.random.default_rng(seed)
    return views_of(generator.poisson(light) + generator.normal(0, READ_VARIANCE_E2**0.5, light.shape))


def views_of(light: NDArray[np.floating]) -> PinholeViews:
    """Return views that show the given light (view, row, column)."""
    return PinholeViews(light.astype(np.float32), READ_VARIANCE_E2, matrices(), (FOCAL_PX, FOCAL_PX), AXIS, GRID, NODES)


def away_from_edges(distance: int) -> NDArray[np.bool_]:
    """Return samples farther than this from the outline of the square and from the border of the picture."""
    near = inverse_depth() == NEAR
    result = np.zeros(SHAPE, bool)
    inner = np.s_[distance:-distance, distance:-distance]
    result[inner] = True
    for down in range(-distance, distance + 1):
        for right in range(-distance, distance + 1):
            result[inner] &= np.roll(near, (down, right), (0, 1))[inner] == near[inner]
    return result


@cache
def _waves(seed: int) -> NDArray[np.float64]:
    """Return noise without finer detail than the pixels show, between about 0.2 and 1.8, also beyond the picture."""
    blurred = gaussian_filter(np.random.default_rng(seed).normal(size=(SHAPE[0] + 80, SHAPE[1] + 80)), 1.4)
    return np.asarray(1 + 0.4 * np.clip(blurred / blurred.std(), -2, 2))


def texture(seed: int, column: NDArray[np.float64], row: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(map_coordinates(_waves(seed), [row + 40, column + 40], order=3))


def _in_square(column: NDArray[np.floating], row: NDArray[np.floating]) -> NDArray[np.bool_]:
    left, right, top, bottom = EDGES_PX
    return np.asarray((column > left) & (column < right) & (row > top) & (row < bottom))
