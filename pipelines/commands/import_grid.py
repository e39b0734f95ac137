"""`faintfield import grid`: an elemental set from pictures taken on a regular grid, in a folder or in one file."""

from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from faintfield.pipelines.arguments import Count, Fraction, NotNegative, Positive
from faintfield.pipelines.console import inform

if TYPE_CHECKING:
    from faintfield.pipelines.formats.sets.elemental_file import Arrangement


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
    arrangement: "Arrangement"


def import_grid(
    src: Path,
    out: Path,
    /,
    *,
    pitch_mm: Positive | None = None,
    fx_px: Positive | None = None,
    disparity_px: NotNegative | None = None,
    rows: Count | None = None,
    columns: Count | None = None,
    pattern: str | None = None,
    flip_rows: bool = False,
    flip_columns: bool = False,
    transpose: bool = False,
    exposure_s: Positive | None = None,
    offset_dn: float | None = None,
    gain_dn_per_e: Positive | None = None,
    read_noise_e: NotNegative | None = None,
    dark_current_e_per_s: NotNegative = 0.0,
    quantum_efficiency: Fraction | None = None,
    linear: bool = False,
    srgb: bool = False,
    overwrite: bool = False,
) -> ImportedGrid:
    """Make an elemental set from pictures taken on a regular grid.

    Names tell where each picture belongs: view_r3_c12.jpg, or two numbers that vary, row before column; names with
    positions such as out_00_01_-381.909_1124.376_.png also place the cameras. One running number counts row by row. For
    other names give --pattern, or --rows and --columns to take files in order. Row 0 is the top, column 0 the left,
    unless the pictures show that it is otherwise: a camera that moves right sees points move left, near ones more, and
    near things hide far ones. What they show is printed and recorded; what they leave open is taken from the names.

    A parameters.cfg of the HCI 4D benchmark beside the pictures gives the scale. Pictures of 16 bits are copied as they
    are, and floats become 16 bits by one factor. Those of 8 bits are taken to have the tone curve of sRGB, as
    photographs have; it is undone, and they become 16-bit TIFF. Gain and noise that are not given are estimated from
    the views.

    Parameters
    ----------
    src
        Folder of pictures: TIFF, PNG, JPEG, BMP, PGM, PPM, PFM, OpenEXR or raw. Or one file: a TIFF with a picture for
        each view, row by row, or one picture with all views side by side, in --rows and --columns of equal tiles.
    out
        Folder to write.
    pitch_mm
        Distance between neighbouring nodes, from column to column. With --fx-px, and for aligned pictures with
        --disparity-px, depths are in mm; without, planes are known by their disparity in px.
    fx_px
        Focal length; by default the width of a picture.
    disparity_px
        For pictures aligned (rectified) on a plane: how many pixels that plane moved from node to node before it was
        aligned, a positive number. With the pitch it sets the plane's depth to fx · pitch / disparity. 0: not aligned.
    rows
        Rows of the grid, where the names do not tell.
    columns
        Columns of the grid, where the names do not tell.
    pattern
        What names say, such as `{name}_{row}_{column}_{y}_{x}.png`: {name} and * are anything, {row}, {column} and
        {index} whole numbers ({row:2} of two digits), {x} and {y} the camera's position in any unit.
    flip_rows
        The first row of the names is the bottom one. With one of these three options the order is the one they state.
    flip_columns
        The first column of the names is the right one.
    transpose
        The first number of a name is the column.
    exposure_s
        Exposure of each picture; by default that of EXIF; not known where there is none.
    offset_dn
        Dark level. By default that of each raw file, and 0 for other pictures.
    gain_dn_per_e
        DN per electron, of the values without tone curve (8-bit ones with it: white becomes 65535). By default it is
        estimated from the differences of neighbouring views, and no light is stated in electrons.
    read_noise_e
        Standard deviation of the read noise; estimated likewise.
    dark_current_e_per_s
        Dark electrons per pixel and second.
    quantum_efficiency
        Electrons per photon; without it no result is given in photons.
    linear
        Values of 8-bit pictures are proportional to light; without it the tone curve of sRGB is undone.
    srgb
        16-bit pictures have the tone curve of sRGB, too, which is undone.
    overwrite
        Replace an earlier set in OUT.
    """
    options = {name: value for name, value in locals().items() if name not in ("src", "out", "overwrite")}
    import numpy as np

    from faintfield.calib.arrangement.nodes import Orientation
    from faintfield.calib.lens import Lens
    from faintfield.pipelines.formats.exchange.arranged_grid import arrange_grid
    from faintfield.pipelines.formats.exchange.hci import described_grid, write_true_depth
    from faintfield.pipelines.formats.exchange.imported_noise import StatedNoise
    from faintfield.pipelines.formats.exchange.imported_set import read_picture, write_imported_set
    from faintfield.pipelines.formats.exchange.packed_views import unpack_views
    from faintfield.pipelines.formats.exchange.tone import asked_tone
    from faintfield.pipelines.formats.units import Units

    described = described_grid(src)
    own_scale = pitch_mm is None and fx_px is None and disparity_px is None
    if described is not None:
        pitch_mm, fx_px, disparity_px = described.scale(pitch_mm, fx_px, disparity_px)
    stated = Orientation(transpose, flip_rows, flip_columns)
    with unpack_views(src, rows, columns, pattern, described.size if described else None) as views:
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
            noise=StatedNoise(gain_dn_per_e, read_noise_e, offset_dn, dark_current_e_per_s, quantum_efficiency),
            exposure_s=exposure_s,
            tone=asked_tone(linear=linear, srgb=srgb),
            command="import grid",
            options=options | {"dn_per_value": views.dn_per_value},
            models=[described.file] if described else [],
            sources=views.sources,
            units=Units(depth="mm" if in_mm else "disparity_px" if len(grid.paths) > 1 else "relative"),
            arrangement=arrangement,
            also=partial(write_true_depth, described, grid) if described is not None and own_scale else None,
            overwrite=overwrite,
        )
    inform(f"{out}: {grid.size[0]} x {grid.size[1]} views of {width} x {height} px")
    return ImportedGrid(str(out), *grid.size, lens.size_px, len(grid.paths), arrangement)


def _scale(
    arrangement: "Arrangement", width_px: float, pitch_mm: float | None, fx_px: float | None, disparity_px: float
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
