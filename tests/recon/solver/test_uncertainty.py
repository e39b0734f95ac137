"""Standard deviations against inverse matrices, known errors, and errors that were really made."""

from dataclasses import replace

import numpy as np
import pytest

from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.reconstruction.planes.penalised import Objective, certified, solve_pmlem
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.collaborative import patch_candidates
from faintfield.recon.prior.evidence import evidence_of_planes
from faintfield.recon.prior.proposal import ProposalAnswers, propose
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.uncertainty import LocalFit, LocalProblem, local_fits, standard_deviation
from tests.recon.displaced import dark_views, pieces
from tests.recon.operator_contract import dense_matrix
from tests.recon.small_problems import SHAPE, TWO_GRIDS, difference_matrix, two_planes


def test_local_fits_are_those_of_the_dense_matrix() -> None:
    posed = two_planes(occluded=True)
    matrix = dense_matrix(posed.operator)
    samples = posed.start()
    local_parts = local_fits(posed.operator, posed.fit(1.0), samples)
    first = 0
    for local, grid in zip(local_parts, TWO_GRIDS, strict=True):
        size = grid.shape[0] * grid.shape[1]
        own = matrix[:, first : first + size].T @ matrix[:, first : first + size]
        seen = own.sum(axis=1) > 0.01 * own.sum(axis=1).max()
        expected = np.divide(np.diag(own), own.sum(axis=1), out=np.zeros(size), where=seen)
        np.testing.assert_allclose(local.noise_share.ravel(), expected, rtol=1e-10, atol=1e-12)
        down = (-1.0) ** np.arange(grid.shape[0])[:, np.newaxis] * np.ones(grid.shape)
        right = (-1.0) ** np.arange(grid.shape[1]) * np.ones(grid.shape)
        for signs, left in zip((down.ravel(), right.ravel()), local.alternation, strict=True):
            alone = (signs * (own @ signs))[seen].sum() / own.sum(axis=1)[seen].sum()
            assert left == pytest.approx(alone, rel=1e-10)
        first += size
    gradient = posed.fit(1.0).value_and_gradient(samples)[1]
    np.testing.assert_allclose(posed.operator.samples_of([part.gradient for part in local_parts]), gradient, rtol=1e-12)


def constant(metric: Image, *, light: float = 20.0, alternation: tuple[float, float] = (1.0, 1.0)) -> LocalFit:
    """Return a constant plane at its optimum, of which the views tell no errors."""
    nothing = np.zeros_like(metric)
    return LocalFit(np.full_like(metric, light), metric, nothing, nothing, alternation)


def test_sigma_under_quadratic_penalty_is_of_inverse_matrix() -> None:
    generator = np.random.default_rng(4)
    metric = generator.uniform(3.0, 4.0, SHAPE)
    gradient_of, weight, delta = difference_matrix().toarray(), 2.0, 0.5
    inverse = np.linalg.inv(np.diag(metric.ravel()) + weight / delta * gradient_of.T @ gradient_of)
    exact = np.diag(inverse @ np.diag(metric.ravel()) @ inverse).reshape(SHAPE)
    smooth = 0.3 * blurred(exact, (1, 2, 4)) + 0.5 * blurred(exact, (1, 2, 4, 8, 8, 16)) + 0.2 * exact.mean()
    penalty = Penalty("quadratic", delta)
    result = np.mean([standard_deviation(constant(metric), weight, penalty, generator) ** 2 for _ in range(20)], axis=0)
    assert result.mean() == pytest.approx(1.1 * smooth.mean(), rel=0.05)  # the usual ratio
    np.testing.assert_allclose(result, 1.1 * smooth, rtol=0.15)


def test_penalty_reduces_correlated_noise_less() -> None:
    metric, penalty = np.full((48, 48), 4.0), Penalty("quadratic", 0.5)
    means = [
        float(standard_deviation(constant(metric, alternation=(k, k)), 2.0, penalty, np.random.default_rng(2)).mean())
        for k in (1.0, 1 / 3)
    ]
    frequency = np.fft.fftfreq(48)
    down, right = np.meshgrid(frequency, frequency, indexing="ij")
    penalised = 2.0 / 0.5 * (4 - 2 * np.cos(2 * np.pi * down) - 2 * np.cos(2 * np.pi * right))
    for result, t in zip(means, (0.0, 0.25), strict=True):
        seen = np.prod([(1 + 2 * t * np.cos(2 * np.pi * f)) / (1 + 2 * t) for f in (down, right)], axis=0)
        assert result**2 == pytest.approx(1.1 * np.mean(4 * seen / (4 * seen + penalised) ** 2), rel=0.1)


def test_sigma_without_penalty_is_that_of_the_data() -> None:
    metric = np.random.default_rng(4).uniform(0.1, 4.0, SHAPE)
    result = standard_deviation(constant(metric), 0.0, Penalty("none"), np.random.default_rng(1))
    np.testing.assert_allclose(result, metric**-0.5, rtol=1e-6)


def test_sigma_includes_contrast_that_the_penalty_removed() -> None:
    generator = np.random.default_rng(5)
    shape, w = (96, 96), 2.0
    plane = np.where(np.arange(96) < 48, 0.0, 20.0) * np.ones(shape)
    lost = np.where(plane > 0, generator.normal(0, 1.5, shape), 0.0)
    noise = generator.normal(0, w**-0.5, shape)
    sigmas = []
    for residual in (noise, noise + lost):
        local = LocalFit(plane, np.full(shape, w), -w * residual, np.ones(shape), (1.0, 1.0))
        sigmas.append(standard_deviation(local, 60.0, Penalty(), np.random.default_rng(1)))
    lit, dark = np.s_[:, 60:], np.s_[:, :36]
    assert np.sqrt(np.mean(sigmas[0][lit] ** 2)) < 0.4
    assert np.sqrt(np.mean(sigmas[1][lit] ** 2)) == pytest.approx(1.5, rel=0.12)
    assert sigmas[1][dark].mean() < 0.2


def test_sigma_of_a_black_plane_is_not_zero() -> None:
    metric = np.full(SHAPE, 2.0)
    black = LocalFit(np.zeros(SHAPE), metric, np.full(SHAPE, 50.0), np.ones(SHAPE), (1.0, 1.0))
    result = standard_deviation(black, 1.0, Penalty(), np.random.default_rng(1))
    assert np.isfinite(result).all()
    assert result.min() >= 0.0099 * 2**-0.5


def texture(size: int) -> Image:
    """Return fine random texture, most of which total variation removes."""
    rough = blurred(np.random.default_rng(9).normal(size=(size, size)), (1, 2))
    return np.asarray(np.maximum(1 + 0.25 * rough / rough.std(), 0), np.float32)


@pytest.mark.parametrize(
    ("truth", "prior"), [(pieces(64), "patches"), (texture(64), "tv")], ids=["pieces, patches", "texture, variation"]
)
def test_intervals_cover_the_truth_on_objects(truth: Image, prior: PriorName) -> None:
    shares = []
    for seed in range(1 if prior == "patches" else 2):
        operator, images = dark_views(truth, seed)
        solution = solve(operator, images, "pmlem", SolverOptions(uncertainty=True, prior=prior))
        shares.append(np.mean((np.abs(solution.plane - truth) <= 1.645 * solution.sidecars["sigma"])[8:-8, 8:-8]))
    assert 0.85 <= np.mean(shares) <= 0.96


def test_plane_about_proposal_answers_as_to_other_data() -> None:
    operator, images = dark_views(pieces(48), 3)
    objective = Objective.of(SceneProblem(operator, images), SolverOptions())
    (pilot,) = solve_pmlem(objective)
    weight = pilot.record.penalty_weight or 0.0
    (evidence,) = evidence_of_planes(operator, images, pilot.plane)
    (proposal,) = propose(objective.posed, pilot.plane, [evidence], weight, patch_candidates)

    def about(posed: SceneProblem, proposed: Image) -> Image:
        dual = replace(posed.dual(), proposal=proposed)
        return certified(replace(objective, posed=posed), objective.start, weight, dual)[1]

    plane = about(objective.posed, proposal.picture)
    deviation = np.sqrt(images.background_e + images.read_variance_e2)
    noise = np.random.default_rng(5).normal(0, deviation, images.electrons.shape)
    noisy = replace(objective.posed.images, electrons=(images.electrons + 0.5 * noise).astype(np.float32))
    others = replace(objective.posed, images=noisy)
    (other_pilot,) = solve_pmlem(replace(objective, posed=others, options=SolverOptions(penalty_weight=weight)))
    (other_evidence,) = evidence_of_planes(operator, noisy, other_pilot.plane)
    really = about(others, proposal.again(other_evidence._replace(noise=evidence.noise), other_pilot.plane)) - plane

    (local,) = local_fits(operator, objective.posed.fit(objective.level_e), plane)
    gradient = others.fit(objective.level_e).value_and_gradient(plane)[1]
    assert isinstance(objective.penalty, Penalty)
    answer = ProposalAnswers(LocalProblem(local, weight, objective.penalty), proposal, pilot.plane)(
        (local.gradient - gradient).astype(np.float32)
    )
    inner = np.s_[8:-8, 8:-8]
    assert np.corrcoef(answer[inner].ravel(), really[inner].ravel())[0, 1] > 0.8
    assert answer[inner].std() == pytest.approx(really[inner].std(), rel=0.3)
