"""The mixture of candidates against direct sums, all points of a fine simplex, and a general solver."""

from itertools import product

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import LinearConstraint, minimize

from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.mixture import Scores, best_mixture, scores


def random_scores(seed: int, count: int, rank: int) -> Scores:
    """Scores of candidates that span `rank` dimensions, of which a picture may be outside."""
    generator = np.random.default_rng(seed)
    pictures = generator.normal(size=(count, rank)) @ generator.normal(size=(rank, 30)) + generator.normal(2, 1, 30)
    target = generator.normal(2, 2, 30)
    return Scores(pictures @ pictures.T, pictures @ target)


def is_a_mixture(weights: Image) -> bool:
    return bool((weights >= 0).all() and abs(weights.sum() - 1) < 1e-9)


def test_scores_are_direct_sums_and_the_loss_is_the_weighted_squared_error_up_to_a_constant() -> None:
    generator = np.random.default_rng(1)
    pictures, picture = list(generator.normal(size=(3, 6, 5))), generator.normal(size=(6, 5))
    weight = generator.uniform(0, 2, (6, 5))
    found = scores(pictures, picture, weight)
    for j, k in product(range(3), repeat=2):
        assert found.gram[j, k] == pytest.approx(np.sum(weight * pictures[j] * pictures[k]), rel=1e-12)
    for k in range(3):
        assert found.towards[k] == pytest.approx(np.sum(weight * pictures[k] * picture), rel=1e-12)
    constant = np.sum(weight * picture**2)
    for a in generator.dirichlet(np.ones(3), 5):
        mixed = np.tensordot(a, pictures, 1)
        assert found.loss(a) + constant == pytest.approx(np.sum(weight * (mixed - picture) ** 2), rel=1e-10)


def test_scores_of_two_pictures_add_up() -> None:
    a, b = random_scores(2, 3, 3), random_scores(3, 3, 3)
    weights = np.array([0.2, 0.5, 0.3])
    assert (a + b).loss(weights) == pytest.approx(a.loss(weights) + b.loss(weights), rel=1e-12)


@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 5), rank=st.integers(0, 5), twin=st.booleans())
def test_the_mixture_is_as_good_as_that_of_a_general_solver(seed: int, count: int, rank: int, twin: bool) -> None:
    """Also with more candidates than dimensions, and with one candidate twice."""
    found = random_scores(seed, count, rank)
    if twin:
        chosen = [*range(count), 0]
        found = Scores(found.gram[np.ix_(chosen, chosen)], found.towards[chosen])
    best = best_mixture(found)
    assert is_a_mixture(best)
    size, scale = found.towards.size, float(np.trace(found.gram))
    solved = minimize(  # type: ignore[call-overload]
        lambda a: found.loss(a) / scale,
        np.full(size, 1 / size),
        jac=lambda a: 2 * (found.gram @ a - found.towards) / scale,
        method="SLSQP",
        bounds=[(0, 1)] * size,
        constraints=LinearConstraint(np.ones((1, size)), 1, 1),
        options={"ftol": 1e-12},
    )
    assert found.loss(best) / scale <= solved.fun + 1e-7


@pytest.mark.parametrize("scale", [1e-9, 1e12])
def test_weights_sum_to_one_whatever_the_scale_of_the_light(scale: float) -> None:
    found = random_scores(4, 5, 4)
    best = best_mixture(Scores(scale * found.gram, scale * found.towards))
    assert best.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(best, best_mixture(found), atol=1e-6)


def test_where_all_predict_alike_the_first_is_chosen_and_fewer_before_more() -> None:
    for same in (Scores(np.ones((4, 4)), np.ones(4)), Scores(np.zeros((4, 4)), np.zeros(4))):
        np.testing.assert_array_equal(best_mixture(same), [1, 0, 0, 0])
    # The second is the picture; so is the mean of the first and the third
    pictures = [np.array([[x, 1.0]]) for x in (0, 1, 2)]
    found = scores(pictures, pictures[1], np.ones((1, 2)))
    np.testing.assert_allclose(best_mixture(found), [0, 1, 0], atol=1e-9)


def test_candidates_on_either_side_are_mixed_and_those_on_one_side_are_not() -> None:
    def mixture(*values: float) -> Image:
        return best_mixture(scores([np.array([[x]]) for x in values], np.array([[1.0]]), np.ones((1, 1))))

    np.testing.assert_allclose(mixture(0.0, 4.0), [0.75, 0.25], atol=1e-9)
    np.testing.assert_array_equal(mixture(3.0, 2.0), [0, 1])
    np.testing.assert_array_equal(mixture(-3.0, -2.0, -5.0), [0, 1, 0])
