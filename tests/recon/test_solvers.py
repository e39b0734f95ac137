"""Solvers against dense algebra, an independent optimiser and closed forms, on planes of a hundred samples."""

from collections.abc import Iterator, Sequence
from itertools import islice, pairwise
from typing import Any

import numpy as np
import pytest
from scipy.optimize import minimize
from scipy.stats import norm, poisson

from faintfield.recon.errors import NotConverged
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.one_step_late import (
    Iterate,
    IterationStep,
    oscillates,
    pmlem_one_step_late,
    settled,
    updated_samples,
)
from faintfield.recon.solver.penalties import total_variation, total_variation_gradient

SHAPE = (9, 12)


def shifted_views(views: int, *, unseen_columns: int = 0, **options: Any) -> PlaneOperator:
    """Views at scale one, all but the first displaced by up to half a sample; that one leaves out the last columns."""
    last_column = SHAPE[1] - unseen_columns if unseen_columns else SHAPE[1] + 1
    columns, rows = np.meshgrid(np.arange(-1.0, last_column), np.arange(-1.0, SHAPE[0] + 1))
    homographies = np.stack([np.eye(3)] * views)
    homographies[1:, :2, 2] = np.random.default_rng(1).uniform(-0.5, 0.5, (views - 1, 2))
    rays, grid = np.stack([columns, rows], axis=-1), PlaneGrid(SHAPE, 1.0, (0.0, 0.0))
    return PlaneOperator(homographies, rays, grid, **{"dtype": np.float64, "workers": 1, **options})


def box(low: float, high: float) -> Image:
    plane = np.full(SHAPE, low)
    plane[2:6, 3:9] = high
    return plane


def drawn(
    operator: PlaneOperator, plane: Image, background_e: float = 0.3, variance_e2: float = 12.0
) -> ElementalImages:
    generator = np.random.default_rng(2)
    counts = generator.poisson(operator.forward(plane) + background_e)
    read_noise = generator.normal(0, np.sqrt(variance_e2), operator.images_shape)
    return ElementalImages(counts + read_noise, background_e, variance_e2)


def mlem(operator: PlaneOperator, images: ElementalImages, start: Image) -> Iterator[Iterate]:
    return pmlem_one_step_late(operator, images, start, penalty_weight=0.0, epsilon=1.0)


def after(iterates: Iterator[Iterate], passes: int) -> Iterate:
    return list(islice(iterates, passes))[-1]


def dense_matrix(operator: PlaneOperator) -> Image:
    units = np.eye(SHAPE[0] * SHAPE[1])
    return np.stack([operator.forward(unit.reshape(SHAPE)).ravel() for unit in units], axis=1)


def shifted_data(images: ElementalImages) -> Image:
    return np.asarray(np.maximum(images.electrons + images.read_variance_e2, 0)).ravel()


def negative_log_likelihood(matrix: Image, f: Image, images: ElementalImages) -> float:
    mean = matrix @ f.ravel() + images.background_e + images.read_variance_e2
    return float(np.sum(mean - shifted_data(images) * np.log(mean)))


@pytest.mark.parametrize(("penalty_weight", "variance_e2"), [(0.0, 0.0), (0.4, 12.0)])
def test_each_pass_agrees_with_eqs_2_and_3_in_dense_algebra(penalty_weight: float, variance_e2: float) -> None:
    operator = shifted_views(4)
    images, f = drawn(operator, box(2, 6), variance_e2=variance_e2), np.random.default_rng(4).uniform(1, 5, SHAPE)
    matrix, s = dense_matrix(operator), operator.sensitivity()
    for iterate in islice(pmlem_one_step_late(operator, images, f, penalty_weight=penalty_weight, epsilon=0.5), 3):
        expected = matrix @ f.ravel() + images.background_e + variance_e2
        back = (matrix.T @ (shifted_data(images) / expected)).reshape(SHAPE)
        next_f = f / (s + penalty_weight * total_variation_gradient(f, 0.5)) * back
        fixed = ~updated_samples(s, penalty_weight)
        next_f[fixed] = f[fixed]
        np.testing.assert_allclose(iterate.plane, next_f, rtol=1e-11)
        assert iterate.step.relative_change == pytest.approx(np.linalg.norm(next_f - f) / np.linalg.norm(f), rel=1e-9)
        f = next_f


def test_mlem_conserves_the_light_of_poisson_data() -> None:
    operator = shifted_views(3, flat=np.linspace([0.5], [1], 11) * np.ones(14))
    images = drawn(operator, box(2, 6), background_e=0.0, variance_e2=0.0)
    counted = operator.forward(np.ones(SHAPE)) > 0
    for iterate in islice(mlem(operator, images, np.ones(SHAPE)), 4):
        light_e = np.vdot(operator.sensitivity(), iterate.plane)
        assert light_e == pytest.approx(images.electrons[counted].sum(), rel=1e-12)


def test_mlem_never_makes_the_likelihood_worse() -> None:
    operator = shifted_views(3)
    images = drawn(operator, box(2, 6), variance_e2=4.0)
    matrix = dense_matrix(operator)
    costs = [negative_log_likelihood(matrix, it.plane, images) for it in islice(mlem(operator, images, box(1, 2)), 60)]
    assert all(later < earlier for earlier, later in pairwise(costs))


def test_mlem_recovers_a_plane_seen_without_noise() -> None:
    dtype = np.float32
    operator = shifted_views(6, dtype=dtype)
    truth = np.random.default_rng(8).uniform(1, 3, SHAPE)
    images = ElementalImages(operator.forward(truth) + dtype(0.3), background_e=0.3)
    plane = after(mlem(operator, images, smooth_start(operator, images)), 400).plane
    assert plane.dtype == dtype
    np.testing.assert_allclose(plane, truth, rtol=2e-3)


def test_a_settled_run_agrees_with_an_independent_optimiser() -> None:
    operator = shifted_views(5)
    images, weight, epsilon = drawn(operator, box(4, 12), variance_e2=1.0), 0.05, 4.0
    matrix = dense_matrix(operator)
    assert updated_samples(operator.sensitivity(), weight).all()

    def cost(f: Image) -> float:
        return negative_log_likelihood(matrix, f, images) + weight * total_variation(f.reshape(SHAPE), epsilon)

    def gradient(f: Image) -> Image:
        ratio = shifted_data(images) / (matrix @ f + images.background_e + images.read_variance_e2)
        return matrix.T @ (1 - ratio) + weight * total_variation_gradient(f.reshape(SHAPE), epsilon).ravel()

    start = smooth_start(operator, images)
    found = after(pmlem_one_step_late(operator, images, start, penalty_weight=weight, epsilon=epsilon), 1500)
    best = minimize(
        cost, start.ravel(), jac=gradient, method="L-BFGS-B", bounds=[(0, None)] * start.size,
        options={"maxiter": 5000, "maxfun": 10000, "ftol": 1e-15, "gtol": 1e-9},
    )  # fmt: skip
    assert found.step.relative_change < 1e-8
    np.testing.assert_allclose(found.plane.ravel(), best.x, rtol=1e-3, atol=1e-3)
    assert cost(found.plane.ravel()) <= best.fun + 1e-6


def test_the_variance_shift_keeps_the_mean_while_clipping_doubles_it() -> None:
    mean_e, variance_e2, views = 0.97, 12.0, 4000  # SNR 0.16 on the paper's camera, by moments
    columns_rows = np.stack(np.meshgrid([0.0, 1.0], [0.0, 1.0]), axis=-1)
    operator = PlaneOperator(np.stack([np.eye(3)] * views), columns_rows, PlaneGrid((2, 2), 1.0, (0.0, 0.0)))
    images = drawn(operator, np.full((2, 2), mean_e), 0.0, variance_e2)
    clipped = ElementalImages(np.maximum(images.electrons, 0))
    start, deviation_e = np.ones((2, 2)), np.sqrt((mean_e + variance_e2) / (4 * views))
    clipped_mean_e = expectation_clipped_below(0.0, mean_e, variance_e2)
    assert clipped_mean_e > 2 * mean_e
    assert after(mlem(operator, clipped, start), 20).plane.mean() == pytest.approx(clipped_mean_e, abs=4 * deviation_e)
    assert after(mlem(operator, images, start), 400).plane.mean() == pytest.approx(mean_e, abs=4 * deviation_e)
    # What the shift leaves to clip, closed form: Φ(−σ) of the pixels, by little
    assert expectation_clipped_below(-variance_e2, mean_e, variance_e2) == pytest.approx(mean_e, abs=0.002)


def expectation_clipped_below(limit_e: float, mean_e: float, variance_e2: float) -> float:
    """The mean of max(g, limit) for g = Poisson(mean) + N(0, variance)."""
    counts, sd = np.arange(60), np.sqrt(variance_e2)
    above = (counts - limit_e) / sd
    return float(np.sum(poisson.pmf(counts, mean_e) * (limit_e + sd * (above * norm.cdf(above) + norm.pdf(above)))))


def test_samples_seen_by_too_few_views_keep_their_start() -> None:
    operator = shifted_views(4, unseen_columns=3)
    images, start = drawn(operator, box(2, 6)), np.random.default_rng(6).uniform(1, 2, SHAPE)
    plane = after(pmlem_one_step_late(operator, images, start, penalty_weight=0.5, epsilon=1.0), 5).plane
    kept = operator.sensitivity() <= 0.5 * (2 + np.sqrt(2))
    assert (operator.sensitivity()[kept] > 0).any()
    assert 0 < kept.sum() < kept.size / 2
    np.testing.assert_array_equal(plane[kept], start[kept])
    assert (plane[~kept] != start[~kept]).all()


def run(penalty_weight: float, epsilon: float) -> list[IterationStep]:
    operator = shifted_views(6)
    images = drawn(operator, box(1, 3))
    start = smooth_start(operator, images)
    solver = pmlem_one_step_late(operator, images, start, penalty_weight=penalty_weight, epsilon=epsilon)
    return [iterate.step for iterate in islice(solver, 200)]


def test_a_large_weight_oscillates_and_a_small_one_settles() -> None:
    swinging, settling = run(1.0, 0.01), run(0.1, 1.0)
    assert oscillates(swinging, 1e-3)
    assert not settled(swinging, 1e-3)
    assert settled(settling, 1e-3)
    assert not oscillates(settling, 1e-3)
    # Not because denominators came near zero: clamping them would change nothing
    sensitivity, weight = shifted_views(6).sensitivity(), 1.0
    updated = updated_samples(sensitivity, weight)
    assert (sensitivity[updated] > 2 * weight).all()


def history(changes: Sequence[float], alternation: float) -> list[IterationStep]:
    return [IterationStep(k + 1, change, alternation) for k, change in enumerate(changes)]


@pytest.mark.parametrize(
    ("changes", "alternation", "verdict"),
    [
        ([0.1] * 10, -0.9, True),
        ([0.1] * 10, -0.4, False),  # steps do not oppose one another
        ([0.1] * 5 + [0.07] * 5, -0.9, False),  # shrinks
        ([1e-4] * 10, -0.9, False),  # below the tolerance
        ([1e-4] * 7 + [0.1] * 10, -0.9, True),  # only the last passes count
    ],
)
def test_oscillation_is_opposing_steps_that_do_not_shrink(
    changes: list[float], alternation: float, verdict: bool
) -> None:
    assert oscillates(history(changes, alternation), tolerance=1e-3) is verdict


def test_nothing_has_settled_before_the_first_pass() -> None:
    assert not settled([], 1.0)
    assert settled(history([0.5, 1e-4], 0.0), 1e-3)
    assert not settled(history([1e-4, 0.5], 0.0), 1e-3)


def test_a_weight_that_makes_most_denominators_negative_is_refused_with_its_limit() -> None:
    operator = shifted_views(6)
    images = drawn(operator, box(2, 6))
    limit = 6 / (2 + np.sqrt(2))
    with pytest.raises(NotConverged, match=rf"below {limit:.3g}"):
        pmlem_one_step_late(operator, images, np.ones(SHAPE), penalty_weight=1.01 * limit, epsilon=1.0)
    next(pmlem_one_step_late(operator, images, np.ones(SHAPE), penalty_weight=0.99 * limit, epsilon=1.0))


def test_an_iterate_that_is_not_finite_is_reported_with_its_pass() -> None:
    operator = shifted_views(2, dtype=np.float32)
    images = ElementalImages(np.full(operator.images_shape, 1e38, np.float32), 1e-9)
    with pytest.raises(NotConverged, match="pass 1 left"), np.errstate(over="ignore", invalid="ignore"):
        next(mlem(operator, images, np.full(SHAPE, 1e-30)))


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"penalty_weight": -0.1}, "penalty_weight >= 0"),
        ({"epsilon": 0.0}, "epsilon > 0"),
        ({"start": np.zeros(SHAPE)}, "start must be positive"),
    ],
)
def test_arguments_out_of_range_are_refused_before_the_first_pass(changed: dict[str, Any], words: str) -> None:
    operator = shifted_views(2)
    images = drawn(operator, box(2, 6))
    good: dict[str, Any] = {"start": np.ones(SHAPE), "penalty_weight": 0.1, "epsilon": 1.0}
    with pytest.raises(ValueError, match=words):
        pmlem_one_step_late(operator, images, **{**good, **changed})
