"""H as a linear operator of scipy and of pylops, against matrices built without it."""

from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from scipy.sparse.linalg import lsmr

from faintfield import linear_operator
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.surface_operator import SurfaceOperator
from tests.recon.operator.test_single_plane import matrix_by_ray_casting
from tests.recon.operator_cases import Case, cases
from tests.recon.small_problems import SHAPE, problem, two_planes

_VIEWS = [5, 0, 3]


@settings(max_examples=15)
@given(case=cases(max_rows=5, max_columns=7))
def test_columns_are_those_of_traced_rays(case: Case) -> None:
    """Masks, responses and lattices are in the rows; the order is view, row, column and row, column."""
    dense, flat = matrix_by_ray_casting(case), linear_operator(case.operator())
    assert flat.shape == dense.shape
    np.testing.assert_allclose(flat @ np.eye(flat.shape[1]), dense, atol=1e-9)
    np.testing.assert_allclose(flat.T @ np.eye(flat.shape[0]), dense.T, atol=1e-9)


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_transpose_and_dtype_are_those_of_plane(dtype: Any) -> None:
    operator = problem(dtype=dtype).operator
    flat, rng = linear_operator(operator), np.random.default_rng(4)
    x, y = rng.normal(size=flat.shape[1]).astype(dtype), rng.normal(size=flat.shape[0]).astype(dtype)
    image, back = flat @ x, flat.T @ y
    assert image.dtype == back.dtype == flat.dtype == dtype
    assert np.vdot(image, y) == pytest.approx(np.vdot(x, back), rel=1e-4 if dtype == np.float32 else 1e-12)
    np.testing.assert_array_equal(image.reshape(flat.dimsd), operator.forward(x.reshape(SHAPE)))
    np.testing.assert_array_equal(back.reshape(flat.dims), operator.adjoint(y.reshape(operator.images_shape)))


def test_views_are_rows_in_their_order() -> None:
    posed = problem()
    flat = linear_operator(posed.operator, _VIEWS)
    rows = posed.matrix.reshape(*posed.operator.images_shape, -1)[_VIEWS].reshape(flat.shape)
    np.testing.assert_allclose(flat @ np.eye(flat.shape[1]), rows, atol=1e-12)
    np.testing.assert_allclose(flat.T @ np.eye(flat.shape[0]), rows.T, atol=1e-12)
    with pytest.raises(IndexError):
        linear_operator(posed.operator, [12])


def _surface() -> SurfaceOperator:
    plane = problem().operator
    steps = np.where(np.arange(SHAPE[1]) < 6, 1.0, 0.8) * np.ones(SHAPE)
    poses = np.stack([np.eye(3, 4)] * 3)
    poses[:, 0, 3] = 0, 1, -1
    rays = np.stack(np.meshgrid(np.arange(-1.0, 13.0), np.arange(-1.0, 10.0)), axis=-1)
    return SurfaceOperator(poses, rays, plane.grid, steps, dtype=np.float64, workers=1)


@pytest.mark.parametrize("operator", [two_planes().operator, two_planes(occluded=True).operator, _surface()])
def test_scenes_and_surfaces_have_transposes(operator: SceneOperator) -> None:
    flat = linear_operator(operator)
    forward = flat @ np.eye(flat.shape[1])
    assert forward.any()
    np.testing.assert_allclose(flat.T @ np.eye(flat.shape[0]), forward.T, atol=1e-12)


def test_scipy_solves_least_squares() -> None:
    posed = problem()
    flat, damping = linear_operator(posed.operator), 2.0
    normal = posed.matrix.T @ posed.matrix + damping**2 * np.eye(flat.shape[1])
    expected = np.linalg.solve(normal, posed.matrix.T @ posed.images.electrons.ravel())
    solution = lsmr(flat, posed.images.electrons.ravel(), damp=damping, atol=1e-12, btol=1e-12)[0]
    np.testing.assert_allclose(solution, expected, atol=1e-8)


@pytest.mark.parametrize(("dtype", "rounding"), [(np.float32, 1e-4), (np.float64, 1e-10)])
def test_pylops_takes_shapes_of_both_sides(dtype: Any, rounding: float) -> None:
    pylops = pytest.importorskip("pylops")
    posed = problem(dtype=dtype)
    operator = pylops.LinearOperator(linear_operator(posed.operator))
    assert (operator.dims, operator.dimsd, operator.dtype) == (SHAPE, posed.operator.images_shape, dtype)
    assert pylops.utils.dottest(operator, rtol=rounding)
    plane = np.random.default_rng(5).normal(size=SHAPE).astype(dtype)
    expected = (posed.matrix @ plane.ravel()).reshape(posed.operator.images_shape)
    np.testing.assert_allclose(operator @ plane, expected, atol=10 * rounding)
