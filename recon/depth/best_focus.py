"""The planes of best focus of a sweep: depths at which much of the picture lies, each as the views like it best."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.depth.agreement import Agreement, DepthMap
from faintfield.recon.depth.focus import prominence

# Samples count whose depth is as probable as this.
SURE = 0.9

# Fewer samples than these say nothing: a number, and a part of those that are sure.
LEAST_SAMPLES = 12
_LEAST_SHARE, _LEAST_PROMINENCE = 0.02, 0.1

# A plane's samples are those within so many steps of it.
_REACH = 1.5


def places_of_focus(found: DepthMap, planes: int) -> list[NDArray[np.bool_]]:
    """Return the samples (row, column) of each depth at which much of the picture lies, in the order of depths.

    That is each peak of the sure samples' distribution over depth that stands out by a tenth of the highest, with at
    least one in fifty of these samples. None are found where fewer than `LEAST_SAMPLES` are sure.

    Parameters
    ----------
    found : DepthMap
        Of a sweep.
    planes : int
        How many planes the sweep has.
    """
    sure = found.confidence >= SURE
    if np.count_nonzero(sure) < LEAST_SAMPLES:
        return []
    counts = np.convolve(np.bincount(np.rint(found.index[sure]).astype(int), minlength=planes), (0.25, 0.5, 0.25))[1:-1]
    least = max(LEAST_SAMPLES, _LEAST_SHARE * np.count_nonzero(sure))
    peaks = [peak for peak in range(planes) if prominence(counts, peak) > _LEAST_PROMINENCE * counts.max()]
    places = [sure & (np.abs(found.index - peak) <= _REACH) for peak in peaks]
    return [place for place in places if np.count_nonzero(place) >= least]


def likeliest_depth_mm(planes: Sequence[Agreement], depths_mm: Sequence[float], place: NDArray[np.bool_]) -> float:
    """Return the one depth at which the views agree best on all samples of a place, by a parabola between depths.

    Parameters
    ----------
    planes : sequence of Agreement
        What the views say at each depth, on samples one angle apart.
    depths_mm : sequence of float
        The depths, in equal steps of 1/depth.
    place : bool array (row, column)
        The samples.
    """
    reduced = np.array(
        [
            float(plane.squares[place].sum(dtype=np.float64))
            / max(float((plane.sensitivity[place] - 1).sum(dtype=np.float64)), 1e-9)
            for plane in planes
        ]
    )
    inverse = 1 / np.asarray(depths_mm)
    best = int(reduced.argmin())
    if not 0 < best < len(planes) - 1:
        return float(depths_mm[best])
    before, here, after = reduced[best - 1 : best + 2]
    bend = before - 2 * here + after
    offset = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(1 / (inverse[best] + offset * (inverse[best + 1] - inverse[best])))
