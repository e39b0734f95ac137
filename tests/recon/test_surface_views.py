"""Sums over pinhole views, against one written in numpy, sample by sample, and in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews, gather

GRID = PlaneGrid((7, 9), 0.1, (-0.41, -0.29))
SHAPE = (8, 11)
Q = 0.002


def _views(light: NDArray[np.floating] | None = None, count: int = 6) -> PinholeViews:
    """Views that are turned, moved, and of different scale; their pictures cut some samples off on every side."""
    generator = np.random.default_rng(7)
    matrices = np.zeros((count, 3, 4))
    matrices[:, :3, :3] = np.eye(3) + generator.uniform(-0.05, 0.05, (count, 3, 3))
    matrices[:, :, 3] = generator.uniform(-90, 90, (count, 3)) * [1, 1, 0.3]
    if light is None:
        light = generator.uniform(1, 9, (count, *SHAPE))
        light[generator.random(light.shape) < 0.1] = UNKNOWN
    return PinholeViews(light.astype(np.float32), 1.5, matrices, (11.0, 10.0), (5.2, 3.4), GRID)


def _place(views: PinholeViews, view: int, row: int, column: int) -> tuple[float, float]:
    """Row and column at which a view sees a sample."""
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
        if not (0 <= down < SHAPE[0] - 1 and 0 <= right < SHAPE[1] - 1):
            continue
        if relief[view, round(down), round(right)] > Q + tolerance[view]:
            continue
        i, j = int(down), int(right)
        corners = pictures[view, i : i + 2, j : j + 2].astype(float)
        if (corners[:, :, 0] == UNKNOWN).any():
            continue
        rows, columns = [1 - (down - i), down - i], [1 - (right - j), right - j]
        sums[half[view], 0, row, column] += 1
        sums[half[view], 1:, row, column] += np.einsum("i,j,ijn->n", rows, columns, corners)
    return sums


@pytest.mark.parametrize("numbers", [1, 2])
def test_sums_are_those_of_each_sample_interpolated_by_itself(numbers: int) -> None:
    views, generator = _views(), np.random.default_rng(1)
    more = generator.normal(0, 5, (6, *SHAPE, numbers - 1))
    pictures = np.concatenate([views.light_e[..., np.newaxis], more], axis=-1).astype(np.float32)
    relief = np.where(generator.random((6, *SHAPE)) < 0.2, 0.0045, 0.001).astype(np.float32)
    tolerance = np.array([0, 0.001, 0.001, 0.002, 0.003, 0.001], np.float32)  # the fifth view is one that nothing hides
    half = np.array([0, 1, 1, 0, 1, 0])
    expected = _summed(views, pictures, relief, tolerance, half)
    assert 0 < expected[:, 0].min(initial=9, where=expected[:, 0] > 0) < expected[:, 0].max() == 3
    np.testing.assert_allclose(gather(views, pictures, Q, relief, tolerance, half), expected, rtol=2e-5, atol=2e-4)


def test_a_ramp_is_seen_at_the_places_of_the_samples() -> None:
    row, column = np.indices(SHAPE)
    views = _views(np.tile(4 + 2 * row + 3.0 * column, (6, 1, 1)))
    nothing, anywhere, half = np.zeros((6, *SHAPE), np.float32), np.full(6, np.inf, np.float32), np.zeros(6, np.intp)
    sums = gather(views, views.light_e[..., np.newaxis], Q, nothing, anywhere, half)
    for at in [(3, 4), (2, 6), (4, 3)]:
        places = [_place(views, view, *at) for view in range(6)]
        assert all(0 <= down < SHAPE[0] - 1 and 0 <= right < SHAPE[1] - 1 for down, right in places)
        assert sums[0, 0, *at] == 6
        assert sums[0, 1, *at] == pytest.approx(sum(4 + 2 * down + 3 * right for down, right in places), rel=1e-5)
    assert (sums[1] == 0).all()


@pytest.mark.parametrize(("relief_above", "seen"), [(-0.001, True), (0.00099, True), (0.00101, False)])
def test_only_what_is_nearer_by_more_than_the_tolerance_hides(relief_above: float, seen: bool) -> None:
    views = _views(np.ones((6, *SHAPE)))
    relief = np.full((6, *SHAPE), Q + relief_above, np.float32)
    tolerance, half = np.full(6, 0.001, np.float32), np.zeros(6, np.intp)
    sums = gather(views, views.light_e[..., np.newaxis], Q, relief, tolerance, half)
    assert (sums[0, 0].max() == 6) == seen
    assert (sums == 0).all() == (not seen)


def test_bins_add_light_up_and_look_where_their_pixels_look() -> None:
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


def test_reach_is_by_how_many_samples_a_view_moves_per_inverse_depth() -> None:
    matrices = np.zeros((2, 3, 4))
    matrices[:, :3, :3] = np.eye(3)
    matrices[1, :2, 3] = -30, 40
    views = PinholeViews(np.ones((2, *SHAPE), np.float32), 1.0, matrices, (10.0, 10.0), (5.0, 3.5), GRID)
    far, near = (views.pixel_from_surface[1] @ [0, 0, 1, q] for q in (0.001, 0.003))
    moved_px = np.linalg.norm((near / near[2] - far / far[2])[:2])
    np.testing.assert_allclose(views.reach, [0, moved_px / 0.002], rtol=1e-5)  # pixels and samples are 0.1 apart
    np.testing.assert_allclose(views.reach[1], 50 / 0.1, rtol=1e-6)
