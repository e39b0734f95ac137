"""Confidence of a depth: the probability that it is right within 2 %, from what is known to go wrong."""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from faintfield.recon.likelihood.images import Image
from faintfield.recon.surface.edges import near_side, values_at

# Relative error of a depth that still counts as right.
RIGHT_WITHIN = 0.02

# Probability above which a depth is called sure, and below which none is stated.
SURE, UNKNOWN_BELOW = 0.9, 0.03

# Samples from an edge beyond which it does not matter.
_FAR_FROM_EDGE = 12.0

# Samples from the border of the picture beyond which it does not matter.
_FAR_FROM_BORDER = 10.0

# Share of the detail from which a surface explains the views well enough.
_EXPLAINED = 0.5

# Alternatives to a depth lie at least this many steps away from it.
_APART_STEPS = 3.0

# Coefficients of the logistic model, in the order of `features`: fitted by `python -m benchmarks.surface_confidence`.
COEFFICIENTS = (-3.773, 1.015, 1.953, 0.814, 1.967)

# No probability is stated above this: scenes contain what no model has.
_MAX_CONFIDENCE = 0.95

# Where a surface explains less of the detail than this, nor above this: other surfaces may explain as much.
_POORLY_EXPLAINED, _MAX_IF_POORLY = 0.35, 0.85


def confidence(index: Image, costs: Image, inverse_depths: Image, explained: Image) -> NDArray[np.float32]:
    """Return the probability (row, column) that depths are right within `RIGHT_WITHIN`.

    A logistic model of `features`, whose coefficients were fitted on rendered scenes of known depth.

    Parameters
    ----------
    index : float array (row, column)
        The depths, as fractional index.
    costs : float array (row, column, depth)
        Costs by paths, see `sum_over_paths`.
    inverse_depths : float array (depth,)
        1/depth.
    explained : float array (row, column)
        How much of the views' detail the surface explains, see `explained_share`.
    """
    logit = np.tensordot(np.asarray(COEFFICIENTS), features(index, costs, inverse_depths, explained), 1)
    most = np.where(explained < _POORLY_EXPLAINED, _MAX_IF_POORLY, _MAX_CONFIDENCE)
    return np.asarray(np.minimum(1 / (1 + np.exp(-logit)), most), np.float32)


def features(index: Image, costs: Image, inverse_depths: Image, explained: Image) -> NDArray[np.float64]:
    """Return what the probability depends on (feature, row, column); the first is one everywhere.

    In order: one; by how much alternatives cost more (logarithm); the distance to the next edge of something nearer;
    the distance to the border of the picture; how much of the detail is explained (logarithm), if it is little.
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
    return np.stack(
        [
            np.ones_like(q),
            np.log1p(np.maximum(margin, 0)),
            edge / _FAR_FROM_EDGE,
            border / _FAR_FROM_BORDER,
            np.log(np.minimum(explained / _EXPLAINED, 1)),
        ]
    )
