"""Planes of a folder as layers of napari, in the units of their set and on one grey scale."""

from collections.abc import Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.errors import import_optional
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import white_level
from faintfield.pipelines.formats.results.records import PlaneRecord, ReconstructionRecord
from faintfield.pipelines.formats.results.stacks import Scale, planes_in_order, stack_scale, stacked_plane
from faintfield.pipelines.formats.results.surface import planes_below
from faintfield.pipelines.formats.units import StatedUnits, units_of
from faintfield.pipelines.pages.report_planes import method_title

# Planes at fewer depths than this are a layer each; more, in equal steps, are one layer with a slider.
_MIN_DEPTHS_OF_A_STACK = 3

# Names of units of length in napari, for which one without a name is a pixel.
_UNITS = {"mm": "mm", "px": "pixel", "": "pixel"}


class _Layer(NamedTuple):
    """An image layer of one or several planes, by the parameters of `napari.Viewer.add_image`."""

    data: NDArray[Any]
    name: str
    rgb: bool
    scale: tuple[float, ...]
    translate: tuple[float, ...]
    units: tuple[str, ...]
    axis_labels: tuple[str, ...]


def show_planes(directory: Path) -> list[str]:
    """Show the planes below a folder in napari until its window is closed, and return the names of the layers.

    Raises MissingFile or BadValue without a result that can be read, and MissingPackage without napari.
    """
    by_method = [_layers(directory, folder, result) for folder, result in planes_below(directory).items()]
    napari = import_optional("napari", "view", "pip install 'napari[pyqt6]'")
    # The least noisy method sets the scale, as in the report, so that noise may be clipped and planes are not
    white = min(max(white_level(layer.data) for layer in layers) for layers in by_method)
    viewer = napari.Viewer(title=f"faintfield: {directory.resolve().name}")
    layers = list(chain.from_iterable(by_method))
    for index, layer in enumerate(layers):
        limits = (0.0, max(white, 1e-6))
        viewer.add_image(**layer._asdict(), contrast_limits=limits, colormap="gray", visible=index == 0)
    napari.run()
    return [layer.name for layer in layers]


def _layers(directory: Path, folder: Path, result: ReconstructionRecord) -> list[_Layer]:
    planes = planes_in_order(result.planes)
    tilted = {record.file: record for record in result.planes if record.rt_ref_plane is not UNSET}.values()
    method = result.planes[0].method
    where = folder.relative_to(directory).as_posix()
    name = method_title(result.planes) + (f", {where}" if where not in (".", method) else "")
    units = units_of(result)
    scale = stack_scale(planes, units) if len(planes) >= _MIN_DEPTHS_OF_A_STACK else None
    if scale is not None and scale.step_mm is not None:
        layers = [_stack_layer(folder, planes, name, scale, scale.step_mm, units)]
    else:
        layers = [
            _plane_layer(folder, plane, f"{name}, {units.depths_text([plane.depth_mm])}", units) for plane in planes
        ]
    return layers + [_plane_layer(folder, plane, f"{name}, {plane.name}", units) for plane in tilted]


def _plane_layer(folder: Path, plane: PlaneRecord, name: str, units: StatedUnits) -> _Layer:
    pixels = _pixels(folder, plane)
    (x, y), pitch = plane.origin_mm, plane.pitch_mm
    unit = _UNITS[units.length]
    return _Layer(pixels, name, pixels.ndim == 3, (pitch, pitch), (y, x), (unit, unit), ("y", "x"))


def _stack_layer(
    folder: Path, planes: Sequence[PlaneRecord], name: str, scale: Scale, step_mm: float, units: StatedUnits
) -> _Layer:
    pixels = np.stack([stacked_plane(folder, planes, scale, index) for index in range(len(planes))])
    across = _UNITS.get(scale.unit, scale.unit)
    units_of_axes = (_UNITS[units.length], across, across)
    spacing = (step_mm, scale.across, scale.across)
    start = (planes[0].depth_mm, scale.origin[1], scale.origin[0])
    return _Layer(pixels, name, pixels.ndim == 4, spacing, start, units_of_axes, (units.quantity, "y", "x"))


def _pixels(folder: Path, plane: PlaneRecord) -> NDArray[Any]:
    return read_frame(folder / Path(plane.file).name).pixels_dn
