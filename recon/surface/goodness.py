"""Goodness of a surface: its samples with light, the detail that it explains, its prediction of views left out."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.surface.evidence import DepthEvidence, Explained, blurred_mean, detail
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews, gaussian

# Scale of the window in samples over which light is gathered: that of the smallest window in which depths are compared.
_LIGHT_WINDOW = 1.5

# Smallest light, in standard deviations of its noise and relative to the picture's level: less may be stray light.
_MIN_SIGMAS, _MIN_LIGHT = 4.0, 0.03

# Scale of the window in samples over which detail is gathered, and of the blur that light is compared with.
_WINDOW, _DETAIL = 6.0, 6.0

# Log-likelihood that chance may add to both, in a window.
_CHANCE = 100.0

# Squared errors that the light of a right surface may have, as a share of the variance. With less, few depths are sure
# in the dark; with more, wrong poses are trusted.
_LIGHT_ERROR = 0.1

# Number of planes that stand for a surface, each a share of its samples.
_PLANES = 4

# Blurs of the mean of neighbours, in pixels: the best counts.
_BLURS = (1.0, 2.0, 4.0)

# Scale in pixels of the blur that tells the light of a pixel, for its variance.
_LEVEL_SCALE = 8.0


def lit_samples(views: PinholeViews, inverse_depth: Image) -> NDArray[np.bool_]:
    """Return the samples (row, column) of a surface whose light stands out of noise: black looks alike at any depth.

    The light is the mean of all views over a small window, and the picture's level its root mean square.
    """
    operator = views.surface_operator(inverse_depth)
    count = np.maximum(gaussian(operator.sensitivity(), _LIGHT_WINDOW), np.float32(1e-3))
    light = np.maximum(gaussian(operator.adjoint(views.light_e), _LIGHT_WINDOW) / count, 0)
    sigma = np.sqrt((light + views.variance_e2) / (count * 4 * np.pi * _LIGHT_WINDOW**2))
    level = np.sqrt(np.mean(np.square(light, dtype=np.float64)))
    return np.asarray((light > _MIN_SIGMAS * sigma) & (light > _MIN_LIGHT * level))


def explained_share(evidence: DepthEvidence, index: Image) -> NDArray[np.float32]:
    """Return how much of the views' detail a surface explains, near each sample (row, column), between 0 and 1.

    In a window, let E be by how much the detail of the light raises the log-likelihood, as far as the two halves of
    the views agree on it, and X by how much the errors of one half, predicted by the light of the other, exceed those
    of the noise and a share of it for errors of the light. Returned is `(E + c) / (E + X + c)`, with c for chance in
    both. It is small where something shines, is seen through or repeats itself, because no light of one surface then
    fits all views. It is near 1 where little is seen at all. `index` (row, column) is the surface, as fractional index
    of the depths.
    """
    known = evidence.explained(index)
    views = np.sum([known.operator.sensitivity(half) for half in evidence.halves], axis=0)
    first, second = (detail(light, np.ones_like(light), _DETAIL) for light in known.lights)
    explained = np.asarray(0.5 * views * first * second / evidence.variance, np.float32)
    excess = np.zeros_like(evidence.views.light_e)
    for half, light in zip(evidence.halves, reversed(known.lights), strict=True):
        errors = squared_errors(evidence, known.operator.forward(light, half), half)
        excess[half] = np.where(seen_of(evidence, known, half), 0.5 * (errors - 1 - _LIGHT_ERROR), 0)
    misfit = np.asarray(known.operator.adjoint(excess), np.float32)
    e, x = (np.maximum(gaussian(part, _WINDOW) * np.float32(4 * np.pi * _WINDOW**2), 0) for part in (explained, misfit))
    return np.asarray((e + _CHANCE) / (e + x + _CHANCE), np.float32)


@dataclass(frozen=True)
class Prediction:
    """Goodness of the prediction of views that were left out.

    Attributes
    ----------
    views, pixels : int array (view,), int
        The views, and the number of their pixels that were compared: those that see the surface and the planes.
    surface, planes, standard_error : float
        Mean squared error over variance, by the surface, and by the same depths on a few planes, NaN without pixels;
        standard error of their difference.
    neighbours : float, optional
        The same by the mean of the views next to each, under the best blur; None without such views.
    """

    views: NDArray[np.intp]
    pixels: int
    surface: float
    planes: float
    standard_error: float
    neighbours: float | None


def seen_of(evidence: DepthEvidence, known: Explained, views: NDArray[np.intp]) -> NDArray[np.bool_]:
    """Return the pixels of views (view, row, column) that have a number and see the surface."""
    return np.asarray((known.relief[views] > 0) & (evidence.views.light_e[views] > UNKNOWN))


def squared_errors(evidence: DepthEvidence, expected: Image, views: NDArray[np.intp]) -> NDArray[np.float32]:
    """Return the squared errors of pixels (view, row, column) over their variance, given their expected light.

    The variance is that of the pixels' own light, blurred: were it that of the expected light, too much of this would
    seem to err less.
    """
    light_e = evidence.views.light_e[views]
    known = light_e > UNKNOWN
    levels_e = [
        blurred_mean(np.where(there, picture, 0), there.astype(np.float32), _LEVEL_SCALE)
        for picture, there in zip(light_e, known, strict=True)
    ]
    variance = evidence.views.pixel_variance(np.stack(levels_e))
    errors = np.where(known, light_e - expected, 0)
    return np.asarray(np.square(errors) / np.maximum(variance, np.float32(1e-6)), np.float32)


def predicted(
    evidence: DepthEvidence, index: Image, views: NDArray[np.intp], neighbours: Sequence[NDArray[np.intp]]
) -> Prediction:
    """Return how well a surface predicts views that the evidence leaves out, and how well its rivals do.

    Parameters
    ----------
    evidence, index : DepthEvidence, float array (row, column)
        Of the other views; the surface, as fractional index of the depths.
    views, neighbours : int array (view,), sequence of int array
        The views that were left out, and for each the views next to it that were not.
    """
    limits = np.quantile(index, np.arange(1, _PLANES) / _PLANES)
    middles = np.quantile(index, (np.arange(_PLANES) + 0.5) / _PLANES)
    planes = evidence.explained(np.asarray(middles[np.searchsorted(limits, index)], np.float32))
    surface = evidence.explained(index)
    seen = seen_of(evidence, surface, views) & seen_of(evidence, planes, views)
    by_surface, by_planes = (
        squared_errors(evidence, known.operator.forward(known.light(), views), views) for known in (surface, planes)
    )
    pixels = int(seen.sum())
    scatter = float(np.std((by_planes - by_surface)[seen], dtype=np.float64)) if pixels else float("nan")
    standard_error, by_neighbours = scatter / max(pixels, 1) ** 0.5, _by_neighbours(evidence, views, neighbours, seen)
    return Prediction(views, pixels, _mean(by_surface, seen), _mean(by_planes, seen), standard_error, by_neighbours)


def _by_neighbours(
    evidence: DepthEvidence, views: NDArray[np.intp], neighbours: Sequence[NDArray[np.intp]], counted: NDArray[np.bool_]
) -> float | None:
    """Return the mean error of views predicted by the mean of those next to them, under the best blur."""
    if not neighbours or min(map(len, neighbours)) == 0:
        return None
    light = evidence.views.light_e
    counts = [np.asarray((light[near] > UNKNOWN).sum(axis=0), np.float32) for near in neighbours]
    sums = [np.where(light[near] > UNKNOWN, light[near], 0).sum(axis=0, dtype=np.float32) for near in neighbours]
    errors = []
    for blur in _BLURS:
        expected = np.stack([blurred_mean(*of_view, blur) for of_view in zip(sums, counts, strict=True)])
        errors.append(_mean(squared_errors(evidence, expected, views), counted))
    return min(errors)


def _mean(squares: NDArray[np.float32], counted: NDArray[np.bool_]) -> float:
    return float(np.mean(squares[counted], dtype=np.float64)) if counted.any() else float("nan")
