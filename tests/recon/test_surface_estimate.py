"""Surfaces and their range from simulated views, against the truth; views that were left out as a figure of merit."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache
from unittest.mock import patch

import numba
import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from faintfield.recon.errors import NothingInFocus
from faintfield.recon.surface import estimate
from faintfield.recon.surface.confidence import RIGHT_WITHIN
from faintfield.recon.surface.estimate import _OUTLIERS, SurfaceEstimate, _votes, estimate_surface, halves
from faintfield.recon.surface.evidence import DepthEvidence, Halves
from faintfield.recon.surface.held_out import predicted, seen_of, squared_errors
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews
from faintfield.recon.surface.sweep import equal_steps, found_range
from tests.recon import surface_scene
from tests.recon.surface_scene import FAR, NEAR, NODES, SHAPE

# Light in electrons per pixel: its detail, 40 % of it, has about 1.4 times the noise's deviation
LEVEL_E = 20.0

LEFT_OUT = np.array([1, 8, 12, 15, 23])
FARTHEST, NEAREST = 1 / 650, 1 / 465
DEPTHS = np.linspace(FARTHEST, NEAREST, 40)  # fewer than `equal_steps` would take, for speed


@cache
def _recorded() -> tuple[SurfaceEstimate, list[NDArray[np.intp]]]:
    """The estimate that several tests look at, and the views that each of its searches used."""
    used = []

    class Recorded(DepthEvidence):
        def __init__(self, views: PinholeViews, inverse_depths: NDArray[np.float64], halves: Halves) -> None:
            super().__init__(views, inverse_depths, halves)
            used.append(np.concatenate(halves))

    with patch.object(estimate, "DepthEvidence", Recorded):
        return estimate_surface(surface_scene.drawn_views(LEVEL_E), DEPTHS, NODES), used


def _estimate() -> SurfaceEstimate:
    return _recorded()[0]


def _error(found: SurfaceEstimate) -> NDArray[np.float64]:
    """Relative error of the depths."""
    return np.abs(found.inverse_depth / surface_scene.inverse_depth() - 1)


def test_the_depths_of_wall_and_square_are_found() -> None:
    error = _error(_estimate())
    inner = surface_scene.away_from_edges(2)
    for depth in (FAR, NEAR):
        assert (error[inner & (surface_scene.inverse_depth() == depth)] < RIGHT_WITHIN).mean() > 0.96
    assert (error < RIGHT_WITHIN).mean() > 0.92  # with the edges and the border of the picture
    # Beside the square, where some views see it instead, the wall is drawn to it by half a step
    assert np.median(error) < 0.006
    assert np.median(error[inner & (surface_scene.inverse_depth() == NEAR)]) < 0.002


def test_views_that_judge_the_rounds_take_part_in_the_last_one_only() -> None:
    found, (first, last) = _recorded()
    assert found.prediction is not None
    assert sorted([*first, *found.prediction.views]) == list(range(25))
    assert sorted(last) == list(range(25))
    assert found.prediction.surface < 0.9 * (found.prediction.neighbours or 0)
    assert 2 <= found.rounds <= 4


def test_the_last_round_starts_from_the_one_that_predicts_the_views_left_out_best(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    errors = iter([3.0, 2.0, 2.5, 2.2])
    monkeypatch.setattr(estimate, "squared_errors", lambda _, expected, __: np.full_like(expected, next(errors)))
    started: list[NDArray[np.floating]] = []
    explained = DepthEvidence.explained

    def noted(self: DepthEvidence, index: NDArray[np.floating]) -> object:
        started.append(index)
        return explained(self, index)

    monkeypatch.setattr(DepthEvidence, "explained", noted)
    assert estimate_surface(surface_scene.drawn_views(LEVEL_E), DEPTHS, NODES).rounds == 2
    assert started[-2] is started[1]  # the last is the result, judged for its confidence


def test_no_window_is_more_certain_than_outliers_allow() -> None:
    evidence = np.zeros((9, 9, 20), np.float32)
    evidence[:, :, 7] = 1000
    votes = _votes(evidence, 2.0)
    gap = np.log((1 - _OUTLIERS + _OUTLIERS / 20) / (_OUTLIERS / 20))
    np.testing.assert_allclose(votes[:, :, 3] - votes[:, :, 7], gap, rtol=1e-4)


def test_what_is_called_sure_is_right() -> None:
    error, confidence = _error(_estimate()), _estimate().confidence
    assert 0 <= confidence.min() < confidence.max() < 1
    assert confidence[error < RIGHT_WITHIN].mean() > confidence[error > RIGHT_WITHIN].mean() + 0.2
    assert (error[confidence > 0.9] < RIGHT_WITHIN).mean() > 0.95


def test_the_number_of_threads_changes_the_rounding_only(monkeypatch: pytest.MonkeyPatch) -> None:
    first, default = _estimate(), numba.config.NUMBA_NUM_THREADS
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 1 if default > 1 else 2)
    views = surface_scene.drawn_views(LEVEL_E)
    again = estimate_surface(views, DEPTHS, NODES)
    assert again.rounds == first.rounds
    np.testing.assert_allclose(again.inverse_depth, first.inverse_depth, rtol=1e-5)


def test_pixels_without_a_number_matter_only_nearby() -> None:
    drawn = surface_scene.drawn_views(LEVEL_E)
    light = drawn.light_e.copy()
    light[np.random.default_rng(3).permutation(25)[:12], 26:34, 4:12] = UNKNOWN  # of half of the views
    light[6, 5, 70] = UNKNOWN
    found = estimate_surface(surface_scene.views_of(light), DEPTHS, NODES)
    far_away = np.s_[:, 36:]
    change = np.abs(found.inverse_depth / _estimate().inverse_depth - 1)
    assert (change[far_away] < RIGHT_WITHIN / 4).mean() > 0.97
    assert (_error(found)[surface_scene.away_from_edges(2)] < RIGHT_WITHIN).mean() > 0.95


def test_halves_are_a_checkerboard_of_those_that_count() -> None:
    both = halves(NODES, np.setdiff1d(np.arange(25), LEFT_OUT))
    board = np.full((5, 5), -1)
    for number, half in enumerate(both):
        board[tuple(NODES[half].T)] = number
    assert board.tolist() == [
        [0, -1, 0, 1, 0],
        [1, 0, 1, -1, 1],
        [0, 1, -1, 1, 0],
        [-1, 0, 1, 0, 1],
        [0, 1, 0, -1, 0],
    ]


@pytest.mark.parametrize(
    ("nodes", "first"),
    [
        ([(row, column) for row in (0, 2, 4) for column in (1, 3, 5)], [0, 2, 4, 6, 8]),  # every second node
        ([(k, k) for k in range(6)], [0, 2, 4]),  # along a diagonal
        ([(0, 1), (1, 0), (1, 1), (1, 2), (2, 1)], [0, 2, 4]),  # a cross
    ],
)
def test_both_halves_have_views_however_nodes_lie(nodes: list[tuple[int, int]], first: list[int]) -> None:
    both = halves(np.array(nodes))
    assert both.first.tolist() == first
    assert both.second.tolist() == sorted({*range(len(nodes))} - {*first})


def test_darkness_without_any_noise_is_no_evidence() -> None:
    """Pixels that never count a photon have no variance: a division by it would spoil the samples around them."""
    light = surface_scene.expected_light(LEVEL_E).astype(np.float32)
    light[:, :, 20:] = 0
    views = replace(surface_scene.views_of(light), variance_e2=0.0)
    evidence = _evidence(views)
    ratios = evidence.at_first()
    assert np.isfinite(ratios).all()
    assert np.ptp(ratios[20:40, 5:15], axis=2).max() > 1


def test_steps_are_equal_and_as_fine_as_the_outermost_view_asks_for() -> None:
    views = surface_scene.drawn_views(LEVEL_E)
    outermost = max(np.hypot(*surface_scene.CENTRES_MM.T)) * surface_scene.FOCAL_PX  # samples per 1/depth
    for near in (NEAREST, 1 / 120):
        depths = equal_steps(views, FARTHEST, near)
        np.testing.assert_allclose(np.diff(depths), (near - FARTHEST) / (len(depths) - 1), rtol=1e-9)
        assert (depths[0], depths[-1]) == (FARTHEST, pytest.approx(near))
    moved = outermost * np.diff(depths)[0]
    assert 1.4 < moved <= 1.6
    assert len(equal_steps(views, FARTHEST, FARTHEST * 1.01)) == 64
    assert len(equal_steps(views, FARTHEST, 1.0)) == 128


def test_the_range_contains_the_scene_and_little_more() -> None:
    far, near = found_range(surface_scene.drawn_views(LEVEL_E), NODES, 1 / 1000, 1 / 380)
    assert 1 / 1000 <= far < FAR < NEAR < near <= 1 / 380
    assert near - far < 2 * (NEAR - FAR)


def test_the_range_stays_within_that_searched() -> None:
    far, near = found_range(surface_scene.drawn_views(LEVEL_E), NODES, 1 / 602, 1 / 498)
    assert 1 / 602 <= far < FAR < NEAR < near <= 1 / 498


def test_noise_alone_has_no_range() -> None:
    level_e = 5.0
    noise = np.random.default_rng(1)
    light = noise.poisson(level_e, (25, *SHAPE)) + noise.normal(0, surface_scene.READ_VARIANCE_E2**0.5, (25, *SHAPE))
    with pytest.raises(NothingInFocus, match=r"^the views tell the depth of [0-9.]+% of the picture; give"):
        found_range(surface_scene.views_of(light), NODES, 1 / 1000, 1 / 380)


def _evidence(views: PinholeViews) -> DepthEvidence:
    """Evidence of all views but those left out."""
    return DepthEvidence(views, DEPTHS, halves(NODES, np.setdiff1d(np.arange(25), LEFT_OUT)))


def _index_of(inverse_depth: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.interp(inverse_depth, DEPTHS, np.arange(len(DEPTHS)))


def test_the_right_surface_predicts_better_than_its_rivals() -> None:
    views = surface_scene.drawn_views(LEVEL_E)
    evidence = _evidence(views)
    kept = np.concatenate(evidence.halves)
    beside = [kept[np.abs(NODES[kept] - NODES[view]).sum(axis=1) == 1] for view in LEFT_OUT]
    right = predicted(evidence, _index_of(surface_scene.inverse_depth()), LEFT_OUT, beside)
    wrong = predicted(evidence, _index_of(np.full(SHAPE, FAR)), LEFT_OUT, beside)
    assert right.neighbours is not None
    assert 0.95 < right.surface < 1.4  # noise, and what smoothing the light costs
    assert right.surface < 0.8 * wrong.surface
    assert right.surface < 0.8 * right.neighbours
    assert wrong.planes == pytest.approx(wrong.surface)  # a plane is one already
    assert right.views.tolist() == LEFT_OUT.tolist()
    assert 0.75 * _size() < right.pixels < _size()
    assert predicted(evidence, _index_of(np.full(SHAPE, FAR)), LEFT_OUT, []).neighbours is None


def test_neighbours_predict_faint_light_without_bias_and_without_pixels_that_have_no_number() -> None:
    """Light of 2 e⁻ everywhere, of which neighbours show a third as unknown: the noise is the only error."""
    generator = np.random.default_rng(4)
    light = 2.0 + generator.normal(0, 2.0, (25, *SHAPE))
    light[generator.random(light.shape) < 1 / 3] = UNKNOWN
    evidence = _evidence(surface_scene.views_of(light))
    beside = [np.setdiff1d(np.arange(25), LEFT_OUT)[:4]] * len(LEFT_OUT)
    found = predicted(evidence, _index_of(np.full(SHAPE, FAR)), LEFT_OUT, beside)
    assert found.neighbours == pytest.approx(1, abs=0.03)


def test_views_without_any_number_have_no_deviance() -> None:
    light = surface_scene.expected_light(LEVEL_E).astype(np.float32)
    light[LEFT_OUT] = UNKNOWN
    found = predicted(_evidence(surface_scene.views_of(light)), _index_of(np.full(SHAPE, FAR)), LEFT_OUT, [])
    assert found.pixels == 0
    assert np.isnan([found.surface, found.planes]).all()


def _size() -> int:
    """Pixels of the views that are left out."""
    return len(LEFT_OUT) * SHAPE[0] * SHAPE[1]


def test_a_slanted_surface_predicts_better_than_planes() -> None:
    """The wall as it is, and the surface too, but for a slope that four planes cannot follow."""
    views = surface_scene.views_of(np.random.default_rng(2).poisson(_slanted()).astype(float))
    evidence = _evidence(views)
    across = np.linspace(1 / 680, 1 / 470, SHAPE[1])
    found = predicted(evidence, _index_of(np.tile(across, (SHAPE[0], 1))), LEFT_OUT, [])
    assert found.surface < 0.9 * found.planes


def _slanted() -> NDArray[np.float64]:
    """Light of a wall whose 1/depth grows from left to right, linear in the column of the reference view."""
    row, column = np.indices(SHAPE, float)
    first, step = 1 / 680 - surface_scene.UNMOVED, (1 / 470 - 1 / 680) / (SHAPE[1] - 1)
    views = []
    for right, down in surface_scene.FOCAL_PX * surface_scene.CENTRES_MM:
        # A view sees column c of the reference view at c − right · (first + step · c)
        at = (column + right * first) / (1 - right * step)
        views.append(surface_scene.texture(2, at, row + down * (first + step * at)))
    return LEVEL_E * np.array(views)


@pytest.mark.parametrize("scale", [1.0, 1.2])
def test_the_deviance_of_the_truth_is_one(scale: float) -> None:
    """A prediction s times λ has (λ + σ² + ((s − 1) λ)²)/v on average, whatever it says of the variance v."""
    views = surface_scene.drawn_views(LEVEL_E)
    light = surface_scene.expected_light(LEVEL_E)[LEFT_OUT]
    seen = np.ones(light.shape, bool)
    variance = light + surface_scene.READ_VARIANCE_E2
    common = gaussian_filter(light, (0, 8, 8), mode="mirror") + surface_scene.READ_VARIANCE_E2
    mean = np.mean((variance + ((scale - 1) * light) ** 2) / common)
    found = squared_errors(_evidence(views), (scale * light).astype(np.float32), LEFT_OUT)[seen].mean()
    assert mean == pytest.approx(1, abs=0.05) or mean > 1.4
    assert found == pytest.approx(mean, abs=0.04)  # 4σ of 24 000 pixels


def test_only_pixels_between_samples_are_compared() -> None:
    """The outermost samples see no pixel beyond them: to expect one black there would decide all comparisons."""
    views = surface_scene.drawn_views(LEVEL_E)
    light = views.light_e.copy()
    light[LEFT_OUT[1], 20, 30] = UNKNOWN
    views = surface_scene.views_of(light)
    evidence = _evidence(views)
    known = evidence.explained(_index_of(np.full(SHAPE, FAR)))
    seen = seen_of(evidence, known, LEFT_OUT)
    row, column = np.indices(SHAPE)
    for view, mask in zip(LEFT_OUT, seen, strict=True):
        right, down = surface_scene.FOCAL_PX * surface_scene.CENTRES_MM[view] * (FAR - surface_scene.UNMOVED)
        inside = (row + down >= 0) & (row + down <= SHAPE[0] - 1) & (column + right >= 0)
        inside &= column + right <= SHAPE[1] - 1
        inside &= light[view] > UNKNOWN
        assert (mask != inside).mean() < 0.02  # rounding, at the very border
        assert not mask[~inside].any()


def test_the_noise_of_one_half_says_nothing_of_the_others() -> None:
    """On average over depths and samples, noise speaks against any light: half of that light's own square."""
    noise = np.random.default_rng(1)
    light = 5 + noise.normal(0, 7**0.5, (25, *SHAPE))
    assert _evidence(surface_scene.views_of(light)).at_first().mean() < 0


type Wrong = Callable[[NDArray[np.float64]], NDArray[np.float64]]


@pytest.mark.parametrize("wrong", [lambda q: q + 4e-5, lambda q: np.full_like(q, NEAR), lambda q: NEAR + FAR - q])
def test_the_evidence_prefers_the_truth_to_a_surface_that_is_wrong(wrong: Wrong) -> None:
    """Against any surface, the depths of the truth have the larger log-likelihood: most where the surface is wrong."""
    views = surface_scene.drawn_views(LEVEL_E)
    evidence, truth = _evidence(views), surface_scene.inverse_depth()
    ratios = evidence.against(evidence.explained(_index_of(wrong(truth))))
    inner = surface_scene.away_from_edges(3)
    at = np.rint(_index_of(truth)).astype(int)[..., np.newaxis]
    differ = inner & (np.abs(wrong(truth) / truth - 1) > RIGHT_WITHIN)
    for volume in ratios:
        assert np.take_along_axis(volume, at, 2)[..., 0][differ].mean() > 0.05
    assumed = np.rint(_index_of(wrong(truth))).astype(int)[..., np.newaxis]
    gained = np.take_along_axis(ratios.both, at, 2) - np.take_along_axis(ratios.both, assumed, 2)
    assert gained[..., 0][differ].mean() > 0.05
