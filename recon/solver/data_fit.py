"""What the data say of a plane, as solvers ask it: value, gradient, and about how the value is curved."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane import PlaneOperator
from faintfield.recon.smoothing import blurred

# The metric is at least this part of its median where anything is seen: the rest is led by its neighbours.
_LEAST_METRIC = 1e-3

# A sample counts as at least this part of the typical light when curvature is asked for.
_LEAST_LIGHT = 0.01


class DataFit:
    """L(f), the negative log-likelihood of the elemental images of all or some views.

    Parameters
    ----------
    operator : PlaneOperator
        H.
    images : ElementalImages
        g, with the likelihood that it is judged by.
    level_e : float
        Typical light of the plane, > 0.
    views : sequence of int, optional
        The views that count; all by default.

    Attributes
    ----------
    sensitivity : float array (row, column)
        s = Hᵀ 1.
    may_reach_zero : bool
        False where nothing but light is expected of some pixel, so that a sample that data speak for cannot be zero.
    """

    def __init__(
        self,
        operator: PlaneOperator,
        images: ElementalImages,
        level_e: float,
        views: Sequence[int] | NDArray[np.intp] | None = None,
    ) -> None:
        self._operator, self._images, self._views = operator, images, views
        self._least_light_e = _LEAST_LIGHT * level_e
        self.sensitivity = operator.sensitivity(views)
        self._coverage = operator.coverage(views)
        known_e2 = np.asarray(images.known_variance_e2(), np.float64)
        self.may_reach_zero = bool(known_e2.min() > 0)
        self._known_e2 = self._averaged(known_e2, level_e)

    def value_and_gradient(self, plane: Image) -> tuple[float, Image]:
        """Return L(f) up to a constant, and ∇L = s − Hᵀ r (row, column), in one pass over the data."""
        value, ratio = self._operator.value_and_ratio(plane, self._images, self._views)
        return value, self.sensitivity - ratio

    def metric(self, plane: Image) -> Image:
        """Return about `Hᵀ[ (H 1)/(H f + b + σ²) ]` > 0 (row, column), without a pass over the data.

        These are the row sums of the Hessian that L has on average, and bound it: `xᵀ(∇²L)x ≤ Σ w x²`, because the
        weights of H are not negative. The inverse variance is averaged over a sample's neighbours, which is no less
        than what pixels between them have. Data scatter about their average, so that a solver still has to see to its
        descent.
        """
        likelihood = self._images.likelihood
        fixed = likelihood.name == "least-squares"
        light_e = np.full_like(plane, likelihood.level_e) if fixed else np.maximum(plane, self._least_light_e)
        response = np.ones_like(self._coverage)
        np.divide(self._coverage, self.sensitivity, out=response, where=self.sensitivity > 0)
        metric = self._coverage * blurred(1 / (light_e * response + self._known_e2), (1,))
        return np.asarray(positive_metric(metric), plane.dtype)

    def _averaged(self, known_e2: NDArray[np.float64], level_e: float) -> float | Image:
        """Return b + σ² as the samples meet it: averaged so that its inverse, with typical light added, is kept."""
        if known_e2.ndim == 0:
            return float(known_e2)
        inverse = self._operator.adjoint_of_map(1 / (level_e + known_e2), self._views)
        mean = np.full_like(inverse, 1 / level_e)
        np.divide(inverse, self.sensitivity, out=mean, where=self.sensitivity > 0)
        return np.asarray(np.maximum(1 / mean - level_e, 0))


def positive_metric(metric: Image) -> Image:
    """Return a metric that is positive where no view sees anything, too."""
    return np.maximum(metric, _LEAST_METRIC * np.median(metric[metric > 0]))
