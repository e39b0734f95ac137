"""PMLEM against two independent solvers on a dense matrix, and its certificate against true distances."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest

from faintfield.recon.errors import NotConverged
from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName, PixelLikelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.penalties import Penalty, differences
from faintfield.recon.solver.pmlem import PmlemIterate, norm, pmlem
from faintfield.recon.solver.proximal import DualField
from tests.recon.displaced import pixel_rays, run_until, views_displaced_by
from tests.recon.small_problems import (
    SHAPE,
    DenseProblem,
    box,
    difference_matrix,
    primal_dual_solution,
    problem,
    smooth_solution,
)

LIKELIHOODS: list[LikelihoodName] = ["shifted-poisson", "poisson-gaussian", "least-squares"]

WEIGHT, TV = 1.5, Penalty()


def started(posed: DenseProblem) -> tuple[DataFit, Image]:
    start = smooth_start(posed.operator, posed.images)
    return DataFit(posed.operator, posed.images, float(start.mean())), start


def iterates_of(
    posed: DenseProblem,
    proposal: Image | None = None,
    *,
    weight: float = WEIGHT,
    penalty: Penalty = TV,
    tolerance: float = 0.01,
) -> Iterator[PmlemIterate]:
    """Return iterates with a penalty that counts from a proposal."""
    fit, start = started(posed)
    dual = replace(DualField.zero([SHAPE], start.dtype), proposal=proposal)
    return pmlem(fit, start, penalty_weight=weight, penalty=penalty, tolerance=tolerance, dual=dual)


def solved(
    posed: DenseProblem, proposal: Image | None = None, *, tolerance: float = 1e-6, most: int = 400, **options: Any
) -> PmlemIterate:
    return run_until(iterates_of(posed, proposal, tolerance=tolerance, **options), tolerance, most)


def quadratic(delta: float) -> Callable[[Image], tuple[Image, Image]]:
    return lambda t: (t**2 / (2 * delta), np.full_like(t, 1 / delta))


def huber(delta: float) -> Callable[[Image], tuple[Image, Image]]:
    return lambda t: (np.where(t < delta, t**2 / (2 * delta), t - delta / 2), 1 / np.maximum(t, delta))


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
def test_total_variation_agrees_with_primal_dual_method(likelihood: LikelihoodName) -> None:
    posed = problem(likelihood, views=6)
    best = primal_dual_solution(posed, WEIGHT, 1000)
    assert distance(solved(posed).plane, best) <= 1e-4
    edges = np.hypot(*(difference_matrix() @ best.ravel()).reshape(2, -1))
    assert (edges < 1e-6).mean() > 0.2  # the penalty has an effect: pieces are flat


def distance(plane: Image, best: Image) -> float:
    return float(np.linalg.norm(plane - best) / np.linalg.norm(best))


def test_about_a_proposal_agrees_with_primal_dual_method() -> None:
    posed, proposal = problem(views=6), np.random.default_rng(20).uniform(0, 8, SHAPE)
    proposal[4:7, 1:5] += 9  # a box that the data do not show
    result = solved(posed, proposal)
    assert distance(result.plane, primal_dual_solution(posed, WEIGHT, 1000, proposal)) <= 2e-4
    assert distance(result.plane, solved(posed).plane) > 0.1
    value = DataFit(posed.operator, posed.images, 3.0).value_and_gradient(result.plane)[0]
    penalty = np.hypot(*(difference_matrix() @ (result.plane - proposal).ravel()).reshape(2, -1)).sum()
    assert result.objective == pytest.approx(value + WEIGHT * penalty, rel=1e-9)


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
@pytest.mark.parametrize("about_box", [False, True])
def test_certificate_bounds_distance_to_optimum(likelihood: LikelihoodName, about_box: bool) -> None:
    """Without a proposal, and about one with a box that is not there."""
    posed, proposal = problem(likelihood, seed=1), None
    if about_box:
        proposal = box(2.0, 6.0)
        proposal[4:7, 1:5] += 4
        proposal += np.random.default_rng(1).normal(0, 0.5, SHAPE)
    best = solved(posed, proposal).plane
    metric = started(posed)[0].metric(best)
    for tolerance in (0.1, 0.003):
        iterates = list(islice(iterates_of(posed, proposal, tolerance=tolerance), 8))
        for iterate in iterates:
            assert norm(iterate.plane - best, metric) / norm(best, metric) <= iterate.certificate.distance + 1e-6
        assert min(iterate.certificate.distance for iterate in iterates) <= tolerance


@pytest.mark.parametrize(
    ("likelihood", "penalty", "phi"),
    [
        ("shifted-poisson", "huber-tv", huber),
        ("poisson-gaussian", "quadratic", quadratic),
        ("least-squares", "huber-tv", huber),
    ],
)
def test_smooth_penalties_agree_with_quasi_newton_method(
    likelihood: LikelihoodName, penalty: str, phi: Callable[[float], Callable[[Image], tuple[Image, Image]]]
) -> None:
    posed = problem(likelihood, views=6)
    result = solved(posed, penalty=Penalty.for_noise(penalty, lambda: 0.7))  # type: ignore[arg-type]
    delta = {"quadratic": 0.7, "huber-tv": 0.07}[penalty]
    assert distance(result.plane, smooth_solution(posed, WEIGHT, phi(delta))) <= 1e-4


def test_no_penalty_gives_maximum_likelihood() -> None:
    posed = problem(views=30)
    best = smooth_solution(posed, 0.0, quadratic(1.0))
    assert distance(solved(posed, weight=0.0, penalty=Penalty("none"), most=3000).plane, best) <= 1e-4


def test_float32_reaches_the_same_plane() -> None:
    posed = problem()
    double = solved(posed).plane
    single = solved(problem(dtype=np.float32), tolerance=3e-3).plane
    assert single.dtype == np.float32
    assert distance(single, double) < 2e-3


def halves(light_e: float, contrast_e: float) -> Image:
    """Return two rows of two samples: the left column is darker than the right one."""
    return np.array([[light_e - contrast_e, light_e + contrast_e]] * 2)


@pytest.mark.parametrize("from_tension", [0.0, 0.3])
def test_certificate_is_tight_at_half_the_curvature(from_tension: float) -> None:
    """Pixels on the samples and a quarter from them see a contrast with half the curvature that they see light with.

    The penalty is just large enough for a level optimum. A plane with some contrast, and a dual field between the one
    that gives this plane and that of the optimum, are as far away as convexity allows.
    """
    contrast_e, light_e, true_contrast_e, variance_e2 = 1.0, 20.0, 2.0, 4.0
    columns = np.array([[0.0, 1.0], [0.25, 0.75]])
    rays = np.stack([np.stack(np.meshgrid(of_lattice, [0.0, 1.0]), axis=-1) for of_lattice in columns])
    grid, lattices = PlaneGrid((2, 2), 1.0, (0.0, 0.0)), np.array([0, 1, 1])
    operator = PlaneOperator(np.stack([np.eye(3)] * 3), rays, grid, lattice_of_view=lattices, dtype=np.float64)
    seen = halves(light_e, true_contrast_e) @ np.array([[[1, 0], [0, 1]], *[[[0.75, 0.25], [0.25, 0.75]]] * 2])
    likelihood = PixelLikelihood("least-squares", level_e=3.0)
    fit = DataFit(operator, ElementalImages(seen, 0.0, variance_e2 - 3.0, likelihood=likelihood), 3.0)
    metric = np.full((2, 2), 3 / variance_e2)
    np.testing.assert_allclose(fit.metric(halves(light_e, contrast_e)), metric, rtol=1e-12)

    def objective(plane: Image) -> float:
        return fit.value_and_gradient(plane)[0] + weight * float(np.hypot(*differences(plane)).sum())

    weight = 0.5 * 3 / variance_e2 * true_contrast_e
    best = halves(light_e, 0.0)
    generator = np.random.default_rng(1)
    assert all(objective(best) <= objective(best + generator.normal(0, 1e-3, (2, 2))) for _ in range(200))

    tension = 1 - (1 - from_tension) * contrast_e / true_contrast_e
    dual = DualField([np.array([np.zeros((2, 2)), [[tension, 0.0]] * 2])])
    result = next(pmlem(fit, halves(light_e, contrast_e), penalty_weight=weight, dual=dual))
    far = norm(result.plane - best, metric) / norm(result.plane, metric)
    assert result.certificate.distance == pytest.approx(far, rel=1e-9)
    a, root_2e = result.certificate.stationarity, result.certificate.slack
    assert far == pytest.approx(a + np.hypot(a, root_2e), rel=1e-9)


@pytest.mark.parametrize(
    ("background_e", "variance_e2", "low", "high", "reached"),
    [
        (0.3, 12.0, 0.5, 2.0, 0.01),
        (5.0, 2.0, 0.0, 900.0, 0.01),
        (0.0, 0.0, 1.0, 2000.0, 0.2),  # a thousand to one with no background: not in 40 passes
    ],
)
def test_objective_never_rises(
    background_e: float, variance_e2: float, low: float, high: float, reached: float
) -> None:
    fit, start = started(problem(background_e=background_e, variance_e2=variance_e2, low=low, high=high))
    iterates = list(islice(pmlem(fit, start, penalty_weight=0.5), 30))
    for before, after in pairwise(iterates):
        assert after.objective <= before.objective + 1e-6 * abs(before.objective)
    assert iterates[-1].certificate.distance < reached
    assert (iterates[-1].plane >= 0).all()


def test_metric_of_even_light_is_hessian_row_sums() -> None:
    """Σ over pixels of (response)²/(response · light + b + σ²), which an even plane lets one count by hand."""
    response = 0.3
    posed, light_e = problem(), 4.0
    flat = np.full(posed.operator.images_shape[1:], response)
    operator = views_displaced_by(posed.shifts, SHAPE, flat=flat, dtype=np.float64)
    fit = DataFit(operator, posed.images, light_e)
    counted = posed.matrix[posed.counted].sum(axis=0).reshape(SHAPE)
    known_e2 = float(posed.images.background_e) + float(posed.images.read_variance_e2)
    expected = counted * response**2 / (response * light_e + known_e2)
    np.testing.assert_allclose(fit.metric(np.full(SHAPE, light_e)), expected, rtol=1e-9)


def test_too_small_metric_is_enlarged_until_objective_falls() -> None:
    posed = problem()
    start = smooth_start(posed.operator, posed.images)

    class TooBold(DataFit):
        def metric(self, samples: Image) -> Image:
            return super().metric(samples) / 16

    bold = TooBold(posed.operator, posed.images, float(start.mean()))
    iterates = list(islice(pmlem(bold, start, penalty_weight=WEIGHT, tolerance=1e-4), 60))
    assert iterates[1].passes > 2  # steps were undone
    assert all(after.objective <= before.objective * (1 + 1e-6) for before, after in pairwise(iterates))
    assert distance(iterates[-1].plane, solved(posed).plane) < 2e-3


@pytest.mark.parametrize(("weight", "least", "words"), [(-1.0, 1.0, "penalty_weight"), (1.0, 0.0, "start must be")])
def test_arguments_out_of_range_are_refused(weight: float, least: float, words: str) -> None:
    fit, start = started(problem())
    with pytest.raises(ValueError, match=words):
        pmlem(fit, np.full_like(start, least), penalty_weight=weight)


def test_infinite_objective_is_refused() -> None:
    class Overflowing(DataFit):
        def value_and_gradient(self, samples: Image) -> tuple[float, Image]:
            return float("nan"), samples

    posed = problem()
    with pytest.raises(NotConverged, match="pass 1 left the finite numbers"):
        next(pmlem(Overflowing(posed.operator, posed.images, 1.0), np.ones(SHAPE), penalty_weight=1.0))


def test_bright_scenes_almost_without_read_noise_are_solved() -> None:
    """Samples beside a bright box fall towards zero, where the exact likelihood is steeper than numbers can say."""
    settings: Any = {"background_e": 0.0, "variance_e2": 0.008, "low": 5.0, "high": 16_000.0, "dtype": np.float32}
    fit, start = started(problem("poisson-gaussian", **settings))
    *_, last = islice(pmlem(fit, start, penalty_weight=1.0), 30)
    assert last.certificate.distance < 0.1
    assert last.plane.max() == pytest.approx(16_000, rel=0.1)


def test_without_light_optimum_is_black_and_certain() -> None:
    posed = problem()
    images = replace(posed.images, electrons=np.full_like(posed.images.electrons, -1.5))
    fit = DataFit(posed.operator, images, 1.0)
    iterate = run_until(pmlem(fit, np.ones(SHAPE), penalty_weight=WEIGHT), 0.0, 20)
    assert not iterate.plane.any()
    assert iterate.certificate.distance == 0


def test_unseen_samples_stay_finite() -> None:
    posed = problem()
    wide = PlaneGrid((4 * SHAPE[0], 4 * SHAPE[1]), 1.0, (-1.5 * SHAPE[1], -1.5 * SHAPE[0]))
    operator = PlaneOperator(np.stack([np.eye(3)] * 12), pixel_rays(SHAPE), wide, dtype=np.float64)
    images = replace(posed.images, electrons=posed.images.electrons[:, 1:-1, 1:-1])
    fit, start = DataFit(operator, images, 3.0), smooth_start(operator, images)
    assert np.median(operator.sensitivity()) == 0
    assert fit.metric(start).min() > 0
    *_, last = islice(pmlem(fit, start, penalty_weight=WEIGHT), 10)
    assert np.isfinite(last.plane).all()
