"""`faintfield export zarr`: the planes of a sweep as OME-Zarr."""

from pathlib import Path

import msgspec

from faintfield.pipelines.errors import BadValue


class ZarrExport(msgspec.Struct, frozen=True):
    """The result of `faintfield export zarr`."""

    out: str
    shape: tuple[int, int, int, int]
    levels: int
    unit: str


def export_zarr(directory: Path, out: Path, /, *, overwrite: bool = False) -> ZarrExport:
    """Write the planes of a folder as OME-Zarr 0.5, which napari, Fiji and others open at the right scale.

    Axes are colour, depth, row, column; values are float32, light per detector pixel in the unit of the set.
    Lengths are in mm where all planes have one pitch (reconstruct with --pitch-mm); otherwise rows and columns are in
    thousandths of x/z, which have no unit in this format. Of a set without a scale, no length has a unit: the attribute
    `faintfield` says what it is. Depths, or disparities, must be in equal steps.

    Parameters
    ----------
    directory
        Folder with reconstruction.json: what `reconstruct` wrote by one method.
    out
        Folder to write; its name usually ends with .ome.zarr.
    overwrite
        Replace an earlier export in OUT.
    """
    from faintfield.pipelines.formats.exchange.zarr import plane_stack, require_zarr, write_zarr
    from faintfield.pipelines.formats.results.surface import planes_below
    from faintfield.pipelines.formats.units import units_of

    require_zarr()
    results = planes_below(directory)
    if len(results) > 1:
        names = ", ".join(str(folder) for folder in results)
        raise BadValue(f"{directory}: holds planes of {len(results)} calls or methods; name one folder of {names}")
    ((folder, result),) = results.items()
    stack = plane_stack(folder, result.planes, units_of(result))
    write_zarr(out, stack, directory.resolve().name, overwrite=overwrite)
    return ZarrExport(str(out), stack.shape, stack.levels, stack.scale.unit or "relative")
