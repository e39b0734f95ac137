"""Views that were left out, as a surface and its rivals predict them: a figure of merit that needs no truth."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.surface.evidence import DepthEvidence, Explained, blurred_mean
from faintfield.recon.surface.pinhole_views import UNKNOWN

# Number of planes that stand for a surface, each a share of its samples.
_PLANES = 4

# Blurs of the mean of neighbours, in pixels: the best counts.
_BLURS = (1.0, 2.0, 4.0)

# Scale in pixels of the blur that tells the light of a pixel, for its variance.
_LEVEL_SCALE = 8.0


@dataclass(frozen=True)
class Prediction:
    """Goodness of the prediction of views that were left out.

    Attributes
    ----------
    views : int array (view,)
        The views.
    pixels : int
        Number of their pixels that were compared: those that see the surface and the planes.
    surface, planes : float
        Mean squared error over variance, by the surface, and by the same depths on a few planes; NaN without pixels.
    standard_error : float
        Of the difference between the two, as the errors of the pixels scatter.
    neighbours : float, optional
        The same by the mean of the views next to each, blurred as suits it best; None without such views.
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
    """Return the squared errors of pixels (view, row, column) over their variance, given what is expected of them.

    The variance is that of the pixels' own light, blurred: were it that of what is expected, whoever expects too much
    would seem to err less.
    """
    light_e = evidence.views.light_e[views]
    known = light_e > UNKNOWN
    level_e = np.stack(
        [
            blurred_mean(np.where(there, picture, 0), there.astype(np.float32), _LEVEL_SCALE)
            for picture, there in zip(light_e, known, strict=True)
        ]
    )
    variance = np.maximum(level_e, 0) + np.float32(evidence.views.variance_e2)
    errors = np.where(known, light_e - expected, 0)
    return np.asarray(np.square(errors) / np.maximum(variance, np.float32(1e-6)), np.float32)


def predicted(
    evidence: DepthEvidence,
    index: NDArray[np.floating],
    views: NDArray[np.intp],
    neighbours: Sequence[NDArray[np.intp]],
) -> Prediction:
    """Return how well a surface predicts views that the evidence leaves out, and how well its rivals do.

    Parameters
    ----------
    evidence : DepthEvidence
        Of the other views.
    index : float array (row, column)
        The surface, as fractional index of the depths.
    views : int array (view,)
        The views that were left out.
    neighbours : sequence of int array
        For each of them, the views next to it that were not left out.
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
    return Prediction(
        views,
        pixels,
        _mean(by_surface, seen),
        _mean(by_planes, seen),
        scatter / max(pixels, 1) ** 0.5,
        _by_neighbours(evidence, views, neighbours, seen),
    )


def _by_neighbours(
    evidence: DepthEvidence,
    views: NDArray[np.intp],
    neighbours: Sequence[NDArray[np.intp]],
    counted: NDArray[np.bool_],
) -> float | None:
    """Return the deviance of views predicted by the mean of those beside them, under the best blur."""
    if not neighbours or min(map(len, neighbours)) == 0:
        return None
    light = evidence.views.light_e
    counts = [np.asarray((light[near] > UNKNOWN).sum(axis=0), np.float32) for near in neighbours]
    sums = [np.where(light[near] > UNKNOWN, light[near], 0).sum(axis=0, dtype=np.float32) for near in neighbours]
    return min(
        _mean(
            squared_errors(
                evidence, np.stack([blurred_mean(*of_view, blur) for of_view in zip(sums, counts, strict=True)]), views
            ),
            counted,
        )
        for blur in _BLURS
    )


def _mean(squares: NDArray[np.float32], counted: NDArray[np.bool_]) -> float:
    """Return the mean of the errors of pixels that count, NaN of none."""
    return float(np.mean(squares[counted], dtype=np.float64)) if counted.any() else float("nan")
