"""Confidence of a depth: the probability that it is right within 2 %, from what is known to go wrong."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt
from scipy.special import erf

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

# Standard deviation in samples by which interpolation between pixels misplaces each view, fitted by the same program.
MISPLACED = 0.4


def confidence(
    index: Image, costs: Image, inverse_depths: Image, explained: Image, parallax: float = np.inf
) -> NDArray[np.float32]:
    """Return the probability (row, column) that depths are right within `RIGHT_WITHIN`.

    A logistic model of `features`, whose coefficients were fitted on rendered scenes of known depth, says whether the
    depth is the right one. It is multiplied by the probability that the error by interpolation is small enough.

    Parameters
    ----------
    index, inverse_depths : float array (row, column), float array (depth,)
        The depths, as fractional index of 1/depth.
    costs : float array (row, column, depth)
        Costs by paths, see `sum_over_paths`.
    explained : float array (row, column)
        Share of the views' detail that the surface explains, see `explained_share`.
    parallax : float
        Root of the sum of squares of the views' parallaxes, in samples per unit of 1/depth; no limit by default.
    """
    logit = np.tensordot(np.asarray(COEFFICIENTS), features(index, costs, inverse_depths, explained), 1)
    most = np.where(explained < _POORLY_EXPLAINED, _MAX_IF_POORLY, _MAX_CONFIDENCE)
    found = np.minimum(1 / (1 + np.exp(-logit)), most)
    tolerance = RIGHT_WITHIN * parallax * np.interp(index, np.arange(len(inverse_depths)), inverse_depths)
    return np.asarray(found * erf(tolerance / (np.sqrt(2) * MISPLACED)), np.float32)


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
