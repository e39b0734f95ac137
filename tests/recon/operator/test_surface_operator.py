"""H of a surface: the operator contract, planes, of which it is the general case, and rays cast one by one."""

from dataclasses import replace
from functools import cache
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from numpy.typing import NDArray

from faintfield.calib.homography import ray_from_surface
from faintfield.calib.lens import Lens
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, LikelihoodName, PixelLikelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.placement import EDGE_TOLERANCE
from faintfield.recon.operator.surface_operator import SurfaceOperator
from faintfield.recon.solver.data_fit import DataFit
from tests.recon import step_scene
from tests.recon.operator_cases import Case, cases
from tests.recon.operator_contract import check_linear_operator
from tests.recon.step_scene import FAR, NEAR, NEITHER, SHAPE

LENS = Lens((77, 31), 90.0, 90.0, 38.2, 15.1)
LENS_PITCH = 1 / LENS.fx_px
LENS_GRID = PlaneGrid((31, 77), LENS_PITCH, (-38.2 * LENS_PITCH, -15.1 * LENS_PITCH))
POSES = np.random.default_rng(7).uniform(-1, 1, (5, 6)) * np.repeat([0.06, 20.0], 3)


def surface_of(case: Case, inverse_depth: NDArray[np.float64]) -> SurfaceOperator:
    """Return the surface whose samples lie in the directions of those of the plane of a case."""
    depth_mm, grid = float(case.rt_ref_plane[5]), case.grid
    x, y = grid.origin_mm
    return SurfaceOperator(
        ray_from_surface(case.rt_cam_ref),
        case.rays,
        PlaneGrid(grid.shape, grid.pitch_mm / depth_mm, (x / depth_mm, y / depth_mm)),
        inverse_depth,
        flat=case.flat,
        valid=case.valid,
        lattice_of_view=case.lattice_of_view,
        dtype=np.float64,
        workers=case.workers,
    )


def rough(case: Case) -> NDArray[np.float64]:
    """Return 1/depth with a slope and bumps; of larger grids also with a step, and a sample without surface."""
    columns = case.grid.shape[1]
    bumps = np.random.default_rng(case.grid.shape).uniform(0.99, 1.01, case.grid.shape)
    inverse = np.asarray(bumps * np.linspace(0.9, 1.1, columns) / case.rt_ref_plane[5])
    if columns >= 12:
        inverse[:, 3 * columns // 4 :] *= 1.4
        inverse[0, 0] = np.nan
    return inverse


@pytest.mark.parametrize("overshoot", [0.9, -1.1])
@pytest.mark.parametrize("axis", [0, 1])
def test_pixel_sees_edge_only_within_tolerance(overshoot: float, axis: int) -> None:
    at = np.full((1, 1, 2), 2.0)
    at[..., axis] = overshoot * EDGE_TOLERANCE + (0 if overshoot < 0 else 4)
    rays = np.concatenate([at, [[[1.5, 2.5]]]], axis=1)
    slope = 1e-3 * np.arange(25.0).reshape(5, 5)
    surface = SurfaceOperator(np.eye(3, 4)[np.newaxis], rays, PlaneGrid((5, 5), 1.0, (0, 0)), slope, dtype=np.float64)
    np.testing.assert_array_equal(surface.forward(np.ones((5, 5)))[0, 0], [float(abs(overshoot) < 1), 1])


PITCH = 1 / step_scene.FOCAL_PX
GRID = PlaneGrid(SHAPE, PITCH, (-step_scene.AXIS[0] * PITCH, -step_scene.AXIS[1] * PITCH))


@cache
def poses() -> NDArray[np.float64]:
    """Return a grid of 5 x 3 views, not symmetric, all but three of them turned and off their plane."""
    x_mm, y_mm = np.meshgrid([-60.0, -20.0, 0.0, 30.0, 60.0], [-40.0, 0.0, 50.0])
    generator, result = np.random.default_rng(2), np.zeros((15, 6))
    result[:, 3], result[:, 4] = -x_mm.ravel(), -y_mm.ravel()
    result[3:, :3], result[3:, 5] = generator.uniform(-0.03, 0.03, (12, 3)), generator.uniform(-9, 9, 12)
    return result


def operator_of_step(inverse_depth: NDArray[np.float64] | None = None, **options: Any) -> SurfaceOperator:
    inverse_depth = step_scene.picture()[1] if inverse_depth is None else inverse_depth
    return SurfaceOperator(
        ray_from_surface(poses()), step_scene.rays(), GRID, inverse_depth, **{"dtype": np.float64, **options}
    )


@cache
def cast_views() -> tuple[NDArray[np.int_], NDArray[np.float64], NDArray[np.bool_]]:
    """Return what pixels (view, row, column) sees, its light, and which pixels are two pixels away from all edges."""
    sights = [step_scene.cast(rt) for rt in poses()]
    what = np.stack([sight.what for sight in sights])
    away = [(x, y) for x in (-2.0, -1.0, 0.0, 1.0, 2.0) for y in (-2.0, -1.0, 0.0, 1.0, 2.0)]
    same = [np.stack([step_scene.cast(rt, shift).what for rt in poses()]) == what for shift in away]
    return what, np.stack([sight.light for sight in sights]), np.all(same, axis=0)


@pytest.mark.parametrize(("dtype", "atol"), [(np.float64, 1e-9), (np.float32, 1e-4)])
def test_pixels_away_from_edges_see_the_nearest_surface(
    dtype: type[np.float32] | type[np.float64], atol: float
) -> None:
    what, light, clear = cast_views()
    assert min((clear & (what == kind)).sum() for kind in (NEAR, FAR, NEITHER)) > 5000
    light_e = operator_of_step(dtype=dtype).forward(step_scene.picture()[0].astype(dtype))
    np.testing.assert_allclose(light_e[clear], light[clear], atol=atol)


def test_depth_of_pixels_is_that_of_cast_rays() -> None:
    what, _, clear = cast_views()
    expected = np.choose(what, [0, 1 / step_scene.NEAR_MM, 1 / step_scene.FAR_MM])
    np.testing.assert_allclose(operator_of_step().inverse_depth_of_pixels()[clear], expected[clear], atol=1e-7)


def test_few_pixels_are_lost_at_edges() -> None:
    what, light, _ = cast_views()
    operator = operator_of_step()
    light_e, sees = operator.forward(step_scene.picture()[0]), operator.forward(np.ones(SHAPE)) > 0
    left, right, top, bottom = step_scene.EDGES_PX
    # Views see the edge of the square as long as the reference view does
    edge_px = 2 * len(what) * ((right - left) + (bottom - top))
    there = what != NEITHER
    lost, invented = there & ~sees, ~there & sees
    wrong = there & sees & (np.abs(light_e - light) > 0.1)
    assert 0 < lost.sum() <= 1.75 * edge_px
    assert wrong.sum() + invented.sum() <= 0.12 * edge_px


def test_surface_is_torn_at_steps_not_at_slopes() -> None:
    """Parallax of 1.5 samples per sample, light_e from the side from which it looks wide, and a step of 1.5 samples."""
    column = np.arange(60.0)
    centre = -1.0  # mm, along x
    for inverse, whole in ((1.5 * column, True), (np.where(column < 30, 0.0, 1.5), False)):
        matrices = np.array([np.eye(3, 4)])
        matrices[0, 0, 3] = -centre
        rays = np.stack(np.meshgrid(np.arange(1.0, 58.0, 0.5), [1.0, 2.0]), axis=-1)
        surface = SurfaceOperator(
            matrices, rays, PlaneGrid((4, 60), 1.0, (0.0, 0.0)), np.tile(inverse, (4, 1)), dtype=np.float64
        )
        light_e = surface.forward(np.tile(column, (4, 1)))[0, 0]
        if whole:
            np.testing.assert_allclose(light_e, rays[0, :, 0] / 2.5, atol=1e-3)
        else:
            between = (rays[0, :, 0] > 29) & (rays[0, :, 0] < 31.5)
            np.testing.assert_array_equal(light_e[between], 0)
            assert (light_e > 0).sum() >= (~between).sum() - 4


@pytest.mark.parametrize("name", ["shifted-poisson", "poisson-gaussian", "least-squares"])
def test_pixels_that_see_nothing_leave_likelihood_unchanged(name: LikelihoodName) -> None:
    operator, truth = operator_of_step(), step_scene.picture()[0]
    sees = operator.forward(np.ones(SHAPE)) > 0
    assert 5000 < (~sees).sum() < sees.size / 3
    likelihood = PixelLikelihood(name, level_e=5.0) if name == "least-squares" else PixelLikelihood(name)
    generator = np.random.default_rng(3)
    electrons = generator.normal(5.0, 3.0, operator.images_shape)
    results = []
    for other in (0.0, -50.0, 1000.0):
        images = ElementalImages(np.where(sees, electrons, other), 0.5, 2.0, likelihood=likelihood)
        fit = DataFit(operator, images, 5.0)
        value, gradient = fit.value_and_gradient(truth)
        held_out = operator.negative_log_likelihood(truth, images, [0, 4, 11])
        results.append(np.concatenate([[value, held_out], gradient.ravel(), fit.metric(truth).ravel()]))
    np.testing.assert_array_equal(results[1], results[0])
    np.testing.assert_array_equal(results[2], results[0])
    assert np.isfinite(results[0]).all()


@pytest.mark.parametrize(
    ("nearest_mm", "farthest_mm", "error_px"), [(300.0, 455.0, 0.01), (870.0, np.inf, 0.01), (300.0, np.inf, 0.03)]
)
def test_rounding_of_depths_moves_pixels_little(nearest_mm: float, farthest_mm: float, error_px: float) -> None:
    """A corner view of 7 x 7 at a pitch of 50 mm, 6000 px at a focal length of 7500 px, and a slanted plane."""
    centre_mm, pitch = 150.0, 20 / 7500
    near, far = 1 / nearest_mm, 1 / farthest_mm
    grid = PlaneGrid((4, 301), pitch, (-0.4, -0.01))
    x = grid.origin_mm[0] + pitch * np.arange(301)
    slope = (near - far) / (x[-1] - x[0])
    inverse = np.tile(far + slope * (x - x[0]), (4, 1))
    matrices = np.eye(3, 4)[np.newaxis].copy()
    matrices[0, 0, 3] = -centre_mm
    # Rays through points spread over the plane
    at = np.random.default_rng(6).uniform(x[3], x[-4], 20_000)
    depth = far + slope * (at - x[0])
    rays = np.stack([at - centre_mm * depth, np.full_like(at, -0.005)], axis=-1)[np.newaxis]
    surface = SurfaceOperator(matrices, rays, grid, inverse, dtype=np.float64)
    result = surface.forward(np.tile(x, (4, 1)))[0, 0]
    inside = result != 0
    worst_px = 7500 * np.abs(result[inside] - at[inside]).max()
    assert inside.mean() > 0.99
    assert worst_px < error_px
    assert worst_px > 0.5 * error_px
    # Of the parallax: half a code, and what float32 adds
    assert 7500 * np.abs(surface.inverse_depth_of_pixels()[0, 0] - depth).max() * centre_mm < 1.05 * error_px


@settings(max_examples=12)
@given(case=cases())
def test_every_surface_keeps_the_operator_contract(case: Case) -> None:
    check_linear_operator(surface_of(case, rough(case)))


@settings(max_examples=15)
@given(case=cases())
def test_surface_of_one_depth_is_a_plane(case: Case) -> None:
    plane = replace(case, rt_ref_plane=case.rt_ref_plane * [0, 0, 0, 0, 0, 1]).operator()
    surface = surface_of(case, np.full(case.grid.shape, 1 / case.rt_ref_plane[5]))
    generator = np.random.default_rng(4)
    samples, images = generator.normal(size=plane.samples_shape), generator.normal(size=plane.images_shape)
    np.testing.assert_allclose(surface.forward(samples), plane.forward(samples), atol=1e-9)
    np.testing.assert_allclose(surface.adjoint(images), plane.adjoint(images), atol=1e-9)
    np.testing.assert_allclose(surface.sensitivity(), plane.sensitivity(), atol=1e-9)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"ray_from_surface": np.full((5, 3, 4), np.nan)}, "not a finite number"),
        ({"ray_from_surface": ray_from_surface(POSES) * [[1], [-1], [1]]}, "mirror image"),
        ({"inverse_depth": np.full((77, 31), 1 / 400)}, "inverse_depth has shape"),
        ({"inverse_depth": np.full(LENS_GRID.shape, -1 / 400)}, "zero or negative"),
    ],
)
def test_parts_that_do_not_fit_are_refused(bad: dict[str, Any], words: str) -> None:
    inverse_depth = np.full(LENS_GRID.shape, 1 / 400)
    good: dict[str, Any] = {"ray_from_surface": ray_from_surface(POSES), "inverse_depth": inverse_depth}
    SurfaceOperator(rays=LENS.rays(), grid=LENS_GRID, **good)
    with pytest.raises(GeometryMismatch, match=words):
        SurfaceOperator(rays=LENS.rays(), grid=LENS_GRID, **{**good, **bad})
