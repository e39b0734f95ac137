"""H of a surface: the operator contract, and planes, of which it is the general case."""

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray, ray_from_surface
from faintfield.calib.lens import Lens
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.placement import EDGE_TOLERANCE
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.surface_operator import SurfaceOperator
from tests.recon.operator_cases import Case, cases
from tests.recon.test_operator import LinearOperatorCheck

LENS = Lens((77, 31), 90.0, 90.0, 38.2, 15.1)
PITCH = 1 / LENS.fx_px
GRID = PlaneGrid((31, 77), PITCH, (-38.2 * PITCH, -15.1 * PITCH))
POSES = np.random.default_rng(7).uniform(-1, 1, (5, 6)) * np.repeat([0.06, 20.0], 3)


def surface_of(case: Case, inverse_depth: NDArray[np.float64]) -> SurfaceOperator:
    """The surface whose samples lie in the directions of those of the plane of a case."""
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
    """1/depth with a slope and bumps; of larger grids also with a step, and a sample without surface."""
    columns = case.grid.shape[1]
    bumps = np.random.default_rng(case.grid.shape).uniform(0.99, 1.01, case.grid.shape)
    inverse = np.asarray(bumps * np.linspace(0.9, 1.1, columns) / case.rt_ref_plane[5])
    if columns >= 12:
        inverse[:, 3 * columns // 4 :] *= 1.4
        inverse[0, 0] = np.nan
    return inverse


def compare(one: PlaneOperator, other: PlaneOperator, atol: float) -> None:
    """Check that two operators have the same numbers."""
    generator = np.random.default_rng(4)
    samples, images = generator.normal(size=one.samples_shape), generator.normal(size=one.images_shape)
    np.testing.assert_allclose(one.forward(samples), other.forward(samples), atol=atol)
    np.testing.assert_allclose(one.adjoint(images), other.adjoint(images), atol=atol)
    np.testing.assert_allclose(one.sensitivity(), other.sensitivity(), atol=atol)


@given(case=cases())
def test_every_surface_keeps_the_contract_of_a_linear_operator(
    case: Case, check_linear_operator: LinearOperatorCheck
) -> None:
    check_linear_operator(surface_of(case, rough(case)))


@given(case=cases())
def test_a_surface_of_one_depth_is_a_plane_up_to_its_borders(case: Case) -> None:
    facing = replace(case, rt_ref_plane=case.rt_ref_plane * [0, 0, 0, 0, 0, 1])
    compare(surface_of(case, np.full(case.grid.shape, 1 / case.rt_ref_plane[5])), facing.operator(), atol=1e-9)


def test_a_plane_before_sheared_views_is_the_same_surface() -> None:
    dtype = np.float64
    shift = np.random.default_rng(8).uniform(-0.1, 0.1, (5, 2))
    homographies = plane_from_ray(POSES, fronto_parallel_rt_ref_plane(400.0), shift)
    grid = PlaneGrid(GRID.shape, PITCH * 400, (-38.2 * PITCH * 400, -15.1 * PITCH * 400))
    plane = PlaneOperator(homographies, LENS.rays(), grid, dtype=dtype)
    flat = np.full(GRID.shape, 1 / 400)
    surface = SurfaceOperator(ray_from_surface(POSES, shift), LENS.rays(), GRID, flat, dtype=dtype)
    compare(surface, plane, atol=1e-9)
    same = SurfaceOperator(ray_from_surface(POSES), LENS.rays(), GRID, flat, dtype=dtype)
    assert np.abs(same.sensitivity() - plane.sensitivity()).max() > 0.5


@pytest.mark.parametrize("overshoot", [0.9, -1.1])
@pytest.mark.parametrize("axis", [0, 1])
def test_a_pixel_beside_the_samples_sees_their_edge_only_within_the_tolerance(overshoot: float, axis: int) -> None:
    at = np.full((1, 1, 2), 2.0)
    at[..., axis] = overshoot * EDGE_TOLERANCE + (0 if overshoot < 0 else 4)
    rays = np.concatenate([at, [[[1.5, 2.5]]]], axis=1)
    slope = 1e-3 * np.arange(25.0).reshape(5, 5)
    surface = SurfaceOperator(np.eye(3, 4)[np.newaxis], rays, PlaneGrid((5, 5), 1.0, (0, 0)), slope, dtype=np.float64)
    np.testing.assert_array_equal(surface.forward(np.ones((5, 5)))[0, 0], [float(abs(overshoot) < 1), 1])


@pytest.mark.parametrize("turned", [(0.0, 0.9, 0.0), (-0.4, -0.5, 0.3)])
def test_a_slanted_plane_is_seen_where_a_tilted_plane_is(turned: tuple[float, float, float]) -> None:
    rt_ref_plane = np.array([*turned, 3.0, -4.0, 400.0])
    plane_from_reference = plane_from_ray(np.zeros((1, 6)), rt_ref_plane)[0]
    column, row = np.meshgrid(np.arange(77.0), np.arange(31.0))
    direction = np.stack([GRID.origin_mm[0] + PITCH * column, GRID.origin_mm[1] + PITCH * row, np.ones_like(row)])
    on_plane = np.tensordot(plane_from_reference, direction, 1)  # (X, Y, 1), times the inverse of the depth
    surface = SurfaceOperator(ray_from_surface(POSES), LENS.rays(), GRID, on_plane[2], dtype=np.float64)
    grid = PlaneGrid((400, 400), 4.0, (-798.0, -798.0))
    plane = PlaneOperator(plane_from_ray(POSES, rt_ref_plane), LENS.rays(), grid, dtype=np.float64)
    x, y = np.meshgrid(*(grid.origin_mm[axis] + 4.0 * np.arange(400.0) for axis in (0, 1)))
    x_mm, y_mm = plane.forward(x), plane.forward(y)  # where each pixel meets the plane
    met = np.einsum("ij,jvrc->ivrc", np.linalg.inv(plane_from_reference), np.stack([x_mm, y_mm, np.ones_like(x_mm)]))
    expected = np.stack([met[0] / met[2] - GRID.origin_mm[0], met[1] / met[2] - GRID.origin_mm[1]]) / PITCH
    inside = ((expected > 0) & (expected < [[[[76]]], [[[30]]]])).all(axis=0) & (plane.forward(np.ones(grid.shape)) > 0)
    assert inside.sum() > 6000
    np.testing.assert_allclose(np.stack([surface.forward(column), surface.forward(row)])[:, inside].T,
                               expected[:, inside].T, atol=2e-3)  # fmt: skip
    np.testing.assert_array_equal(surface.forward(np.ones(GRID.shape))[inside], 1)
    # at the depth, too
    np.testing.assert_allclose(surface.inverse_depth_of_pixels()[inside], 1 / met[2][inside], rtol=1e-3)


GOOD: dict[str, Any] = {
    "ray_from_surface": ray_from_surface(POSES),
    "rays": LENS.rays(),
    "grid": GRID,
    "inverse_depth": np.full(GRID.shape, 1 / 400),
}


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"ray_from_surface": np.full((5, 3, 4), np.nan)}, "not a finite number"),
        ({"ray_from_surface": ray_from_surface(POSES) * [[1], [-1], [1]]}, "mirror image"),
        ({"inverse_depth": np.full((77, 31), 1 / 400)}, "inverse_depth has shape"),
        ({"inverse_depth": np.full(GRID.shape, -1 / 400)}, "zero or negative"),
        ({"inverse_depth": np.full(GRID.shape, np.nan)}, "no pixel of any of the 5 views"),
        ({"lattice_of_view": np.array([0, 0, 1, 0, 0])}, "lattices, counted from 0"),
    ],
)
def test_parts_of_a_surface_that_do_not_fit_are_refused(bad: dict[str, Any], words: str) -> None:
    SurfaceOperator(**GOOD)
    with pytest.raises(GeometryMismatch, match=words):
        SurfaceOperator(**{**GOOD, **bad})
