"""Planes in focus: curves whose peaks are known, and the power of detail; views added one by one."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.depth.agreement import Agreement
from faintfield.recon.depth.focus import (
    FocusMeasure,
    RunningPlane,
    focus_measure,
    likeliest_depth_mm,
    seen_by_view,
    sharp_depths_mm,
)
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.initialization import back_projection
from tests.recon.displaced import views_displaced_by

SHAPE = (40, 50)
HALVES = (np.array([0, 2]), np.array([1, 3]))


def curve(heights: NDArray[np.floating], sigma_e2: float = 1e-6) -> list[FocusMeasure]:
    return [FocusMeasure(float(height), sigma_e2) for height in heights]


def test_parabola_has_focus_at_its_vertex() -> None:
    depths = np.array([400.0, 430.0, 470.0, 520.0, 600.0])
    heights = 50.0 - 1e-3 * (depths - 481.0) ** 2
    assert sharp_depths_mm(depths.tolist(), curve(heights)) == pytest.approx([481.0])
    order = [3, 0, 4, 2, 1]
    assert sharp_depths_mm(depths[order].tolist(), curve(heights[order])) == pytest.approx([481.0])


def test_end_of_curve_is_no_peak() -> None:
    assert sharp_depths_mm([400.0, 500.0], curve(np.array([1.0, 2.0]))) == []
    assert sharp_depths_mm([400.0, 500.0, 600.0], curve(np.array([1.0, 2.0, 5.0]))) == []
    assert sharp_depths_mm([400.0, 500.0, 600.0], curve(np.array([5.0, 2.0, 1.0]))) == []


@pytest.mark.parametrize(("height", "sigma_e2", "peaks"), [(1, 0.19, 2), (1, 0.21, 1), (0.6, 1e-6, 2), (0.4, 1e-6, 1)])
def test_peak_needs_five_sigma_and_a_tenth(height: float, sigma_e2: float, peaks: int) -> None:
    """Prominences of 5 and `height`, a range of 5."""
    heights = np.array([0.0, 5.0, 0.0, height, 0.0])
    assert len(sharp_depths_mm([1.0, 2.0, 3.0, 4.0, 5.0], curve(heights, sigma_e2))) == peaks


def test_noise_of_curve_is_median_over_depths() -> None:
    points = [FocusMeasure(h, s) for h, s in zip((0.0, 5.0, 0.0, 1.0, 0.0), (0.1, 9.0, 0.1, 9.0, 0.1), strict=True)]
    assert len(sharp_depths_mm([1.0, 2.0, 3.0, 4.0, 5.0], points)) == 2


def plane(squares: float, sensitivity: float = 4.0) -> Agreement:
    ones = np.ones((3, 3), np.float32)
    return Agreement(squares * ones, sensitivity * ones, ones, ones)


def test_likeliest_depth_is_vertex_over_inverse_depth() -> None:
    inverse = np.linspace(1 / 400, 1 / 600, 6)
    place = np.zeros((3, 3), bool)
    place[1, 1:] = True
    for vertex in (2.3, 1.6):
        planes = [plane(3.0 * (5.0 + (k - vertex) ** 2)) for k in range(6)]
        expected = 1 / (inverse[0] + vertex * (inverse[1] - inverse[0]))
        assert likeliest_depth_mm(planes, (1 / inverse).tolist(), place) == pytest.approx(expected, rel=1e-6)
    planes = [plane(3.0 * k + 3.0) for k in range(6)]
    assert likeliest_depth_mm(planes, (1 / inverse).tolist(), place) == pytest.approx(400.0)
    # Squares count per degree of freedom, one less than the views
    unequal = [plane(30.0, 4.0), plane(24.0, 3.0), plane(8.0, 2.0), plane(39.0, 4.0), plane(60.0, 4.0)]
    a, b, _ = np.polyfit([1, 2, 3], [12.0, 8.0, 13.0], 2)
    expected = 1 / (inverse[0] - b / (2 * a) * (inverse[1] - inverse[0]))
    assert likeliest_depth_mm(unequal, (1 / inverse[:5]).tolist(), place) == pytest.approx(expected, rel=1e-6)


def views(shift_px: float = 0.0, level_e: float = 20.0, detail_e: float = 0.0, seed: int = 0) -> ElementalImages:
    """Return four views of waves, each shifted against the one before."""
    rows, columns = np.indices(SHAPE, float)
    light = [level_e + detail_e * np.sin(1.2 * (columns - k * shift_px)) * np.cos(rows) for k in range(4)]
    electrons = np.random.default_rng(seed).poisson(light).astype(np.float32)
    return ElementalImages(electrons, background_e=0.0, read_variance_e2=0.0)


OVERLAID = views_displaced_by(np.zeros((4, 2)), SHAPE, margin=0)


def test_focus_of_noise_is_zero_within_sigma() -> None:
    result = [focus_measure(OVERLAID, views(seed=seed), HALVES) for seed in range(60)]
    detail = np.array([point.detail_e2 for point in result])
    sigma = np.mean([point.sigma_e2 for point in result])
    assert abs(detail.mean()) < 4 * sigma / np.sqrt(60)
    assert 0.7 < detail.std() / sigma < 1.3


def test_detail_counts_where_halves_agree() -> None:
    in_focus = focus_measure(OVERLAID, views(detail_e=8.0), HALVES)
    # Opposite waves in the two halves are worse than none
    opposite = focus_measure(OVERLAID, views(shift_px=np.pi / 1.2, detail_e=8.0), HALVES)
    assert in_focus.detail_e2 > 5 * in_focus.sigma_e2
    assert opposite.detail_e2 == pytest.approx(-in_focus.detail_e2, rel=0.2)


def test_views_without_common_samples_measure_nothing() -> None:
    apart = views_displaced_by(np.array([[0.0, 0.0], [0.0, 1000.0]] * 2), SHAPE, margin=0)
    assert focus_measure(apart, views(), HALVES) == FocusMeasure(0.0, 0.0)


_SHAPE = (30, 40)
_SHIFTS = np.array([(-4.5, -6.0), (-4.5, 6.0), (0.0, 0.0), (4.5, 6.0), (5.2, -6.0)])
_HALVES = (np.array([0, 3]), np.array([1, 2, 4]))


def views_operator(views: list[int], flat: np.ndarray | None, valid: np.ndarray | None) -> PlaneOperator:
    return views_displaced_by(_SHIFTS[views], _SHAPE, margin=0, flat=flat, valid=valid)


@pytest.fixture(params=["even", "vignetting and saturation"])
def problem(request: pytest.FixtureRequest) -> tuple[np.ndarray | None, ElementalImages]:
    generator = np.random.default_rng(3)
    electrons = generator.normal(5.0, 3.0, (5, *_SHAPE)).astype(np.float32)
    if request.param == "even":
        return None, ElementalImages(electrons)
    flat = generator.uniform(0.5, 1.0, _SHAPE).astype(np.float32)
    flat[7, 9] = 0
    return flat, ElementalImages(electrons, 0.7, valid=generator.random(electrons.shape) > 0.05)


def single_view(images: ElementalImages, view: int) -> ElementalImages:
    part = slice(view, view + 1)
    valid = None if images.valid is None else images.valid[part]
    return ElementalImages(images.electrons[part], images.background_e, valid=valid)


def added(problem: tuple[np.ndarray | None, ElementalImages], views: list[int]) -> RunningPlane:
    flat, images = problem
    running = RunningPlane(_SHAPE)
    for view in views:
        single = single_view(images, view)
        seen = seen_by_view(views_operator([view], flat, single.valid), single)
        running.add(seen, int(view in _HALVES[1]))
    return running


def test_mean_of_all_views_is_their_back_projection(problem: tuple[np.ndarray | None, ElementalImages]) -> None:
    flat, images = problem
    together = views_operator(list(range(5)), flat, images.valid)
    running = added(problem, [4, 0, 3, 1, 2])
    covered = together.coverage() > 0.01
    expected = back_projection(together, images)
    assert covered.mean() > 0.5
    np.testing.assert_allclose(running.mean()[covered], expected[covered], rtol=1e-4, atol=1e-4)
    assert not running.mean()[together.coverage() == 0].any()


def test_removed_view_leaves_nothing(problem: tuple[np.ndarray | None, ElementalImages]) -> None:
    flat, images = problem
    running = added(problem, [0, 1, 2, 3, 4])
    single = single_view(images, 4)
    running.remove(seen_by_view(views_operator([4], flat, single.valid), single), 1)
    without = added(problem, [0, 1, 2, 3])
    covered = without.covered
    np.testing.assert_allclose(running.mean()[covered], without.mean()[covered], atol=2e-4)
    assert (running.covered == covered).mean() > 0.99


def test_frames_of_partial_exposure_add_up() -> None:
    generator = np.random.default_rng(4)
    electrons = generator.poisson(20.0, (2, *_SHAPE)).astype(np.float32)
    running = RunningPlane(_SHAPE)
    for frame, share in zip(electrons, (0.25, 0.75), strict=True):
        running.add(seen_by_view(views_operator([2], None, None), ElementalImages(frame[np.newaxis]), share), 0)
    np.testing.assert_allclose(running.mean(), electrons.sum(axis=0), rtol=1e-4)


def test_focus_is_that_of_the_whole_set() -> None:
    images = ElementalImages(np.random.default_rng(5).normal(5.0, 3.0, (5, *_SHAPE)).astype(np.float32))
    result = added((None, images), [0, 1, 2, 3, 4]).focus()
    expected = focus_measure(views_operator(list(range(5)), None, None), images, _HALVES)
    # The two leave out other samples at the edges
    assert result.detail_e2 == pytest.approx(expected.detail_e2, abs=0.3 * expected.sigma_e2)
    assert result.sigma_e2 == pytest.approx(expected.sigma_e2, rel=0.2)


def test_no_focus_before_both_halves_have_views() -> None:
    images = ElementalImages(np.ones((5, *_SHAPE), np.float32))
    assert added((None, images), [0, 3]).focus() == (0.0, 0.0)
