"""One-step-late PMLEM against dense algebra and its limits; total variation against its derivative."""

from itertools import islice

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faintfield.recon.errors import NotConverged
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.one_step_late import (
    IterationStep,
    oscillates,
    pmlem_one_step_late,
    settled,
    updated_samples,
)
from faintfield.recon.solver.penalties import total_variation, total_variation_gradient
from tests.recon.displaced import noisy_images
from tests.recon.operator_contract import dense_matrix
from tests.recon.small_problems import SHAPE, box, shifted_views


@pytest.mark.parametrize(("penalty_weight", "variance_e2"), [(0.0, 0.0), (0.4, 12.0)])
def test_each_pass_agrees_with_dense_algebra(penalty_weight: float, variance_e2: float) -> None:
    operator = shifted_views(4)
    images = noisy_images(operator, box(2, 6), 0.3, variance_e2, 2)
    f = np.random.default_rng(4).uniform(1, 5, SHAPE)
    matrix, s = dense_matrix(operator), operator.sensitivity()
    shifted = np.maximum(images.electrons + variance_e2, 0).ravel()
    for iterate in islice(pmlem_one_step_late(operator, images, f, penalty_weight=penalty_weight, epsilon=0.5), 3):
        expected = matrix @ f.ravel() + images.background_e + variance_e2
        back = (matrix.T @ (shifted / expected)).reshape(SHAPE)
        next_f = f / (s + penalty_weight * total_variation_gradient(f, 0.5)) * back
        fixed = ~updated_samples(s, penalty_weight)
        next_f[fixed] = f[fixed]
        np.testing.assert_allclose(iterate.plane, next_f, rtol=1e-11)
        assert iterate.step.relative_change == pytest.approx(np.linalg.norm(next_f - f) / np.linalg.norm(f), rel=1e-9)
        f = next_f


def test_samples_with_few_views_keep_their_start() -> None:
    operator = shifted_views(4, unseen_columns=3)
    images, start = noisy_images(operator, box(2, 6), 0.3, 12.0, 2), np.random.default_rng(6).uniform(1, 2, SHAPE)
    *_, last = islice(pmlem_one_step_late(operator, images, start, penalty_weight=0.5, epsilon=1.0), 5)
    kept = operator.sensitivity() <= 0.5 * (2 + np.sqrt(2))
    assert (operator.sensitivity()[kept] > 0).any()
    assert 0 < kept.sum() < kept.size / 2
    np.testing.assert_array_equal(last.plane[kept], start[kept])
    assert (last.plane[~kept] != start[~kept]).all()


def run(penalty_weight: float, epsilon: float) -> list[IterationStep]:
    operator = shifted_views(6)
    images = noisy_images(operator, box(1, 3), 0.3, 12.0, 2)
    start = smooth_start(operator, images)
    solver = pmlem_one_step_late(operator, images, start, penalty_weight=penalty_weight, epsilon=epsilon)
    return [iterate.step for iterate in islice(solver, 200)]


def test_large_weight_oscillates_and_small_weight_settles() -> None:
    swinging, settling = run(1.0, 0.01), run(0.1, 1.0)
    assert oscillates(swinging, 1e-3)
    assert not settled(swinging, 1e-3)
    assert settled(settling, 1e-3)
    assert not oscillates(settling, 1e-3)
    # Not because denominators came near zero: clamping them would change nothing
    sensitivity, weight = shifted_views(6).sensitivity(), 1.0
    updated = updated_samples(sensitivity, weight)
    assert (sensitivity[updated] > 2 * weight).all()


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
    steps = [IterationStep(k + 1, change, alternation) for k, change in enumerate(changes)]
    assert oscillates(steps, tolerance=1e-3) is verdict


def test_weight_beyond_its_limit_is_refused() -> None:
    operator = shifted_views(6)
    images = noisy_images(operator, box(2, 6), 0.3, 12.0, 2)
    limit = 6 / (2 + np.sqrt(2))
    with pytest.raises(NotConverged, match=rf"below {limit:.3g}"):
        next(pmlem_one_step_late(operator, images, np.ones(SHAPE), penalty_weight=1.01 * limit, epsilon=1.0))
    next(pmlem_one_step_late(operator, images, np.ones(SHAPE), penalty_weight=0.99 * limit, epsilon=1.0))


def test_infinite_iterate_is_reported_with_its_pass() -> None:
    operator = shifted_views(2, dtype=np.float32)
    images = ElementalImages(np.full(operator.images_shape, 1e38, np.float32), 1e-9)
    with pytest.raises(NotConverged, match="pass 1 left"), np.errstate(over="ignore", invalid="ignore"):
        next(pmlem_one_step_late(operator, images, np.full(SHAPE, 1e-30), penalty_weight=0.0, epsilon=1.0))


planes = st.tuples(
    st.integers(2, 7), st.integers(2, 7), st.sampled_from([1e-3, 1.0, 1e3]), st.integers(0, 2**32 - 1)
).map(lambda drawn: drawn[2] * np.random.default_rng(drawn[3]).normal(size=drawn[:2]))


@settings(max_examples=25)
@given(plane=planes, seed=st.integers(0, 2**32 - 1))
def test_gradient_is_derivative_of_total_variation(plane: Image, seed: int) -> None:
    size = float(np.abs(plane).max())
    epsilon, step = size**2, 1e-5 * size  # smooth on the scale of the step, so that the central difference is exact
    direction = np.random.default_rng(seed).normal(size=plane.shape)
    change = total_variation(plane + step * direction, epsilon) - total_variation(plane - step * direction, epsilon)
    slope = float(np.vdot(total_variation_gradient(plane, epsilon), direction))
    assert change / (2 * step) == pytest.approx(slope, rel=1e-7, abs=1e-7 * float(np.linalg.norm(direction)))


def test_lone_spike_reaches_the_bound() -> None:
    plane = np.zeros((3, 3))
    plane[1, 1] = 1e6
    assert total_variation_gradient(plane, 1e-6)[1, 1] == pytest.approx(2 + np.sqrt(2), rel=1e-9)


def test_total_variation_has_its_closed_form() -> None:
    # u: (3, 4, ε=11) → 6; (0, –, 11); (–, 0, 11); the corner has no difference
    plane = np.array([[1.0, 5.0], [4.0, 5.0]])
    assert total_variation(plane, 11.0) == pytest.approx(6 + np.sqrt(11) + np.sqrt(1 + 11) + np.sqrt(11))


def test_total_variation_is_summed_in_float64() -> None:
    plane = np.tile(np.array([0.0, 1.0], np.float32), (512, 256))
    assert total_variation(plane, 1e-12) == pytest.approx(512 * 511, rel=1e-6)
    assert total_variation_gradient(plane, 1e-6).dtype == np.float32
