"""Several planes solved together, against a primal-dual method on dense matrices and the solver of one plane."""

import tracemalloc

import numpy as np
import pytest

from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName, PixelLikelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.evidence import evidence_of_planes
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import mean_light_e
from faintfield.recon.solver.pmlem import PmlemIterate, pmlem
from faintfield.recon.solver.uncertainty import local_fits
from tests.recon.small_problems import problem

WEIGHT = 0.8
VIEWS, SIZE = 9, 12
GRIDS = PlaneGrid((10, 9), 1.0, (1.0, 1.0)), PlaneGrid((7, 8), 1.5, (0.2, 0.4))


def scene(likelihood: LikelihoodName = "shifted-poisson", *, occluded: bool = False, seed: int = 3) -> SceneProblem:
    """Two planes of unlike grids, which slide over each other from view to view."""
    generator = np.random.default_rng(seed)
    homographies = np.stack([np.eye(3)] * 2 * VIEWS).reshape(2, VIEWS, 3, 3)
    homographies[0, :, :2, 2] = generator.uniform(-2.5, 2.5, (VIEWS, 2))
    homographies[1, :, :2, 2] = generator.uniform(-0.5, 0.5, (VIEWS, 2))
    rays = np.stack(np.meshgrid(np.arange(float(SIZE)), np.arange(float(SIZE))), axis=-1)
    opacities = [generator.uniform(0, 0.8, grid.shape) for grid in GRIDS]
    hiding = Occluders(opacities, [500.0, 700.0]) if occluded else None
    operator = SceneOperator(homographies, rays, GRIDS, occluders=hiding, dtype=np.float64, workers=1)
    near, far = np.zeros(GRIDS[0].shape), np.zeros(GRIDS[1].shape)
    near[3:7, 2:6], far[1:5, 4:7] = 5.0, 3.0
    mean = operator.forward(operator.samples_of([near, far]))
    electrons = generator.poisson(mean + 0.3) + generator.normal(0, 1, mean.shape)
    judged_by = PixelLikelihood(likelihood, level_e=2.0 if likelihood == "least-squares" else 0.0)
    return SceneProblem(operator, ElementalImages(electrons, 0.3, 1.0, likelihood=judged_by))


def solved(posed: SceneProblem, weight: float, tolerance: float = 1e-7, most: int = 4000) -> PmlemIterate:
    start = posed.start()
    fit = posed.fit(mean_light_e(posed.operator, start))
    for iterate in pmlem(fit, start, penalty_weight=weight, tolerance=tolerance, dual=posed.dual()):
        if iterate.certificate.distance <= tolerance or iterate.passes >= most:
            break
    return iterate


def dense(operator: SceneOperator) -> Image:
    """H as a matrix (pixel, sample), by what it makes of each sample."""
    count = sum(grid.shape[0] * grid.shape[1] for grid in operator.grids)
    return np.stack([operator.forward(one).ravel() for one in np.eye(count)], axis=1)


def differences() -> Image:
    """∇ of both planes as a matrix (2 · samples, samples): all differences down, then all to the right."""
    index = np.arange(sum(grid.shape[0] * grid.shape[1] for grid in GRIDS))
    matrix = np.zeros((2, index.size, index.size))
    first = 0
    for grid in GRIDS:
        part = index[first : first + grid.shape[0] * grid.shape[1]].reshape(grid.shape)
        first += part.size
        for axis, (here, there) in enumerate(((part[:-1], part[1:]), (part[:, :-1], part[:, 1:]))):
            matrix[axis, here.ravel(), there.ravel()] = 1
            matrix[axis, here.ravel(), here.ravel()] = -1
    return matrix.reshape(-1, index.size)


def objective_and_gradient(posed: SceneProblem, counted: tuple[Image, Image], f: Image) -> tuple[float, Image]:
    """The negative log-likelihood of all planes and its gradient, by formulas of their own."""
    rows, g = counted
    mean = rows @ f + 0.3
    if posed.images.likelihood.name == "least-squares":
        variance = 2.0 + 0.3 + 1.0
        return float(np.sum((g - mean) ** 2) / (2 * variance)), rows.T @ ((mean - g) / variance)
    y, m = np.maximum(g + 1, 0), mean + 1
    return float(np.sum(m - y * np.log(m))), rows.T @ (1 - y / m)


def primal_dual(posed: SceneProblem, weight: float, passes: int) -> Image:
    """The optimum by Condat and Vũ's iteration with fixed steps."""
    matrix, gradient_of = dense(posed.operator), differences()
    samples, counted = matrix.shape[1], matrix.any(axis=1)
    seen = matrix[counted], posed.images.electrons.ravel()[counted]
    curvature = np.linalg.norm(matrix, 2) ** 2 * 4
    step, dual_step = 1 / curvature, curvature / (16 * weight**2)
    f, p = np.ones(samples), np.zeros(2 * samples)
    for _ in range(passes):
        slope = objective_and_gradient(posed, seen, f)[1]
        ahead = np.maximum(f - step * (slope + weight * (gradient_of.T @ p)), 0)
        p = p + dual_step * weight * (gradient_of @ (2 * ahead - f))
        p = (p.reshape(2, samples) / np.maximum(np.hypot(*p.reshape(2, samples)), 1)).ravel()
        f = ahead
    return f


@pytest.mark.parametrize(("likelihood", "occluded"), [("shifted-poisson", True), ("least-squares", False)])
def test_planes_solved_together_agree_with_a_primal_dual_method(likelihood: LikelihoodName, occluded: bool) -> None:
    posed = scene(likelihood, occluded=occluded)
    best = primal_dual(posed, WEIGHT, 5000)
    found = solved(posed, WEIGHT).plane
    assert np.linalg.norm(found - best) <= 1e-4 * np.linalg.norm(best)
    alone = [np.linalg.norm(part) for part in posed.operator.planes_of(best)]
    assert min(alone) > 0.2 * max(alone)


def test_no_array_is_as_large_as_the_images() -> None:
    _solve(_wide_scene(3))  # compiles and imports
    posed = _wide_scene(60)
    tracemalloc.start()
    _solve(posed)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < posed.images.electrons.nbytes / 4


def _wide_scene(views: int) -> SceneProblem:
    """Two planes of few samples, which hide each other, in views of many pixels."""
    generator = np.random.default_rng(5)
    homographies = np.stack([np.eye(3)] * 2 * views).reshape(2, views, 3, 3)
    homographies[0, :, :2, 2] = generator.uniform(-9, 9, (views, 2))
    rays = np.stack(np.meshgrid(np.arange(128.0), np.arange(128.0)), axis=-1)
    grids = [PlaneGrid((32, 32), 4.0, (0.0, 0.0))] * 2
    hiding = Occluders([np.full((32, 32), 0.5)] * 2, [500.0, 700.0])
    electrons = generator.normal(1, 3, (views, 128, 128)).astype(np.float32)
    operator = SceneOperator(homographies, rays, grids, occluders=hiding, workers=2)
    return SceneProblem(operator, ElementalImages(electrons, 0.1, 9.0))


def _solve(posed: SceneProblem) -> None:
    """Make two passes with all views but one, and what else is done with the planes."""
    operator, images = posed.operator, posed.images
    training, (held_out,) = operator.seeing_views[:-1], operator.seeing_views[-1:]
    fit = posed.fit(1.0, training)
    iterates = pmlem(fit, posed.start(training), penalty_weight=1.0, dual=posed.dual())
    plane = [next(iterates).plane for _ in range(2)][-1]
    operator.negative_log_likelihood(plane, images, [held_out])
    local_fits(operator, fit, plane)
    evidence_of_planes(operator, images, plane)


def test_a_scene_of_one_plane_equals_that_plane() -> None:
    posed = problem()
    plane = posed.operator
    homographies, rays = posed.homographies[np.newaxis], posed.rays
    scene_of_one = SceneOperator(homographies, rays, [plane.grid], dtype=np.float64, workers=1)
    alone = solved(SceneProblem(plane, posed.images), 1.5)
    same = solved(SceneProblem(scene_of_one, posed.images), 1.5)
    np.testing.assert_array_equal(same.plane, alone.plane.ravel())
    # A plane that hides nothing changes nothing but the way to the metric, which is that of several planes
    clear = Occluders([np.zeros(plane.grid.shape)], [500.0])
    general = SceneOperator(homographies, rays, [plane.grid], occluders=clear, dtype=np.float64, workers=1)
    together = solved(SceneProblem(general, posed.images), 1.5)
    np.testing.assert_allclose(together.plane.reshape(plane.grid.shape), alone.plane, rtol=1e-4, atol=1e-5)


@pytest.mark.parametrize("occluded", [False, True])
def test_the_metric_bounds_the_curvature_between_planes_too(occluded: bool) -> None:
    posed = scene(occluded=occluded)
    matrix, start = dense(posed.operator), posed.start()
    light = matrix @ start + 1.3
    hessian = matrix.T @ (matrix / light[:, None])
    metric = posed.fit(mean_light_e(posed.operator, start)).metric(start)
    scaled = hessian / np.sqrt(np.outer(metric, metric))
    assert 0.5 < np.linalg.eigvalsh(scaled)[-1] <= 1 + 1e-9


def test_views_that_are_left_out_do_not_count() -> None:
    posed = scene()
    kept = np.array([0, 2, 3, 5, 8])
    generator = np.random.default_rng(1)
    electrons = posed.images.electrons.copy()
    electrons[[1, 4, 6, 7]] = generator.normal(100, 1, (4, SIZE, SIZE))
    other = SceneProblem(posed.operator, ElementalImages(electrons, 0.3, 1.0))
    np.testing.assert_allclose(posed.start(kept), other.start(kept), rtol=1e-12)
    first, second = posed.fit(1.0, kept), other.fit(1.0, kept)
    value, gradient = first.value_and_gradient(posed.start())
    again = other.operator.negative_log_likelihood(posed.start(), other.images, kept)
    assert again == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(second.value_and_gradient(posed.start())[1], gradient, rtol=1e-12)
    np.testing.assert_allclose(second.metric(posed.start()), first.metric(posed.start()), rtol=1e-12)
    assert not np.allclose(posed.fit(1.0).metric(posed.start()), first.metric(posed.start()))
