"""The planes of best focus of a sweep: depths at which much of the picture lies, refined by the views' agreement."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.depth.agreement import Agreement, DepthEstimate
from faintfield.recon.depth.focus import prominence

# Smallest probability of a sample's depth for the sample to count.
SURE = 0.9

# Fewest samples of a plane: a number, and a fraction of the sure samples.
MIN_SAMPLES = 12
_MIN_SHARE = 0.02

# Smallest prominence of a peak, relative to the highest peak.
_MIN_PROMINENCE = 0.1

# Largest distance of a plane's samples from it, in steps of the sweep.
_REACH = 1.5


def places_of_focus(found: DepthEstimate, planes: int) -> list[NDArray[np.bool_]]:
    """Return the samples (row, column) of each depth at which much of the picture lies, in the order of depths.

    These are the peaks of the sure samples' distribution over depth that stand out by a tenth of the highest and hold
    at least one in fifty of these samples. There are none if fewer than `MIN_SAMPLES` samples are sure.

    Parameters
    ----------
    found : DepthEstimate
        Depths from a sweep.
    planes : int
        Number of planes of the sweep.
    """
    sure = found.confidence >= SURE
    if np.count_nonzero(sure) < MIN_SAMPLES:
        return []
    counts = np.convolve(np.bincount(np.rint(found.index[sure]).astype(int), minlength=planes), (0.25, 0.5, 0.25))[1:-1]
    fewest = max(MIN_SAMPLES, _MIN_SHARE * np.count_nonzero(sure))
    peaks = [peak for peak in range(planes) if prominence(counts, peak) > _MIN_PROMINENCE * counts.max()]
    places = [sure & (np.abs(found.index - peak) <= _REACH) for peak in peaks]
    return [place for place in places if np.count_nonzero(place) >= fewest]


def likeliest_depth_mm(planes: Sequence[Agreement], depths_mm: Sequence[float], place: NDArray[np.bool_]) -> float:
    """Return the depth at which the views agree best on all samples of a place, by a parabola between depths.

    Parameters
    ----------
    planes : sequence of Agreement
        Agreement at each depth, on samples of the same angular pitch.
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
