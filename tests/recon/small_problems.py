"""Problems of a hundred samples with a dense matrix H, and textbook solvers for them, in float64."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np
from scipy.optimize import minimize
from scipy.special import gammaln

from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName, PixelLikelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator

SHAPE = (9, 12)
DETECTOR = (11, 14)  # a sample more on each side
SAMPLES = SHAPE[0] * SHAPE[1]

_COUNTS = np.arange(50.0)


@dataclass(frozen=True, eq=False)
class DenseProblem:
    """Data of one plane, the operator under test, and the same operator as a matrix."""

    operator: PlaneOperator
    images: ElementalImages
    matrix: Image
    homographies: Image
    rays: Image

    @cache  # noqa: B019 - a problem lives as long as its test
    def counted(self) -> Any:
        return self.matrix.any(axis=1)

    @cache  # noqa: B019
    def rows(self) -> Image:
        """Those of the matrix of the counted pixels."""
        return np.asarray(self.matrix[self.counted()])

    @cache  # noqa: B019 - a problem lives as long as its test
    def count_weights(self) -> Image:
        """exp(−(g − N)²/2σ²)/N! of every counted pixel and N."""
        g = self.images.electrons.ravel()[self.counted(), None]
        exponent = -((g - _COUNTS) ** 2) / (2 * float(self.images.read_variance_e2))
        return np.asarray(np.exp(exponent - gammaln(_COUNTS + 1)))

    def value_and_gradient(self, f: Image) -> tuple[float, Image]:
        """The negative log-likelihood and its gradient, from formulas independent of the code under test."""
        rows = self.rows()
        g = self.images.electrons.ravel()[self.counted()]
        b, v = float(self.images.background_e), float(self.images.read_variance_e2)
        mean = rows @ f.ravel() + b
        match self.images.likelihood.name:
            case "least-squares":
                variance = self.images.likelihood.level_e + b + v
                return float(np.sum((g - mean) ** 2) / (2 * variance)), rows.T @ ((mean - g) / variance)
            case "poisson-gaussian":
                powers = mean[:, None] ** _COUNTS * self.count_weights()
                expected = powers @ _COUNTS / powers.sum(axis=1)
                value = float(np.sum(mean - np.log(powers.sum(axis=1))))
                return value, rows.T @ (1 - expected / mean)
            case name:
                v = v if name == "shifted-poisson" else 0.0
                y, m = np.maximum(g + v, 0), mean + v
                return float(np.sum(m - y * np.log(m))), rows.T @ (1 - y / m)


def problem(
    likelihood: LikelihoodName = "shifted-poisson",
    *,
    views: int = 12,
    background_e: float = 0.3,
    variance_e2: float = 2.0,
    low: float = 2.0,
    high: float = 6.0,
    seed: int = 2,
    dtype: type[np.float32] | type[np.float64] = np.float64,
) -> DenseProblem:
    """A bright box on a dark plane, in views that are displaced by up to half a sample."""
    generator = np.random.default_rng(seed)
    shifts = generator.uniform(-0.5, 0.5, (views, 2))
    columns, rows = np.meshgrid(np.arange(-1.0, SHAPE[1] + 1), np.arange(-1.0, SHAPE[0] + 1))
    homographies = np.stack([np.eye(3)] * views)
    homographies[:, :2, 2] = shifts[:, ::-1]
    rays, grid = np.stack([columns, rows], axis=-1), PlaneGrid(SHAPE, 1.0, (0.0, 0.0))
    operator = PlaneOperator(homographies, rays, grid, dtype=dtype, workers=1)
    matrix = np.concatenate([_bilinear(rows.ravel() + down, columns.ravel() + right) for down, right in shifts])
    truth = np.full(SHAPE, low)
    truth[2:6, 3:9] = high
    mean = (matrix @ truth.ravel()).reshape(views, *DETECTOR)
    electrons = generator.poisson(mean + background_e) + generator.normal(0, np.sqrt(variance_e2), mean.shape)
    pixel_likelihood = PixelLikelihood(likelihood, level_e=3.0 if likelihood == "least-squares" else 0.0)
    return DenseProblem(
        operator,
        ElementalImages(electrons, background_e, variance_e2, likelihood=pixel_likelihood),
        matrix,
        homographies,
        rays,
    )


def _bilinear(rows: Image, columns: Image) -> Image:
    """The matrix from samples to points of the plane: hat functions of the distance to each sample."""
    down = np.maximum(1 - np.abs(rows[:, None] - np.arange(SHAPE[0])), 0)
    right = np.maximum(1 - np.abs(columns[:, None] - np.arange(SHAPE[1])), 0)
    inside = (rows >= 0) & (rows <= SHAPE[0] - 1) & (columns >= 0) & (columns <= SHAPE[1] - 1)
    matrix: Image = (down[:, :, None] * right[:, None, :]).reshape(rows.size, SAMPLES)
    return matrix * inside[:, None]


def difference_matrix() -> Image:
    """∇ as a matrix (2 · samples, samples): differences down, then right, none across an edge."""
    index = np.arange(SAMPLES).reshape(SHAPE)
    matrix = np.zeros((2, SAMPLES, SAMPLES))
    for part, (here, there) in enumerate(((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]))):
        matrix[part, here.ravel(), there.ravel()] = 1
        matrix[part, here.ravel(), here.ravel()] = -1
    return matrix.reshape(2 * SAMPLES, SAMPLES)


def primal_dual_solution(posed: DenseProblem, weight: float, passes: int, proposal: Image | None = None) -> Image:
    """The optimum with total variation about a proposal, by Condat and Vũ's primal-dual iteration with fixed steps."""
    gradient_of = difference_matrix()
    proposed = np.zeros(SAMPLES) if proposal is None else proposal.ravel()
    lightest = float(posed.images.background_e) + float(posed.images.read_variance_e2)
    curvature = np.linalg.norm(posed.matrix, 2) ** 2 * 4 / lightest
    step = 1 / curvature
    dual_step = curvature / (2 * 8 * weight**2)
    f, p = np.full(SAMPLES, 3.0), np.zeros(2 * SAMPLES)
    for _ in range(passes):
        ahead = f - step * (posed.value_and_gradient(f)[1] + weight * (gradient_of.T @ p))
        ahead = np.maximum(ahead, 0)
        p = p + dual_step * weight * (gradient_of @ (2 * ahead - f - proposed))
        length = np.hypot(*p.reshape(2, SAMPLES))
        p = (p.reshape(2, SAMPLES) / np.maximum(length, 1)).ravel()
        f = ahead
    return f.reshape(SHAPE)


def smooth_solution(posed: DenseProblem, weight: float, phi: Callable[[Image], tuple[Image, Image]]) -> Image:
    """The optimum with a penalty Σ φ(|∇f|) that has a derivative, by L-BFGS-B; `phi` gives φ and φ'/t."""
    gradient_of = difference_matrix()

    def objective(f: Image) -> tuple[float, Image]:
        value, slope = posed.value_and_gradient(f)
        differences = gradient_of @ f
        of_length, over_length = phi(np.hypot(*differences.reshape(2, SAMPLES)))
        pull = gradient_of.T @ (np.tile(over_length, 2) * differences)
        return value + weight * float(of_length.sum()), slope + weight * pull

    options: Any = {"maxiter": 20000, "maxfun": 40000, "ftol": 1e-16, "gtol": 1e-10, "maxcor": 50}
    start, bounds = np.full(SAMPLES, 3.0), [(0, None)] * SAMPLES
    found = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(found.x).reshape(SHAPE)
