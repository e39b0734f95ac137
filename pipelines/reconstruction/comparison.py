"""How the views of a set agree at each of some depths, in bins of pixels: what autofocus compares."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from faintfield.pipelines.console import progress
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.recon.depth.agreement import Agreement, DepthEstimate, agreement, bins_for, depth_map

# Fewest bins across the detector: limits the size of a bin.
_MIN_BINS_ACROSS = 8


@dataclass(frozen=True)
class Compared:
    """The agreement of the views at each depth, all colours together.

    Attributes
    ----------
    planes : list of Agreement
        In the order of the depths.
    depths_mm : sequence of float
        The depths.
    bins_px : int
        Width of the bins in which pixels were added up, in detector pixels.
    """

    planes: list[Agreement]
    depths_mm: Sequence[float]
    bins_px: int

    def depth_map(self) -> DepthEstimate:
        """Return where each sample is sharp."""
        return depth_map(self.planes, np.asarray(self.depths_mm))


def compared_depths(
    loaded: ElementalSet, depths_mm: Sequence[float], out: Path, *, min_bins_px: int = 1, bins_px: int | None = None
) -> Compared:
    """Compare the views at each depth; the images of one colour at a time are in memory, or in a file in `out`.

    Pixels are added up in bins of `bins_px`; by default in bins of at least `min_bins_px`, larger ones in low light.
    """
    planes: list[Agreement] = []
    bins = 0
    for layout in channel_layouts(loaded):
        images = load_channel(loaded, layout, memory_or_file(out))
        step = max(layout.lattices[0].step)
        if bins_px is not None:
            bins = bins_px // step
        elif not bins:
            middle_mm = sorted(depths_mm)[len(depths_mm) // 2]
            needed = bins_for(
                OperatorFactory(loaded, layout, images).at(middle_mm, plane_grid(loaded, middle_mm)), images
            )
            bins = min(max(needed, -(-min_bins_px // step)), min(layout.lattices[0].shape) // _MIN_BINS_ACROSS)
        images = images.binned(bins)
        factory = OperatorFactory(loaded, layout, images, bins=bins)
        found = [
            agreement(factory.at(depth, plane_grid(loaded, depth).binned(bins * step)), images)
            for depth in progress(depths_mm, f"comparing views, {layout.name}")
        ]
        planes = [_sum(*pair) for pair in zip(planes, found, strict=True)] if planes else found
    return Compared(planes, depths_mm, bins * step)


def _sum(one: Agreement, other: Agreement) -> Agreement:
    """Return the agreement of two colours together."""
    return Agreement(*(a + b for a, b in zip(one, other, strict=True)))
