"""Several planes solved together, against a primal-dual method and the solver of one plane; metrics and starts."""

import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from itertools import islice

import numpy as np
import pytest

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.evidence import evidence_of_planes
from faintfield.recon.solver.data_fit import DataFit, SceneProblem
from faintfield.recon.solver.initialization import back_projection, mean_light_e, smooth_start
from faintfield.recon.solver.penalty_weight import universal_penalty_weight
from faintfield.recon.solver.pmlem import PmlemIterate, pmlem
from faintfield.recon.solver.uncertainty import local_fits
from tests.recon.displaced import noisy_images, pixel_rays, planes_displaced_by, run_until, views_displaced_by
from tests.recon.operator_contract import dense_matrix
from tests.recon.small_problems import (
    SHAPE,
    TWO_GRIDS,
    Likelihood,
    box,
    difference_matrix,
    primal_dual_solution,
    problem,
    shifted_views,
    two_planes,
)

WEIGHT = 0.8


def solved(posed: SceneProblem, weight: float, tolerance: float = 1e-7, most: int = 4000) -> PmlemIterate:
    start = posed.start()
    fit = posed.fit(mean_light_e(posed.operator, start))
    return run_until(pmlem(fit, start, penalty_weight=weight, tolerance=tolerance, dual=posed.dual()), tolerance, most)


@pytest.mark.parametrize(("likelihood", "occluded"), [("shifted-poisson", True), ("least-squares", False)])
def test_two_planes_agree_with_primal_dual_method(likelihood: LikelihoodName, occluded: bool) -> None:
    posed = two_planes(likelihood, occluded=occluded)
    gradient_of = difference_matrix(*(grid.shape for grid in TWO_GRIDS))
    best = primal_dual_solution(
        Likelihood(posed.images, dense_matrix(posed.operator)), WEIGHT, 1200, gradient_of=gradient_of
    )
    assert np.linalg.norm(solved(posed, WEIGHT).plane - best) <= 1e-4 * np.linalg.norm(best)
    alone = [np.linalg.norm(part) for part in posed.operator.planes_of(best)]
    assert min(alone) > 0.2 * max(alone)


def test_no_array_is_as_large_as_the_images() -> None:
    """Two passes with all views but one, and what follows them."""
    peaks = []
    for views in (3, 24):  # the first compiles and imports
        posed = _wide_scene(views)
        operator, images = posed.operator, posed.images
        training, held_out = operator.seeing_views[:-1], operator.seeing_views[-1:]
        tracemalloc.start()
        fit = posed.fit(1.0, training)
        *_, last = islice(pmlem(fit, posed.start(training), penalty_weight=1.0, dual=posed.dual()), 2)
        operator.negative_log_likelihood(last.plane, images, held_out)
        local_fits(operator, fit, last.plane)
        evidence_of_planes(operator, images, last.plane)
        peaks.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert peaks[-1] < images.electrons.nbytes / 4


def _wide_scene(views: int) -> SceneProblem:
    """Return two planes of few samples, which hide each other, in views of many pixels."""
    generator = np.random.default_rng(5)
    homographies = np.stack([np.eye(3)] * 2 * views).reshape(2, views, 3, 3)
    homographies[0, :, :2, 2] = generator.uniform(-9, 9, (views, 2))
    grids = [PlaneGrid((32, 32), 4.0, (0.0, 0.0))] * 2
    hiding = Occluders([np.full((32, 32), 0.5)] * 2, [500.0, 700.0])
    electrons = generator.normal(1, 3, (views, 128, 128)).astype(np.float32)
    operator = SceneOperator(homographies, pixel_rays((128, 128)), grids, occluders=hiding, workers=2)
    return SceneProblem(operator, ElementalImages(electrons, 0.1, 9.0))


def test_scene_of_one_plane_equals_that_plane() -> None:
    posed = problem()
    plane = posed.operator
    scene_of_one = planes_displaced_by([posed.shifts], SHAPE, dtype=np.float64)
    alone = solved(SceneProblem(plane, posed.images), 1.5)
    same = solved(SceneProblem(scene_of_one, posed.images), 1.5)
    np.testing.assert_array_equal(same.plane, alone.plane.ravel())
    # A plane that hides nothing changes nothing but the way to the metric, which is that of several planes
    clear = Occluders([np.zeros(SHAPE)], [500.0])
    general = planes_displaced_by([posed.shifts], SHAPE, occluders=clear, dtype=np.float64)
    together = solved(SceneProblem(general, posed.images), 1.5)
    np.testing.assert_allclose(together.plane.reshape(SHAPE), alone.plane, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("occluded", [False, True])
def test_metric_bounds_curvature_between_planes(occluded: bool) -> None:
    posed = two_planes(occluded=occluded)
    matrix, start = dense_matrix(posed.operator), posed.start()
    light = matrix @ start + 1.3
    hessian = matrix.T @ (matrix / light[:, None])
    metric = posed.fit(mean_light_e(posed.operator, start)).metric(start)
    scaled = hessian / np.sqrt(np.outer(metric, metric))
    assert 0.5 < np.linalg.eigvalsh(scaled)[-1] <= 1 + 1e-9


def test_samples_hardly_seen_follow_neighbours_in_solvers_alone() -> None:
    operator = shifted_views(4, unseen_columns=4)
    fit = DataFit(operator, ElementalImages(np.ones(operator.images_shape), 0.1, 9.0), 1.0)
    samples = np.ones(operator.samples_shape)
    (of_errors,) = fit.metric_of_each(samples)
    metric = fit.metric(samples)
    assert metric.min() == pytest.approx(10 * of_errors.min())
    np.testing.assert_array_equal(metric, np.maximum(of_errors, metric.min()))


def test_left_out_views_do_not_count() -> None:
    posed, kept = two_planes(), np.array([0, 2, 3, 5, 8])
    electrons = posed.images.electrons.copy()
    electrons[[1, 4, 6, 7]] = np.random.default_rng(1).normal(100, 1, (4, *electrons.shape[1:]))
    changed = SceneProblem(posed.operator, ElementalImages(electrons, 0.3, 1.0))
    start = posed.start()
    np.testing.assert_allclose(changed.start(kept), posed.start(kept), rtol=1e-12)
    first, second = posed.fit(1.0, kept), changed.fit(1.0, kept)
    value, gradient = first.value_and_gradient(start)
    again = changed.operator.negative_log_likelihood(start, changed.images, kept)
    assert again == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(second.value_and_gradient(start)[1], gradient, rtol=1e-12)
    np.testing.assert_allclose(second.metric(start), first.metric(start), rtol=1e-12)
    assert not np.allclose(posed.fit(1.0).metric(start), first.metric(start))


def test_noise_map_bounds_curvature_by_mean_precision() -> None:
    operator = views_displaced_by(np.array([[0.0, -2.3], [0.0, 0.0], [0.0, 3.1]]), (12, 16), margin=0)
    electrons = np.random.default_rng(2).poisson(5.0, operator.images_shape).astype(np.float64)
    noise = np.random.default_rng(4).uniform(1.0, 6.0, (1, 12, 16))
    images = ElementalImages(electrons, background_e=0.0, read_variance_e2=noise)
    level_e = 5.0
    samples = np.full(operator.samples_shape, level_e)
    # A sample's noise is that whose precision, with the typical light, is the mean of Hᵀ
    precision = operator.adjoint(np.broadcast_to(1 / (level_e + noise), operator.images_shape).copy())
    mean = precision / operator.sensitivity()
    response = operator.coverage() / operator.sensitivity()
    known_e2 = 1 / mean - level_e
    expected = operator.coverage() * blurred(1 / (level_e * response + known_e2), (1,))
    result = DataFit(operator, images, level_e).metric(samples)
    np.testing.assert_allclose(result, expected, rtol=1e-5)


@pytest.mark.parametrize("views", [None, [0, 3]])
@pytest.mark.parametrize("estimate", [back_projection, smooth_start])
def test_constant_plane_stays_constant(views: list[int] | None, estimate: Callable[..., Image]) -> None:
    generator = np.random.default_rng(3)
    valid = generator.random((4, 11, 9)) < 0.8
    operator = shifted_views(4, unseen_columns=4, flat=generator.uniform(0.4, 1, (11, 9)), valid=valid)
    background_e = generator.uniform(0, 5, (1, 11, 9))
    images = ElementalImages(operator.forward(np.full(SHAPE, 2.5)) + background_e, background_e)
    plane = estimate(operator, images) if estimate is smooth_start else estimate(operator, images, views)
    seen = operator.coverage(views) > 1e-3
    assert 0 < seen.sum() < seen.size
    np.testing.assert_allclose(plane[seen], 2.5, rtol=1e-12)


def test_back_projection_is_zero_where_no_view_sees() -> None:
    operator = shifted_views(1, unseen_columns=4)
    electrons = np.random.default_rng(3).normal(size=operator.images_shape)
    plane = back_projection(operator, ElementalImages(electrons, background_e=0.5))
    np.testing.assert_allclose(plane[:, :-4], electrons[0, 1:-1, 1:] - 0.5, rtol=1e-12)
    np.testing.assert_array_equal(plane[:, -4:], 0.0)


def test_start_is_positive_where_data_are_negative() -> None:
    operator = shifted_views(3, unseen_columns=5)
    assert smooth_start(operator, ElementalImages(np.full(operator.images_shape, -1.0))).min() > 0
    electrons = np.where(np.arange(operator.images_shape[2]) < 3, 50.0, -1.0) * np.ones(operator.images_shape)
    level_e = operator.adjoint(electrons).sum() / operator.coverage().sum()
    start = smooth_start(operator, ElementalImages(electrons))
    assert start.min() == pytest.approx(0.01 * level_e, rel=1e-9)
    assert start.max() > 2 * level_e


def test_start_has_mean_level_far_from_seen_samples() -> None:
    operator = shifted_views(3, unseen_columns=10)
    start = smooth_start(operator, ElementalImages(np.full(operator.images_shape, 7.0)))
    assert (operator.coverage()[:, 3:] == 0).all()
    np.testing.assert_allclose(start, 7.0, rtol=1e-12)


def test_universal_weight_is_the_noise_of_the_gradient() -> None:
    operator = shifted_views(6)
    images = noisy_images(operator, box(2, 6), 0.5, 12.0, 2)
    weight = universal_penalty_weight(operator, images, np.full(SHAPE, 3.0))
    assert weight == pytest.approx(0.7 * np.sqrt(6 / 15.5), rel=1e-12)
    brighter = replace(images, background_e=0.5 + 15.5 * 3)
    assert universal_penalty_weight(operator, brighter, np.full(SHAPE, 3.0)) == pytest.approx(weight / 2, rel=1e-12)
