"""Edges of a proposal, views that contradict a plane, and the mixture of candidates against a general solver."""

from collections.abc import Collection
from dataclasses import replace
from itertools import product

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from scipy.optimize import LinearConstraint, minimize

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.reconstruction.planes.penalised import Objective
from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior import evidence as evidence_module
from faintfield.recon.prior import proposal
from faintfield.recon.prior.evidence import Evidence, Misfit, evidence_of_planes, misfits
from faintfield.recon.prior.proposal import Scores, best_mixture, mixtures_of, propose, scores
from faintfield.recon.solver import penalty_weight
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.penalty_weight import validation_views
from tests.recon.displaced import dark_views, noisy_images, pieces, planes_displaced_by
from tests.recon.operator_contract import dense_matrix


def pilot_alone(evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
    return {"tv": evidence.pilot}


def mean_of_nine(picture: Image) -> Image:
    """Return the mean of each sample and its neighbours, weighted by ¼, ½ and ¼ along both axes."""
    wide = np.pad(picture.astype(float), 1, "edge")
    result = np.zeros(picture.shape)
    for row in range(picture.shape[0]):
        for column in range(picture.shape[1]):
            result[row, column] = np.sum(wide[row : row + 3, column : column + 3] * np.outer([1, 2, 1], [1, 2, 1])) / 16
    return result


@pytest.mark.parametrize("light", [1.0, 40.0])
def test_edges_beyond_noise_are_those_of_the_plane(light: float) -> None:
    plane = np.float32(light) * pieces(32)
    operator, images = dark_views(pieces(32), 2)
    problem = Objective.of(SceneProblem(operator, images), SolverOptions()).posed
    (evidence,) = evidence_of_planes(operator, images, plane)
    unseen = np.zeros(plane.shape, bool)
    unseen[:3] = True
    variance = np.where(unseen, np.inf, evidence.noise.variance).astype(np.float32)
    evidence = evidence._replace(noise=evidence.noise._replace(variance=variance))
    (result,) = propose(problem, plane, [evidence], 1.0, pilot_alone)
    edges = plane - evidence.pilot
    share = mean_of_nine(edges**2) / (mean_of_nine(edges**2) + 0.1 * np.where(unseen, 1, variance))
    expected = np.where(unseen, plane, np.maximum(evidence.pilot + share * edges, 0))
    np.testing.assert_allclose(result.picture, expected, rtol=1e-3, atol=1e-4 * light)
    np.testing.assert_array_equal(result.again(evidence, plane), result.picture)
    blurred = np.abs(edges) > 0.05 * light
    kept = np.abs((result.picture - evidence.pilot)[blurred & ~unseen]) / np.abs(edges[blurred & ~unseen])
    assert np.median(kept) > 0.9 if light == 40 else np.median(kept) < 0.9


def test_windows_stand_for_a_large_plane(monkeypatch: pytest.MonkeyPatch) -> None:
    """Candidates are judged in windows, and made once of the whole plane; weights are about those of all of it."""
    plane = pieces(96)
    operator, images = dark_views(plane, 3)
    problem = Objective.of(SceneProblem(operator, images), SolverOptions()).posed
    (evidence,) = evidence_of_planes(operator, images, plane)
    shapes: list[tuple[int, ...]] = []

    def multiples_of_pilot(evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        shapes.append(evidence.pilot.shape)
        return {"half": evidence.pilot / 2, "zero": 0 * evidence.pilot, "twice": 2 * evidence.pilot}

    (whole,) = propose(problem, plane, [evidence], 1.0, multiples_of_pilot)
    assert set(shapes) == {(96, 96)}
    shapes.clear()
    monkeypatch.setattr(penalty_weight, "SIDE", 24)
    monkeypatch.setattr(proposal, "WINDOW_SAMPLES", 6 * 24**2)
    monkeypatch.setattr(proposal, "_EDGE", 2)
    (windowed,) = propose(problem, plane, [evidence], 1.0, multiples_of_pilot)
    assert shapes.count((24, 24)) == len(shapes) - 1 == 6
    assert shapes[-1] == (96, 96)
    for region in ("light, detail", "light, smooth"):
        mixture = windowed.mixture[region]
        light = mixture["half"] / 2 + 2 * mixture["twice"]  # the pilot itself predicts best
        expected = whole.mixture[region]["half"] / 2 + 2 * whole.mixture[region]["twice"]
        assert light == pytest.approx(expected, abs=0.05)
        assert light == pytest.approx(1, abs=0.1)


@pytest.mark.parametrize(("error", "is_made"), [(5.0, True), (20.0, False)])
def test_candidates_that_hardly_help_get_no_weight(error: float, is_made: bool) -> None:
    """Errors are independent, so that weights are as their inverse squares; the last candidate adds 0.8 or 0.05 %."""
    independent = Scores(np.diag([4.0, 1.0, error**2]), np.zeros(3))
    mixture = mixtures_of(["tv", "good", "poor"], {"light": independent})["light"]
    inverse = np.array([0.25, 1.0, error**-2 if is_made else 0.0])
    np.testing.assert_allclose([mixture[name] for name in ("tv", "good", "poor")], inverse / inverse.sum(), atol=1e-9)


@pytest.mark.parametrize(
    ("detail", "smooth", "se", "contradicts"),
    [
        (1.03, 1.0, 0.002, True),
        (1.03, 1.03, 0.002, False),  # the noise is 3 % off everywhere
        (0.99, 0.95, 0.002, False),  # detail fits
        (1.03, 1.0, 0.02, False),  # by chance
    ],
)
def test_only_worse_fit_of_detail_contradicts(detail: float, smooth: float, se: float, contradicts: bool) -> None:
    assert Misfit(detail, smooth, se).contradicts is contradicts


def test_shifted_plane_contradicts_and_true_plane_does_not() -> None:
    truth = pieces(64)
    operator, images = dark_views(truth, 3)
    steep = np.hypot(*np.gradient(truth.astype(float))) > 0.1
    regions = {"light, detail": steep.astype(np.float32), "light, smooth": (~steep).astype(np.float32)}
    (right,) = misfits(operator, images, truth, [regions])
    assert right.detail == pytest.approx(1, abs=4 * right.se)
    assert not right.contradicts
    bright = replace(images, electrons=(images.electrons + operator.forward(50 * truth)).astype(np.float32))
    (right,) = misfits(operator, bright, 51 * truth, [regions])
    (shifted,) = misfits(operator, bright, 51 * np.roll(truth, 1, axis=1), [regions])
    assert not right.contradicts
    assert shifted.contradicts


@pytest.mark.parametrize("compared_pixels", [1, 2**26])  # of a seventh of the views, and of all
def test_squares_and_variances_are_those_of_dense_matrices(
    compared_pixels: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(evidence_module, "_COMPARED_PIXELS", compared_pixels)
    operator, images = dark_views(pieces(20), 1)
    images = replace(images, background_e=0.3)
    plane = pieces(20) + np.float32(0.2)
    count = len(operator.seeing_views)
    views = operator.seeing_views if compared_pixels > 1 else operator.seeing_views[validation_views(count)]
    pixels = np.isin(np.arange(images.electrons.shape[0]), views).repeat(images.electrons[0].size)
    matrix = dense_matrix(operator).T[:, pixels]
    expected = matrix.T @ plane.ravel() + 0.3
    variance = expected + images.read_variance_e2
    squares = np.square(images.electrons.ravel()[pixels] - expected)
    share = np.linspace(0, 1, plane.size).reshape(plane.shape)
    (result,) = misfits(operator, images, plane, [{"light, detail": share, "light, smooth": 1 - share}])
    weight = matrix.T @ share.ravel()
    assert result.detail == pytest.approx(weight @ squares / (weight @ variance), rel=1e-4)
    other = matrix.T @ (1 - share).ravel()
    spread = 2 * variance**2 + expected
    errors = [np.sqrt(w @ spread) / (w @ variance) for w in (weight, other)]
    assert result.se == pytest.approx(np.hypot(*errors), rel=1e-4)


def random_scores(seed: int, count: int, rank: int) -> Scores:
    """Scores of candidates that span `rank` dimensions, of which a picture may be outside."""
    generator = np.random.default_rng(seed)
    pictures = generator.normal(size=(count, rank)) @ generator.normal(size=(rank, 30)) + generator.normal(2, 1, 30)
    target = generator.normal(2, 2, 30)
    return Scores(pictures @ pictures.T, pictures @ target)


def test_loss_is_weighted_squared_error_less_a_constant() -> None:
    generator = np.random.default_rng(1)
    pictures, picture = list(generator.normal(size=(3, 6, 5))), generator.normal(size=(6, 5))
    weight = generator.uniform(0, 2, (6, 5))
    result = scores(pictures, picture, weight)
    for j, k in product(range(3), repeat=2):
        assert result.gram[j, k] == pytest.approx(np.sum(weight * pictures[j] * pictures[k]), rel=1e-12)
    for k in range(3):
        assert result.towards[k] == pytest.approx(np.sum(weight * pictures[k] * picture), rel=1e-12)
    constant = np.sum(weight * picture**2)
    for a in generator.dirichlet(np.ones(3), 5):
        mixed = np.tensordot(a, pictures, 1)
        assert result.loss(a) + constant == pytest.approx(np.sum(weight * (mixed - picture) ** 2), rel=1e-10)


@settings(max_examples=25)
@given(seed=st.integers(0, 2**32 - 1), count=st.integers(1, 5), rank=st.integers(0, 5), twin=st.booleans())
def test_mixture_is_as_good_as_a_general_solvers(seed: int, count: int, rank: int, twin: bool) -> None:
    """Also with more candidates than dimensions, and with one candidate twice."""
    result = random_scores(seed, count, rank)
    if twin:
        chosen = [*range(count), 0]
        result = Scores(result.gram[np.ix_(chosen, chosen)], result.towards[chosen])
    best = best_mixture(result)
    assert (best >= 0).all()
    assert best.sum() == pytest.approx(1, abs=1e-9)
    size, scale = result.towards.size, float(np.trace(result.gram))
    expected = minimize(  # type: ignore[call-overload]
        lambda a: result.loss(a) / scale,
        np.full(size, 1 / size),
        jac=lambda a: 2 * (result.gram @ a - result.towards) / scale,
        method="SLSQP",
        bounds=[(0, 1)] * size,
        constraints=LinearConstraint(np.ones((1, size)), 1, 1),
        options={"ftol": 1e-12},
    )
    assert result.loss(best) / scale <= expected.fun + 1e-7


@pytest.mark.parametrize("scale", [1e-9, 1e12])
def test_weights_do_not_depend_on_scale_of_light(scale: float) -> None:
    result = random_scores(4, 5, 4)
    best = best_mixture(Scores(scale * result.gram, scale * result.towards))
    assert best.sum() == pytest.approx(1, abs=1e-12)
    np.testing.assert_allclose(best, best_mixture(result), atol=1e-6)


def test_first_wins_where_all_predict_alike() -> None:
    for same in (Scores(np.ones((4, 4)), np.ones(4)), Scores(np.zeros((4, 4)), np.zeros(4))):
        np.testing.assert_array_equal(best_mixture(same), [1, 0, 0, 0])


def test_fewest_win_where_mixtures_predict_alike() -> None:
    """The second is the picture; so is the mean of the first and the third."""
    pictures = [np.array([[x, 1.0]]) for x in (0, 1, 2)]
    mixture = mixtures_of(["a", "b", "c"], {"all": scores(pictures, pictures[1], np.ones((1, 2)))})["all"]
    np.testing.assert_allclose([mixture[name] for name in "abc"], [0, 1, 0], atol=1e-9)


@pytest.mark.parametrize(("error", "is_made"), [(0.5, True), (2.0, False)])
def test_slow_candidates_that_help_little_get_no_weight(error: float, is_made: bool) -> None:
    """Errors are independent; without the slow candidate 16 or 4 % of the gain over the first are lost."""
    independent = Scores(np.diag([4.0, error**2, 1.0]), np.zeros(3))
    mixture = mixtures_of(["tv", "slow", "half"], {"light": independent}, is_slow=lambda name: name == "slow")["light"]
    inverse = np.array([0.25, error**-2 if is_made else 0.0, 1.0])
    np.testing.assert_allclose(list(mixture.values()), inverse / inverse.sum(), atol=1e-9)


def test_planes_may_have_different_candidates() -> None:
    """As where one of two planes is smaller than a patch."""
    generator = np.random.default_rng(8)
    operator = planes_displaced_by([*generator.uniform(-2, 2, (2, 12, 2))], (24, 24))
    samples = np.concatenate([5 * pieces(24).ravel(), 0 * pieces(24).ravel()]).astype(np.float32)
    images = noisy_images(operator, samples, 0.0, 4.0, generator)
    problem = Objective.of(SceneProblem(operator, images), SolverOptions()).posed

    def more_where_bright(evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
        made = {"tv": evidence.pilot, "same": evidence.pilot}
        return made if evidence.pilot.mean() > 1 else {"tv": evidence.pilot}

    evidences = evidence_of_planes(operator, images, samples)
    bright, dark = propose(problem, samples, evidences, 1.0, more_where_bright)
    assert {tuple(weights) for weights in bright.mixture.values()} == {("tv", "same")}
    assert {tuple(weights) for weights in dark.mixture.values()} == {("tv",)}
