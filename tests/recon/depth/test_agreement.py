"""Depth maps and planes of best focus, on views of waves computed in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.depth.agreement import _MODEL_ERROR, Agreement, agreement, bins_for, depth_map
from faintfield.recon.depth.focus import SURE, likeliest_depth_mm, places_of_focus
from faintfield.recon.likelihood.images import ElementalImages
from tests.recon.displaced import views_displaced_by

SHAPE = (48, 96)
OFFSETS = np.array([(row, column) for row in (-1, 0, 1) for column in (-2, -1, 0, 1, 2)], float)
DISPARITIES = np.linspace(-3, 3, 25)
DEPTHS_MM = 1 / np.linspace(1 / 400, 1 / 900, 25)
NEAR, FAR = 17, 6  # planes of the sweep in which the two halves of the scene lie


def _light(x: NDArray[np.floating], y: NDArray[np.floating], level_e: float | None) -> NDArray[np.floating]:
    """Return even light, or waves if no level is given."""
    waves = 6 * np.cos(x * 0.9 + y * 0.4) + 6 * np.cos(x * 0.35 - y * 0.8 + 1) + 5 * np.sin(0.6 * x + 0.2 * y)
    return np.full_like(x, level_e) if level_e is not None else np.asarray(20 + waves)


def _problem(near_e: float | None = None, far_e: float | None = None) -> list[Agreement]:
    """The left half is near, the right half far; pixels are computed from their coordinates, without an operator."""
    rows, columns = np.indices(SHAPE, float)
    views = []
    for down, right in OFFSETS:
        on_near, on_far = (
            (columns + disparity * right, rows + disparity * down) for disparity in DISPARITIES[[NEAR, FAR]]
        )
        views.append(np.where(on_near[0] < SHAPE[1] / 2, _light(*on_near, near_e), _light(*on_far, far_e)))
    electrons = np.random.default_rng(3).poisson(views).astype(np.float32)
    images = ElementalImages(electrons, background_e=0.0, read_variance_e2=0.5)
    return [agreement(views_displaced_by(disparity * OFFSETS, SHAPE, margin=0), images) for disparity in DISPARITIES]


@pytest.fixture(scope="module")
def halves() -> list[Agreement]:
    return _problem()


def test_depth_of_each_half_is_right(halves: list[Agreement]) -> None:
    result = depth_map(halves, DEPTHS_MM)
    for part, truth in ((np.s_[6:-6, 8:40], NEAR), (np.s_[6:-6, 58:86], FAR)):
        sure = result.confidence[part] >= SURE
        assert sure.mean() > 0.8
        assert np.median(np.abs(result.index[part][sure] - truth)) < 0.3
        assert np.quantile(np.abs(result.index[part][sure] - truth), 0.95) < 1


def test_squares_of_even_views_are_of_their_levels() -> None:
    operator = views_displaced_by(np.zeros((3, 2)), (12, 16), margin=0)
    light_e, background_e, read_variance_e2 = np.array([18.0, 20.0, 25.0]), 3.0, 2.0
    electrons = np.broadcast_to((light_e + background_e)[:, None, None], (3, 12, 16)).astype(np.float32)
    result = agreement(operator, ElementalImages(electrons, background_e, read_variance_e2))
    mean_e = light_e.mean()
    variance_e2 = mean_e + background_e + read_variance_e2 + (_MODEL_ERROR * mean_e) ** 2
    np.testing.assert_allclose(result.light, mean_e, rtol=1e-5)
    np.testing.assert_allclose(result.squares, np.sum((light_e - mean_e) ** 2) / variance_e2, rtol=1e-5)
    np.testing.assert_allclose(result.light_variance, variance_e2 / 3, rtol=1e-5)
    np.testing.assert_allclose(result.sensitivity, 3.0)


@pytest.mark.parametrize("level_e", [0.0, 20.0])
def test_dark_and_uniform_regions_have_no_confident_depth(level_e: float) -> None:
    result = depth_map(_problem(far_e=level_e), DEPTHS_MM)
    assert (result.confidence[6:-6, 8:36] >= SURE).mean() > 0.8
    assert (result.confidence[6:-6, 62:86] >= SURE).mean() < 0.02


def test_depths_at_sweep_ends_are_not_confident(halves: list[Agreement]) -> None:
    result = depth_map(halves[: NEAR + 1], DEPTHS_MM[: NEAR + 1])
    at_end = np.rint(result.index) >= NEAR - 0.25
    assert at_end[6:-6, 8:40].mean() > 0.5
    assert (result.confidence[at_end] < SURE).all()


def test_planes_of_best_focus_are_located_and_refined(halves: list[Agreement]) -> None:
    places = places_of_focus(depth_map(halves, DEPTHS_MM), len(DEPTHS_MM))
    depths = [likeliest_depth_mm(halves, DEPTHS_MM.tolist(), place) for place in places]
    # A sixth of a step of 1/depth
    np.testing.assert_allclose(depths, DEPTHS_MM[[FAR, NEAR]], rtol=0.004)


def test_noise_alone_has_no_plane_of_focus() -> None:
    assert places_of_focus(depth_map(_problem(0.2, 0.2), DEPTHS_MM), len(DEPTHS_MM)) == []


def test_less_light_takes_larger_bins() -> None:
    operator = views_displaced_by(0 * OFFSETS, SHAPE, margin=0)
    # A pixel of λ electrons and 0.5 (e⁻)² of read noise has the power ratio λ²/(λ + 0.5); k² of it must reach 2
    for light_e, bins in ((30.0, 2), (1.0, 2), (0.4, 4), (0.2, 8)):
        images = ElementalImages(
            np.random.default_rng(1).poisson(np.full((len(OFFSETS), *SHAPE), light_e)).astype(np.float32),
            background_e=0.0,
            read_variance_e2=0.5,
        )
        assert bins_for(operator, images) == bins


def test_chance_agreement_of_few_views_does_not_win() -> None:
    """Of 20 views 3 see the second plane, and agree there perfectly; all see the others, and agree at the fourth."""
    shape, depths_mm = (24, 24), np.array([400.0, 450.0, 500.0, 550.0, 600.0])
    seen_by, reduced = [20, 3, 20, 20, 20], [3.0, 0.0, 3.0, 1.0, 3.0]
    planes = [
        Agreement(
            np.full(shape, (views - 1) * squares), np.full(shape, float(views)), np.full(shape, 50.0), np.ones(shape)
        )
        for views, squares in zip(seen_by, reduced, strict=True)
    ]
    result = depth_map(planes, depths_mm)
    np.testing.assert_allclose(result.index, 3.0, atol=0.5)
