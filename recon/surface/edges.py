# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Edges of the depths, moved to where the light and the views have them, compiled.

Windows make what is near, and textured, wider than it is. In a band beside each edge, a sample may belong to the nearer
side or to the farther one. Minimised over the share u of the nearer one, from 0 to 1, is `Σ g |∇u| − Σ d u`: d is by
how much the views prefer the nearer depth, and an edge costs g, which is little where the light changes (Nikolova,
Esedoglu and Chan 2006, with the absolute differences of rows and columns).
"""

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import distance_transform_edt

from faintfield.recon.likelihood.images import Image
from faintfield.recon.numba_tools import compiled
from faintfield.recon.surface.pinhole_views import gaussian

# A difference between neighbours, in steps of the sweep, that counts as the edge of something nearer.
EDGE_STEPS = 3.0

# Width of the band in samples on either side.
_BAND = 8.0

# Window of the views' preference in samples, the share of it that is independent, and its limit.
_WINDOW, _INDEPENDENT, _MAX_PREFERENCE = 1.5, 0.3, 3.0

# A change of light of this share of the picture's standard deviation makes an edge cheap; it never costs less than g₀.
_CONTRAST, _MIN_COST = 0.2, 0.05

# Steps of the minimisation, and the length of each: the squared norm of the operator is at most 8.
_STEPS, _STEP = 200, np.float32(0.35)


def near_side(index: Image, of_near: bool = True) -> NDArray[np.bool_]:
    """Return the samples (row, column) at an edge that are on its nearer side, or on its farther one."""
    found = np.zeros(index.shape, bool)
    right, down = (np.diff(index if of_near else -index, axis=axis) for axis in (1, 0))
    found[:, 1:] |= right > EDGE_STEPS
    found[:, :-1] |= right < -EDGE_STEPS
    found[1:] |= down > EDGE_STEPS
    found[:-1] |= down < -EDGE_STEPS
    return found


def moved_edges(index: NDArray[np.float32], ratios: Image, light: Image) -> NDArray[np.float32]:
    """Return depths whose edges lie where the light and the views have them.

    Parameters
    ----------
    index, light : float array (row, column)
        Depths as fractional index, larger for nearer ones; the picture.
    ratios : float array (row, column, depth)
        Log-likelihood ratios of the depths.
    """
    near_edge, far_edge = near_side(index), near_side(index, of_near=False)
    if not near_edge.any():
        return index
    to_near, near_at = distance_transform_edt(~near_edge, return_indices=True)
    to_far, far_at = distance_transform_edt(~far_edge, return_indices=True)
    near, far = index[tuple(near_at)], index[tuple(far_at)]
    is_near = np.abs(index - near) < np.abs(index - far)
    near, far = np.where(is_near, index, near), np.where(is_near, far, index)
    free = (np.minimum(to_near, to_far) <= _BAND) & (near - far > EDGE_STEPS / 2)
    scale = np.float32(4 * np.pi * _WINDOW**2 * _INDEPENDENT)
    preference = gaussian(values_at(ratios, near) - values_at(ratios, far), _WINDOW) * scale
    share = is_near.astype(np.float32)
    _divide(np.clip(preference, -_MAX_PREFERENCE, _MAX_PREFERENCE), *_edge_costs(light), free, share, _STEPS)
    return np.where(free, np.where(share > 0.5, near, far), index)


def values_at(volume: Image, index: Image) -> NDArray[np.float32]:
    """Return a volume (row, column, depth) at fractional indices (row, column)."""
    below = np.clip(np.floor(index).astype(np.intp), 0, volume.shape[2] - 2)
    share = np.clip(index - below, 0, 1)
    low, high = (np.take_along_axis(volume, (below + k)[:, :, np.newaxis], 2)[:, :, 0] for k in (0, 1))
    return np.asarray(low + share * (high - low), np.float32)


def _edge_costs(light: Image) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return g to the right of each sample and below it (row, column)."""
    scale = max(_CONTRAST * float(light.std()), 1e-12)
    costs = []
    for axis in (1, 0):
        change = np.diff(light, axis=axis, append=np.take(light, [-1], axis)) / scale
        costs.append(np.asarray(_MIN_COST + np.exp(-np.square(change)), np.float32))
    return costs[0], costs[1]


@compiled
def _divide(preference, cost_right, cost_down, free, share, steps):
    """Minimise over `share` where it is free (Chambolle and Pock 2011)."""
    rows, columns = share.shape
    right, down = np.zeros_like(share), np.zeros_like(share)
    ahead = share.copy()
    zero, one, two = np.float32(0), np.float32(1), np.float32(2)
    for _ in range(steps):
        for i in range(rows):
            for j in range(columns):
                if j + 1 < columns:
                    slope = right[i, j] + _STEP * (ahead[i, j + 1] - ahead[i, j])
                    right[i, j] = min(max(slope, -cost_right[i, j]), cost_right[i, j])
                if i + 1 < rows:
                    slope = down[i, j] + _STEP * (ahead[i + 1, j] - ahead[i, j])
                    down[i, j] = min(max(slope, -cost_down[i, j]), cost_down[i, j])
        for i in range(rows):
            for j in range(columns):
                if not free[i, j]:
                    continue
                divergence = right[i, j] + down[i, j]
                if j > 0:
                    divergence -= right[i, j - 1]
                if i > 0:
                    divergence -= down[i - 1, j]
                value = min(max(share[i, j] + _STEP * (divergence + preference[i, j]), zero), one)
                ahead[i, j] = two * value - share[i, j]
                share[i, j] = value
