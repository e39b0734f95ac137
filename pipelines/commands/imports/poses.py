"""`faintfield import poses`: poses from a table, the lens from options."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.errors import WrongUsage

if TYPE_CHECKING:
    from faintfield.pipelines.formats.exchange.imported_set import ImportedSet


type Result = ImportedSet


def import_poses(
    src: Path,
    out: Path,
    /,
    *,
    fx_px: Positive,
    fy_px: Positive | None = None,
    cx_px: float | None = None,
    cy_px: float | None = None,
    distortion: tuple[float, ...] = (),
    images: Path | None = None,
    mm_per_unit: Positive | None = None,
    reference: str | None = None,
    exposure_s: Positive | None = None,
    linear: bool = False,
    srgb: bool = False,
    overwrite: bool = False,
) -> Result:
    """Make an elemental set from a table of camera positions and its images.

    The first line of the table names its columns: name, x, y, z or x_mm, y_mm, z_mm, and qw, qx, qy, qz if cameras are
    turned. A position is where the camera is; the quaternion turns the camera's axes (x right, y down, z forward) into
    those of the positions. Without quaternions all cameras look along z, with x right and y down.

    Parameters
    ----------
    src
        The table: CSV, with commas, semicolons or tabs.
    out
        Folder to write.
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
    images
        Folder of the images; that of the table by default.
    mm_per_unit
        Length of the unit of x, y and z, if it is known. Without it, and without _mm or _m, depths are relative.
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
    from faintfield.calib.lens import Lens
    from faintfield.pipelines.formats.exchange.imported_set import import_posed, read_picture
    from faintfield.pipelines.formats.exchange.pose_table import PoseTable
    from faintfield.pipelines.formats.exchange.tone import asked_tone

    table, folder = PoseTable(src), images or src.parent
    if mm_per_unit is not None and table.mm_per_unit is not None:
        raise WrongUsage(f"{src}: its header states the unit of positions; leave --mm-per-unit out")
    height, width = read_picture(table.first_picture(folder)).pixels_dn.shape[:2]
    try:
        lens = Lens(
            (width, height),
            fx_px,
            fy_px or fx_px,
            (width - 1) / 2 if cx_px is None else cx_px,
            (height - 1) / 2 if cy_px is None else cy_px,
            distortion,
        )
    except ValueError as failure:
        raise WrongUsage(f"the lens of the options cannot be: {failure}; correct them") from failure
    return import_posed(
        out,
        table.posed(lens, folder),
        mm_per_unit=mm_per_unit or table.mm_per_unit,
        reference=reference,
        exposure_s=exposure_s,
        tone=asked_tone(linear=linear, srgb=srgb),
        command="import poses",
        overwrite=overwrite,
    )
