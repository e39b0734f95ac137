"""Views added one by one give what all of them together give."""

import numpy as np
import pytest

from faintfield.recon.depth.focus import focus_measure
from faintfield.recon.depth.running import RunningPlane, seen_by_view
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.initialization import back_projection

_SHAPE, _DEPTH_MM, _F_PX = (30, 40), 500.0, 50.0
_GRID = PlaneGrid(_SHAPE, _DEPTH_MM / _F_PX, (-19.5 * _DEPTH_MM / _F_PX, -14.5 * _DEPTH_MM / _F_PX))
_SHIFTS_MM = [(-60.0, -45.0), (60.0, -45.0), (0.0, 0.0), (60.0, 45.0), (-60.0, 52.0)]
_HALVES = (np.array([0, 3]), np.array([1, 2, 4]))


def operator(views: list[int], flat: np.ndarray | None, valid: np.ndarray | None) -> PlaneOperator:
    rows, columns = np.indices(_SHAPE)
    rays = np.stack([(columns - 19.5) / _F_PX, (rows - 14.5) / _F_PX], axis=-1)
    homographies = [[[_DEPTH_MM, 0, x], [0, _DEPTH_MM, y], [0, 0, 1]] for x, y in (_SHIFTS_MM[view] for view in views)]
    return PlaneOperator(np.array(homographies), rays, _GRID, flat=flat, valid=valid, workers=1)


@pytest.fixture(params=["even", "vignetting and saturation"])
def problem(request: pytest.FixtureRequest) -> tuple[np.ndarray | None, ElementalImages]:
    generator = np.random.default_rng(3)
    electrons = generator.normal(5.0, 3.0, (5, *_SHAPE)).astype(np.float32)
    if request.param == "even":
        return None, ElementalImages(electrons)
    flat = generator.uniform(0.5, 1.0, _SHAPE).astype(np.float32)
    flat[7, 9] = 0
    return flat, ElementalImages(electrons, 0.7, valid=generator.random(electrons.shape) > 0.05)


def one(images: ElementalImages, view: int) -> ElementalImages:
    part = slice(view, view + 1)
    valid = None if images.valid is None else images.valid[part]
    return ElementalImages(images.electrons[part], images.background_e, valid=valid)


def added(problem: tuple[np.ndarray | None, ElementalImages], views: list[int]) -> RunningPlane:
    flat, images = problem
    running = RunningPlane(_SHAPE)
    for view in views:
        single = one(images, view)
        seen = seen_by_view(operator([view], flat, single.valid), single)
        running.add(seen, int(view in _HALVES[1]))
    return running


def test_the_mean_of_all_views_is_their_back_projection(problem: tuple[np.ndarray | None, ElementalImages]) -> None:
    flat, images = problem
    together = operator(list(range(5)), flat, images.valid)
    running = added(problem, [4, 0, 3, 1, 2])
    covered = together.coverage() > 0.01
    expected = back_projection(together, images)
    assert covered.mean() > 0.5
    np.testing.assert_allclose(running.mean()[covered], expected[covered], rtol=1e-4, atol=1e-4)
    assert not running.mean()[together.coverage() == 0].any()


def test_a_view_that_was_removed_leaves_nothing(problem: tuple[np.ndarray | None, ElementalImages]) -> None:
    flat, images = problem
    running = added(problem, [0, 1, 2, 3, 4])
    single = one(images, 4)
    running.remove(seen_by_view(operator([4], flat, single.valid), single), 1)
    without = added(problem, [0, 1, 2, 3])
    covered = without.covered
    np.testing.assert_allclose(running.mean()[covered], without.mean()[covered], atol=2e-4)
    assert (running.covered == covered).mean() > 0.99


def test_frames_of_a_part_of_the_exposure_add_up_to_the_whole() -> None:
    generator = np.random.default_rng(4)
    electrons = generator.poisson(20.0, (2, *_SHAPE)).astype(np.float32)
    running = RunningPlane(_SHAPE)
    for frame, share in zip(electrons, (0.25, 0.75), strict=True):
        running.add(seen_by_view(operator([2], None, None), ElementalImages(frame[np.newaxis]), share), 0)
    np.testing.assert_allclose(running.mean(), electrons.sum(axis=0), rtol=1e-4)


def test_focus_is_that_of_the_whole_set() -> None:
    images = ElementalImages(np.random.default_rng(5).normal(5.0, 3.0, (5, *_SHAPE)).astype(np.float32))
    found = added((None, images), [0, 1, 2, 3, 4]).focus()
    expected = focus_measure(operator(list(range(5)), None, None), images, _HALVES)
    # The two leave out other samples at the edges
    assert found.detail_e2 == pytest.approx(expected.detail_e2, abs=0.3 * expected.sigma_e2)
    assert found.sigma_e2 == pytest.approx(expected.sigma_e2, rel=0.2)


def test_there_is_no_focus_before_both_halves_have_views() -> None:
    images = ElementalImages(np.ones((5, *_SHAPE), np.float32))
    assert added((None, images), [0, 3]).focus() == (0.0, 0.0)
