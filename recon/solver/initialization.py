"""The start of every reconstruction: back-projection, and smooth positive samples."""

from functools import partial

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator, ViewSelection
from faintfield.recon.threads import elementwise

# Spacings of the blur, which has a standard deviation of 2 samples.
_START_BLUR = (1, 1, 1, 1, 2)

# Start level in electrons where the mean of the views is not positive: a start must be above zero.
_MIN_LEVEL_E = 1e-6


def back_projection(
    operator: SceneOperator, images: ElementalImages, views: ViewSelection = None, *, coverage: Image | None = None
) -> Image:
    """Return `Hᵀ(g − b) / Hᵀ H 1` (samples), the mean of the views at each sample; zero where none sees it.

    Without flat field the denominator is s, the number of views that contribute, as in the paper. It is computed unless
    it is given as `coverage`.
    """
    light = operator.adjoint(images.electrons, views)
    if np.any(images.background_e):
        light -= operator.adjoint_of_map(images.background_e, views)
    coverage = operator.coverage(views) if coverage is None else coverage
    return np.divide(light, coverage, out=np.zeros_like(light), where=coverage > 0)


def smooth_start(operator: SceneOperator, images: ElementalImages, views: ViewSelection = None) -> Image:
    """Return positive samples to start from: the back-projection, blurred, at least a hundredth of its mean.

    The blur weights by coverage, so that samples that no view sees take the level of their neighbours. Several planes
    share the light, since the coverage of each counts what its pixels see of all.
    """
    coverages = operator.planes_of(operator.coverage(views))
    lights = operator.planes_of(
        operator.adjoint(images.electrons, views) - operator.adjoint_of_map(images.background_e, views)
    )
    mean = sum(float(x.sum(dtype=np.float64)) for x in lights) / sum(float(x.sum(dtype=np.float64)) for x in coverages)
    level = max(mean, _MIN_LEVEL_E)
    starts = []
    for light, coverage in zip(lights, coverages, strict=True):
        covered = blurred(coverage, _START_BLUR)
        positive_mean = partial(_positive_mean, level, 1e-3 * float(covered.max()))
        starts.append(elementwise(positive_mean, blurred(light, _START_BLUR), covered))
    return operator.samples_of(starts)


def _positive_mean(level: float, least: float, light: Image, coverage: Image) -> Image:
    mean = np.full_like(light, level)
    np.divide(light, coverage, out=mean, where=coverage > least)
    return np.maximum(mean, 0.01 * level, out=mean)


def well_seen_samples(sensitivity: Image) -> NDArray[np.bool_]:
    """Return which samples represent a plane: those seen at least a hundredth as much as the best seen."""
    return np.asarray(sensitivity > 0.01 * sensitivity.max())


def mean_light_e(operator: SceneOperator, samples: Image) -> float:
    """Return the mean light of a pixel: the sum of the means over each plane's well-seen samples."""
    planes = zip(operator.planes_of(samples), operator.planes_of(operator.sensitivity()), strict=True)
    return sum(float(plane[well_seen_samples(seen)].mean(dtype=np.float64)) for plane, seen in planes)
