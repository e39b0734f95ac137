"""For other programs: `faintfield export` writes their files, `faintfield schema` describes those of this one."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from cyclopts import Parameter

from faintfield.pipelines.arguments import SchemaKind
from faintfield.pipelines.formats.units import DepthUnit, LightUnit, StatedUnits

if TYPE_CHECKING:
    from faintfield.pipelines.formats.exchange.emva1288 import ExportedData
    from faintfield.pipelines.formats.exchange.imported_set import ExportedSet
    from faintfield.pipelines.formats.exchange.zarr import ZarrExport
    from faintfield.pipelines.workflows.schema import JsonSchema, KindList

type Result = ExportedSet
type Planes = ZarrExport
type Frames = ExportedData
type Description = JsonSchema | KindList

type _Set = Annotated[Path, Parameter(name="SESSION|SET")]


def export_colmap(set_path: _Set, out: Path, /, *, binary: bool = False, overwrite: bool = False) -> Result:
    """Write the lens and poses of an elemental set as a COLMAP model without points.

    Its unit is the mm, or that of the poses if the set has no scale: then lengths are relative, and the result says so.
    Views with principal points of their own get cameras of their own.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    binary
        .bin instead of .txt files.
    overwrite
        Replace an earlier model in OUT, a folder that holds nothing else.
    """
    from faintfield.pipelines.formats.exchange.colmap import export_model

    return export_model(set_path, out, binary=binary, overwrite=overwrite)


def export_mrcal(set_path: _Set, out: Path, /, *, overwrite: bool = False) -> Result:
    """Write the lens and poses of an elemental set as .cameramodel files, one per view, in metres.

    Of a set without a scale lengths are relative, thousandths of those of its poses, and the result says so. mrcal's
    uncertainty and residuals need the corners of boards: use geometry.cameramodel, which `faintfield geometry` writes.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    overwrite
        Replace earlier models in OUT, a folder that holds nothing else.
    """
    from faintfield.pipelines.formats.exchange.mrcal import export_camera_models

    return export_camera_models(set_path, out, overwrite=overwrite)


def export_nerfstudio(set_path: _Set, out: Path, /, *, overwrite: bool = False) -> Result:
    """Write lens and poses of an elemental set as a transforms.json of nerfstudio and instant-ngp.

    Its unit is that of the set, mm where they are known; its world is the reference camera's frame, with y down. Images
    are named as in the set and not copied: put the file beside them. Views with principal points of their own get
    lenses of their own.

    Parameters
    ----------
    set_path
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder to write.
    overwrite
        Replace an earlier transforms.json in OUT, a folder that holds nothing else.
    """
    from faintfield.pipelines.formats.exchange.nerfstudio import export_transforms

    return export_transforms(set_path, out, overwrite=overwrite)


def export_zarr(directory: Path, out: Path, /, *, overwrite: bool = False) -> Planes:
    """Write the planes of a folder as OME-Zarr 0.5, which napari, Fiji and others open at the right scale.

    Axes are colour, depth, row, column; values are float32, light per detector pixel in the unit of the set.
    Lengths are in mm where all planes have one pitch (reconstruct with --pitch-mm); otherwise rows and columns are in
    thousandths of x/z, which have no unit in this format. Planes in unequal steps are counted along the axis of depth,
    and of a set without a scale no length has a unit: the attribute `faintfield` says what each axis is.

    Parameters
    ----------
    directory
        Folder with reconstruction.json: what `reconstruct` wrote by one method.
    out
        Folder to write; its name usually ends with .ome.zarr.
    overwrite
        Replace an earlier export in OUT.
    """
    from faintfield.pipelines.formats.exchange.zarr import export_planes

    return export_planes(directory, out, overwrite=overwrite)


def export_emva1288(folder: Annotated[Path, Parameter(name="DIR")], out: Path, /, *, overwrite: bool = False) -> Frames:
    """Write dark and flat frames as EMVA 1288 data: a descriptor file and the images that it names.

    The flats must state their photons. Raw files and frames of which only a region is used become TIFF; other images
    are copied as they are. The format has no temperatures and no colour filters.

    Parameters
    ----------
    folder
        A session with dark frames, or a folder with noise.toml and the frames that it names.
    out
        Folder to write: descriptor.txt and images.
    overwrite
        Replace earlier data in OUT.
    """
    from faintfield.pipelines.formats.exchange.emva1288 import export_data

    return export_data(folder, out, overwrite=overwrite)


def schema(
    kind: SchemaKind | None = None, /, *, depth_unit: DepthUnit = "mm", light_unit: LightUnit = "electrons"
) -> Description:
    """Print the JSON Schema of a file that is read or written, or list the kinds of files.

    A schema of a TOML file is that of its tables as JSON. Limits of the numbers in rig.toml are not in its schema: they
    are checked when the file is read. Results name depths and light by their units: state these for the results of a
    set without a scale or without photons.

    Parameters
    ----------
    kind
        Kind of file; without it all kinds are listed, with a sentence each.
    depth_unit
        Unit of depths in a result.
    light_unit
        Unit of light in a result.
    """
    from faintfield.pipelines.workflows.schema import describe_kind, list_kinds

    return list_kinds() if kind is None else describe_kind(kind, StatedUnits(depth=depth_unit, light=light_unit))
