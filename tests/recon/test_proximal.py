"""The proximal operator of the penalty, against closed forms, an independent solver and its own gap."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import minimize

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField, ProxResult, step_sizes

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


@pytest.mark.parametrize(("dtype", "proposed"), [(np.float32, True), (np.float64, False)])
def test_strips_and_threads_change_nothing(dtype: type[np.float32] | type[np.float64], proposed: bool) -> None:
    generator = np.random.default_rng(5)
    v: Image = generator.normal(2, 1, (300, 31)).astype(dtype)
    w: Image = generator.uniform(0.5, 2, (300, 31)).astype(dtype)
    proposal: Image | None = generator.normal(2, 1, (300, 31)).astype(dtype) if proposed else None
    planes = []
    for workers in (1, 3, 4):
        dual = DualField([np.zeros((2, 300, 31), dtype)], proposal, workers)
        planes.append(dual.prox(v, w, 1.0, TV, lambda _: 0.0, 60).plane)
    for plane in planes[1:]:
        np.testing.assert_allclose(plane, planes[0], rtol=50 * np.finfo(dtype).eps)


def test_steps_follow_the_textbook_iteration() -> None:
    """Chambolle and Pock's algorithm 2, written in the variable √w x, in which the metric is that of all textbooks."""
    generator = np.random.default_rng(6)
    v, w, proposal = generator.normal(1, 1, (7, 6)), generator.uniform(0.5, 2, (7, 6)), generator.normal(0, 1, (7, 6))
    steps, root, weight = step_sizes(1.3 / w), np.sqrt(w), 1.3
    p, x = np.zeros((2, 7, 6)), np.maximum(v, 0)
    ahead, length = root * x, 1.0
    for _ in range(40):
        dual_steps = steps / (weight * length)  # on weight * p
        p = weight * p + dual_steps * weight**2 * differences_of(ahead / root - proposal)
        p /= np.maximum(np.hypot(*p) / weight, 1)
        y = (root * x - length * adjoint_differences(p) / root + length * root * v) / (1 + length)
        y = np.maximum(y, 0)
        p /= weight
        momentum = 1 / np.sqrt(1 + 1.2 * length)
        ahead, x, length = y + momentum * (y - root * x), y / root, length * momentum
    dual = DualField([np.zeros((2, 7, 6))], proposal)
    found = dual.prox(v, w, weight, TV, lambda _: 0.0, 40)
    assert (x == 0).any()
    np.testing.assert_allclose(dual.vectors[0], p, atol=1e-12)
    np.testing.assert_allclose(found.plane, x, atol=1e-12)


def test_the_largest_step_is_the_smallest_of_the_samples_that_it_changes() -> None:
    reach = np.array([[1.0, 2.0, 1.0], [1.0, 1.0, 4.0]])
    np.testing.assert_allclose(step_sizes(reach), 0.125 / np.array([[2.0, 2.0, 4.0], [1.0, 4.0, 4.0]]))


def test_a_penalty_without_its_smoothing_is_refused() -> None:
    for name in ("huber-tv", "quadratic"):
        with pytest.raises(ValueError, match="smoothing_e > 0"):
            Penalty(name)


# --- about a proposal ------------------------------------------------------------------------------------------------


def differences_of(x: Image) -> Image:
    field = np.zeros((2, *x.shape))
    field[0, :-1], field[1, :, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
    return field


def adjoint_differences(p: Image) -> Image:
    x = np.zeros(p.shape[1:])
    x[1:] += p[0, :-1]
    x[:-1] -= p[0, :-1]
    x[:, 1:] += p[1, :, :-1]
    x[:, :-1] -= p[1, :, :-1]
    return x


def slow_prox(v: Image, w: Image, weight: float, proposal: Image, penalty: Penalty) -> Image:
    """The solution by Chambolle and Pock's iteration, with fixed steps that do not use the metric."""
    x = ahead = np.maximum(v, 0)
    p, step = np.zeros((2, *v.shape)), 0.35
    for _ in range(20_000):
        p = p + step * differences_of(ahead - proposal)
        p /= 1 + step * penalty.smoothing_e / weight
        if penalty.bounded:
            p /= np.maximum(np.hypot(*p) / weight, 1)
        after = np.maximum((x - step * adjoint_differences(p) + step * w * v) / (1 + step * w), 0)
        x, ahead = after, 2 * after - x
    return x


def cost_about(x: Image, v: Image, w: Image, weight: float, proposal: Image, penalty: Penalty) -> float:
    t, delta = np.hypot(*differences_of(x - proposal)), penalty.smoothing_e
    squares = t**2 / (2 * max(delta, 1e-300))
    phi = {"tv": t, "quadratic": squares, "huber-tv": np.where(t < delta, squares, t - delta / 2)}[penalty.name]
    return float(0.5 * np.sum(w * (x - v) ** 2) + weight * phi.sum())


def solved_about(
    proposal: Image | None, v: Image, w: Image, weight: float, penalty: Penalty = TV, *, gap: float = 1e-10
) -> ProxResult:
    dual = DualField([np.zeros((2, *v.shape), v.dtype)], proposal)
    return dual.prox(v, w, weight, penalty, lambda _: gap, 50_000)


@pytest.mark.parametrize("penalty", [TV, Penalty("huber-tv", 0.3), Penalty("quadratic", 0.8)])
def test_about_a_proposal_it_agrees_with_a_slow_primal_dual_method(penalty: Penalty) -> None:
    generator = np.random.default_rng(7)
    v, w, proposal = generator.normal(0.4, 1, (8, 9)), generator.uniform(0.5, 2, (8, 9)), generator.normal(0, 2, (8, 9))
    found = solved_about(proposal, v, w, 0.7, penalty)
    best = slow_prox(v, w, 0.7, proposal, penalty)
    np.testing.assert_allclose(found.plane, best, atol=1e-4)
    assert (best == 0).any()
    lowest = cost_about(best, v, w, 0.7, proposal, penalty)
    assert np.abs(solved_about(None, v, w, 0.7, penalty).plane - best).max() > 0.5  # the proposal has an effect
    assert found.gap <= 1e-10
    for steps in (20, 40):
        rough = DualField([np.zeros((2, 8, 9))], proposal).prox(v, w, 0.7, penalty, lambda _: 0.0, steps)
        excess = cost_about(rough.plane, v, w, 0.7, proposal, penalty) - lowest
        assert 0 < excess <= rough.gap + 1e-9
        assert rough.gap < 10


def test_where_no_sample_is_black_a_proposal_only_moves_the_origin() -> None:
    """`x = v + x̂` has the differences of v to penalise, so prox(v + x̂) = x̂ + prox(v)."""
    generator = np.random.default_rng(8)
    v, w, proposal = (
        generator.normal(20, 1, (11, 7)),
        generator.uniform(0.5, 2, (11, 7)),
        generator.normal(0, 2, (11, 7)),
    )
    moved = solved_about(proposal, v + proposal, w, 0.9).plane
    assert moved.min() > 0
    np.testing.assert_allclose(moved, proposal + solved_about(None, v, w, 0.9).plane, atol=1e-4)


def test_under_a_large_weight_the_proposal_moves_by_a_constant() -> None:
    generator = np.random.default_rng(9)
    v, w, proposal = generator.normal(9, 1, (6, 8)), generator.uniform(0.5, 2, (6, 8)), generator.normal(0, 2, (6, 8))
    expected = proposal + np.average(v - proposal, weights=w)
    np.testing.assert_allclose(solved_about(proposal, v, w, 100.0).plane, expected, rtol=1e-4)


def test_the_penalty_and_the_slack_count_from_the_proposal() -> None:
    generator = np.random.default_rng(10)
    x, proposal = generator.uniform(0, 3, (2, 5, 6))
    field = generator.normal(size=(2, 5, 6))
    field /= np.maximum(np.hypot(*field), 1)
    change = differences_of(x - proposal)
    value, slack = DualField([field], proposal).penalty_and_slack(x, TV)
    assert value == pytest.approx(np.hypot(*change).sum(), rel=1e-12)
    assert slack == pytest.approx(np.hypot(*change).sum() - np.sum(field * change), rel=1e-9)


def test_a_proposal_of_zeros_changes_no_bit() -> None:
    dtype, workers = np.float32, 3
    generator = np.random.default_rng(11)
    v: Image = generator.normal(1, 1, (200, 13)).astype(dtype)
    w: Image = generator.uniform(0.5, 2, (200, 13)).astype(dtype)
    without, about = (DualField([np.zeros((2, 200, 13), dtype)], x, workers) for x in (None, np.zeros_like(v)))
    results = [dual.prox(v, w, 1.0, TV, lambda _: 0.0, 60) for dual in (without, about)]
    np.testing.assert_array_equal(results[0].plane, results[1].plane)
    np.testing.assert_array_equal(without.vectors[0], about.vectors[0])
    assert results[0].gap == results[1].gap


def test_each_of_several_planes_has_its_part_of_the_proposal() -> None:
    generator = np.random.default_rng(12)
    shapes = [(5, 6), (8, 4), (3, 7)]
    planes = [
        np.stack([generator.normal(1, 1, shape), generator.uniform(0.5, 2, shape), generator.normal(0, 2, shape)])
        for shape in shapes
    ]
    v, w, proposal = (np.concatenate([plane[k].ravel() for plane in planes]) for k in range(3))
    dual = DualField([np.zeros((2, *shape)) for shape in shapes], proposal)
    together = dual.prox(v, w, 0.7, TV, lambda _: 1e-10, 50_000)
    alone = [solved_about(plane[2], plane[0], plane[1], 0.7, gap=1e-10 / 3) for plane in planes]
    np.testing.assert_array_equal(together.plane, np.concatenate([one.plane.ravel() for one in alone]))
    assert together.gap == pytest.approx(sum(one.gap for one in alone))
    value, slack = dual.penalty_and_slack(together.plane, TV)
    expected = sum(
        np.hypot(*differences_of(one.plane - plane[2])).sum() for one, plane in zip(alone, planes, strict=True)
    )
    assert value == pytest.approx(expected, rel=1e-12)
    assert 0 <= 0.7 * slack <= 2e-10


def test_a_copy_keeps_the_proposal() -> None:
    dual = DualField([np.zeros((2, 3, 4))], np.ones((3, 4)))
    copy = dual.copy()
    assert copy.proposal is dual.proposal
    copy.vectors[0] += 1
    assert not dual.vectors[0].any()
