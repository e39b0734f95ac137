"""PMLEM against two independent solvers on a dense matrix, and its certificate against true distances."""

from collections.abc import Callable, Iterator
from dataclasses import replace
from itertools import islice, pairwise

import numpy as np
import pytest

from faintfield.recon.errors import NotConverged
from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName, PixelLikelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.penalties import Penalty, differences
from faintfield.recon.solver.pmlem import PmlemIterate, norm, pmlem
from faintfield.recon.solver.proximal import DualField
from tests.recon.small_problems import (
    SHAPE,
    DenseProblem,
    difference_matrix,
    primal_dual_solution,
    problem,
    smooth_solution,
)

LIKELIHOODS: list[LikelihoodName] = ["shifted-poisson", "poisson-gaussian", "least-squares"]
WEIGHT = 1.5


def started(posed: DenseProblem) -> tuple[DataFit, Image]:
    start = smooth_start(posed.operator, posed.images)
    return DataFit(posed.operator, posed.images, float(start.mean())), start


def solved(
    posed: DenseProblem, weight: float, penalty: Penalty, *, tolerance: float = 1e-6, most: int = 400
) -> PmlemIterate:
    fit, start = started(posed)
    for iterate in pmlem(fit, start, penalty_weight=weight, penalty=penalty, tolerance=tolerance):
        if iterate.certificate.distance <= tolerance or iterate.passes >= most:
            break
    return iterate


def distance(found: Image, best: Image) -> float:
    return float(np.linalg.norm(found - best) / np.linalg.norm(best))


def quadratic(delta: float) -> Callable[[Image], tuple[Image, Image]]:
    return lambda t: (t**2 / (2 * delta), np.full_like(t, 1 / delta))


def huber(delta: float) -> Callable[[Image], tuple[Image, Image]]:
    return lambda t: (np.where(t < delta, t**2 / (2 * delta), t - delta / 2), 1 / np.maximum(t, delta))


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
def test_total_variation_agrees_with_a_primal_dual_method(likelihood: LikelihoodName) -> None:
    posed = problem(likelihood)
    best = primal_dual_solution(posed, WEIGHT, 5000)
    found = solved(posed, WEIGHT, Penalty())
    assert distance(found.plane, best) <= 1e-4
    differences = (difference_matrix() @ best.ravel()).reshape(2, -1)
    assert (np.hypot(*differences) < 1e-6).mean() > 0.2  # the penalty has an effect: pieces are flat


def about(proposal: Image | None, posed: DenseProblem, *, tolerance: float = 0.01) -> Iterator[PmlemIterate]:
    """Iterates with total variation counted from a proposal."""
    fit, start = started(posed)
    dual = replace(DualField.zero([SHAPE], start.dtype), proposal=proposal)
    return pmlem(fit, start, penalty_weight=WEIGHT, tolerance=tolerance, dual=dual)


def a_proposal(seed: int) -> Image:
    """A plane with a box that the data do not show, and much that they contradict."""
    proposal = np.random.default_rng(seed).uniform(0, 8, SHAPE)
    proposal[4:7, 1:5] += 9
    return proposal


def settled_about(proposal: Image, posed: DenseProblem) -> PmlemIterate:
    for found in about(proposal, posed, tolerance=1e-6):
        if found.certificate.distance <= 1e-6 or found.passes >= 400:
            break
    return found


def test_total_variation_about_a_proposal_agrees_with_a_primal_dual_method() -> None:
    likelihood: LikelihoodName = "shifted-poisson"
    posed, proposal = problem(likelihood), a_proposal(20)
    found = settled_about(proposal, posed)
    assert distance(found.plane, primal_dual_solution(posed, WEIGHT, 5000, proposal)) <= 2e-4
    assert distance(found.plane, solved(posed, WEIGHT, Penalty()).plane) > 0.1
    value = DataFit(posed.operator, posed.images, 3.0).value_and_gradient(found.plane)[0]
    penalty = np.hypot(*(difference_matrix() @ (found.plane - proposal).ravel()).reshape(2, -1)).sum()
    assert found.objective == pytest.approx(value + WEIGHT * penalty, rel=1e-9)


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
def test_certificate_bounds_distance_about_false_box(
    likelihood: LikelihoodName,
) -> None:
    seed = 1
    posed, proposal = problem(likelihood, seed=seed), np.full(SHAPE, 2.0)
    proposal[2:6, 3:9] = 6
    proposal[4:7, 1:5] += 4
    proposal += np.random.default_rng(seed).normal(0, 0.5, SHAPE)
    best = settled_about(proposal, posed).plane
    metric = started(posed)[0].metric(best)
    for tolerance in (0.1, 0.003):
        iterates = list(islice(about(proposal, posed, tolerance=tolerance), 8))
        for iterate in iterates:
            assert norm(iterate.plane - best, metric) / norm(best, metric) <= iterate.certificate.distance + 1e-6
        assert min(iterate.certificate.distance for iterate in iterates) <= tolerance


def test_certificate_parts_bound_distance_about_any_proposal() -> None:
    """With m of the straight way to the optimum, `(a + √(a² + 4 m e))/2m` bounds the distance, by convexity alone.

    A rough proposal that the data contradict has an m below the ½ that the certificate assumes.
    """
    seed = 1
    posed, proposal = problem("least-squares", seed=seed), a_proposal(seed)
    best = settled_about(proposal, posed).plane
    metric = started(posed)[0].metric(best)
    rows = posed.matrix[posed.counted()]
    variance_e2 = posed.images.likelihood.level_e + posed.images.background_e + posed.images.read_variance_e2
    for iterate in islice(about(proposal, posed, tolerance=0.003), 10):
        away = iterate.plane - best
        far, size = norm(away, metric), norm(iterate.plane, metric)
        m = float(np.sum((rows @ away.ravel()) ** 2 / variance_e2)) / far**2
        a, e = iterate.certificate.stationarity * size, (iterate.certificate.slack * size) ** 2 / 2
        assert far <= (a + np.sqrt(a**2 + 4 * m * e)) / (2 * m) + 1e-5 * size


@pytest.mark.parametrize(
    ("likelihood", "penalty", "phi"),
    [
        ("shifted-poisson", "huber-tv", huber),
        ("poisson-gaussian", "quadratic", quadratic),
        ("least-squares", "huber-tv", huber),
    ],
)
def test_smooth_penalties_agree_with_a_quasi_newton_method(
    likelihood: LikelihoodName, penalty: str, phi: Callable[[float], Callable[[Image], tuple[Image, Image]]]
) -> None:
    posed = problem(likelihood)
    found = solved(posed, WEIGHT, Penalty.for_noise(penalty, lambda: 0.7))  # type: ignore[arg-type]
    delta = {"quadratic": 0.7, "huber-tv": 0.07}[penalty]
    assert distance(found.plane, smooth_solution(posed, WEIGHT, phi(delta))) <= 1e-4


@pytest.mark.parametrize("likelihood", LIKELIHOODS[:2])
def test_without_penalty_it_finds_the_maximum_of_the_likelihood(likelihood: LikelihoodName) -> None:
    posed = problem(likelihood, views=30)
    best = smooth_solution(posed, 0.0, quadratic(1.0))
    assert distance(solved(posed, 0.0, Penalty("none"), most=3000).plane, best) <= 1e-4


@pytest.mark.parametrize("likelihood", LIKELIHOODS)
def test_certificate_bounds_distance_to_optimum(likelihood: LikelihoodName) -> None:
    seed = 2
    posed = problem(likelihood, seed=seed)
    best = solved(posed, WEIGHT, Penalty(), tolerance=1e-7).plane
    fit, start = started(posed)
    metric = fit.metric(best)
    for tolerance in (0.1, 0.003):
        for iterate in islice(pmlem(fit, start, penalty_weight=WEIGHT, tolerance=tolerance), 8):
            true = norm(iterate.plane - best, metric) / norm(best, metric)
            assert true <= iterate.certificate.distance + 1e-6
        assert iterate.certificate.distance <= tolerance


def halves(light_e: float, contrast_e: float) -> Image:
    """Two rows of two samples: the left column is darker than the right one."""
    return np.array([[light_e - contrast_e, light_e + contrast_e]] * 2)


@pytest.mark.parametrize("from_tension", [0.0, 0.3])
def test_certificate_is_tight_at_half_the_curvature(
    from_tension: float,
) -> None:
    """Pixels on the samples and a quarter from them see a contrast with half the curvature that they see light with.

    The penalty is just large enough for a level optimum. A plane with some contrast, and a dual field between the one
    that gives this plane and that of the optimum, are as far away as convexity allows.
    """
    contrast_e = 1.0
    light_e, true_contrast_e, variance_e2 = 20.0, 2.0, 4.0
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
    assert all(objective(best) <= objective(best + generator.normal(0, 1e-3, (2, 2))) for _ in range(1000))

    tension = 1 - (1 - from_tension) * contrast_e / true_contrast_e
    dual = DualField([np.array([np.zeros((2, 2)), [[tension, 0.0]] * 2])])
    found = next(pmlem(fit, halves(light_e, contrast_e), penalty_weight=weight, dual=dual))
    far = norm(found.plane - best, metric) / norm(found.plane, metric)
    assert far <= found.certificate.distance * (1 + 1e-9)
    assert found.certificate.distance == pytest.approx(far, rel=1e-9)


@pytest.mark.parametrize(
    ("background_e", "variance_e2", "low", "high", "reached"),
    [
        (0.3, 12.0, 0.5, 2.0, 0.01),
        (5.0, 2.0, 0.0, 900.0, 0.01),
        (0.0, 0.0, 1.0, 2000.0, 0.2),  # a thousand to one with no background: not in 40 passes
    ],
)
def test_the_objective_never_rises(
    background_e: float, variance_e2: float, low: float, high: float, reached: float
) -> None:
    posed = problem(background_e=background_e, variance_e2=variance_e2, low=low, high=high)
    fit, start = started(posed)
    iterates = []
    for iterate in pmlem(fit, start, penalty_weight=0.5):
        iterates.append(iterate)
        if iterate.passes >= 40 or iterate.certificate.distance < 0.003:
            break
    for before, after in pairwise(iterates):
        assert after.objective <= before.objective + 1e-6 * abs(before.objective)
    assert iterates[-1].certificate.distance < reached
    assert (iterates[-1].plane >= 0).all()


def test_the_metric_of_even_light_is_the_row_sums_of_the_hessian_under_any_response() -> None:
    """Σ over pixels of (response)²/(response · light + b + σ²), which an even plane lets one count by hand."""
    response = 0.3
    posed, light_e = problem(), 4.0
    grid, flat = PlaneGrid(SHAPE, 1.0, (0.0, 0.0)), np.full(posed.rays.shape[:2], response)
    operator = PlaneOperator(posed.homographies, posed.rays, grid, flat=flat, dtype=np.float64)
    fit = DataFit(operator, posed.images, light_e)
    counted = posed.matrix[posed.counted()].sum(axis=0).reshape(SHAPE)
    known_e2 = float(posed.images.background_e) + float(posed.images.read_variance_e2)
    expected = counted * response**2 / (response * light_e + known_e2)
    np.testing.assert_allclose(fit.metric(np.full(SHAPE, light_e)), expected, rtol=1e-9)


def test_a_metric_that_is_too_small_is_made_larger_until_the_objective_falls() -> None:
    posed = problem()
    start = smooth_start(posed.operator, posed.images)

    class TooBold(DataFit):
        def metric(self, samples: Image) -> Image:
            return super().metric(samples) / 16

    bold = TooBold(posed.operator, posed.images, float(start.mean()))
    iterates = list(islice(pmlem(bold, start, penalty_weight=WEIGHT, tolerance=1e-4), 60))
    assert iterates[1].passes > 2  # steps were undone
    assert all(after.objective <= before.objective * (1 + 1e-6) for before, after in pairwise(iterates))
    assert distance(iterates[-1].plane, solved(posed, WEIGHT, Penalty()).plane) < 2e-3


def test_float32_reaches_the_same_plane() -> None:
    posed = problem()
    double = solved(posed, WEIGHT, Penalty()).plane
    single = solved(problem(dtype=np.float32), WEIGHT, Penalty(), tolerance=3e-3).plane
    assert single.dtype == np.float32
    assert distance(single, double) < 2e-3


def test_starting_from_a_similar_solution_saves_passes() -> None:
    posed = problem()
    fit, start = started(posed)
    near = solved(posed, 1.1 * WEIGHT, Penalty(), tolerance=1e-3)
    begun = next(pmlem(fit, np.maximum(near.plane, 1e-3), penalty_weight=WEIGHT, dual=near.dual))
    assert begun.certificate.distance < next(pmlem(fit, start, penalty_weight=WEIGHT)).certificate.distance / 2


@pytest.mark.parametrize(("weight", "least", "words"), [(-1.0, 1.0, "penalty_weight"), (1.0, 0.0, "start must be")])
def test_arguments_out_of_range_are_refused_before_the_first_pass(weight: float, least: float, words: str) -> None:
    fit, start = started(problem())
    with pytest.raises(ValueError, match=words):
        pmlem(fit, np.full_like(start, least), penalty_weight=weight)


def test_an_objective_that_is_not_finite_is_refused() -> None:
    class Overflowing(DataFit):
        def value_and_gradient(self, samples: Image) -> tuple[float, Image]:
            return float("nan"), samples

    posed = problem()
    with pytest.raises(NotConverged, match="pass 1 left the finite numbers"):
        next(pmlem(Overflowing(posed.operator, posed.images, 1.0), np.ones(SHAPE), penalty_weight=1.0))


def test_bright_scenes_of_hardly_any_read_noise_are_solved() -> None:
    """Samples beside a bright box fall towards zero, where the exact likelihood is steeper than numbers can say."""
    dtype = np.float32
    posed = problem("poisson-gaussian", background_e=0.0, variance_e2=0.008, low=5.0, high=16_000.0, dtype=dtype)
    fit, start = started(posed)
    *_, last = islice(pmlem(fit, start, penalty_weight=1.0), 30)
    assert last.certificate.distance < 0.1
    assert last.plane.max() == pytest.approx(16_000, rel=0.1)


def test_without_light_the_optimum_is_black_and_certain() -> None:
    posed = problem()
    images = replace(posed.images, electrons=np.full_like(posed.images.electrons, -1.5))
    fit = DataFit(posed.operator, images, 1.0)
    for iterate in islice(pmlem(fit, np.ones(SHAPE), penalty_weight=WEIGHT), 20):
        if iterate.certificate.distance == 0:
            break
    assert not iterate.plane.any()
    assert iterate.certificate.distance == 0


def test_samples_that_no_view_sees_follow_their_neighbours() -> None:
    posed = problem()
    wide = PlaneGrid((4 * SHAPE[0], 4 * SHAPE[1]), 1.0, (-1.5 * SHAPE[1], -1.5 * SHAPE[0]))
    rays = np.stack(np.meshgrid(np.arange(float(SHAPE[1])), np.arange(float(SHAPE[0]))), axis=-1)
    operator = PlaneOperator(np.stack([np.eye(3)] * 12), rays, wide, dtype=np.float64)
    images = replace(posed.images, electrons=posed.images.electrons[:, 1:-1, 1:-1])
    fit, start = DataFit(operator, images, 3.0), smooth_start(operator, images)
    assert np.median(operator.sensitivity()) == 0
    assert fit.metric(start).min() > 0
    *_, last = islice(pmlem(fit, start, penalty_weight=WEIGHT), 10)
    assert np.isfinite(last.plane).all()
