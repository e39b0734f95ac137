"""Small parts of the depth search: sums over views and over paths, and piecewise planes."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.interpolate import BSpline
from scipy.optimize import minimize
from scipy.sparse import csr_array

from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews, gather
from faintfield.recon.surface.regularization import PiecewisePlane, lowest, sum_over_paths

ONE_STEP, ANY_STEP = 0.7, 2.2
DIRECTIONS = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]


def _change(step: int) -> float:
    return 0.0 if step == 0 else min(ONE_STEP, ANY_STEP) if abs(step) == 1 else ANY_STEP


def _best_on_path(costs: NDArray[np.float32], at: tuple[int, int], direction: tuple[int, int], z: int) -> float:
    """Return the least cost of all paths of depths that end in z at a sample, coming from one direction."""
    before = at[0] - direction[0], at[1] - direction[1]
    own = float(costs[*at, z])
    if not (0 <= before[0] < costs.shape[0] and 0 <= before[1] < costs.shape[1]):
        return own
    ways = [_best_on_path(costs, before, direction, other) for other in range(costs.shape[2])]
    return own + min(way + _change(z - other) for other, way in enumerate(ways)) - min(ways)


def test_all_eight_paths_are_added_up() -> None:
    costs = np.random.default_rng(8).uniform(0, 4, (3, 4, 4)).astype(np.float32)
    expected = [
        sum(_best_on_path(costs, (row, column), direction, z) for direction in DIRECTIONS)
        for row, column, z in np.ndindex(*costs.shape)
    ]
    np.testing.assert_allclose(sum_over_paths(costs, ONE_STEP, ANY_STEP).ravel(), expected, rtol=1e-5)


def test_lowest_is_the_vertex_within_the_ends() -> None:
    vertices = np.array([[1.0, 2.3, 3.5, 4.74], [1.51, 2.49, -3.0, 9.0]], np.float32)
    costs = 3 * (np.arange(7, dtype=np.float32) - vertices[:, :, np.newaxis]) ** 2 - 5
    np.testing.assert_allclose(lowest(costs), np.clip(vertices, 0.5, 5.5), atol=1e-4)


def _plane(rows: int, columns: int) -> NDArray[np.float64]:
    row, column = np.indices((rows, columns))
    return 5 + 0.3 * column - 0.2 * row


def _differences(fields: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ∇u − w (right, down) and the symmetrised derivative of w (right, down, √2 times mixed), of u and w."""
    u, right, down = fields
    result = np.zeros((5, *u.shape))
    result[0, :, :-1], result[1, :-1] = np.diff(u, axis=1) - right[:, :-1], np.diff(u, axis=0) - down[:-1]
    result[2, :, 1:], result[3, 1:] = np.diff(right, axis=1), np.diff(down, axis=0)
    result[4, 1:] += np.diff(right, axis=0) / 2**0.5
    result[4, :, 1:] += np.diff(down, axis=1) / 2**0.5
    return result


@pytest.mark.parametrize("bend", [(0.5, 0.9), (1.5, 0.4)])  # a step that stays; a twist that is nearly a plane
def test_energy_reaches_scipys_minimum(bend: tuple[float, float]) -> None:
    target = np.random.default_rng(6).normal(0, 1, (4, 5)) + _plane(4, 5)
    target[:, 3:] += 4
    target += np.multiply.outer(np.arange(4), np.arange(5))
    weight = 0.8
    units = np.eye(3 * target.size).reshape(-1, 3, *target.shape)
    matrix = csr_array(np.stack([_differences(unit).ravel() for unit in units], axis=1))

    def energy(fields: NDArray[np.float64], tiny: float) -> tuple[float, NDArray[np.float64]]:
        """Return the sum that is minimised, its kinks rounded, and its gradient."""
        vectors = (matrix @ fields).reshape(5, *target.shape)
        slope, error = np.zeros_like(vectors), np.zeros((3, *target.shape))
        error[0] = fields[: target.size].reshape(target.shape) - target
        total = weight / 2 * float(np.sum(error**2))
        for part, strength in zip((np.s_[:2], np.s_[2:]), bend, strict=True):
            length = np.sqrt(np.sum(vectors[part] ** 2, axis=0) + tiny)
            total += strength * float(length.sum())
            slope[part] = strength * vectors[part] / np.maximum(length, 1e-30)
        return total, matrix.T @ slope.ravel() + weight * error.ravel()

    best = np.concatenate([target.ravel(), np.zeros(2 * target.size)])
    for tiny in (1e-2, 1e-4, 1e-6, 1e-8):
        best = minimize(energy, best, (tiny,), "BFGS", jac=True).x
    surface = PiecewisePlane(np.zeros_like(target))  # wherever it starts
    surface.approach(target, weight, bend, 4000)
    result = np.concatenate([surface.values.ravel(), surface.slopes.ravel()]).astype(float)
    assert abs(energy(result, 0)[0] / energy(best, 0)[0] - 1) < 1e-3
    np.testing.assert_allclose(surface.values, best[: target.size].reshape(target.shape), atol=0.01)
    assert np.ptp(surface.values) > 2  # neither the constant nor the target
    assert np.abs(surface.values - target).max() > 0.2


GRID = PlaneGrid((7, 9), 0.1, (-0.41, -0.29))
SHAPE = (8, 11)
Q = 0.002


# The quadratic B-spline of unit knots around zero
_SPLINE = BSpline.basis_element([-1.5, -0.5, 0.5, 1.5], extrapolate=False)


def _views(light: NDArray[np.floating] | None = None, count: int = 6) -> PinholeViews:
    """Return views that are turned, moved, and of different scale; their pictures cut samples off on every side."""
    generator = np.random.default_rng(7)
    matrices = np.zeros((count, 3, 4))
    matrices[:, :3, :3] = np.eye(3) + generator.uniform(-0.05, 0.05, (count, 3, 3))
    matrices[:, :, 3] = generator.uniform(-90, 90, (count, 3)) * [1, 1, 0.3]
    if light is None:
        light = generator.uniform(1, 9, (count, *SHAPE))
        light[generator.random(light.shape) < 0.03] = UNKNOWN
    nodes = np.argwhere(np.ones((1, count)))
    return PinholeViews(light.astype(np.float32), 1.5, matrices, (11.0, 10.0), (5.2, 3.4), GRID, nodes)


def _place(views: PinholeViews, view: int, row: int, column: int) -> tuple[float, float]:
    """Return row and column at which a view sees a sample."""
    x, y = GRID.origin_mm[0] + GRID.pitch_mm * column, GRID.origin_mm[1] + GRID.pitch_mm * row
    ray = views.ray_from_surface[view] @ [x, y, 1, Q]
    (fx, fy), (cx, cy) = views.focal_px, views.centre_px
    return fy * ray[1] / ray[2] + cy, fx * ray[0] / ray[2] + cx


def _summed(
    views: PinholeViews,
    pictures: NDArray[np.float32],
    relief: NDArray[np.float32],
    tolerance: NDArray[np.float32],
    half: NDArray[np.intp],
) -> NDArray[np.float64]:
    sums = np.zeros((2, 1 + pictures.shape[3], *GRID.shape))
    for view, row, column in np.ndindex(len(pictures), *GRID.shape):
        down, right = _place(views, view, row, column)
        i, j = round(down), round(right)
        if not (1 <= i < SHAPE[0] - 1 and 1 <= j < SHAPE[1] - 1) or relief[view, i, j] > Q + tolerance[view]:
            continue
        around = pictures[view, i - 1 : i + 2, j - 1 : j + 2].astype(float)
        if (around[:, :, 0] == UNKNOWN).any():
            continue
        rows, columns = (_SPLINE(np.arange(-1, 2) - off) for off in (down - i, right - j))
        sums[half[view], 0, row, column] += 1
        sums[half[view], 1:, row, column] += np.einsum("i,j,ijn->n", rows, columns, around)
    return sums


@pytest.mark.parametrize("numbers", [1, 2])
def test_sums_are_of_each_sample_interpolated(numbers: int) -> None:
    views, generator = _views(), np.random.default_rng(1)
    more = generator.normal(0, 5, (6, *SHAPE, numbers - 1))
    pictures = np.concatenate([views.light_e[..., np.newaxis], more], axis=-1).astype(np.float32)
    relief = np.where(generator.random((6, *SHAPE)) < 0.2, 0.0045, 0.001).astype(np.float32)
    tolerance = np.array([0, 0.001, 0.001, 0.002, 0.003, 0.001], np.float32)  # the fifth view is one that nothing hides
    half = np.array([0, 1, 1, 0, 1, 0])
    expected = _summed(views, pictures, relief, tolerance, half)
    assert 0 < expected[:, 0].min(initial=9, where=expected[:, 0] > 0) < expected[:, 0].max() == 3
    np.testing.assert_allclose(gather(views, pictures, Q, relief, tolerance, half), expected, rtol=2e-5, atol=2e-4)


@pytest.mark.parametrize(("relief_above", "visible"), [(-0.001, True), (0.00099, True), (0.00101, False)])
def test_only_relief_nearer_than_tolerance_hides(relief_above: float, visible: bool) -> None:
    views = _views(np.ones((6, *SHAPE)))
    relief = np.full((6, *SHAPE), Q + relief_above, np.float32)
    tolerance, half = np.full(6, 0.001, np.float32), np.zeros(6, np.intp)
    sums = gather(views, views.light_e[..., np.newaxis], Q, relief, tolerance, half)
    assert (sums[0, 0].max() == 6) == visible
    assert (sums == 0).all() == (not visible)


def test_bins_add_light_of_their_pixels() -> None:
    generator = np.random.default_rng(3)
    light = generator.uniform(1, 9, (6, *SHAPE)).astype(np.float32)
    light[2, 3, 4:6] = UNKNOWN
    light[4, 0, 0] = UNKNOWN
    views = _views(light)
    binned = views.binned(2)
    assert binned.light_e.shape == (6, 4, 5)
    assert binned.light_e[1, 2, 3] == pytest.approx(light[1, 4:6, 6:8].sum(), rel=1e-6)
    assert np.argwhere(binned.light_e == UNKNOWN).tolist() == [[2, 1, 2], [4, 0, 0]]
    assert binned.light_e[binned.light_e != UNKNOWN].min() > 0
    assert binned.variance_e2 == 4 * 1.5
    assert binned.grid == GRID.binned(2)
    # A bin looks where its four pixels look on average
    np.testing.assert_allclose(
        binned.rays(), views.rays()[:8, :10].reshape(4, 2, 5, 2, 2).mean(axis=(1, 3)), rtol=1e-5, atol=1e-6
    )
    assert views.binned(1) is views


def test_reach_is_samples_moved_per_inverse_depth() -> None:
    matrices = np.stack([np.eye(3, 4)] * 2)
    matrices[1, :2, 3] = -30, 40
    light, nodes = np.ones((2, *SHAPE), np.float32), np.array([(0, 0), (0, 1)])
    views = PinholeViews(light, 1.0, matrices, (10.0, 10.0), (5.0, 3.5), GRID, nodes)
    np.testing.assert_allclose(views.reach, [0, 50 / 0.1], rtol=1e-6)  # samples are 0.1 apart
