"""Standard deviations against inverse matrices, and against errors that were really made."""

import numpy as np
import pytest

from faintfield.pipelines.reconstruction.planes import Objective, Settings, solve, solve_pmlem
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.penalties import Penalty, PenaltyName
from faintfield.recon.solver.uncertainty import standard_deviation
from tests.recon.small_problems import SHAPE, difference_matrix
from tests.recon.test_cross_validation import dark_views
from tests.recon.test_cross_validation import scene as pieces
from tests.recon.test_scene_fit import scene


def test_with_a_quadratic_penalty_sigma_is_that_of_the_inverse_matrix() -> None:
    generator = np.random.default_rng(4)
    metric = generator.uniform(3.0, 4.0, SHAPE)
    gradient_of, weight, delta = difference_matrix(), 2.0, 0.5
    covariance = np.linalg.inv(np.diag(metric.ravel()) + weight / delta * gradient_of.T @ gradient_of)
    exact = np.sqrt(np.diag(covariance)).reshape(SHAPE)
    penalty = Penalty("quadratic", delta)
    draws = [standard_deviation(np.ones(SHAPE), metric, weight, penalty, generator) ** 2 for _ in range(60)]
    found = np.sqrt(np.mean(draws, axis=0))
    assert np.median(np.abs(found / exact - 1)) < 0.05
    assert found.mean() == pytest.approx(exact.mean(), rel=0.03)


def test_without_a_penalty_sigma_is_that_of_the_data() -> None:
    metric = np.random.default_rng(4).uniform(0.1, 4.0, SHAPE)
    found = standard_deviation(np.ones(SHAPE), metric, 0.0, Penalty("none"), np.random.default_rng(1))
    np.testing.assert_allclose(found, metric**-0.5, rtol=1e-6)


def test_with_total_variation_sigma_is_larger_at_edges_and_below_that_of_the_data() -> None:
    plane = np.where(np.arange(48) < 24, 0.0, 20.0) * np.ones((40, 1))
    penalty = Penalty("huber-tv", 0.02)  # of a given weight
    found = standard_deviation(plane, np.full(plane.shape, 4.0), 3.0, penalty, np.random.default_rng(3))
    assert found.max() < 0.5 * 1.15  # the draws of an edge scatter
    assert found[:, 22:26].mean() > 1.1 * found[:, :16].mean()


@pytest.mark.parametrize("name", ["quadratic", "huber-tv"])
def test_a_larger_weight_reduces_sigma(name: PenaltyName) -> None:
    sigmas = [
        standard_deviation(np.ones((40, 40)), np.full((40, 40), 2.0), weight, Penalty(name, 0.1), generator)
        for weight in (0.5, 1.0, 2.0)
        for generator in [np.random.default_rng(1)]
    ]
    means = [float(sigma.mean()) for sigma in sigmas]
    assert means[0] > 1.1 * means[1] > 1.1**2 * means[2]
    assert means[0] < 2**-0.5


def test_total_variation_takes_its_weight_from_the_roughness_of_the_plane() -> None:
    rough = blurred(np.random.default_rng(1).normal(0, 4, (40, 40)), (1, 2))

    def mean_of(height: float, weight: float) -> float:
        metric, generator = np.full(rough.shape, 2.0), np.random.default_rng(1)
        return float(standard_deviation(5 + height * rough, metric, weight, Penalty(), generator).mean())

    assert mean_of(1.0, 0.3) == pytest.approx(mean_of(1.0, 3.0), rel=0.05)
    assert 1.1 * mean_of(1.0, 1.0) < mean_of(2.0, 1.0) < 2**-0.5


def test_intervals_cover_the_truth_on_objects() -> None:
    truth: Image = pieces(64)
    held = []
    for seed in range(3):
        operator, images = dark_views(truth, seed)
        found = solve(operator, images, "pmlem", Settings(uncertainty=True))
        held.append(np.mean((np.abs(found.plane - truth) <= 1.645 * found.sidecars["sigma"])[8:-8, 8:-8]))
    assert 0.85 <= np.mean(held) <= 0.995


def test_each_plane_of_a_scene_has_sigma_as_if_the_others_were_known() -> None:
    posed = scene()
    images = ElementalImages(posed.images.electrons, 0.3, 1.0)
    settings = Settings(penalty_weight=0.8, uncertainty=True)
    found = solve_pmlem(Objective.of(SceneProblem(posed.operator, images), settings), settings)
    for solution, grid in zip(found, posed.operator.grids, strict=True):
        assert solution.sidecars["sigma"].shape == grid.shape
        assert solution.sidecars["sigma"].min() > 0
    samples = posed.operator.samples_of([solution.plane for solution in found])
    fit = posed.fit(1.0)
    own = posed.operator.samples_of(fit.metric_of_each(samples))
    assert (own <= fit.metric(samples) * (1 + 1e-9)).all()
