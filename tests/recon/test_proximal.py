"""The proximal operator of the penalty, against closed forms, an independent solver and its own gap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField, step_sizes

TV = Penalty()


def solution(
    v: Image, w: Image, weight: float, penalty: Penalty = TV, *, gap: float = 1e-10, most: int = 20000
) -> Image:
    return DualField.zero([(v.shape[0], v.shape[1])], v.dtype).prox(v, w, weight, penalty, lambda _: gap, most).plane


def test_two_halves_lose_contrast_as_predicted() -> None:
    """Two halves of a plane: each level moves by β · (length of the edge) / (weight of the half)."""
    v, w = np.full((16, 20), 2.0), np.full((16, 20), 3.0)
    v[:, 5:] = 6.0
    x = solution(v, w, 1.5)
    np.testing.assert_allclose(x[:, :5], 2.0 + 1.5 / (3 * 5), atol=1e-5)
    np.testing.assert_allclose(x[:, 5:], 6.0 - 1.5 / (3 * 15), atol=1e-5)


def test_a_large_weight_leaves_the_weighted_mean() -> None:
    generator = np.random.default_rng(1)
    v, w = generator.normal(5, 1, (12, 17)), generator.uniform(0.5, 2, (12, 17))
    np.testing.assert_allclose(solution(v, w, 100.0), np.average(v, weights=w), rtol=1e-4)


@pytest.mark.parametrize("penalty", [TV, Penalty("huber-tv", 0.3), Penalty("quadratic", 0.8)])
def test_no_plane_is_better_than_the_gap_allows(penalty: Penalty) -> None:
    generator = np.random.default_rng(3)
    v, w = generator.normal(0.4, 1, (8, 9)), generator.uniform(0.5, 2, (8, 9))

    def cost(x: Image) -> float:
        x = x.reshape(v.shape)
        down, right = np.zeros_like(x), np.zeros_like(x)
        down[:-1], right[:, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
        t, delta = np.sqrt(down**2 + right**2 + 1e-16), penalty.smoothing_e
        if penalty.name == "quadratic":
            t = t**2 / (2 * delta)
        elif penalty.name == "huber-tv":
            t = np.where(t < delta, t**2 / (2 * delta), t - delta / 2)
        return float(0.5 * np.sum(w * (x - v) ** 2) + 0.7 * t.sum())

    found = DualField.zero([(v.shape[0], v.shape[1])], v.dtype).prox(v, w, 0.7, penalty, lambda _: 1e-9, 50000)
    assert found.gap <= 1e-9
    assert (found.plane >= 0).all()
    assert (found.plane == 0).any()
    best = minimize(
        cost, found.plane.ravel(), method="L-BFGS-B", bounds=[(0, None)] * v.size, options={"maxfun": 200000}
    )
    assert cost(found.plane.ravel()) <= best.fun + 1e-6
    rough = DualField.zero([(v.shape[0], v.shape[1])], v.dtype).prox(v, w, 0.7, penalty, lambda _: 0.0, 20)
    assert cost(rough.plane.ravel()) - cost(found.plane.ravel()) <= rough.gap + 1e-6


@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(2, 9),
    columns=st.integers(2, 9),
    smoothing=st.sampled_from([0, 0.4]),
)
def test_the_slack_is_zero_only_for_the_field_of_the_plane(
    seed: int, rows: int, columns: int, smoothing: float
) -> None:
    generator = np.random.default_rng(seed)
    penalty = Penalty("huber-tv", smoothing) if smoothing else TV
    x, field = generator.uniform(0, 3, (rows, columns)), generator.normal(size=(2, rows, columns))
    down, right = np.zeros_like(x), np.zeros_like(x)
    down[:-1], right[:, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
    t = np.hypot(down, right)
    belongs = np.stack([down, right]) / np.maximum(np.maximum(t, smoothing), 1e-300)
    value, slack = DualField([belongs]).penalty_and_slack(x, penalty)
    phi = np.where(t < smoothing, t**2 / (2 * max(smoothing, 1e-9)), t - smoothing / 2)
    assert value == pytest.approx(phi.sum(), rel=1e-12)
    assert abs(slack) <= 1e-12 * t.sum()
    field /= np.maximum(np.hypot(*field), 1)
    other = DualField([field]).penalty_and_slack(x, penalty)[1]
    expected = phi.sum() - (down * field[0] + right * field[1]).sum() + smoothing / 2 * (field**2).sum()
    assert other == pytest.approx(expected, rel=1e-9)
    assert other > 0


@pytest.mark.parametrize("dtype", [np.float32, np.float64])
def test_strips_and_threads_change_nothing(dtype: type[np.float32] | type[np.float64]) -> None:
    generator = np.random.default_rng(5)
    v: Image = generator.normal(2, 1, (300, 31)).astype(dtype)
    w: Image = generator.uniform(0.5, 2, (300, 31)).astype(dtype)
    planes = []
    for workers in (1, 3, 4):
        dual = DualField([np.zeros((2, 300, 31), dtype)], workers=workers)
        planes.append(dual.prox(v, w, 1.0, TV, lambda _: 0.0, 60).plane)
    for plane in planes[1:]:
        np.testing.assert_allclose(plane, planes[0], rtol=50 * np.finfo(dtype).eps)


def test_steps_follow_the_textbook_iteration() -> None:
    generator = np.random.default_rng(6)
    v, w = generator.normal(2, 1, (7, 6)), generator.uniform(0.5, 2, (7, 6))
    reach = 1.3 / w
    steps = step_sizes(reach)
    p = q = np.zeros((2, 7, 6))
    t = 1.0
    for _ in range(20):
        field = np.pad(q, [(0, 0), (1, 0), (1, 0)])
        x = np.maximum(v + reach * (q.sum(0) - field[0, :-1, 1:] - field[1, 1:, :-1]), 0)
        down, right = np.zeros_like(x), np.zeros_like(x)
        down[:-1], right[:, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
        ahead = q + steps * np.stack([down, right])
        ahead /= np.maximum(np.hypot(*ahead), 1)
        t_next = (1 + np.sqrt(1 + 4 * t * t)) / 2
        q = ahead + (t - 1) / t_next * (ahead - p)
        p, t = ahead, t_next
    dual = DualField.zero([(v.shape[0], v.shape[1])], v.dtype)
    dual.prox(v, w, 1.3, TV, lambda _: 0.0, 20)
    np.testing.assert_allclose(dual.vectors[0], p, atol=1e-12)


def test_the_largest_step_is_the_smallest_of_the_samples_that_it_changes() -> None:
    reach = np.array([[1.0, 2.0, 1.0], [1.0, 1.0, 4.0]])
    np.testing.assert_allclose(step_sizes(reach), 0.125 / np.array([[2.0, 2.0, 4.0], [1.0, 4.0, 4.0]]))


def test_a_penalty_without_its_smoothing_is_refused() -> None:
    for name in ("huber-tv", "quadratic"):
        with pytest.raises(ValueError, match="smoothing_e > 0"):
            Penalty(name)
