"""Consistent depths: sums over paths against dynamic programmes in plain Python; piecewise planes against scipy."""

from itertools import pairwise, product

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array

from faintfield.recon.surface.generalized_variation import PiecewisePlane
from faintfield.recon.surface.paths import lowest, sum_over_paths

ONE_STEP, ANY_STEP = 0.7, 2.2
DIRECTIONS = [(down, right) for down in (-1, 0, 1) for right in (-1, 0, 1) if down or right]


def _costs(*shape: int) -> NDArray[np.float32]:
    return np.random.default_rng(8).uniform(0, 4, shape).astype(np.float32)


def _change(step: int) -> float:
    return 0.0 if step == 0 else min(ONE_STEP, ANY_STEP) if abs(step) == 1 else ANY_STEP


def _best_on_path(costs: NDArray[np.float32], at: tuple[int, int], came: tuple[int, int], z: int) -> float:
    """Least cost of all paths of depths that end in z at a sample, coming from one direction."""
    before = at[0] - came[0], at[1] - came[1]
    own = float(costs[*at, z])
    if not (0 <= before[0] < costs.shape[0] and 0 <= before[1] < costs.shape[1]):
        return own
    ways = [_best_on_path(costs, before, came, other) for other in range(costs.shape[2])]
    return own + min(way + _change(z - other) for other, way in enumerate(ways)) - min(ways)


def test_all_eight_paths_are_added_up() -> None:
    costs = _costs(3, 4, 4)
    expected = [
        sum(_best_on_path(costs, (row, column), came, z) for came in DIRECTIONS)
        for row, column, z in np.ndindex(*costs.shape)
    ]
    np.testing.assert_allclose(sum_over_paths(costs, ONE_STEP, ANY_STEP).ravel(), expected, rtol=1e-5)


@pytest.mark.parametrize("upright", [False, True])
def test_a_single_row_has_the_costs_of_its_best_chains(upright: bool) -> None:
    """The two paths along a row meet at a sample: together they tell the best chain through each of its depths."""
    costs = _costs(1, 6, 5)
    chains = np.full((6, 5), np.inf)
    for labels in product(range(5), repeat=6):
        energy = sum(float(costs[0, at, z]) for at, z in enumerate(labels))
        energy += sum(_change(b - a) for a, b in pairwise(labels))
        for at, z in enumerate(labels):
            chains[at, z] = min(chains[at, z], energy)
    given = costs.transpose(1, 0, 2).copy() if upright else costs
    found = sum_over_paths(given, ONE_STEP, ANY_STEP).reshape(6, 5) - 7 * costs[0]  # the other six paths start here
    np.testing.assert_allclose(
        found - found.min(axis=1, keepdims=True), chains - chains.min(axis=1, keepdims=True), atol=1e-4
    )


def test_the_vertex_of_a_parabola_is_found() -> None:
    vertices = np.array([[1.0, 2.3, 3.5, 4.74], [1.51, 2.49, 3.0, 0.6]], np.float32)
    costs = 3 * (np.arange(7, dtype=np.float32) - vertices[:, :, np.newaxis]) ** 2 - 5
    np.testing.assert_allclose(lowest(costs), vertices, atol=1e-4)


def test_a_vertex_beyond_the_ends_stays_half_a_depth_within_them() -> None:
    costs = (np.arange(7, dtype=np.float32) - np.array([[[-3.0], [9.0]]], np.float32)) ** 2
    np.testing.assert_array_equal(lowest(costs), [[0.5, 5.5]])


def _plane(rows: int, columns: int) -> NDArray[np.float64]:
    row, column = np.indices((rows, columns))
    return 5 + 0.3 * column - 0.2 * row


def test_a_slanted_plane_stays_as_it_is() -> None:
    plane = _plane(20, 24)
    surface = PiecewisePlane.start(plane)
    surface.approach(plane, 0.2, (0.5, 3.0), 3000)
    np.testing.assert_allclose(surface.values, plane, atol=2e-3)
    np.testing.assert_allclose(surface.slopes[0, 1:-1, 1:-1], 0.3, atol=2e-3)
    np.testing.assert_allclose(surface.slopes[1, 1:-1, 1:-1], -0.2, atol=2e-3)


def _differences(fields: NDArray[np.float64]) -> NDArray[np.float64]:
    """∇u − w (right, down) and the symmetrised derivative of w (right, down, √2 times mixed), of u and w."""
    u, right, down = fields
    found = np.zeros((5, *u.shape))
    found[0, :, :-1], found[1, :-1] = np.diff(u, axis=1) - right[:, :-1], np.diff(u, axis=0) - down[:-1]
    found[2, :, 1:], found[3, 1:] = np.diff(right, axis=1), np.diff(down, axis=0)
    found[4, 1:] += np.diff(right, axis=0) / 2**0.5
    found[4, :, 1:] += np.diff(down, axis=1) / 2**0.5
    return found


@pytest.mark.parametrize("bend", [(0.5, 0.9), (1.5, 0.4)])  # a step that stays; a twist that is nearly a plane
def test_the_energy_reaches_the_minimum_that_scipy_finds(bend: tuple[float, float]) -> None:
    target = np.random.default_rng(6).normal(0, 1, (4, 5)) + _plane(4, 5)
    target[:, 3:] += 4
    target += np.multiply.outer(np.arange(4), np.arange(5))
    weight = 0.8
    units = np.eye(3 * target.size).reshape(-1, 3, *target.shape)
    matrix = csr_array(np.stack([_differences(unit).ravel() for unit in units], axis=1))

    def energy(fields: NDArray[np.float64], tiny: float) -> tuple[float, NDArray[np.float64]]:
        """The sum that is minimised, its kinks rounded, and its gradient."""
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
    surface = PiecewisePlane.start(np.zeros_like(target))  # wherever it starts
    surface.approach(target, weight, bend, 4000)
    found = np.concatenate([surface.values.ravel(), surface.slopes.ravel()]).astype(float)
    assert abs(energy(found, 0)[0] / energy(best, 0)[0] - 1) < 1e-3
    np.testing.assert_allclose(surface.values, best[: target.size].reshape(target.shape), atol=0.01)
    assert np.ptp(surface.values) > 2  # neither the constant nor the target
    assert np.abs(surface.values - target).max() > 0.2
