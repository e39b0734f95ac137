"""A penalty of one's own in PMLEM, against dense linear algebra and a quasi-Newton method."""

from dataclasses import dataclass
from itertools import islice

import numpy as np
import pytest
from scipy.optimize import minimize

from faintfield.recon.likelihood.images import Image, LikelihoodName
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.pmlem import iterate_until, norm, pmlem
from tests.recon.small_problems import SAMPLES, SHAPE, problem, two_planes

WEIGHT = 0.8


@dataclass
class Tikhonov:
    """½ Σ (f − c)²."""

    centre: float = 0.0

    def value(self, plane: Image) -> float:
        return 0.5 * float(np.sum((plane - self.centre) ** 2))

    def prox(self, point: Image, metric: Image, weight: float) -> Image:
        return np.asarray(np.maximum((metric * point + weight * self.centre) / (metric + weight), 0))


@pytest.mark.parametrize("likelihood", ["shifted-poisson", "poisson-gaussian", "least-squares"])
def test_optimum_agrees_with_quasi_newton_method(likelihood: LikelihoodName) -> None:
    posed, penalty = problem(likelihood), Tikhonov(3.0)

    def objective(f: Image) -> tuple[float, Image]:
        value, gradient = posed.value_and_gradient(f)
        return value + 0.5 * WEIGHT * float(np.sum((f - 3.0) ** 2)), gradient + WEIGHT * (f - 3.0)

    best = minimize(objective, np.full(SAMPLES, 3.0), jac=True, method="L-BFGS-B", bounds=[(0, None)] * SAMPLES)
    start = smooth_start(posed.operator, posed.images)
    fit = DataFit(posed.operator, posed.images, float(start.mean()))
    iterate = iterate_until(pmlem(fit, start, penalty_weight=WEIGHT, penalty=penalty, tolerance=1e-6), 1e-6, 400)
    assert np.allclose(iterate.plane, best.x.reshape(SHAPE), atol=1e-3)
    assert np.isnan(iterate.certificate.distance)  # nothing is claimed
    assert iterate.certificate.within(1e-6)


@pytest.mark.parametrize("weight", [1e-3, 0.1, 0.8])
@pytest.mark.parametrize("likelihood", ["shifted-poisson", "least-squares"])
def test_expected_distance_is_about_the_true_one(likelihood: LikelihoodName, weight: float) -> None:
    posed, penalty, tolerance = problem(likelihood), Tikhonov(3.0), 0.01
    start = smooth_start(posed.operator, posed.images)
    fit = DataFit(posed.operator, posed.images, float(start.mean()))
    ends = [
        iterate_until(pmlem(fit, start, penalty_weight=weight, penalty=penalty, tolerance=limit), limit, 2000)
        for limit in (tolerance, 1e-7)
    ]
    metric = fit.metric(ends[1].plane)
    distance = norm(ends[0].plane - ends[1].plane, metric) / norm(ends[1].plane, metric)
    assert distance <= 2 * tolerance


def test_several_planes_have_penalty_each() -> None:
    posed = two_planes()
    start = posed.start()
    fit = posed.fit(float(start.mean()))
    strong = 1e4
    iterates = pmlem(fit, start, penalty_weight=strong, penalty=Tikhonov(2.0), dual=posed.dual())
    (iterate,) = islice(iterates, 30, 31)
    assert np.allclose(iterate.plane, 2.0, atol=0.02)
    samples = sum(plane.size for plane in posed.operator.planes_of(iterate.plane))
    assert iterate.plane.size == samples


def test_prox_of_wrong_shape_or_sign_is_refused() -> None:
    class Wrong(Tikhonov):
        def prox(self, point: Image, metric: Image, weight: float) -> Image:
            return -np.abs(point) - 1

    posed = problem()
    start = smooth_start(posed.operator, posed.images)
    fit = DataFit(posed.operator, posed.images, float(start.mean()))
    with pytest.raises(ValueError, match=r"Wrong\.prox returned .* none negative"):
        next(pmlem(fit, start, penalty_weight=WEIGHT, penalty=Wrong()))
