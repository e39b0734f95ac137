"""`faintfield import grid`: an elemental set from a folder of pictures taken on a regular grid."""

from pathlib import Path

import msgspec

from faintfield.calib.lens import Lens
from faintfield.pipelines.arguments import Count, Fraction, NotNegative, Positive
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.exchange.image_grid import find_grid
from faintfield.pipelines.formats.exchange.imported_set import read_picture, write_imported_set
from faintfield.pipelines.formats.sets.elemental_file import Noise

# Without a pitch the unit of length is free: the plane on which the pictures are aligned gets this depth.
_FREE_REFERENCE_DEPTH_MM = 1000.0


class ImportedGrid(msgspec.Struct, frozen=True):
    """The result of `faintfield import grid`."""

    out: str
    rows: int
    columns: int
    size_px: tuple[int, int]


def import_grid(
    src: Path,
    out: Path,
    /,
    *,
    pitch_mm: Positive | None = None,
    fx_px: Positive | None = None,
    disparity_px: NotNegative = 0.0,
    rows: Count | None = None,
    columns: Count | None = None,
    exposure_s: Positive | None = None,
    offset_dn: float | None = None,
    gain_dn_per_e: Positive = 1.0,
    read_noise_e: NotNegative = 0.0,
    dark_current_e_per_s: NotNegative = 0.0,
    quantum_efficiency: Fraction | None = None,
    overwrite: bool = False,
) -> ImportedGrid:
    """Make an elemental set from pictures taken on a regular grid.

    The last two numbers in a picture's name are its row and column, as in view_r3_c12.jpg. Names without two numbers
    are taken in order, row by row, with --rows and --columns. Row 0 is the top, column 0 the left. Pictures are copied
    as they are, except that 8-bit ones become 16-bit TIFF with the same values. Pixel values are taken to be
    proportional to light: photographs with a gamma curve, as most JPEGs are, give pictures but no photometry.

    Parameters
    ----------
    src
        Folder of pictures: TIFF, PNG, JPEG or raw.
    out
        Folder to write.
    pitch_mm
        Distance between neighbouring nodes. Without it depths are relative: the plane of --disparity-px is at 1000.
    fx_px
        Focal length; by default the width of a picture.
    disparity_px
        For pictures aligned (rectified) on a plane: how many pixels that plane moved from node to node before it was
        aligned, a positive number. With the pitch it sets the plane's depth to fx · pitch / disparity. 0: not aligned.
    rows
        Rows of the grid, where the names do not tell.
    columns
        Columns of the grid, where the names do not tell.
    exposure_s
        Exposure of each picture; by default that of EXIF, or 1 s where there is none.
    offset_dn
        Dark level. By default that of each raw file, and 0 for other pictures.
    gain_dn_per_e
        DN per electron.
    read_noise_e
        Standard deviation of the read noise.
    dark_current_e_per_s
        Dark electrons per pixel and second.
    quantum_efficiency
        Electrons per photon; without it no result is given in photons.
    overwrite
        Replace an earlier set in OUT.
    """
    options = {name: value for name, value in locals().items() if name not in ("src", "out", "overwrite")}
    grid = find_grid(src, rows, columns)
    height, width = read_picture(next(iter(grid.paths.values()))).pixels_dn.shape[:2]
    focal_px = fx_px or float(width)
    if pitch_mm is None:
        pitch_mm = _FREE_REFERENCE_DEPTH_MM * disparity_px / focal_px if disparity_px else 1.0
    lens = Lens((width, height), focal_px, focal_px, (width - 1) / 2, (height - 1) / 2)
    write_imported_set(
        out,
        grid.posed(lens, pitch_mm, disparity_px),
        reference=grid.centre,
        noise=Noise(gain_dn_per_e, read_noise_e, offset_dn, dark_current_e_per_s, quantum_efficiency),
        exposure_s=exposure_s,
        command="import grid",
        options=options,
        overwrite=overwrite,
    )
    inform(f"{out}: {grid.size[0]} x {grid.size[1]} views of {width} x {height} px")
    return ImportedGrid(str(out), *grid.size, lens.size_px)
