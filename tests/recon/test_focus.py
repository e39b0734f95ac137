"""Planes in focus: curves whose peaks are known, and the power of detail on views of known noise."""

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy import signal

from faintfield.recon.depth.agreement import Agreement
from faintfield.recon.depth.focus import FocusMeasure, focus_measure, likeliest_depth_mm, prominence, sharp_depths_mm
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator

SHAPE = (40, 50)
HALVES = (np.array([0, 2]), np.array([1, 3]))


def curve(heights: NDArray[np.floating], sigma_e2: float = 1e-6) -> list[FocusMeasure]:
    return [FocusMeasure(float(height), sigma_e2) for height in heights]


def test_a_parabola_has_its_focus_at_its_vertex_in_whatever_order_depths_are_given() -> None:
    depths = np.array([400.0, 430.0, 470.0, 520.0, 600.0])
    heights = 50.0 - 1e-3 * (depths - 481.0) ** 2
    assert sharp_depths_mm(depths.tolist(), curve(heights)) == pytest.approx([481.0])
    order = [3, 0, 4, 2, 1]
    assert sharp_depths_mm(depths[order].tolist(), curve(heights[order])) == pytest.approx([481.0])


def test_two_depths_are_no_curve_and_a_peak_at_an_end_lies_there() -> None:
    assert sharp_depths_mm([400.0, 500.0], curve(np.array([1.0, 2.0]))) == []
    assert sharp_depths_mm([400.0, 500.0, 600.0], curve(np.array([1.0, 2.0, 5.0]))) == [600.0]
    assert sharp_depths_mm([400.0, 500.0, 600.0], curve(np.array([5.0, 2.0, 1.0]))) == [400.0]


@pytest.mark.parametrize(("sigma_e2", "peaks"), [(0.19, 2), (0.21, 1)])
def test_a_peak_counts_that_stands_out_by_five_sigma(sigma_e2: float, peaks: int) -> None:
    heights = np.array([0.0, 5.0, 0.0, 1.0, 0.0])  # prominences of 5 and 1, range of 5
    assert len(sharp_depths_mm([1.0, 2.0, 3.0, 4.0, 5.0], curve(heights, sigma_e2))) == peaks


@pytest.mark.parametrize(("height", "peaks"), [(0.6, 2), (0.4, 1)])
def test_a_peak_counts_that_stands_out_by_a_tenth_of_the_range(height: float, peaks: int) -> None:
    heights = np.array([0.0, 5.0, 0.0, height, 0.0])
    assert len(sharp_depths_mm([1.0, 2.0, 3.0, 4.0, 5.0], curve(heights))) == peaks


def test_the_noise_of_a_curve_is_the_median_over_its_depths() -> None:
    points = [FocusMeasure(h, s) for h, s in zip((0.0, 5.0, 0.0, 1.0, 0.0), (0.1, 9.0, 0.1, 9.0, 0.1), strict=True)]
    assert len(sharp_depths_mm([1.0, 2.0, 3.0, 4.0, 5.0], points)) == 2


def test_prominences_are_those_of_scipy() -> None:
    heights = np.array([1.0, 4.0, 2.0, 9.0, 3.0, 6.0, 5.0, 5.5, 0.5])
    peaks = np.array([1, 3, 5, 7])
    expected = signal.peak_prominences(heights, peaks)[0]
    assert [prominence(heights, peak) for peak in peaks] == pytest.approx(expected.tolist())
    assert prominence(heights, 0) == prominence(heights, 4) == 0.0


def plane(squares: float, sensitivity: float = 4.0) -> Agreement:
    ones = np.ones((3, 3), np.float32)
    return Agreement(squares * ones, sensitivity * ones, ones, ones)


def test_the_likeliest_depth_is_the_vertex_over_inverse_depth() -> None:
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


def operator() -> PlaneOperator:
    rows, columns = np.indices(SHAPE, float)
    rays = np.stack([columns, rows], axis=-1)
    return PlaneOperator(np.stack([np.eye(3)] * 4), rays, PlaneGrid(SHAPE, 1.0, (0.0, 0.0)))


def test_noise_alone_has_a_focus_measure_of_zero_with_the_stated_sigma() -> None:
    h = operator()
    found = [focus_measure(h, views(seed=seed), HALVES) for seed in range(60)]
    detail = np.array([one.detail_e2 for one in found])
    sigma = np.mean([one.sigma_e2 for one in found])
    assert abs(detail.mean()) < 4 * sigma / np.sqrt(60)
    assert 0.7 < detail.std() / sigma < 1.3


def test_detail_counts_where_the_halves_agree_on_it() -> None:
    h = operator()
    in_focus = focus_measure(h, views(detail_e=8.0), HALVES)
    # Opposite waves in the two halves are worse than none
    opposite = focus_measure(h, views(shift_px=np.pi / 1.2, detail_e=8.0), HALVES)
    assert in_focus.detail_e2 > 5 * in_focus.sigma_e2
    assert opposite.detail_e2 == pytest.approx(-in_focus.detail_e2, rel=0.2)


def test_views_that_see_nothing_in_common_measure_nothing() -> None:
    homographies = np.stack([np.eye(3)] * 4)
    homographies[1::2, 0, 2] = 1000.0
    rows, columns = np.indices(SHAPE, float)
    apart = PlaneOperator(homographies, np.stack([columns, rows], axis=-1), PlaneGrid(SHAPE, 1.0, (0.0, 0.0)))
    assert focus_measure(apart, views(), HALVES) == FocusMeasure(0.0, 0.0)
