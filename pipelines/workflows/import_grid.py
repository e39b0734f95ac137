"""Pictures of a grid to a set, at poses by the views if the grid was not regular: `faintfield import grid`."""

from pathlib import Path

import msgspec
from msgspec import UNSET, UnsetType

from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.exchange.options import GridOptions
from faintfield.pipelines.formats.exchange.picture_grid import ImportedGrid, import_pictures
from faintfield.pipelines.reconstruction.alignment import MIN_VIEWS
from faintfield.pipelines.workflows.align import AlignmentSummary, align_views


class AlignedGrid(ImportedGrid, frozen=True, kw_only=True):
    """The result of `faintfield import grid`, with that of the alignment if the views were irregular."""

    alignment: AlignmentSummary | UnsetType = UNSET


def import_and_align(src: Path, out: Path, options: GridOptions) -> AlignedGrid:
    """Make an elemental set of pictures; find the poses by the views if these are irregular, and enough."""
    result = AlignedGrid(**msgspec.structs.asdict(import_pictures(src, out, options)))
    if options.no_align or not result.arrangement.irregular or result.views < MIN_VIEWS:
        return result
    inform("the grid is irregular: finding the poses by the views (--no-align leaves it out)")
    return msgspec.structs.replace(result, alignment=align_views(out))
