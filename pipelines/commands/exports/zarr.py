"""`faintfield export zarr`: the planes of a sweep as OME-Zarr, chunked and at several resolutions, for large stacks."""

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import progress
from faintfield.pipelines.errors import BadValue, MissingPackage
from faintfield.pipelines.formats.files import building_folder
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.records import PlaneRecord
from faintfield.pipelines.formats.results.result_files import results_below
from faintfield.pipelines.formats.results.stacks import Scale, at_depths, planes_in_order, stack_scale

# Planes are halved until no side is longer; viewers load the rest only where they look closer.
_COARSEST_PX = 512

_CHUNK_PX = 512


# What the folder of an export holds: its metadata, and one array for each resolution.
_HELD = ("zarr.json", "[0-9]", "[0-9][0-9]")


def export_zarr(directory: Path, out: Path, /, *, overwrite: bool = False) -> dict[str, Any]:
    """Write the planes of a folder as OME-Zarr 0.5, which napari, Fiji and others open at the right scale.

    Axes are colour, depth, row, column; float32 in expected electrons per detector pixel. Planes at equal steps of
    depth have lengths in mm where they have one pitch (reconstruct with --pitch-mm); otherwise rows and columns are
    thousandths of x/z, which have no unit there.

    Parameters
    ----------
    directory
        Folder with reconstruction.json: what `reconstruct` wrote by one method.
    out
        Folder to write, by custom with a name that ends with .ome.zarr.
    overwrite
        Replace an earlier export in OUT.
    """
    zarr = _zarr()
    folder, planes, colours = _planes_of(directory)
    scale = _scale_of(directory, planes)
    shape = (colours, len(planes), *planes[0].shape)
    levels = _levels(planes[0].shape)
    earlier = _HELD if overwrite and _is_export(out) else ()
    with building_folder(out, replace_only=earlier, reads=[directory]) as building:
        group = zarr.open_group(building, mode="w", zarr_format=3)
        _metadata(group, directory.resolve().name, scale, planes, shape, levels)
        for index, record in enumerate(progress(planes, "writing planes")):
            plane = np.atleast_3d(np.asarray(read_frame(folder / Path(record.file).name).pixels_dn, np.float32))
            for level in range(levels):
                group[str(level)][:, index] = np.moveaxis(plane, 2, 0)
                plane = _halved(plane)
    return {"out": str(out), "shape": list(shape), "levels": levels, "unit": scale.unit}


def _is_export(folder: Path) -> bool:
    """Return whether a folder is an earlier export; every Zarr group has a zarr.json, ours says who wrote it."""
    try:
        return "faintfield" in json.loads((folder / "zarr.json").read_bytes())["attributes"]
    except (OSError, ValueError, LookupError, TypeError):
        return False


def _zarr() -> Any:
    """Return zarr, if that and the library that knows OME-Zarr's metadata are there; nothing else needs them."""
    try:
        import ome_zarr_models  # noqa: F401
        import zarr
    except ImportError as failure:
        raise MissingPackage(
            "zarr or ome-zarr-models is not installed; they are an extra: pip install 'faintfield[zarr]'"
        ) from failure
    return zarr


def _planes_of(directory: Path) -> tuple[Path, list[PlaneRecord], int]:
    """Return the folder of the planes, one entry for each in the order of their depths, and how many colours they have.

    Raises
    ------
    BadValue
        They are of several methods, or sizes.
    """
    results = results_below(directory)
    if len(results) > 1:
        names = ", ".join(str(folder) for folder in results)
        raise BadValue(f"{directory}: holds planes of {len(results)} calls or methods; name one folder of {names}")
    ((folder, result),) = results.items()
    planes = planes_in_order(result.planes)
    if not planes:
        raise BadValue(f"{directory}: holds planes given by a pose only; a stack is of depths: reconstruct some")
    shapes = sorted({record.shape for record in planes})
    if len(shapes) > 1:
        raise BadValue(f"{directory}: planes are of {len(shapes)} sizes, {shapes[0]} and others; a stack takes one")
    return folder, planes, len(at_depths(result.planes)) // len(planes)


def _scale_of(directory: Path, planes: Sequence[PlaneRecord]) -> Scale:
    """Return the scale of planes; OME-Zarr knows one step of depth only."""
    scale = stack_scale(planes)
    if scale.step_mm is None and len(planes) > 1:
        raise BadValue(
            f"{directory}: the {len(planes)} depths are not in equal steps, and OME-Zarr states only one; "
            "reconstruct with --sweep-mm"
        )
    return scale


def _metadata(
    group: Any, name: str, scale: Scale, planes: Sequence[PlaneRecord], shape: tuple[int, ...], levels: int
) -> None:
    """Make the arrays of all resolutions, and say what their axes are."""
    from ome_zarr_models.v05.axes import Axis
    from ome_zarr_models.v05.image import ImageAttrs
    from ome_zarr_models.v05.multiscales import Dataset, Multiscale

    unit = "millimeter" if scale.unit == "mm" else None
    axes = (
        Axis(name="c", type="channel"),
        Axis(name="z", type="space", unit="millimeter"),
        Axis(name="y", type="space", unit=unit),
        Axis(name="x", type="space", unit=unit),
    )
    x, y = scale.origin
    datasets = []
    for level in range(levels):
        step = 2**level
        size = (*shape[:2], shape[2] // step, shape[3] // step)
        chunks = (1, 1, min(_CHUNK_PX, size[2]), min(_CHUNK_PX, size[3]))
        group.create_array(str(level), shape=size, chunks=chunks, dtype="float32", dimension_names=list("czyx"))
        across, shift = scale.across * step, scale.across * (step - 1) / 2  # the middle of the samples that are one now
        datasets.append(
            Dataset.build(
                path=str(level),
                scale=(1.0, scale.step_mm or 1.0, across, across),
                translation=(0.0, planes[0].depth_mm, y + shift, x + shift),
            )
        )
    multiscale = Multiscale(axes=axes, datasets=tuple(datasets), name=name)
    group.attrs["ome"] = ImageAttrs(version="0.5", multiscales=[multiscale]).model_dump(mode="json", exclude_none=True)
    group.attrs["faintfield"] = {
        "value": "expected electrons per detector pixel of the reference view",
        "row_and_column": scale.unit,
        "planes": msgspec.to_builtins(list(planes)),
    }


def _levels(shape: Sequence[int]) -> int:
    """Return how many resolutions a plane (row, column) is kept in."""
    levels, longest = 1, max(shape)
    while longest > _COARSEST_PX and min(shape) >> levels:
        levels, longest = levels + 1, longest // 2
    return levels


def _halved(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a plane (row, column, colour) with the mean of each two by two samples; an odd last one is left out."""
    rows, columns = plane.shape[0] // 2, plane.shape[1] // 2
    blocks = plane[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, -1)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))
