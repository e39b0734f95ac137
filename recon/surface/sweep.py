"""The depths among which a surface is sought: their steps, and their range if it is not known."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import NothingInFocus
from faintfield.recon.surface.confidence import confidence
from faintfield.recon.surface.estimate import first_depths, halves, next_depths
from faintfield.recon.surface.evidence import DepthEvidence
from faintfield.recon.surface.goodness import explained_share
from faintfield.recon.surface.pinhole_views import PinholeViews

# Movement of the outermost view from one depth to the next, in samples; fewest and most depths.
_SAMPLES_PER_STEP, _MIN_DEPTHS, _MAX_DEPTHS = 1.6, 64, 128

# Bins in which a range is sought, on top of those of the views; searches, each in the range that the last found.
_BINS, _SEARCHES = 2, 2

# Samples that tell the range are right with this probability; there are at least so many.
_LIKELY, _MIN_SAMPLES = 0.5, 64

# Quantiles of their depths, and what is added on either side: a share of the range, and steps.
_QUANTILES, _MARGIN, _MARGIN_STEPS = (0.003, 0.997), 0.05, 2.0

# Search again if the range shrinks to less than this share of the last one.
_SHRUNK_ENOUGH = 0.6


def equal_steps(views: PinholeViews, far: float, near: float) -> NDArray[np.float64]:
    """Return the 1/depth (depth,) to compare, ascending from `far` to `near`."""
    moved = (near - far) * float(views.reach.max())
    count = int(np.clip(np.ceil(moved / _SAMPLES_PER_STEP) + 1, _MIN_DEPTHS, _MAX_DEPTHS))
    return np.linspace(far, near, count)


def found_range(views: PinholeViews, nodes: NDArray[np.intp], far: float, near: float) -> tuple[float, float]:
    """Return the range of 1/depth, far and near, in which the views show anything.

    Parameters
    ----------
    views : PinholeViews
        The views.
    nodes : int array (view, 2)
        Row and column of each view in the grid of nodes.
    far, near : float
        1/depth at the ends of the range to search.

    Raises
    ------
    NothingInFocus
        Nowhere do the views agree on anything.
    """
    coarse = views.binned(_BINS)
    limits = (far, near)
    for _ in range(_SEARCHES):
        depths = equal_steps(coarse, far, near)
        evidence = DepthEvidence(coarse, depths, halves(nodes))
        index, costs = next_depths(evidence, evidence.explained(first_depths(evidence)))
        likely = confidence(index, costs, depths, explained_share(evidence, index)) >= _LIKELY
        if np.count_nonzero(likely) < _MIN_SAMPLES:
            raise NothingInFocus(f"the views tell the depth of {likely.mean():.1%} of the picture; give a range")
        first, last = np.quantile(index[likely], _QUANTILES)
        margin = _MARGIN * (last - first) + _MARGIN_STEPS
        before = near - far
        step = depths[1] - depths[0]
        far, near = depths[0] + step * (first - margin), depths[0] + step * (last + margin)
        far, near = max(far, limits[0]), min(near, limits[1])
        if near - far > _SHRUNK_ENOUGH * before:
            break
    return far, near
