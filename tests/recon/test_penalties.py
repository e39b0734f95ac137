"""Eq. (3) against its derivative, its printed formula and its bounds."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.penalties import total_variation, total_variation_gradient

planes = st.tuples(
    st.integers(2, 7), st.integers(2, 7), st.sampled_from([1e-3, 1.0, 1e3]), st.integers(0, 2**32 - 1)
).map(lambda drawn: drawn[2] * np.random.default_rng(drawn[3]).normal(size=drawn[:2]))
epsilons = st.sampled_from([1e-6, 1e-2, 1.0])


def penalty_as_printed(f: Image, epsilon: float) -> Image:
    """Eq. (3), sample by sample; samples across an edge equal those on it."""

    def at(i: int, j: int) -> float:
        return float(f[min(i, f.shape[0] - 1), min(j, f.shape[1] - 1)])

    def u(i: int, j: int) -> float:
        return float(np.sqrt((at(i + 1, j) - at(i, j)) ** 2 + (at(i, j + 1) - at(i, j)) ** 2 + epsilon))

    penalty = np.zeros(f.shape)
    for i, j in np.ndindex(f.shape):
        above = (at(i, j) - at(i - 1, j)) / u(i - 1, j) if i else 0.0
        left = (at(i, j) - at(i, j - 1)) / u(i, j - 1) if j else 0.0
        penalty[i, j] = above + left - (at(i + 1, j) + at(i, j + 1) - 2 * at(i, j)) / u(i, j)
    return penalty


@given(plane=planes, epsilon=epsilons)
def test_the_gradient_is_eq_3_as_printed(plane: Image, epsilon: float) -> None:
    np.testing.assert_allclose(
        total_variation_gradient(plane, epsilon), penalty_as_printed(plane, epsilon), rtol=1e-12, atol=1e-12
    )


@given(plane=planes, seed=st.integers(0, 2**32 - 1))
def test_the_gradient_is_the_derivative_of_the_total_variation(plane: Image, seed: int) -> None:
    size = float(np.abs(plane).max())
    epsilon, step = size**2, 1e-5 * size  # smooth on the scale of the step, so that the central difference is exact
    direction = np.random.default_rng(seed).normal(size=plane.shape)
    change = total_variation(plane + step * direction, epsilon) - total_variation(plane - step * direction, epsilon)
    slope = float(np.vdot(total_variation_gradient(plane, epsilon), direction))
    assert change / (2 * step) == pytest.approx(slope, rel=1e-7, abs=1e-7 * float(np.linalg.norm(direction)))


@given(plane=planes, epsilon=epsilons)
def test_the_gradient_sums_to_zero_and_is_at_most_two_plus_root_two(plane: Image, epsilon: float) -> None:
    gradient = total_variation_gradient(plane, epsilon)
    assert abs(gradient.sum()) <= 1e-12 * gradient.size
    assert np.abs(gradient).max() <= 2 + np.sqrt(2)


@pytest.mark.parametrize("sign", [-1, 1])
def test_a_lone_spike_reaches_the_bound(sign: int) -> None:
    plane = np.zeros((3, 3))
    plane[1, 1] = sign * 1e6
    assert total_variation_gradient(plane, 1e-6)[1, 1] == pytest.approx(sign * (2 + np.sqrt(2)), rel=1e-9)


def test_the_total_variation_of_a_small_plane_is_its_closed_form() -> None:
    # u: (3, 4, ε=11) → 6; (0, –, 11); (–, 0, 11); the corner has no difference
    plane = np.array([[1.0, 5.0], [4.0, 5.0]])
    assert total_variation(plane, 11.0) == pytest.approx(6 + np.sqrt(11) + np.sqrt(1 + 11) + np.sqrt(11))


def test_the_total_variation_of_a_large_float32_plane_is_summed_in_float64() -> None:
    plane = np.tile(np.array([0.0, 1.0], np.float32), (512, 256))
    assert total_variation(plane, 1e-12) == pytest.approx(512 * 511, rel=1e-6)
    assert total_variation_gradient(plane, 1e-6).dtype == np.float32
