"""Surfaces from simulated views against the truth; misleading scenes, where nothing may be sure and wrong."""

from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter, map_coordinates

from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.surface import estimate
from faintfield.recon.surface.confidence import MISPLACEMENT, RIGHT_WITHIN, SURE, confidence, spacing_needed
from faintfield.recon.surface.estimate import SurfaceEstimate, estimate_surface, first_depths, halves
from faintfield.recon.surface.evidence import DepthEvidence, Halves
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews
from tests.recon import surface_scene
from tests.recon.surface_scene import DEPTHS, FAR, FOCAL_PX, LEVEL_E, NEAR, NODE_MM, NODES, SHAPE, UNMOVED

# Cameras that are equal steps apart, up to 2 mm
ALMOST_REGULAR_MM = NODE_MM * (NODES[:, ::-1] - 2) + np.random.default_rng(4).uniform(-2, 2, (25, 2))


@cache
def _recorded() -> tuple[SurfaceEstimate, list[NDArray[np.intp]]]:
    """The estimate that several tests look at, and the views that each of its searches used."""
    used = []

    class Recorded(DepthEvidence):
        def __init__(self, views: PinholeViews, inverse_depths: NDArray[np.float64], halves: Halves) -> None:
            super().__init__(views, inverse_depths, halves)
            used.append(np.concatenate(halves))

    with patch.object(estimate, "DepthEvidence", Recorded):
        return estimate_surface(surface_scene.drawn_views(LEVEL_E), DEPTHS), used


def _estimate() -> SurfaceEstimate:
    return _recorded()[0]


def _error(result: SurfaceEstimate) -> NDArray[np.float64]:
    """Relative error of the depths."""
    return np.abs(result.inverse_depth / surface_scene.inverse_depth() - 1)


def test_depths_of_wall_and_square_are_right() -> None:
    error = _error(_estimate())
    inner = surface_scene.away_from_edges(2)
    for depth in (FAR, NEAR):
        assert (error[inner & (surface_scene.inverse_depth() == depth)] < RIGHT_WITHIN).mean() > 0.96
    assert (error < RIGHT_WITHIN).mean() > 0.92  # with the edges and the border of the picture
    # Beside the square, where some views see it instead, the wall is drawn to it by half a step
    assert np.median(error) < 0.006
    assert np.median(error[inner & (surface_scene.inverse_depth() == NEAR)]) < 0.002


def test_judging_views_join_the_last_round_only() -> None:
    result, (first, last) = _recorded()
    assert result.prediction is not None
    assert sorted([*first, *result.prediction.views]) == list(range(25))
    assert sorted(last) == list(range(25))
    assert result.prediction.surface < 0.9 * (result.prediction.neighbours or 0)
    assert 2 <= result.rounds <= 3


def test_last_round_starts_from_the_best_prediction(monkeypatch: pytest.MonkeyPatch) -> None:
    errors = iter([3.0, 2.0, 2.5, 2.2])
    monkeypatch.setattr(estimate, "squared_errors", lambda _, expected, __: np.full_like(expected, next(errors)))
    starts: list[NDArray[np.floating]] = []
    explained = DepthEvidence.explained

    def recorded(self: DepthEvidence, index: NDArray[np.floating]) -> object:
        starts.append(index)
        return explained(self, index)

    monkeypatch.setattr(DepthEvidence, "explained", recorded)
    assert estimate_surface(surface_scene.drawn_views(LEVEL_E), DEPTHS[::3]).rounds == 2
    assert starts[-2] is starts[1]  # the last is the result, judged for its confidence


def test_sure_depths_are_right() -> None:
    error, confidence = _error(_estimate()), _estimate().confidence
    assert 0 <= confidence.min() < confidence.max() < 1
    assert confidence[error < RIGHT_WITHIN].mean() > confidence[error > RIGHT_WITHIN].mean() + 0.2
    assert (error[confidence > 0.9] < RIGHT_WITHIN).mean() > 0.95
    # Else the tests of scenes that mislead could not fail
    right, wrong = _sure(_estimate())
    assert right > 0.4
    assert wrong < 0.03


def test_number_of_threads_changes_rounding_only(monkeypatch: pytest.MonkeyPatch) -> None:
    results = []
    for threads in (1, 2):
        monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", threads)
        results.append(estimate_surface(surface_scene.drawn_views(LEVEL_E), DEPTHS[::3]))
    assert results[0].rounds == results[1].rounds
    np.testing.assert_allclose(results[1].inverse_depth, results[0].inverse_depth, rtol=1e-5)


def test_pixels_without_a_number_matter_only_nearby() -> None:
    light = surface_scene.drawn_views(LEVEL_E).light_e.copy()
    light[np.random.default_rng(3).permutation(25)[:12], 26:34, 4:12] = UNKNOWN  # of half of the views
    light[6, 5, 70] = UNKNOWN
    result = estimate_surface(surface_scene.views_of(light), DEPTHS)
    change = np.abs(result.inverse_depth / _estimate().inverse_depth - 1)
    assert (change[:, 36:] < RIGHT_WITHIN / 4).mean() > 0.97
    assert (_error(result)[surface_scene.away_from_edges(2)] < RIGHT_WITHIN).mean() > 0.95


def _estimate_of(
    light: NDArray[np.float64], matrices: NDArray[np.float64] | None = None, seed: int = 7
) -> SurfaceEstimate:
    """Return the surface of the given light (view, row, column), with noise."""
    views = surface_scene.noisy_views_of(light, seed)
    return estimate_surface(views if matrices is None else replace(views, ray_from_surface=matrices), DEPTHS)


def _sure(result: SurfaceEstimate, truth: NDArray[np.float64] | float | None = None) -> tuple[float, float]:
    """Return the shares of all samples that are sure and right, and sure and wrong."""
    expected = surface_scene.inverse_depth() if truth is None else truth
    right = np.abs(result.inverse_depth / expected - 1) < RIGHT_WITHIN
    sure = result.confidence >= SURE
    return float((sure & right).mean()), float((sure & ~right).mean())


def test_even_wall_is_never_sure() -> None:
    result = _estimate_of(np.full((len(NODES), *SHAPE), LEVEL_E))
    assert (result.confidence >= SURE).mean() < 0.01


def _wall_of_equal_squares(pair_px: float, seed: int) -> SurfaceEstimate:
    """Return the surface of a wall of squares at 600 mm, seen from almost regular nodes."""
    centres = ALMOST_REGULAR_MM - ALMOST_REGULAR_MM[12]
    # Quarters of pixels along each side
    row, column = (np.indices((4 * SHAPE[0], 4 * SHAPE[1])) - 1.5) / 4
    views = []
    for right, down in FOCAL_PX * centres * (FAR - UNMOVED):
        white = (np.floor(2 * (column + right) / pair_px) + np.floor(2 * (row + down) / pair_px)) % 2
        views.append(0.4 + 1.2 * white.reshape(SHAPE[0], 4, SHAPE[1], 4).mean(axis=(1, 3)))
    rays = surface_scene.matrices()
    rays[:, :2, 3], rays[:, :2, 2] = -centres, UNMOVED * centres
    return _estimate_of(LEVEL_E * np.array(views), rays, seed)


@pytest.mark.parametrize(("other_mm", "draws"), [(480, 1), pytest.param(500, 8, marks=pytest.mark.deep)])
def test_wall_of_equal_squares_is_rarely_wrong(other_mm: float, draws: int) -> None:
    """The views of a pair of squares agree at another depth as well; at 500 mm the share varies from 0 to 7 %."""
    pair_px = NODE_MM * FOCAL_PX * (1 / other_mm - FAR)
    walls = [_wall_of_equal_squares(pair_px, seed) for seed in range(7, 7 + draws)]
    assert np.mean([_sure(wall, FAR)[1] for wall in walls]) < 0.03


def test_wrong_poses_make_depths_less_sure() -> None:
    """Each view but that of the reference is seen 1 px away from where it is, in a direction by chance."""
    angle = np.random.default_rng(11).uniform(0, 2 * np.pi, len(NODES))
    turned = surface_scene.matrices()
    turned[:, 0, 2] += np.cos(angle) / FOCAL_PX
    turned[:, 1, 2] += np.sin(angle) / FOCAL_PX
    turned[12] = surface_scene.matrices()[12]
    result = _estimate_of(surface_scene.expected_light(LEVEL_E), turned)
    right, wrong = _sure(result)
    assert result.confidence.mean() < _estimate().confidence.mean()
    assert right + wrong < sum(_sure(_estimate()))
    assert right > 0.1
    assert wrong <= 0.2 * (right + wrong)
    assert wrong < 0.05


@pytest.mark.parametrize("bins_per_node", [1.0, 1.5])
def test_depths_are_right_where_views_move_by_few_bins(bins_per_node: float) -> None:
    """Texture as fine as bins, whole or half bins per node: views on opposite sides must not cancel between bins."""
    rng = np.random.default_rng(5)
    fine = gaussian_filter(rng.normal(size=(160, 200)), 1.0)
    fine = 100 * np.maximum(1 + 0.4 * fine / fine.std(), 0.1)
    rows, columns = np.indices((60, 80), np.float64)
    moved = bins_per_node * (NODES - 2)
    light = [map_coordinates(fine, [rows + 50 + down, columns + 60 + right], order=3) for down, right in moved]
    true = 0.002
    ray_from_surface = np.tile(np.eye(3, 4), (25, 1, 1))
    ray_from_surface[:, :2, 3] = -moved[:, ::-1] / (200 * true)
    views = PinholeViews(
        rng.poisson(np.maximum(light, 0)).astype(np.float32),
        1.0,
        ray_from_surface,
        (200.0, 200.0),
        (39.5, 29.5),
        PlaneGrid((60, 80), 1 / 200, (-39.5 / 200, -29.5 / 200)),
        NODES,
    )
    index = first_depths(DepthEvidence(views, np.linspace(0.6 * true, 1.4 * true, 65), halves(NODES)))
    assert np.median(index) == pytest.approx(32, abs=0.5)  # steps of 1.25 %


def test_confidence_falls_with_parallax() -> None:
    rng = np.random.default_rng(1)
    index, inverse_depths = np.full((24, 24), 10.0, np.float32), np.linspace(1e-3, 2e-3, 64)
    costs = np.abs(np.arange(64) - index[:, :, np.newaxis]).astype(np.float32) * 100
    known = (index, costs, inverse_depths, np.ones((24, 24), np.float32))
    draws = rng.normal(0, MISPLACEMENT, 100_000)
    for parallax in (5e3, 2e4, 1e5):
        tolerated = RIGHT_WITHIN * inverse_depths[10] * parallax
        expected = confidence(*known, None) * np.mean(np.abs(draws) < tolerated)
        np.testing.assert_allclose(confidence(*known, parallax), expected, atol=0.005)
    shared = confidence(*known, 1e9, 5e-6) / confidence(*known, 1e9)  # views so far apart that only this error counts
    draws = rng.normal(0, 5e-6, 100_000)
    np.testing.assert_allclose(shared, np.mean(np.abs(draws) < RIGHT_WITHIN * inverse_depths[10]), atol=0.005)
    enough = 5e3 * spacing_needed(inverse_depths[10], 5e3)
    assert confidence(*known, 0.99 * enough).max() < SURE < confidence(*known, 1.01 * enough).max()
