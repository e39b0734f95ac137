"""`faintfield import`: sets of images, or of frames, from pictures and files of other programs."""

from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.formats.exchange.options import GridOptions, ImportOptions, LensOptions

if TYPE_CHECKING:
    from faintfield.pipelines.formats.exchange.emva1288 import ImportedFrames
    from faintfield.pipelines.formats.exchange.imported_set import ImportedSet
    from faintfield.pipelines.workflows.import_grid import AlignedGrid

_DEFAULTS, _GRID_DEFAULTS = ImportOptions(), GridOptions()

type Result = ImportedSet
type Frames = ImportedFrames
type Grid = AlignedGrid


def import_grid(src: Path, out: Path, /, *, options: GridOptions = _GRID_DEFAULTS) -> Grid:
    """Make an elemental set from pictures taken on a regular grid.

    Names tell where each picture belongs: view_r3_c12.jpg, or two numbers that vary, row before column; names with
    positions such as out_00_01_-381.909_1124.376_.png also place the cameras. One running number counts row by row. For
    other names give --pattern, or --rows and --columns to take files in order. Row 0 is the top, column 0 the left,
    unless the pictures show that it is otherwise: a camera that moves right sees points move left, near ones more, and
    near things hide far ones. What they show is printed and recorded; what they leave open is taken from the names.

    A parameters.cfg of the HCI 4D benchmark beside the pictures gives the scale. Pictures of 16 bits are copied as they
    are, and floats become 16 bits by one factor. Those of 8 bits are taken to have the tone curve of sRGB, as
    photographs have; it is undone, and they become 16-bit TIFF. Gain and noise that are not given are estimated from
    the views. Where the pictures show that the grid was not regular, the poses are found by the views, as by `align`,
    whose page lies in OUT/alignment.

    Parameters
    ----------
    src
        Folder of pictures: TIFF, PNG, JPEG, BMP, PGM, PPM, PFM, OpenEXR or raw. Or one file: a TIFF with a picture for
        each view, row by row, or one picture with all views side by side, in --rows and --columns of equal tiles.
    out
        Folder to write.
    """
    from faintfield.pipelines.workflows.import_grid import import_and_align

    return import_and_align(src, out, options)


def import_colmap(src: Path, out: Path, /, *, options: ImportOptions = _DEFAULTS) -> Result:
    """Make an elemental set from a COLMAP model, text or binary, and its images.

    Parameters
    ----------
    src
        Folder of the sparse model: cameras and images, .bin or .txt.
    out
        Folder to write.
    """
    from faintfield.pipelines.formats.exchange.colmap import import_model

    return import_model(src, out, options)


def import_mrcal(src: Path, out: Path, /, *, options: ImportOptions = _DEFAULTS) -> Result:
    """Make an elemental set from a folder of .cameramodel files and images of the same names.

    Parameters
    ----------
    src
        Folder of .cameramodel files, one per image, all with the same lens but for its principal point.
    out
        Folder to write.
    """
    from faintfield.pipelines.formats.exchange.mrcal import import_camera_models

    return import_camera_models(src, out, options)


def import_nerfstudio(src: Path, out: Path, /, *, options: ImportOptions = _DEFAULTS) -> Result:
    """Make an elemental set from the transforms.json of nerfstudio or instant-ngp and its images.

    Parameters
    ----------
    src
        The transforms.json, or the folder that holds it.
    out
        Folder to write.
    """
    from faintfield.pipelines.formats.exchange.nerfstudio import import_transforms

    return import_transforms(src, out, options)


def import_poses(src: Path, out: Path, /, *, lens: LensOptions, options: ImportOptions = _DEFAULTS) -> Result:
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
    """
    from faintfield.pipelines.formats.exchange.pose_table import import_table

    return import_table(src, out, lens, options)


def import_emva1288(descriptor: Path, out: Path, /, *, overwrite: bool = False) -> Frames:
    """Make a noise set of EMVA 1288 reference data.

    Parameters
    ----------
    descriptor
        The data's descriptor file; images lie beside it.
    out
        Folder to write: noise.toml and copies of the images.
    overwrite
        Replace an earlier set in OUT.
    """
    from faintfield.pipelines.formats.exchange.emva1288 import import_data

    return import_data(descriptor, out, overwrite=overwrite)
