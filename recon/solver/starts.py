"""Where every reconstruction starts: back-projection, a smooth positive plane, a weight for the penalty."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane import PlaneOperator
from faintfield.recon.smoothing import blurred

# A standard deviation of 2 samples.
START_BLUR = (1, 1, 1, 1, 2)

# Where the mean of the views is not positive there is no light to speak of.
LEAST_LEVEL_E = 1e-6


def back_projection(
    operator: PlaneOperator, images: ElementalImages, views: Sequence[int] | NDArray[np.intp] | None = None
) -> Image:
    """Return `Hᵀ(g − b) / Hᵀ H 1` (row, column): the mean of what the views say of each sample.

    It is zero where no view sees the sample. Without flat field the denominator is s, the number of views that
    contribute, as in the paper.
    """
    light = operator.adjoint(images.electrons, views) - operator.adjoint_of_map(images.background_e, views)
    coverage = operator.coverage(views)
    return np.divide(light, coverage, out=np.zeros_like(light), where=coverage > 0)


def smooth_start(
    operator: PlaneOperator, images: ElementalImages, views: Sequence[int] | NDArray[np.intp] | None = None
) -> Image:
    """Return a positive plane to start from: the back-projection, blurred, at least a hundredth of its mean.

    A multiplicative iteration can neither leave zero nor start below it. The blur weighs by coverage, so that samples
    that no view sees take the level of their neighbours.
    """
    coverage = operator.coverage(views)
    light = operator.adjoint(images.electrons, views) - operator.adjoint_of_map(images.background_e, views)
    level = max(float(light.sum(dtype=np.float64) / coverage.sum(dtype=np.float64)), LEAST_LEVEL_E)
    coverage = blurred(coverage, START_BLUR)
    start = np.full_like(light, level)
    np.divide(blurred(light, START_BLUR), coverage, out=start, where=coverage > 1e-3 * coverage.max())
    return np.asarray(np.maximum(start, 0.01 * level, out=start))


def well_seen_samples(sensitivity: Image) -> NDArray[np.bool_]:
    """Return which samples count for a plane as a whole: those seen at least a hundredth as much as the best seen."""
    return np.asarray(sensitivity > 0.01 * sensitivity.max())


def universal_penalty_weight(operator: PlaneOperator, images: ElementalImages, plane: Image) -> float:
    """Return a penalty weight from the noise alone: β = 0.7 √( s / (f + b + σ²) ), with medians for s and means else.

    The noise of the likelihood's gradient has the standard deviation √( s / (f + b + σ²) ) at each sample, and eq. (3)
    is of the order of one, so this weight removes fluctuations of about that size. It is a starting point that needs no
    tuning, not the best weight for a scene.
    """
    return universal_weight(operator.sensitivity(), images, plane)


def universal_weight(sensitivity: Image, images: ElementalImages, plane: Image) -> float:
    """Return `universal_penalty_weight` for samples of any shape whose sensitivity is known."""
    seen = well_seen_samples(sensitivity)
    per_view_e = plane[seen].mean() + np.mean(images.known_variance_e2())
    return float(0.7 * np.sqrt(np.median(sensitivity[seen]) / per_view_e))
