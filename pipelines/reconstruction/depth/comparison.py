"""Agreement of the views of a set at each of some depths, in bins of pixels: what autofocus compares."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from faintfield.pipelines.console import progress
from faintfield.pipelines.formats.large_arrays import memory_or_file
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import ChannelLayout, channel_layouts, load_channel
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.recon.depth.agreement import Agreement, DepthEstimate, agreement, bins_for, depth_map
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid

# Place between two pixels, in pixels, at which `w² + (1 − w)²` is 2/3, as on average: see `_between_bins`.
BETWEEN_PIXELS = 0.5 - 0.5 / 3**0.5

# Fewest bins across the detector: limits the size of a bin.
_MIN_BINS_ACROSS = 8

# Bins of a view in one colour that are enough to find depths by: further colours would only take longer.
_ENOUGH_BINS = 40_000


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


@dataclass(frozen=True)
class BinnedViews:
    """The views of a set in bins of pixels, one colour after the other.

    Attributes
    ----------
    elemental_set : ElementalSet
        The set, whose poses are those of the views.
    colours : list of (ChannelLayout, ElementalImages)
        The pixels of each colour, added up; the middle one of the colours first.
    bins_px : int
        Width of the bins in detector pixels.
    """

    elemental_set: ElementalSet
    colours: list[tuple[ChannelLayout, ElementalImages]]
    bins_px: int

    def compared(self, depths_mm: Sequence[float]) -> Compared:
        """Compare the views at each depth."""
        planes: list[Agreement] = []
        for layout, images in self.colours:
            factory = OperatorFactory(
                self.elemental_set, layout, images, bins=self.bins_px // max(layout.lattices[0].step)
            )
            found = [
                agreement(factory.at(depth, _between_bins(self.elemental_set, depth, self.bins_px)), images)
                for depth in progress(depths_mm, f"comparing the views, {layout.name}")
            ]
            planes = [_sum(*pair) for pair in zip(planes, found, strict=True)] if planes else found
        return Compared(planes, depths_mm, self.bins_px)


def _between_bins(elemental_set: ElementalSet, depth_mm: float, bins_px: int) -> PlaneGrid:
    """Return the samples of a plane between the bins of the reference view, so that no depth is favoured.

    Where all views are at whole bins, none is blurred by interpolation, and detail that is not blurred agrees best.
    """
    grid = plane_grid(elemental_set, depth_mm).binned(bins_px)
    moved_mm = BETWEEN_PIXELS * grid.pitch_mm
    return replace(grid, origin_mm=(grid.origin_mm[0] + moved_mm, grid.origin_mm[1] + moved_mm))


def binned_views(elemental_set: ElementalSet, middle_mm: float, out: Path, *, min_bins_px: int = 1) -> BinnedViews:
    """Return the views in bins of pixels; the images of one colour at a time are in memory, or in a file in `out`.

    Pixels are added up in bins of at least `min_bins_px`, larger ones in low light at the depth `middle_mm`. Where that
    leaves many bins, the middle colour is enough.
    """
    layouts = channel_layouts(elemental_set)
    middle = len(layouts) // 2
    images = load_channel(elemental_set, layouts[middle], memory_or_file(out))
    bins = _bins(elemental_set, layouts[middle], images, middle_mm, min_bins_px)
    colours = [(layouts[middle], images.binned(bins))]
    if np.prod(colours[0][1].electrons.shape[1:]) <= _ENOUGH_BINS:
        for layout in layouts[:middle] + layouts[middle + 1 :]:
            del images  # before the next colour is read
            images = load_channel(elemental_set, layout, memory_or_file(out))
            colours.append((layout, images.binned(bins)))
    return BinnedViews(elemental_set, colours, bins * max(layouts[middle].lattices[0].step))


def _bins(
    elemental_set: ElementalSet, layout: ChannelLayout, images: ElementalImages, middle_mm: float, min_bins_px: int
) -> int:
    """Return the width of the bins in pixels of a colour."""
    lattice = layout.lattices[0]
    needed = bins_for(
        OperatorFactory(elemental_set, layout, images).at(middle_mm, plane_grid(elemental_set, middle_mm)), images
    )
    return min(max(needed, -(-min_bins_px // max(lattice.step))), min(lattice.shape) // _MIN_BINS_ACROSS)


def _sum(first: Agreement, second: Agreement) -> Agreement:
    """Return the agreement of two colours together."""
    return Agreement(*(a + b for a, b in zip(first, second, strict=True)))
