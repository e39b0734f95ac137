"""Confidence of a depth: the probability that it is right within 2 %, from what is known to go wrong."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.ndimage import distance_transform_edt
from scipy.special import erf, erfinv

from faintfield.recon.likelihood.images import Image
from faintfield.recon.surface.edges import near_side, values_at

# Relative error of a depth that still counts as right; probability above which it is sure, below which it is unknown.
RIGHT_WITHIN, SURE, UNKNOWN_BELOW = 0.02, 0.9, 0.03

# Samples from an edge, and from the border of the picture, beyond which these do not matter.
_FAR_FROM_EDGE, _FAR_FROM_BORDER = 12.0, 10.0

# Share of the detail from which a surface explains the views well enough; least steps to alternatives to a depth.
_EXPLAINED, _APART_STEPS = 0.5, 3.0

# Coefficients of the logistic model, in the order of `features`, fitted by
# `python -m benchmarks.imaging.surface_confidence`.
COEFFICIENTS = (-3.773, 1.015, 1.953, 0.814, 1.967)

# Largest probability, as scenes contain what no model has, and where a surface explains less than this share of the
# detail: other surfaces may explain as much.
_MAX_CONFIDENCE, _POORLY_EXPLAINED, _MAX_IF_POORLY = 0.95, 0.35, 0.85

# Standard deviation in samples by which each view is misplaced: the same program fits 0.05 where poses are exact, and
# those of a rig, or of a grid of photographs, are not.
MISPLACEMENT = 0.2


def confidence(
    index: Image,
    costs: Image,
    inverse_depths: Image,
    explained: Image,
    parallax: float | None,
    shared_sigma: float = 0.0,
) -> NDArray[np.float32]:
    """Return the probability (row, column) that depths are right within `RIGHT_WITHIN`.

    The product of two probabilities: that the depth is the right one among others, by a logistic model of `features`,
    fitted on rendered scenes of known depth; and that it is precise, although views are misplaced.

    Parameters
    ----------
    index, inverse_depths : float array (row, column), float array (depth,)
        The depths, as fractional index of 1/depth.
    costs : float array (row, column, depth)
        Costs by paths, see `sum_over_paths`.
    explained : float array (row, column)
        Share of the views' detail that the surface explains, see `explained_share`.
    parallax : float, optional
        Root of the sum of squares of the views' parallaxes, in samples per unit of 1/depth; None for the first
        probability alone.
    shared_sigma : float
        Standard deviation that all 1/depth have in common, by errors of the poses.
    """
    found = found_probability(features(index, costs, inverse_depths, explained), COEFFICIENTS)
    if parallax is not None:
        q = np.interp(index, np.arange(len(inverse_depths)), inverse_depths)
        sigma = float(np.hypot(MISPLACEMENT, shared_sigma * parallax))
        found = found * precise_probability(RIGHT_WITHIN * q * parallax, sigma)
    return np.asarray(found, np.float32)


def found_probability(features: NDArray[np.float64], coefficients: ArrayLike) -> NDArray[np.float64]:
    """Return the probability that depths are the right ones, given their features (feature, …) and the coefficients."""
    poorly = features[-1] < np.log(_POORLY_EXPLAINED / _EXPLAINED)
    likely = 1 / (1 + np.exp(-np.tensordot(np.asarray(coefficients), features, 1)))
    return np.minimum(likely, np.where(poorly, _MAX_IF_POORLY, _MAX_CONFIDENCE))


def precise_probability(tolerance: NDArray[np.float64], sigma: float) -> NDArray[np.float64]:
    """Return the probability that an error by misplaced views, of a standard deviation, is within a tolerance.

    Both are in samples, the tolerance as the root of the sum of squares of the movements of the views.
    """
    return np.asarray(erf(tolerance / (np.sqrt(2) * sigma)))


def spacing_needed(inverse_depth: float, parallax: float) -> float:
    """Return the factor by which views must be farther apart for a depth to be sure, however well they show it.

    Parameters
    ----------
    inverse_depth, parallax : float
        1/depth, and the root of the sum of squares of the views' parallaxes, see `confidence`.
    """
    tolerance = np.sqrt(2) * MISPLACEMENT * erfinv(SURE / _MAX_CONFIDENCE)
    return float(tolerance / (RIGHT_WITHIN * inverse_depth * parallax))


def features(index: Image, costs: Image, inverse_depths: Image, explained: Image) -> NDArray[np.float64]:
    """Return the features of a depth (feature, row, column), given the parameters of `confidence`.

    In order: one; the extra cost of alternatives (logarithm); the distance to the next edge of something nearer, and to
    the border of the picture; the share of the detail that is explained (logarithm), if it is little.
    """
    q = np.interp(index, np.arange(len(inverse_depths)), inverse_depths)
    tolerance = RIGHT_WITHIN * q / (inverse_depths[1] - inverse_depths[0])
    away = np.empty_like(costs)
    np.subtract(np.arange(costs.shape[2], dtype=costs.dtype), index[:, :, np.newaxis], out=away)
    np.abs(away, out=away)
    others = np.where(away <= np.maximum(2 * tolerance, _APART_STEPS)[:, :, np.newaxis], np.float32(np.inf), costs)
    margin = np.minimum(others.min(axis=2) - values_at(costs, index), np.float32(1e6))
    near = near_side(index)
    edge = np.minimum(distance_transform_edt(~near), _FAR_FROM_EDGE) if near.any() else np.full(q.shape, _FAR_FROM_EDGE)
    rows, columns = (np.minimum(np.arange(size), np.arange(size)[::-1]) for size in index.shape)
    border = np.minimum(np.minimum(rows[:, np.newaxis], columns), _FAR_FROM_BORDER)
    dearer, poorly = np.log1p(np.maximum(margin, 0)), np.log(np.minimum(explained / _EXPLAINED, 1))
    return np.stack([np.ones_like(q), dearer, edge / _FAR_FROM_EDGE, border / _FAR_FROM_BORDER, poorly])
