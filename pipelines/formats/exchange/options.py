"""Options of imports, apart from the code that reads files: for help."""

from dataclasses import dataclass
from pathlib import Path

from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, Fraction, NotNegative, Positive


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class ImportOptions:
    """Options of the imports of images whose poses another program found.

    Parameters
    ----------
    images
        Folder of the images; by default that of the poses.
    mm_per_unit
        Length of the unit of the positions, which COLMAP and nerfstudio cannot know: measure something, or depths are
        relative. By default that which a table states, and 1000 for mrcal, whose unit is the metre.
    reference
        Name of the image whose camera is the reference; the one nearest to the middle by default.
    exposure_s
        Exposure of each image; by default that of EXIF; not known where there is none.
    linear
        Values of 8-bit images are proportional to light; without it the tone curve of sRGB is undone.
    srgb
        16-bit images have the tone curve of sRGB, too, which is undone.
    overwrite
        Replace an earlier set in OUT.
    """

    images: Path | None = None
    mm_per_unit: Positive | None = None
    reference: str | None = None
    exposure_s: Positive | None = None
    linear: bool = False
    srgb: bool = False
    overwrite: bool = False


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class LensOptions:
    """Options that state the lens of images whose poses are in a table.

    Parameters
    ----------
    fx_px
        Focal length.
    fy_px
        Focal length of the other axis; the same by default.
    cx_px
        Principal point, where the first pixel's centre is 0; the middle of the picture by default.
    cy_px
        Likewise, of the other axis.
    distortion
        k1, k2, p1, p2, k3 … in OpenCV's order.
    """

    fx_px: Positive
    fy_px: Positive | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    distortion: tuple[float, ...] = ()


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class GridOptions:
    """Options of the import of pictures taken on a regular grid.

    Parameters
    ----------
    pitch_mm
        Distance between neighbouring nodes, from column to column. With --fx-px, and for aligned pictures with
        --disparity-px, depths are in mm; without, planes are known by their disparity in px.
    fx_px
        Focal length; by default the width of a picture.
    cx_px
        Principal point, where the first pixel's centre is 0; the middle of the picture by default.
    cy_px
        Likewise, of the other axis.
    distortion
        k1, k2, p1, p2, k3 … in OpenCV's order, with --pitch-mm and --fx-px; none by default.
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
    keep_order
        The order is that of the names. With one of these four options the pictures correct nothing.
    flip_rows
        The first row of the names is the bottom one.
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
    no_align
        Keep the poses of a regular grid where the pictures show that it was none; without it they are found by the
        views, see `align`.
    overwrite
        Replace an earlier set in OUT.
    """

    pitch_mm: Positive | None = None
    fx_px: Positive | None = None
    cx_px: float | None = None
    cy_px: float | None = None
    distortion: tuple[float, ...] = ()
    disparity_px: NotNegative | None = None
    rows: Count | None = None
    columns: Count | None = None
    pattern: str | None = None
    keep_order: bool = False
    flip_rows: bool = False
    flip_columns: bool = False
    transpose: bool = False
    exposure_s: Positive | None = None
    offset_dn: float | None = None
    gain_dn_per_e: Positive | None = None
    read_noise_e: NotNegative | None = None
    dark_current_e_per_s: NotNegative = 0.0
    quantum_efficiency: Fraction | None = None
    linear: bool = False
    srgb: bool = False
    no_align: bool = False
    overwrite: bool = False
