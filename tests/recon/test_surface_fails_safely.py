"""Where depths cannot be known, none may be called sure and be wrong: scenes and views that mislead."""

from functools import cache

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.surface.confidence import RIGHT_WITHIN, SURE
from faintfield.recon.surface.estimate import SurfaceEstimate, estimate_surface
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews
from tests.recon import surface_scene
from tests.recon.surface_scene import AXIS, FAR, FOCAL_PX, GRID, NODE_MM, NODES, READ_VARIANCE_E2, SHAPE, UNMOVED

LEVEL_E = 20.0
DEPTHS = np.linspace(1 / 650, 1 / 465, 40)

# Cameras that are equal steps apart, up to 2 mm.
ALMOST_REGULAR_MM = NODE_MM * (NODES[:, ::-1] - 2) + np.random.default_rng(4).uniform(-2, 2, (25, 2))

type Light = NDArray[np.float64]


def _estimate(light: Light, matrices: NDArray[np.float64] | None = None, seed: int = 7) -> SurfaceEstimate:
    """The surface of the given light (view, row, column), with noise."""
    generator = np.random.default_rng(seed)
    known = generator.poisson(np.maximum(light, 0)) + generator.normal(0, READ_VARIANCE_E2**0.5, light.shape)
    counted = np.where(light == UNKNOWN, UNKNOWN, known).astype(np.float32)
    rays = surface_scene.matrices() if matrices is None else matrices
    views = PinholeViews(counted, READ_VARIANCE_E2, rays, (FOCAL_PX, FOCAL_PX), AXIS, GRID)
    return estimate_surface(views, DEPTHS, NODES)


def _sure(found: SurfaceEstimate, truth: NDArray[np.float64]) -> tuple[float, float]:
    """Shares of all samples that are sure and right, and sure and wrong."""
    right = np.abs(found.inverse_depth / truth - 1) < RIGHT_WITHIN
    sure = found.confidence >= SURE
    return float((sure & right).mean()), float((sure & ~right).mean())


@cache
def _good() -> tuple[SurfaceEstimate, float, float]:
    """The scene as it is: what is found, and the shares of what is sure and right, and sure and wrong."""
    found = _estimate(surface_scene.expected_light(LEVEL_E))
    return found, *_sure(found, surface_scene.inverse_depth())


def test_of_a_good_scene_much_is_sure_and_right() -> None:
    """Else the other tests could not fail."""
    _, right, wrong = _good()
    assert right > 0.4
    assert wrong < 0.03


def test_nothing_of_an_even_wall_is_sure() -> None:
    found = _estimate(np.full((len(NODES), *SHAPE), LEVEL_E))
    assert (found.confidence >= SURE).mean() < 0.01


def _wall(pair_px: float, *, alike: bool, seed: int = 7) -> SurfaceEstimate:
    """What is found of a wall at 600 mm, seen from almost regular nodes: squares, all alike or each drawn by lot."""
    centres = ALMOST_REGULAR_MM - ALMOST_REGULAR_MM[12]
    lot = np.random.default_rng(3).integers(0, 2, (200, 200))
    # Quarters of pixels along each side
    row, column = (np.indices((4 * SHAPE[0], 4 * SHAPE[1])) - 1.5) / 4
    views = []
    for right, down in FOCAL_PX * centres * (FAR - UNMOVED):
        x = np.floor(2 * (column + right) / pair_px).astype(int)
        y = np.floor(2 * (row + down) / pair_px).astype(int)
        white = (x + y) % 2 if alike else lot[x + 100, y + 100]
        views.append(0.4 + 1.2 * white.reshape(SHAPE[0], 4, SHAPE[1], 4).mean(axis=(1, 3)))
    rays = surface_scene.matrices()
    rays[:, :2, 3], rays[:, :2, 2] = -centres, UNMOVED * centres
    return _estimate(LEVEL_E * np.array(views), rays, seed)


def _pair_px(other_mm: float) -> float:
    """Width of two squares for which all views of a wall at 600 mm agree at the other depth as well."""
    return NODE_MM * FOCAL_PX * (1 / other_mm - FAR)


@pytest.mark.parametrize(("other_mm", "draws"), [(480, 1), pytest.param(500, 8, marks=pytest.mark.deep)])
def test_of_a_wall_of_equal_squares_little_is_sure_and_wrong(other_mm: float, draws: int) -> None:
    """At 500 mm the share varies from 0 to 7 % with the noise."""
    walls = [_wall(_pair_px(other_mm), alike=True, seed=seed) for seed in range(7, 7 + draws)]
    wrong = [_sure(wall, np.full(SHAPE, FAR))[1] for wall in walls]
    assert np.mean(wrong) < 0.03


def test_a_wall_of_squares_that_differ_is_sure_and_right() -> None:
    right, wrong = _sure(_wall(_pair_px(500), alike=False), np.full(SHAPE, FAR))
    assert right > 0.9
    assert wrong < 0.03


def test_a_saturated_view_changes_little() -> None:
    light = surface_scene.expected_light(LEVEL_E).copy()
    light[7] = UNKNOWN
    found = _estimate(light)
    right, wrong = _sure(found, surface_scene.inverse_depth())
    assert abs(right - _good()[1]) < 0.1
    assert wrong < 0.03


def test_wrong_poses_make_depths_less_sure() -> None:
    """Each view but that of the reference is seen 1 px away from where it is, in a direction by chance."""
    angle = np.random.default_rng(11).uniform(0, 2 * np.pi, len(NODES))
    turned = surface_scene.matrices()
    turned[:, 0, 2] += np.cos(angle) / FOCAL_PX
    turned[:, 1, 2] += np.sin(angle) / FOCAL_PX
    turned[12] = surface_scene.matrices()[12]
    found = _estimate(surface_scene.expected_light(LEVEL_E), turned)
    right, wrong = _sure(found, surface_scene.inverse_depth())
    good, good_right, good_wrong = _good()
    assert found.confidence.mean() < good.confidence.mean()
    assert right + wrong < good_right + good_wrong
    assert right > 0.1
    assert wrong <= 0.2 * (right + wrong)
    assert wrong < 0.05
