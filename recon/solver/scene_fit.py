"""What the data say of all planes of a scene at once, as solvers ask it; its planes lie one after the other."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene import SceneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.data_fit import positive_metric
from faintfield.recon.solver.starts import LEAST_LEVEL_E, START_BLUR

# A pixel counts as at least this part of the typical light when curvature is asked for.
_LEAST_LIGHT = 0.01


class SceneFit:
    """L(f), the negative log-likelihood of the elemental images under all planes together, g = Σ_z H_z f_z + b.

    Parameters
    ----------
    operator : SceneOperator
        H.
    images : ElementalImages
        g, with the likelihood that it is judged by.
    level_e : float
        Typical light of a pixel, > 0.
    views : sequence of int, optional
        The views that count; all by default.

    Attributes
    ----------
    sensitivity : float array (sample,)
        s = Hᵀ 1 of all planes.
    may_reach_zero : bool
        As of `recon.solver.data_fit.DataFit`.
    """

    def __init__(
        self,
        operator: SceneOperator,
        images: ElementalImages,
        level_e: float,
        views: Sequence[int] | NDArray[np.intp] | None = None,
    ) -> None:
        self._operator, self._images, self._views = operator, images, views
        self._chosen = operator.all_views if views is None else np.asarray(views)
        self._least_light_e = _LEAST_LIGHT * level_e
        self.sensitivity = operator.samples_of(operator.sensitivity(views))
        self.may_reach_zero = bool(np.asarray(images.known_variance_e2()).min() > 0)
        self._seen = operator.forward([np.ones(grid.shape, operator.dtype) for grid in operator.grids], views)

    def value_and_gradient(self, samples: Image) -> tuple[float, Image]:
        """Return L(f) up to a constant, and ∇L = s − Hᵀ r (sample,), in one pass over the data."""
        planes = self._operator.planes_of(samples)
        value, ratios = self._operator.value_and_ratio(planes, self._images, self._views)
        return value, self.sensitivity - self._operator.samples_of(ratios)

    def metric(self, samples: Image) -> Image:
        """Return `Hᵀ[ (Σ_z H_z 1)/(H f + b + σ²) ]` > 0 (sample,), in two passes over the data.

        These are the row sums of the Hessian that L has on average, those between planes included: `Hᵀ D H ≤ diag(Hᵀ D
        H 1)` for weights of H and D that are not negative. What L has of curvature beyond the average is the solver's
        to see to.
        """
        metric = self._operator.samples_of(self._row_sums(self._seen, self._light_e(samples)))
        return np.asarray(positive_metric(metric), samples.dtype)

    def metric_of_each(self, samples: Image) -> list[Image]:
        """Return `H_zᵀ[ (H_z 1)/(H f + b + σ²) ]` > 0 (row, column) of each plane: its metric were the others known."""
        operator, light_e = self._operator, self._light_e(samples)
        metrics = []
        for index in range(len(operator.grids)):
            ones = [np.full(grid.shape, index == z, operator.dtype) for z, grid in enumerate(operator.grids)]
            metrics.append(positive_metric(self._row_sums(operator.forward(ones, self._views), light_e)[index]))
        return metrics

    def _light_e(self, samples: Image) -> Image:
        """Return the variance that L takes a pixel to have, `H f + b + σ²` (view, row, column)."""
        likelihood, operator = self._images.likelihood, self._operator
        if likelihood.name == "least-squares":
            light_e = likelihood.level_e * operator.map_of_views(operator.response(), self._chosen)
        else:
            light_e = np.maximum(operator.forward(operator.planes_of(samples), self._chosen), self._least_light_e)
        return np.asarray(light_e + operator.map_of_views(self._images.known_variance_e2(), self._chosen))

    def _row_sums(self, seen: Image, light_e: Image) -> list[Image]:
        """Return `Hᵀ[ seen/light ]` of each plane."""
        ratio = np.zeros(self._operator.images_shape, self._operator.dtype)
        ratio[self._chosen] = seen / light_e
        return self._operator.adjoint(ratio, self._chosen)


def scene_start(
    operator: SceneOperator, images: ElementalImages, views: Sequence[int] | NDArray[np.intp] | None = None
) -> Image:
    """Return positive planes (sample,) to start from: back-projections that share the light, blurred.

    Each is `H_zᵀ(g − b) / H_zᵀ Σ H 1`, so that together they give about the light that there is.
    """
    seen = np.zeros(operator.images_shape, operator.dtype)
    chosen = operator.all_views if views is None else np.asarray(views)
    seen[chosen] = operator.forward([np.ones(grid.shape, operator.dtype) for grid in operator.grids], chosen)
    coverages = operator.adjoint(seen, chosen)
    of_background = operator.adjoint_of_map(images.background_e, chosen)
    lights = [x - y for x, y in zip(operator.adjoint(images.electrons, chosen), of_background, strict=True)]
    ratio = sum(float(x.sum(dtype=np.float64)) for x in lights) / sum(float(x.sum(dtype=np.float64)) for x in coverages)
    level = max(ratio, LEAST_LEVEL_E)
    starts = []
    for light, coverage in zip(lights, coverages, strict=True):
        covered = blurred(coverage, START_BLUR)
        start = np.full_like(light, level)
        np.divide(blurred(light, START_BLUR), covered, out=start, where=covered > 1e-3 * covered.max())
        starts.append(np.maximum(start, 0.01 * level))
    return operator.samples_of(starts)
