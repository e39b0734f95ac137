"""Value and gradient of the likelihood, and a diagonal that bounds its curvature, for the solvers."""

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator, ViewSelection
from faintfield.recon.solver.initialization import smooth_start, well_seen_samples
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.threads import elementwise

# Smallest value of a metric relative to its median over seen samples; samples below follow their neighbours. Solvers
# take a hundredth, as for samples that are not well seen: with less, those hold up all others. Errors take less.
_MIN_METRIC, _MIN_METRIC_OF_ERRORS = 1e-2, 1e-3

# Samples that a median is taken of: sorting all of a large plane takes as long as a sweep of the data.
_MEDIAN_SAMPLES = 2**20

# Smallest light relative to the typical light when the curvature is computed.
_MIN_LIGHT = 0.01

# Least part of the variance that is not light's, relative to typical light, for samples that may become zero in one
# step. In brighter scenes the exact likelihood falls off so steeply at zero that its gradient would overflow.
_MIN_KNOWN = 0.01


class DataFit:
    """L(f), the negative log-likelihood of the elemental images of all or some views.

    For shifted Poisson data it is `Σ m − y + y ln(y/m)` with `y = (g + σ²)₊` and `m = H f + b + σ²`
    (docs/explanation/physics.md).

    Parameters
    ----------
    operator : SceneOperator
        H, such as a `PlaneOperator`.
    images : ElementalImages
        g with its likelihood.
    level_e : float
        Typical light of a pixel in electrons, > 0.
    views : sequence of int, optional
        The views that count; all by default.

    Attributes
    ----------
    sensitivity : float array (samples)
        s = Hᵀ 1.
    may_reach_zero : bool
        False where about all electrons of some pixel are light: its samples cannot be zero, where L has no gradient.

    Examples
    --------
    Without noise, L is smallest at the true plane, where its gradient is zero:

    >>> import numpy as np
    >>> from faintfield import DataFit, ElementalImages, Lens, PlaneGrid, PlaneOperator
    >>> from faintfield import fronto_parallel_rt_ref_plane, plane_from_ray
    >>> lens = Lens((32, 24), fx_px=40.0, fy_px=40.0, cx_px=15.5, cy_px=11.5)
    >>> poses_rt_cam_ref = np.array([[0.0, 0.0, 0.0, x_mm, 0.0, 0.0] for x_mm in (20.0, 0.0, -20.0)])
    >>> homographies = plane_from_ray(poses_rt_cam_ref, fronto_parallel_rt_ref_plane(depth_mm=400.0))
    >>> grid = PlaneGrid.covering(-160.0, -120.0, 160.0, 120.0, pitch_mm=10.0)
    >>> operator = PlaneOperator(homographies, lens.rays(), grid)
    >>> truth_e = np.full(grid.shape, 2.0)
    >>> fit = DataFit(operator, ElementalImages(operator.forward(truth_e), read_variance_e2=12.0), level_e=2.0)
    >>> value, gradient = fit.value_and_gradient(truth_e)
    >>> round(float(abs(gradient).max()), 3)
    0.0
    >>> brighter, _ = fit.value_and_gradient(1.5 * truth_e)
    >>> brighter > value
    True
    """

    def __init__(
        self, operator: SceneOperator, images: ElementalImages, level_e: float, views: ViewSelection = None
    ) -> None:
        self._operator, self._images = operator, images
        self._views = operator.all_views if views is None else np.asarray(views)
        self._min_light_e = _MIN_LIGHT * level_e
        self.sensitivity = operator.sensitivity(views)
        known_e2 = np.asarray(images.known_variance_e2(), np.float64)
        self.may_reach_zero = bool(known_e2.min() > _MIN_KNOWN * level_e)
        if operator.row_sums_are_response:
            self._coverage = operator.coverage(views)
            self._known_e2 = self._averaged(known_e2, level_e)

    def value_and_gradient(self, samples: Image) -> tuple[float, Image]:
        """Return L(f) up to a constant, and ∇L = s − Hᵀ r (samples), in one pass over the data."""
        value, ratio = self._operator.value_and_ratio(samples, self._images, self._views)
        return value, self.sensitivity - ratio

    def metric(self, samples: Image) -> Image:
        """Return about `Hᵀ[ (H 1)/(H f + b + σ²) ]` > 0 (samples).

        These are the row sums of the Hessian that L has on average, those between planes included. They bound it:
        `xᵀ(∇²L)x ≤ Σ w x²`, because the weights of H are not negative. Data scatter around their average, so that a
        solver must still check that it descends. For one plane this takes no pass over the data: the inverse variance
        is averaged over a sample's neighbours, which is no less than what the pixels between them have.
        """
        if self._operator.row_sums_are_response:
            return _at_least(_MIN_METRIC, self._metric_of_plane(samples))
        metric = self._operator.adjoint_of_precision(samples, self._images, self._min_light_e, self._views)
        return np.asarray(_at_least(_MIN_METRIC, metric), samples.dtype)

    def metric_of_each(self, samples: Image) -> list[Image]:
        """Return `H_zᵀ[ (H_z 1)/(H f + b + σ²) ]` > 0 (row, column), the curvature of each plane alone, for errors."""
        operator = self._operator
        if operator.row_sums_are_response:
            metric = self._metric_of_plane(samples)
        else:
            metric = operator.adjoint_of_precision(samples, self._images, self._min_light_e, self._views, of_each=True)
        return [_at_least(_MIN_METRIC_OF_ERRORS, of_plane) for of_plane in operator.planes_of(metric)]

    def _metric_of_plane(self, samples: Image) -> Image:
        likelihood, number = self._images.likelihood, samples.dtype.type
        least, most = number(self._min_light_e), None
        if likelihood.name == "least-squares":
            least = most = number(likelihood.level_e)

        def precision(light: Image, coverage: Image, sensitivity: Image, known_e2: Image) -> Image:
            """Return the inverse variance of a pixel of each sample's mean response."""
            variance_e2 = np.clip(light, least, most)
            np.multiply(variance_e2, coverage, out=variance_e2, where=sensitivity > 0)
            np.divide(variance_e2, sensitivity, out=variance_e2, where=sensitivity > 0)
            variance_e2 += known_e2
            return np.reciprocal(variance_e2, out=variance_e2)

        known_e2 = np.broadcast_to(np.asarray(self._known_e2, samples.dtype), samples.shape)
        of_samples = elementwise(precision, samples, self._coverage, self.sensitivity, known_e2)
        (of_plane,) = self._operator.planes_of(of_samples)
        metric = blurred(of_plane, (1,)).reshape(samples.shape)
        return elementwise(np.multiply, metric, self._coverage, out=metric)

    def _averaged(self, known_e2: NDArray[np.float64], level_e: float) -> float | Image:
        """Return b + σ² for each sample, averaged such that the inverse of its sum with typical light is kept."""
        if known_e2.ndim == 0:
            return float(known_e2)
        inverse = self._operator.adjoint_of_map(1 / (level_e + known_e2), self._views)
        mean = np.full_like(inverse, 1 / level_e)
        np.divide(inverse, self.sensitivity, out=mean, where=self.sensitivity > 0)
        return np.asarray(np.maximum(1 / mean - level_e, 0))


def _at_least(share: float, metric: Image) -> Image:
    some = metric.reshape(-1)[:: 1 + metric.size // _MEDIAN_SAMPLES]
    seen = some[some > 0]
    least = metric.dtype.type(share * np.median(seen if seen.size else metric[metric > 0]))
    return elementwise(lambda w: np.maximum(w, least), metric)


@dataclass(frozen=True)
class SceneProblem:
    """The images of one plane or several planes together, and the operator that explains them."""

    operator: SceneOperator
    images: ElementalImages

    def start(self, views: ViewSelection = None) -> Image:
        """Return `smooth_start` of some views."""
        return smooth_start(self.operator, self.images, views)

    def fit(self, level_e: float, views: ViewSelection = None) -> DataFit:
        """Return L of some views."""
        return DataFit(self.operator, self.images, level_e, views)

    def dual(self) -> DualField:
        """Return a dual field of zeros."""
        dual = DualField.zero([grid.shape for grid in self.operator.grids], self.operator.dtype)
        return replace(dual, workers=self.operator.workers)

    def well_seen(self) -> NDArray[np.bool_]:
        """Return `well_seen_samples` of each plane, together (samples)."""
        seen = [well_seen_samples(plane).ravel() for plane in self.operator.planes_of(self.operator.sensitivity())]
        return np.concatenate(seen).reshape(self.operator.samples_shape)
