"""Planes of a sweep as OME-Zarr 0.5, chunked and at several resolutions, for stacks too large for memory."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform, progress
from faintfield.pipelines.errors import BadValue, InputError, import_optional
from faintfield.pipelines.formats.files import check_free, require_room, writing_folder
from faintfield.pipelines.formats.reading import read_json
from faintfield.pipelines.formats.results.records import PlaneRecord
from faintfield.pipelines.formats.results.stacks import (
    Scale,
    at_depths,
    planes_in_order,
    stack_scale,
    stacked_plane,
)
from faintfield.pipelines.formats.results.surface import planes_below
from faintfield.pipelines.formats.units import StatedUnits, named_by, units_of

# Planes are halved until no side is longer, px; viewers load the rest only where they look closer.
_COARSEST_PX = 256

_CHUNK_PX = 512

# Units that OME-Zarr has a name for; px, mrad, the index of a plane and relative lengths have none.
_UNITS = {"mm": "millimeter"}

# Patterns of what the folder of an export holds: its metadata, and one array for each resolution.
_HELD = ("zarr.json", "[0-9]", "[0-9][0-9]")


class Axes(msgspec.Struct, frozen=True):
    """Units of the axes of an export; "index" if the axis z counts planes, whose steps of depth are not equal."""

    z: str
    y: str
    x: str


class ZarrExport(msgspec.Struct, frozen=True):
    """The result of `faintfield export zarr`; the shape is colours, planes, rows, columns."""

    out: str
    shape: tuple[int, int, int, int]
    levels: int
    axes: Axes


@dataclass(frozen=True)
class _Stack:
    """Planes of one folder that fit one stack, the nearest first."""

    folder: Path
    planes: Sequence[PlaneRecord]
    shape: tuple[int, int, int, int]
    scale: Scale
    units: StatedUnits

    @property
    def axes(self) -> Axes:
        """Units of the axes."""
        across = self.scale.unit or "relative"
        return Axes(self.units.length or "relative" if self.steps_equal else "index", across, across)

    @property
    def steps_equal(self) -> bool:
        """Return whether one step leads from each plane to the next, as OME-Zarr requires."""
        return self.scale.step_mm is not None or len(self.planes) == 1

    @property
    def levels(self) -> int:
        """Number of resolutions that are stored."""
        levels, longest = 1, max(self.shape[2:])
        while longest > _COARSEST_PX and min(self.shape[2:]) >> levels:
            levels, longest = levels + 1, longest // 2
        return levels

    def size(self, level: int) -> tuple[int, int, int, int]:
        """Return the shape of the array of a resolution."""
        return (*self.shape[:2], self.shape[2] >> level, self.shape[3] >> level)


def export_planes(directory: Path, out: Path, *, overwrite: bool = False) -> ZarrExport:
    """Write the planes in a folder as OME-Zarr.

    Raises
    ------
    BadValue
        Several calls or methods made the planes, none has a depth, or no grid holds the samples of all.
    MissingPackage
        zarr or ome-zarr-models is not installed.
    """
    zarr, models = import_optional("zarr", "zarr"), import_optional("ome_zarr_models.v05", "zarr")
    held = _HELD if _is_export(out) else ()
    check_free(out, replace_only=held, overwrite=overwrite)
    stack = _stack_in(directory)
    size_bytes = sum(math.prod(stack.size(level)) for level in range(stack.levels)) * np.dtype(np.float32).itemsize
    require_room(out, size_bytes, written_bytes=size_bytes)
    with writing_folder(out, replace_only=held, overwrite=overwrite, reads=[stack.folder]) as building:
        group = zarr.open_group(building, mode="w", zarr_format=3)
        _write_metadata(models, group, stack, directory.resolve().name)
        for index in progress(range(len(stack.planes)), "writing planes"):
            plane = np.atleast_3d(stacked_plane(stack.folder, stack.planes, stack.scale, index))
            for level in range(stack.levels):
                group[str(level)][:, index] = np.moveaxis(plane, 2, 0)
                plane = _halve(plane)
    inform(f"{out}: {len(stack.planes)} planes of {stack.shape[3]} x {stack.shape[2]} samples")
    if not stack.steps_equal:
        inform(
            f"the axis z counts the planes, whose steps of {stack.units.quantity} differ, as OME-Zarr states only one; "
            f"the attribute faintfield holds their {stack.units.quantities}"
        )
    return ZarrExport(str(out), stack.shape, stack.levels, stack.axes)


def _stack_in(directory: Path) -> _Stack:
    results = planes_below(directory)
    if len(results) > 1:
        names = ", ".join(map(str, results))
        raise BadValue(f"{directory}: holds planes of {len(results)} calls or methods; name one folder of {names}")
    ((folder, result),) = results.items()
    units, planes = units_of(result), planes_in_order(result.planes)
    if not planes:
        raise BadValue(f"{folder}: holds no planes at depths, only planes given by a pose; reconstruct some at depths")
    scale = stack_scale(planes, units)
    if scale is None:
        raise BadValue(
            f"{folder}: no grid holds the samples of all planes, which are not whole samples apart, or differ in size "
            "and pitch; reconstruct all of them again with one --pitch-mm, or without it"
        )
    colours = len(at_depths(result.planes)) // len(planes)
    return _Stack(folder, planes, (colours, len(planes), *scale.shape), scale, units)


def _is_export(folder: Path) -> bool:
    """Return whether a folder is an earlier export: every Zarr group has a zarr.json, ours says who wrote it."""
    try:
        group = read_json(folder / "zarr.json", dict[str, Any], what="a Zarr group", remedy="export again")
    except InputError:
        return False
    attributes = group.get("attributes")
    return isinstance(attributes, dict) and "faintfield" in attributes


def _write_metadata(models: Any, group: Any, stack: _Stack, name: str) -> None:
    """Make the arrays of all resolutions, and describe their axes."""
    axis, units = models.axes.Axis, msgspec.to_builtins(stack.axes)
    space = [axis(name=name, type="space", unit=_UNITS.get(unit)) for name, unit in units.items()]
    axes = (axis(name="c", type="channel"), *space)
    datasets = tuple(_dataset(models, group, stack, level) for level in range(stack.levels))
    multiscale = models.multiscales.Multiscale(axes=axes, datasets=datasets, name=name)
    attributes = models.image.ImageAttrs(version="0.5", multiscales=[multiscale])
    group.attrs["ome"] = attributes.model_dump(mode="json", exclude_none=True)
    group.attrs["faintfield"] = {
        "value": stack.units.light_description,
        "axes": units,
        "units": msgspec.to_builtins(stack.units),
        "planes": [named_by(msgspec.to_builtins(record), stack.units) for record in stack.planes],
    }


def _dataset(models: Any, group: Any, stack: _Stack, level: int) -> Any:
    """Make the array of one resolution, and return its entry: where its samples lie."""
    scale, size, step = stack.scale, stack.size(level), 2**level
    chunks = (1, 1, min(_CHUNK_PX, size[2]), min(_CHUNK_PX, size[3]))
    group.create_array(
        str(level), shape=size, chunks=chunks, dtype="float32", fill_value=np.nan, dimension_names=list("czyx")
    )
    x, y = scale.origin
    first, depth_step = (stack.planes[0].depth_mm, scale.step_mm or 1.0) if stack.steps_equal else (0.0, 1.0)
    across, shift = scale.across * step, scale.across * (step - 1) / 2  # to the middle of the samples merged into one
    return models.multiscales.Dataset.build(
        path=str(level),
        scale=(1.0, depth_step, across, across),
        translation=(0.0, first, y + shift, x + shift),
    )


def _halve(plane: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return a plane (row, column, colour) with the mean of each two by two samples; an odd last one is left out."""
    rows, columns = plane.shape[0] // 2, plane.shape[1] // 2
    blocks = plane[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, -1)
    return np.asarray(blocks.mean(axis=(1, 3), dtype=np.float32))
