"""Slanted, curved and thin objects: closed forms, rays followed step by step, and views that agree with the depth."""

from collections.abc import Callable
from dataclasses import replace

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.rig.simulation.experiment import surface_experiment
from faintfield.rig.simulation.optics import SimulatedOptics
from faintfield.rig.simulation.scene import RenderedView
from faintfield.rig.simulation.surfaces import (
    Cylinder,
    Rectangle,
    Shape,
    Sphere,
    Surface,
    render_surfaces,
    true_depth_mm,
)

type Points = NDArray[np.float64]

PINHOLE = SimulatedOptics((41, 31), 100.0, 100.0, 20.0, 15.0, vignetting=False)
AT_REFERENCE = np.zeros(6)

BALL = Sphere((30.0, -20.0, 400.0), 60.0)
ROD = Cylinder((-60.0, 50.0, 420.0), (70.0, -40.0, 330.0), 12.0)
PAGE = Rectangle((0.3, -0.5, 0.2, 10.0, -15.0, 350.0), (50.0, 30.0))


def outside_ball(points: Points) -> Points:
    """Signed distance of points (point, 3) from the ball."""
    return np.asarray(np.linalg.norm(points - [30, -20, 400], axis=1) - 60)


def outside_rod(points: Points) -> Points:
    """Distance from the rod, as positive as it is beyond an end."""
    start, end = np.array([-60.0, 50, 420]), np.array([70.0, -40, 330])
    length = np.linalg.norm(end - start)
    height = (points - start) @ (end - start) / length
    across = np.linalg.norm(np.cross(points - start, (end - start) / length), axis=1) - 12
    return np.asarray(np.maximum(across, np.abs(height - length / 2) - length / 2))


def beyond_page(points: Points) -> Points:
    """Distance from a page 1 mm thick, positive before, beside and behind it."""
    x, y, z = Rotation.from_rotvec([0.3, -0.5, 0.2]).inv().apply(points - [10, -15, 350]).T
    return np.asarray(np.maximum.reduce([-z, z - 1, np.abs(x) - 50, np.abs(y) - 30]))


SHAPES: dict[str, tuple[Shape, Callable[[Points], Points]]] = {
    "ball": (BALL, outside_ball),
    "rod": (ROD, outside_rod),
    "page": (PAGE, beyond_page),
}


def painted(name: str, shape: Shape, reflectance: float) -> Surface:
    return Surface(name, shape, np.full((4, 4), reflectance, np.float32), 1.0)


def view_of(
    surfaces: list[Surface], optics: SimulatedOptics = PINHOLE, pose: Points = AT_REFERENCE, samples_per_px: int = 1
) -> RenderedView:
    return next(render_surfaces(surfaces, optics, pose[np.newaxis], samples_per_px=samples_per_px))


@pytest.mark.parametrize("name", SHAPES)
def test_rays_meet_a_shape_as_stepwise_tracing_does(name: str) -> None:
    shape, outside = SHAPES[name]
    generator = np.random.default_rng(1)
    origin = np.array([15.0, -25.0, -40.0])
    directions = np.vstack([generator.uniform(-0.25, 0.25, (2, 400)), np.ones(400)])
    distances = np.asarray(shape.meet(origin, directions), np.float64)
    steps = np.arange(250.0, 600.0, 0.25)
    followed = np.full(400, np.inf)
    for ray, direction in enumerate(directions.T):
        inside = np.flatnonzero(outside(origin + steps[:, np.newaxis] * direction) < 0)
        if inside.size:
            followed[ray] = steps[inside[0]]
    met, hit = np.isfinite(followed), np.isfinite(distances)
    assert 30 < met.sum() < 360
    # Rays may graze the shape for less than a step, or enter the open end of the rod
    assert (hit != met).sum() <= 8
    both = met & hit
    assert np.abs((followed[both] - distances[both]) - 0.125).max() < 0.126
    points = (origin[:, np.newaxis] + distances[both] * directions[:, both]).T
    assert np.abs(outside(points)).max() < 1e-9


def test_shape_behind_or_around_the_camera_is_unmet() -> None:
    ahead = np.array([[0.0], [0.0], [1.0]])
    for shape in (Sphere((0, 0, -300), 50), Rectangle((0, 0, 0, 0, 0, -300)), Cylinder((-9, 0, -50), (9, 0, -50), 5)):
        assert np.isinf(shape.meet(np.zeros(3), ahead)).all()
        assert np.isfinite(shape.meet(np.array([0, 0, -500.0]), ahead)).all()
    assert np.isinf(Sphere((0, 0, 0), 50).meet(np.zeros(3), ahead)).all()


@pytest.mark.parametrize("name", SHAPES)
def test_normals_are_where_the_distance_grows_fastest(name: str) -> None:
    shape, outside = SHAPES[name]
    directions = np.vstack([np.random.default_rng(2).uniform(-0.1, 0.1, (2, 200)), np.ones(200)])
    scale = shape.meet(np.zeros(3), directions)
    points = (scale * directions)[:, np.isfinite(scale)]
    assert points.shape[1] > 20
    normals = shape.normals(points)
    step = 1e-4
    growth = [
        (outside((points + step * axis[:, np.newaxis]).T) - outside((points - step * axis[:, np.newaxis]).T)) / 2 / step
        for axis in np.eye(3)
    ]
    np.testing.assert_allclose(normals, growth, atol=1e-5)
    assert (np.sum(normals * points, axis=0) < 0).all()  # towards the camera


def test_texture_is_interpolated_and_repeats() -> None:
    tile = np.random.default_rng(3).random((5, 7)).astype(np.float32)
    facing = Surface("wall", Rectangle((0, 0, 0, 0, 0, 500.0)), tile, 2.0)
    x, y = np.array([0.0, 6.0, 3.0, 6.0 + 14, -4.0]), np.array([0.0, 4.0, 0.0, 4.0 - 10, 0.0])
    light = facing.light(np.stack([x, y, np.full(5, 500.0)]))
    shade = light[0] / tile[0, 0]
    expected = [tile[0, 0], tile[2, 3], (tile[0, 1] + tile[0, 2]) / 2, tile[2, 3], tile[0, 5]]
    np.testing.assert_allclose(light / shade, expected, rtol=1e-5)


def test_light_is_that_of_half_a_sky() -> None:
    normals = np.random.default_rng(4).standard_normal((3, 500))
    normals /= np.linalg.norm(normals, axis=0)
    light = painted("ball", BALL, 0.8).light(60 * normals + np.array([[30.0], [-20.0], [400.0]]))
    # A plane whose normal is at θ to the middle of a bright half receives (1 + cos θ) / 2 of what faces it receives
    fitted, *_ = np.linalg.lstsq(np.vstack([normals, np.ones(500)]).T, light / 0.8, rcond=None)
    assert fitted[3] == pytest.approx(0.5, abs=1e-6)
    assert np.linalg.norm(fitted[:3]) == pytest.approx(0.5, abs=1e-6)
    assert (fitted[:3] < 0).all()  # from above, left, and the camera's side
    np.testing.assert_allclose(normals.T @ fitted[:3] + 0.5, light / 0.8, atol=1e-6)


@pytest.mark.parametrize("reverse", [False, True])
def test_nearer_surfaces_hide_farther_ones(reverse: bool) -> None:
    wall, rod = painted("wall", Rectangle((0, 0, 0, 0, 0, 500.0)), 0.5), painted("rod", ROD, 0.9)
    surfaces = [rod, wall][:: -1 if reverse else 1]
    both, alone = view_of(surfaces), view_of([rod])
    covered = alone.visible["rod"] == 1
    assert 50 < covered.sum() < 600
    np.testing.assert_array_equal(both.visible["wall"], ~covered)
    np.testing.assert_array_equal(both.light[covered], alone.light[covered])
    np.testing.assert_allclose(both.light[~covered], both.light[0, 0])
    depth = true_depth_mm(surfaces, PINHOLE)
    np.testing.assert_array_equal(depth < 499.9, covered)
    # From behind, the wall hides the rod
    from_behind = np.array([0.0, np.pi, 0.0, 0.0, 0.0, 900.0])
    assert not view_of(surfaces, pose=from_behind).visible["rod"].any()


def smooth(surface: Surface) -> Surface:
    """The surface with waves in place of its texture, which reading between pixels does not blur."""
    rows, columns = 2 * np.pi * np.indices((64, 64)) / 64
    return replace(
        surface, reflectance=(0.5 + 0.2 * np.sin(rows) + 0.2 * np.cos(columns)).astype(np.float32), pitch_mm=4
    )


@pytest.mark.parametrize("view", [0, 45])
def test_views_are_the_reference_moved_by_true_depth(view: int) -> None:
    experiment = surface_experiment(120, 90).grey()
    optics, surfaces = experiment.optics.ideal(), [smooth(surface) for surface in experiment.surfaces]
    pose = experiment.poses_rt_cam_ref(0.3, 3.5e-3, np.random.default_rng(5))[view]
    reference, moved = view_of(surfaces, optics), view_of(surfaces, optics, pose)
    depth = true_depth_mm(surfaces, optics)

    def share_that_agrees(depth_mm: Points) -> float:
        points = np.dstack([optics.rays().astype(float), np.ones(depth.shape)]) * depth_mm[..., np.newaxis]
        x, y, z = (Rotation.from_rotvec(pose[:3]).apply(points.reshape(-1, 3)) + pose[3:]).T.reshape(3, *depth.shape)
        to = (
            (x / z * optics.fx_px + optics.cx_px).astype(np.float32),
            (y / z * optics.fy_px + optics.cy_px).astype(np.float32),
        )
        light = cv2.remap(moved.light, *to, cv2.INTER_LINEAR, borderValue=np.nan)
        # The object that the reference shows is all that the view shows there
        same = np.zeros(depth.shape, bool)
        for name, visible in moved.visible.items():
            same |= (cv2.remap(visible, *to, cv2.INTER_LINEAR, borderValue=0) == 1) & (reference.visible[name] == 1)
        assert same.mean() > 0.3
        return float(np.mean(np.abs(light - reference.light)[same] < 0.01))

    assert share_that_agrees(depth) > 0.98
    assert share_that_agrees(1.03 * depth) < 0.7


def test_colours_are_independent_and_grey_their_mean() -> None:
    coloured = surface_experiment(40, 30)
    light = next(coloured.render(np.zeros((1, 6)))).light
    assert light.shape == (30, 40, 3)
    for channel in range(3):
        alone = [replace(surface, reflectance=surface.reflectance[..., channel]) for surface in coloured.surfaces]
        alone_light = view_of(alone, coloured.optics, samples_per_px=2).light
        np.testing.assert_allclose(light[..., channel], alone_light, atol=1e-6)
    np.testing.assert_allclose(next(coloured.grey().render(np.zeros((1, 6)))).light, light.mean(axis=2), atol=1e-6)
