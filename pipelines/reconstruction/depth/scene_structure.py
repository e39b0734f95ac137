"""The mode of reconstruction that suits a scene, by the distribution of the depths that its views show."""

from collections.abc import Sequence

import numpy as np
from msgspec import UNSET, UnsetType

from faintfield.pipelines.reconstruction.depth.search import DepthSearch
from faintfield.recon.depth.agreement import DepthEstimate
from faintfield.recon.depth.focus import MIN_SAMPLES, SURE, places_of_focus

# Shares of the sure samples at the depths that stand out: at least the first in scenes of separate planes, at most the
# second in a continuum. In between the evidence is not clear. Simulated planes have 0.91 to 0.99, pose errors included,
# simulated surfaces and a photographed chessboard 0.38 to 0.58. In the dark few samples of a continuum are sure, and
# may gather at some depths, so that more than a few depths tell nothing either. Nor does one: those of objects at other
# depths may not be sure.
_OF_PLANES, _OF_CONTINUUM = 0.85, 0.7
_FEW_DEPTHS = 4


def recommendation(share_of_sure: Sequence[float] | UnsetType) -> str | None:
    """Return a sentence on the mode that suits a scene, given the shares of the sure samples at each depth found.

    It is None where the shares do not tell, or are not known.
    """
    if share_of_sure is UNSET:
        return None
    total, count = sum(share_of_sure), len(share_of_sure)
    if total >= _OF_PLANES and 1 < count <= _FEW_DEPTHS:
        return (
            f"{total:.0%} of the samples of sure depth lie at {count} separate depths: if nothing stands in between, "
            "planes there with --occlusion fit this scene"
        )
    if total <= _OF_CONTINUUM:
        depths = "the depth that stands out" if count == 1 else f"the {count} depths that stand out"
        return (
            f"the depths of this scene are a continuum ({total:.0%} of the samples of sure depth lie at "
            f"{depths if count else 'depths that stand out'}): --surface fits it, and planes are blurred"
        )
    return None


def shares_of_depths(search: DepthSearch) -> list[float] | UnsetType:
    """Return the shares of the sure samples at each depth of a map that stands out; UNSET if too few are sure."""
    estimate = search.estimate
    index = np.interp(estimate.inverse_depth, search.compared, np.arange(len(search.compared)))
    depths = DepthEstimate(index, estimate.confidence)
    sure = int(np.count_nonzero(depths.confidence >= SURE))
    if sure < MIN_SAMPLES:
        return UNSET
    return [float(place.sum() / sure) for place in places_of_focus(depths, len(search.compared))]
