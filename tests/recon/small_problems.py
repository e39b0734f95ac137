"""Problems of a hundred samples with a dense matrix H, and textbook solvers for them, in float64."""

from collections.abc import Callable
from dataclasses import dataclass
from functools import cache, cached_property
from typing import Any

import numpy as np
from numpy.polynomial.polynomial import polyval
from numpy.typing import NDArray
from scipy.optimize import minimize
from scipy.sparse import csr_array
from scipy.special import gammaln

from faintfield.recon.likelihood.images import ElementalImages, Image, LikelihoodName, PixelLikelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.data_fit import SceneProblem
from tests.recon.displaced import pixel_rays, views_displaced_by

SHAPE = (9, 12)
DETECTOR = (11, 14)  # a sample more on each side
SAMPLES = SHAPE[0] * SHAPE[1]

# Two planes of unlike grids, seen by views of SIZE x SIZE pixels
TWO_GRIDS = PlaneGrid((10, 9), 1.0, (1.0, 1.0)), PlaneGrid((7, 8), 1.5, (0.2, 0.4))
VIEWS, SIZE = 9, 12
_COUNTS = np.arange(36.0)


@dataclass(frozen=True, eq=False)
class Likelihood:
    """The negative log-likelihood of images by formulas of their own, given H as a matrix (pixel, sample)."""

    images: ElementalImages
    matrix: Image

    @cached_property
    def counted(self) -> NDArray[np.bool_]:
        return np.asarray(self.matrix.any(axis=1))

    @cached_property
    def rows(self) -> Image:
        """Rows of the matrix that belong to counted pixels."""
        return np.asarray(self.matrix[self.counted])

    @cached_property
    def electrons(self) -> Image:
        return np.asarray(self.images.electrons.ravel()[self.counted])

    @cached_property
    def count_weights(self) -> Image:
        """exp(−(g − N)²/2σ²)/N! of every N and counted pixel."""
        exponent = -((self.electrons - _COUNTS[:, None]) ** 2) / (2 * float(self.images.read_variance_e2))
        return np.asarray(np.exp(exponent - gammaln(_COUNTS[:, None] + 1)))

    def value_and_gradient(self, f: Image) -> tuple[float, Image]:
        g, b, v = self.electrons, float(self.images.background_e), float(self.images.read_variance_e2)
        mean = self.rows @ f.ravel() + b
        match self.images.likelihood.name:
            case "least-squares":
                variance = self.images.likelihood.level_e + b + v
                return float(np.sum((g - mean) ** 2) / (2 * variance)), self.rows.T @ ((mean - g) / variance)
            case "poisson-gaussian":
                total = polyval(mean, self.count_weights, tensor=False)
                expected = polyval(mean, _COUNTS[:, None] * self.count_weights, tensor=False) / total
                return float(np.sum(mean - np.log(total))), self.rows.T @ (1 - expected / mean)
            case name:
                v = v if name == "shifted-poisson" else 0.0
                y, m = np.maximum(g + v, 0), mean + v
                return float(np.sum(m - y * np.log(m))), self.rows.T @ (1 - y / m)


@dataclass(frozen=True, eq=False)
class DenseProblem(Likelihood):
    """Data of one plane, the operator under test, and the same operator as a matrix."""

    operator: PlaneOperator
    shifts: Image  # (view, 2), down and right


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
    """Return a bright box on a dark plane, in views that are displaced by up to half a sample."""
    generator = np.random.default_rng(seed)
    shifts = generator.uniform(-0.5, 0.5, (views, 2))
    operator = views_displaced_by(shifts, SHAPE, dtype=dtype)
    columns, rows = pixel_rays(SHAPE, 1).reshape(-1, 2).T
    matrix = np.concatenate([_bilinear(rows + down, columns + right) for down, right in shifts])
    mean = (matrix @ box(low, high).ravel()).reshape(views, *DETECTOR)
    electrons = generator.poisson(mean + background_e) + generator.normal(0, np.sqrt(variance_e2), mean.shape)
    pixel_likelihood = PixelLikelihood(likelihood, level_e=3.0 if likelihood == "least-squares" else 0.0)
    images = ElementalImages(electrons, background_e, variance_e2, likelihood=pixel_likelihood)
    return DenseProblem(images, matrix, operator, shifts)


def box(low: float, high: float) -> Image:
    plane = np.full(SHAPE, low)
    plane[2:6, 3:9] = high
    return plane


def two_planes(
    likelihood: LikelihoodName = "shifted-poisson", *, occluded: bool = False, seed: int = 3
) -> SceneProblem:
    """Return two planes of unlike grids, which slide over each other from view to view."""
    generator = np.random.default_rng(seed)
    homographies = np.stack([np.eye(3)] * 2 * VIEWS).reshape(2, VIEWS, 3, 3)
    homographies[0, :, :2, 2] = generator.uniform(-2.5, 2.5, (VIEWS, 2))
    homographies[1, :, :2, 2] = generator.uniform(-0.5, 0.5, (VIEWS, 2))
    rays = pixel_rays((SIZE, SIZE))
    opacities = [generator.uniform(0, 0.8, grid.shape) for grid in TWO_GRIDS]
    hiding = Occluders(opacities, [500.0, 700.0]) if occluded else None
    operator = SceneOperator(homographies, rays, TWO_GRIDS, occluders=hiding, dtype=np.float64, workers=1)
    near, far = np.zeros(TWO_GRIDS[0].shape), np.zeros(TWO_GRIDS[1].shape)
    near[3:7, 2:6], far[1:5, 4:7] = 5.0, 3.0
    mean = operator.forward(operator.samples_of([near, far]))
    electrons = generator.poisson(mean + 0.3) + generator.normal(0, 1, mean.shape)
    pixel_likelihood = PixelLikelihood(likelihood, level_e=2.0 if likelihood == "least-squares" else 0.0)
    return SceneProblem(operator, ElementalImages(electrons, 0.3, 1.0, likelihood=pixel_likelihood))


def shifted_views(views: int, *, unseen_columns: int = 0, **options: Any) -> PlaneOperator:
    """Return views at scale one, all but the first displaced by up to half a sample."""
    shifts = np.zeros((views, 2))
    shifts[1:] = np.random.default_rng(1).uniform(-0.5, 0.5, (views - 1, 2))[:, ::-1]
    width = SHAPE[1] - 1 - unseen_columns if unseen_columns else SHAPE[1]
    return views_displaced_by(shifts, SHAPE, width=width, **{"dtype": np.float64, **options})


def _bilinear(rows: Image, columns: Image) -> Image:
    """Return the matrix from samples to points of the plane: hat functions of the distance to each sample."""
    down = np.maximum(1 - np.abs(rows[:, None] - np.arange(SHAPE[0])), 0)
    right = np.maximum(1 - np.abs(columns[:, None] - np.arange(SHAPE[1])), 0)
    inside = (rows >= 0) & (rows <= SHAPE[0] - 1) & (columns >= 0) & (columns <= SHAPE[1] - 1)
    matrix: Image = (down[:, :, None] * right[:, None, :]).reshape(rows.size, SAMPLES)
    return matrix * inside[:, None]


@cache
def difference_matrix(*shapes: tuple[int, int]) -> csr_array:
    """Return ∇ of planes (2 · samples, samples): all differences down, then all to the right, none across an edge."""
    shapes = shapes or (SHAPE,)
    ends = np.cumsum([rows * columns for rows, columns in shapes])
    matrix = np.zeros((2, ends[-1], ends[-1]))
    for shape, end in zip(shapes, ends, strict=True):
        index = np.arange(end - shape[0] * shape[1], end).reshape(shape)
        for part, (here, there) in enumerate(((index[:-1], index[1:]), (index[:, :-1], index[:, 1:]))):
            matrix[part, here.ravel(), there.ravel()] = 1
            matrix[part, here.ravel(), here.ravel()] = -1
    return csr_array(matrix.reshape(-1, ends[-1]))


def primal_dual_solution(
    likelihood: Likelihood,
    weight: float,
    passes: int,
    proposal: Image | None = None,
    gradient_of: csr_array | None = None,
) -> Image:
    """Return the optimum with total variation about a proposal, by Condat and Vũ's iteration with fixed steps."""
    gradient_of = difference_matrix() if gradient_of is None else gradient_of
    samples = gradient_of.shape[1]
    offset = np.zeros(2 * samples) if proposal is None else gradient_of @ proposal.ravel()
    lightest = float(likelihood.images.background_e) + float(likelihood.images.read_variance_e2)
    curvature = np.linalg.norm(likelihood.matrix, 2) ** 2 * 4 / lightest
    step = 1 / curvature
    dual_step = curvature / (2 * 8 * weight**2)
    f, p = np.full(samples, 3.0), np.zeros(2 * samples)
    for _ in range(passes):
        slope = likelihood.value_and_gradient(f)[1]
        ahead = np.maximum(f - step * (slope + weight * (gradient_of.T @ p)), 0)
        p = p + dual_step * weight * (gradient_of @ (2 * ahead - f) - offset)
        p = (p.reshape(2, samples) / np.maximum(np.hypot(*p.reshape(2, samples)), 1)).ravel()
        f = ahead
    return f.reshape(SHAPE) if samples == SAMPLES else f


def smooth_solution(posed: DenseProblem, weight: float, phi: Callable[[Image], tuple[Image, Image]]) -> Image:
    """Return the optimum with a penalty Σ φ(|∇f|) that has a derivative, by L-BFGS-B; `phi` gives φ and φ'/t."""
    gradient_of = difference_matrix()

    def objective(f: Image) -> tuple[float, Image]:
        value, slope = posed.value_and_gradient(f)
        differences = gradient_of @ f
        of_length, over_length = phi(np.hypot(*differences.reshape(2, SAMPLES)))
        pull = gradient_of.T @ (np.tile(over_length, 2) * differences)
        return value + weight * float(of_length.sum()), slope + weight * pull

    options: Any = {"maxiter": 20000, "maxfun": 40000, "ftol": 1e-16, "gtol": 1e-10, "maxcor": 50}
    start, bounds = np.full(SAMPLES, 3.0), [(0, None)] * SAMPLES
    best = minimize(objective, start, jac=True, method="L-BFGS-B", bounds=bounds, options=options)
    return np.asarray(best.x).reshape(SHAPE)
