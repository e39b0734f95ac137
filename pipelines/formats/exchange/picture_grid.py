"""An elemental set from pictures taken on a regular grid, in a folder or in one file: `faintfield import grid`."""

from dataclasses import asdict
from functools import partial
from pathlib import Path

import msgspec
import numpy as np

from faintfield.calib.arrangement.nodes import Orientation
from faintfield.calib.lens import Lens
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.exchange.arranged_grid import arrange_grid
from faintfield.pipelines.formats.exchange.hci import described_grid, write_true_depth
from faintfield.pipelines.formats.exchange.imported_noise import StatedNoise
from faintfield.pipelines.formats.exchange.imported_set import read_picture, write_imported_set
from faintfield.pipelines.formats.exchange.options import GridOptions
from faintfield.pipelines.formats.exchange.packed_views import unpack_views
from faintfield.pipelines.formats.exchange.tone import asked_tone
from faintfield.pipelines.formats.sets.elemental_file import Arrangement
from faintfield.pipelines.formats.units import Units

# Without a pitch the unit of length is free: the plane on which the pictures are aligned gets this depth.
_FREE_REFERENCE_DEPTH_MM = 1000.0

# Disparity of infinitely far points beyond the largest one found: a share of the range, and a part of a pixel.
_BEYOND_SHARE, _BEYOND_PX = 0.25, 0.1


class ImportedGrid(msgspec.Struct, frozen=True):
    """The result of `faintfield import grid`; `arrangement` is what the pictures say."""

    out: str
    rows: int
    columns: int
    size_px: tuple[int, int]
    views: int
    arrangement: Arrangement


def import_pictures(src: Path, out: Path, options: GridOptions) -> ImportedGrid:
    """Make an elemental set of the pictures in a folder or a file, put in order by what they show."""
    recorded = asdict(options)
    del recorded["overwrite"]
    pitch_mm, fx_px, disparity_px = options.pitch_mm, options.fx_px, options.disparity_px
    described = described_grid(src)
    own_scale = pitch_mm is None and fx_px is None and disparity_px is None
    if described is not None:
        pitch_mm, fx_px, disparity_px = described.scale(pitch_mm, fx_px, disparity_px)
    stated = Orientation(options.transpose, options.flip_rows, options.flip_columns)
    with unpack_views(
        src, options.rows, options.columns, options.pattern, described.size if described else None
    ) as views:
        for remark in views.grid.remarks:
            inform(remark)
        first = read_picture(next(iter(views.grid.paths.values())))
        height, width = first.pixels_dn.shape[:2]
        white = float(first.saturation_dn or np.iinfo(first.pixels_dn.dtype).max)
        grid, arrangement = arrange_grid(
            views.grid,
            stated if stated != Orientation() else None,
            white=white if views.dn_per_value is None else np.inf,  # floats state no white
            size_px=(width, height),
            aligned=bool(disparity_px),
        )
        pitch_mm, fx_px, at_infinity_px, in_mm = _scale(arrangement, float(width), pitch_mm, fx_px, disparity_px or 0.0)
        lens = Lens((width, height), fx_px, fx_px, (width - 1) / 2, (height - 1) / 2)
        write_imported_set(
            out,
            grid.posed(lens, pitch_mm, at_infinity_px, arrangement.pitch_ratio),
            reference=grid.centre,
            noise=StatedNoise(
                options.gain_dn_per_e,
                options.read_noise_e,
                options.offset_dn,
                options.dark_current_e_per_s,
                options.quantum_efficiency,
            ),
            exposure_s=options.exposure_s,
            tone=asked_tone(linear=options.linear, srgb=options.srgb),
            command="import grid",
            options=recorded | {"dn_per_value": views.dn_per_value},
            models=[described.file] if described else [],
            sources=views.sources,
            units=Units(depth="mm" if in_mm else "disparity_px" if len(grid.paths) > 1 else "relative"),
            arrangement=arrangement,
            also=partial(write_true_depth, described, grid) if described is not None and own_scale else None,
            overwrite=options.overwrite,
        )
    inform(f"{out}: {grid.size[0]} x {grid.size[1]} views of {width} x {height} px")
    return ImportedGrid(str(out), *grid.size, lens.size_px, len(grid.paths), arrangement)


def _scale(
    arrangement: Arrangement, width_px: float, pitch_mm: float | None, fx_px: float | None, disparity_px: float
) -> tuple[float, float, float, bool]:
    """Return pitch in mm, focal length in px, disparity in px of infinitely far points, and whether depths are in mm.

    Without a scale a nominal one is made in which all that was found is in front of the cameras.
    """
    focal_px = fx_px or width_px
    aligned = bool(arrangement.aligned) and not disparity_px
    if (pitch_mm is None) != (fx_px is None) or (pitch_mm is not None and aligned):
        inform(
            "depths are stated as disparities in px: mm need --pitch-mm and --fx-px"
            + (", and --disparity-px as the pictures are aligned on a plane" if aligned else "")
        )
    if pitch_mm is not None and fx_px is not None and (disparity_px or not arrangement.aligned):
        return pitch_mm, focal_px, disparity_px, True
    if disparity_px:
        # The plane on which the pictures are aligned gets a depth of its own
        return pitch_mm or _FREE_REFERENCE_DEPTH_MM * disparity_px / focal_px, focal_px, disparity_px, False
    at_infinity_px = 0.0
    if arrangement.disparity_range_px is not None:
        least, largest = arrangement.disparity_range_px
        # Ranges are those along columns of nodes, the scale is that along rows
        at_infinity_px = max(largest + _BEYOND_SHARE * (largest - least) + _BEYOND_PX, 0.0) / arrangement.pitch_ratio
    return pitch_mm or 1.0, focal_px, at_infinity_px, False
