"""The proximal operator of the penalty, against closed forms, independent solvers and its own gap."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faintfield.recon.likelihood.images import Image
from faintfield.recon.solver import proximal
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField, ProxResult, step_sizes
from tests.recon.small_problems import difference_matrix

TV = Penalty()


def differences_of(x: Image) -> Image:
    matrix = difference_matrix((x.shape[0], x.shape[1]))
    return np.asarray(matrix @ x.ravel()).reshape(2, *x.shape)


def _adjoint(p: Image) -> Image:
    matrix = difference_matrix((p.shape[1], p.shape[2]))
    return np.asarray(matrix.T @ p.ravel()).reshape(p.shape[1:])


def prox(
    v: Image, w: Image, weight: float, penalty: Penalty = TV, *, proposal: Image | None = None, gap: float = 1e-10
) -> ProxResult:
    dual = DualField([np.zeros((2, *v.shape), v.dtype)], proposal)
    return dual.prox(v, w, weight, penalty, lambda _: gap, 50_000)


@settings(max_examples=25)
@given(
    seed=st.integers(0, 2**32 - 1),
    rows=st.integers(2, 9),
    columns=st.integers(2, 9),
    smoothing=st.sampled_from([0, 0.4]),
    about=st.booleans(),
)
def test_slack_is_zero_only_for_field_of_plane(
    seed: int, rows: int, columns: int, smoothing: float, about: bool
) -> None:
    generator = np.random.default_rng(seed)
    penalty = Penalty("huber-tv", smoothing) if smoothing else TV
    x, origin = generator.uniform(0, 3, (2, rows, columns))
    field, proposal = generator.normal(size=(2, rows, columns)), origin if about else None
    change = differences_of(x - about * origin)
    t = np.hypot(*change)
    value, slack = DualField([change / np.maximum(np.maximum(t, smoothing), 1e-300)], proposal).penalty_and_slack(
        x, penalty
    )
    phi = np.where(t < smoothing, t**2 / (2 * max(smoothing, 1e-9)), t - smoothing / 2)
    assert value == pytest.approx(phi.sum(), rel=1e-12)
    assert abs(slack) <= 1e-12 * t.sum()
    field /= np.maximum(np.hypot(*field), 1)
    slack = DualField([field], proposal).penalty_and_slack(x, penalty)[1]
    expected = phi.sum() - np.sum(change * field) + smoothing / 2 * (field**2).sum()
    assert slack == pytest.approx(expected, rel=1e-9)
    assert slack > 0


@pytest.mark.parametrize(("dtype", "proposed"), [(np.float32, True), (np.float64, False)])
def test_tiles_and_threads_change_nothing(
    dtype: type[np.float32] | type[np.float64], proposed: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    generator = np.random.default_rng(5)
    v: Image = generator.normal(2, 1, (300, 61)).astype(dtype)
    w: Image = generator.uniform(0.5, 2, (300, 61)).astype(dtype)
    proposal: Image | None = generator.normal(2, 1, (300, 61)).astype(dtype) if proposed else None
    planes = []
    for workers, columns in ((1, 1024), (3, 16), (4, 25)):
        monkeypatch.setattr(proximal, "_TILE_COLUMNS", columns)
        dual = DualField([np.zeros((2, 300, 61), dtype)], proposal, workers)
        planes.append(dual.prox(v, w, 1.0, TV, lambda _: 0.0, 60).plane)
    for plane in planes[1:]:
        np.testing.assert_allclose(plane, planes[0], rtol=50 * np.finfo(dtype).eps, atol=2 * np.finfo(dtype).eps)


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
        y = (root * x - length * _adjoint(p) / root + length * root * v) / (1 + length)
        y = np.maximum(y, 0)
        p /= weight
        momentum = 1 / np.sqrt(1 + 1.2 * length)
        ahead, x, length = y + momentum * (y - root * x), y / root, length * momentum
    dual = DualField([np.zeros((2, 7, 6))], proposal)
    result = dual.prox(v, w, weight, TV, lambda _: 0.0, 40)
    assert (x == 0).any()
    np.testing.assert_allclose(dual.vectors[0], p, atol=1e-12)
    np.testing.assert_allclose(result.plane, x, atol=1e-12)


def test_step_on_dual_field_is_smallest_of_changed_samples() -> None:
    reach = np.array([[1.0, 2.0, 1.0], [1.0, 1.0, 4.0]])
    np.testing.assert_allclose(step_sizes(reach), 0.15 / np.array([[2.0, 2.0, 4.0], [1.0, 4.0, 4.0]]))


def test_penalty_without_smoothing_is_refused() -> None:
    for name in ("huber-tv", "quadratic"):
        with pytest.raises(ValueError, match="smoothing_e > 0"):
            Penalty(name)


def slow_prox(v: Image, w: Image, weight: float, proposal: Image, penalty: Penalty) -> Image:
    """Return the solution by Chambolle and Pock's iteration, with fixed steps that do not use the metric."""
    x = ahead = np.maximum(v, 0)
    p, step = np.zeros((2, *v.shape)), 0.35
    for _ in range(4_000 if penalty.name == "tv" else 1_500):
        p = p + step * differences_of(ahead - proposal)
        p /= 1 + step * penalty.smoothing_e / weight
        if penalty.bounded:
            p /= np.maximum(np.hypot(*p) / weight, 1)
        after = np.maximum((x - step * _adjoint(p) + step * w * v) / (1 + step * w), 0)
        x, ahead = after, 2 * after - x
    return x


def cost_about(x: Image, v: Image, w: Image, weight: float, proposal: Image, penalty: Penalty) -> float:
    return float(0.5 * np.sum(w * (x - v) ** 2)) + weight * penalty_about(x, proposal, penalty)


def penalty_about(x: Image, proposal: Image, penalty: Penalty) -> float:
    t, delta = np.hypot(*differences_of(x - proposal)), penalty.smoothing_e
    squares = t**2 / (2 * max(delta, 1e-300))
    phi = {"tv": t, "quadratic": squares, "huber-tv": np.where(t < delta, squares, t - delta / 2)}[penalty.name]
    return float(phi.sum())


@pytest.mark.parametrize(
    ("penalty", "about"),
    [(TV, False), (TV, True), (Penalty("huber-tv", 0.3), True), (Penalty("quadratic", 0.8), True)],
)
def test_prox_agrees_with_slow_primal_dual_method(penalty: Penalty, about: bool) -> None:
    generator = np.random.default_rng(7)
    v, w = generator.normal(0.4, 1, (6, 7)), generator.uniform(0.5, 2, (6, 7))
    proposal = generator.normal(0, 2, (6, 7)) * about
    own_proposal = proposal if about else None
    result = prox(v, w, 0.7, penalty, proposal=own_proposal)
    best = slow_prox(v, w, 0.7, proposal, penalty)
    np.testing.assert_allclose(result.plane, best, atol=1e-4)
    assert (best == 0).any()
    lowest = cost_about(best, v, w, 0.7, proposal, penalty)
    assert result.gap <= 1e-10
    for steps in (20, 40):
        dual = DualField([np.zeros((2, 6, 7))], own_proposal)
        rough = dual.prox(v, w, 0.7, penalty, lambda _: 0.0, steps)
        excess = cost_about(rough.plane, v, w, 0.7, proposal, penalty) - lowest
        assert 0 < excess <= rough.gap + 1e-9
        assert rough.gap < 10


@pytest.mark.parametrize("penalty", [TV, Penalty("huber-tv", 0.02)])
@pytest.mark.parametrize("contrast", [0.0, 0.5])
def test_gap_bounds_plane_that_may_be_its_proposal(penalty: Penalty, contrast: float) -> None:
    """The bound is no less than the distance of cost and dual cost.

    The data are the proposal and noise, and a square that the proposal lacks.
    """
    generator = np.random.default_rng(3)
    proposal, w = np.abs(generator.normal(1, 1, (48, 40))), generator.uniform(0.5, 2, (48, 40))
    v = proposal + 0.05 * generator.normal(size=proposal.shape)
    v[8:40, 8:32] += contrast

    def solved(gap: float) -> tuple[ProxResult, Image]:
        dual = DualField([np.zeros((2, *v.shape))], proposal)
        return dual.prox(v, w, 0.5, penalty, lambda _: gap, 3000), dual.vectors[0]

    changes = []
    for gap in (10.0, 3.0, 1.0, 0.3, 0.1, 0.03, 0.01, 0.003, 1e-5):
        result, p = solved(gap)
        best = np.maximum(v - 0.5 / w * _adjoint(p), 0)
        conjugate = 0.5 * penalty.smoothing_e * np.sum(p**2)
        dual_cost = 0.5 * np.sum(w * (best - v) ** 2)
        dual_cost += 0.5 * (np.sum(p * differences_of(best - proposal)) - conjugate)
        assert np.hypot(*p).max() <= 1 + 1e-9
        assert cost_about(result.plane, v, w, 0.5, proposal, penalty) - dual_cost <= result.gap + 1e-9
        changes.append(float(np.abs(result.plane - proposal).max()))
    if penalty.name == "tv":
        assert (changes[3] == 0) == (contrast == 0), "noise is explained without a change, the square is not"


def test_each_plane_has_its_part_of_the_proposal() -> None:
    generator = np.random.default_rng(12)
    shapes = [(5, 6), (8, 4), (3, 7)]
    planes = [
        np.stack([generator.normal(1, 1, shape), generator.uniform(0.5, 2, shape), generator.normal(0, 2, shape)])
        for shape in shapes
    ]
    v, w, proposal = (np.concatenate([plane[k].ravel() for plane in planes]) for k in range(3))
    dual = DualField([np.zeros((2, *shape)) for shape in shapes], proposal)
    together = dual.prox(v, w, 0.7, TV, lambda _: 1e-10, 50_000)
    alone = [prox(plane[0], plane[1], 0.7, proposal=plane[2], gap=1e-10 / 3) for plane in planes]
    np.testing.assert_array_equal(together.plane, np.concatenate([result.plane.ravel() for result in alone]))
    assert together.gap == pytest.approx(sum(result.gap for result in alone))
    value, slack = dual.penalty_and_slack(together.plane, TV)
    expected = sum(penalty_about(result.plane, plane[2], TV) for result, plane in zip(alone, planes, strict=True))
    assert value == pytest.approx(expected, rel=1e-12)
    assert 0 <= 0.7 * slack <= 2e-10


@pytest.mark.parametrize(
    ("shape", "about"), [((129, 128), False), pytest.param((256, 131), True, marks=pytest.mark.deep)]
)
def test_coarse_field_is_near_that_of_the_solution(shape: tuple[int, int], about: bool) -> None:
    """A disk in noise: the gap after 100 steps is a quarter of that without, and the solution is the same."""
    generator = np.random.default_rng(14)
    row, column = np.mgrid[: shape[0], : shape[1]]
    disk = ((row - shape[0] / 2) ** 2 + (column - shape[1] / 2) ** 2 < 45**2) * 1.0
    v, w = disk + generator.normal(0, 1, shape), generator.uniform(0.5, 2, shape)
    proposal = np.exp(-((row - 90) ** 2 + (column - 60) ** 2) / 800) if about else None
    cold, begun = (DualField([np.zeros((2, *shape))], proposal) for _ in range(2))
    begun.begin_coarse(v, w, 4.0, TV, 10.0)
    assert not begun.vectors[0][0, -1].any()
    assert not begun.vectors[0][1, :, -1].any()
    gaps = [field.copy().prox(v, w, 4.0, TV, lambda _: 0.0, 100).gap for field in (cold, begun)]
    assert gaps[1] < 0.25 * gaps[0]
    planes = [field.prox(v, w, 4.0, TV, lambda _: 1e-3, 20_000).plane for field in (cold, begun)]
    np.testing.assert_allclose(planes[1], planes[0], atol=0.1)
    assert np.sqrt(np.sum(w * (planes[1] - planes[0]) ** 2)) < 2 * np.sqrt(2e-3)  # each is at most √(2 gap) away
