"""The mode of reconstruction that suits a scene, by the distribution of the depths that its views show."""

from collections.abc import Collection
from typing import Literal, Protocol

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

# Least share of the samples with light whose depth is sure: the others may lie anywhere. Simulated planes have 0.34 to
# 1 from SNR 0.16 on, a photographed chessboard 0.03 to 0.08 as a surface, where its sure samples seem to lie on planes.
_MIN_SURE = 0.25

type Mode = Literal["surface", "occlusion"]


class StatedShares(Protocol):
    """A record that states how the sure samples lie at depths, and their share of the samples with light."""

    @property
    def share_of_sure(self) -> list[float] | UnsetType:
        """Shares of the sure samples at each depth that stands out."""

    @property
    def sure_of_lit(self) -> float | UnsetType:
        """Share of the samples with light whose depth is sure."""


def recommendation(record: StatedShares, used: Collection[Mode] = ()) -> str | None:
    """Return a sentence on the mode that suits a scene, given the shares of its samples at each depth found.

    It is None where the shares do not tell, or are not known, or tell a mode that was used.
    """
    share_of_sure, known = record.share_of_sure, record.sure_of_lit
    if share_of_sure is UNSET or known is UNSET or known < _MIN_SURE:
        return None
    total, count = sum(share_of_sure), len(share_of_sure)
    if total >= _OF_PLANES and 1 < count <= _FEW_DEPTHS and "occlusion" not in used:
        return (
            f"{total:.0%} of the samples of sure depth lie at {count} separate depths: if nothing stands in between, "
            "planes there with --occlusion fit this scene"
        )
    if total <= _OF_CONTINUUM and "surface" not in used:
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
    depths = DepthEstimate(index, estimate.confidence, estimate.lit_share)
    sure = int(np.count_nonzero(depths.confidence >= SURE))
    if sure < MIN_SAMPLES:
        return UNSET
    return [float(place.sum() / sure) for place in places_of_focus(depths, len(search.compared))]
