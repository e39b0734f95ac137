"""Planes of a folder as layers of napari, in the units of their set and on one grey scale.

`napari.yaml` names `napari_reader` as the reader of results that are dragged into napari's window.
"""

from collections.abc import Callable, Mapping, Sequence
from itertools import chain
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.errors import import_optional
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import white_level
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, PlaneRecord, ReconstructionRecord
from faintfield.pipelines.formats.results.stacks import Scale, planes_in_order, stack_scale, stacked_plane
from faintfield.pipelines.formats.results.surface import planes_below
from faintfield.pipelines.formats.units import StatedUnits, units_of
from faintfield.pipelines.pages.report_planes import method_title

# Planes at fewer depths than this are a layer each; more, in equal steps, are one layer with a slider.
_MIN_DEPTHS_OF_A_STACK = 3

# Names of units of length in napari, for which one without a name is a pixel.
_UNITS = {"mm": "mm", "px": "pixel", "": "pixel"}


type LayerData = tuple[NDArray[Any], dict[str, Any], str]
"""Pixels of a layer, its parameters by the names of `napari.Viewer.add_image`, and its type."""


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
    layers = _layer_data(directory, planes_below(directory))
    napari = import_optional("napari", "view", "pip install 'napari[pyqt6]'")
    viewer = napari.Viewer(title=f"faintfield: {directory.resolve().name}")
    for data, parameters, _ in layers:
        viewer.add_image(data, **parameters)
    napari.run()
    return [parameters["name"] for _, parameters, _ in layers]


def napari_reader(path: str | Sequence[str]) -> Callable[[object], list[LayerData]] | None:
    """Return the function by which napari reads a result: a folder with planes, or its reconstruction.json.

    None if the path, or one of several, holds no planes.
    """
    paths = [Path(path)] if isinstance(path, str) else [Path(each) for each in path]
    if not all(map(_holds_planes, paths)):
        return None
    return lambda _: list(chain.from_iterable(map(_read_layers, paths)))


def _holds_planes(path: Path) -> bool:
    if path.name == RECONSTRUCTION_FILE:
        return path.is_file()
    return any(path.glob(RECONSTRUCTION_FILE)) or any(path.glob(f"*/{RECONSTRUCTION_FILE}"))


def _read_layers(path: Path) -> list[LayerData]:
    if path.name != RECONSTRUCTION_FILE:
        return _layer_data(path, planes_below(path))
    return _layer_data(path.parent, {path.parent: planes_below(path.parent)[path.parent]})


def _layer_data(directory: Path, results: Mapping[Path, ReconstructionRecord]) -> list[LayerData]:
    """Return the layers of results below a folder, the first one visible."""
    by_method = [_layers(directory, folder, result) for folder, result in results.items()]
    # The least noisy method sets the scale, as in the report, so that noise may be clipped and planes are not
    white = min(max(white_level(layer.data) for layer in layers) for layers in by_method)
    common = {"contrast_limits": (0.0, max(white, 1e-6)), "colormap": "gray"}
    return [
        (pixels, parameters | common | {"visible": index == 0}, "image")
        for index, (pixels, parameters) in enumerate(map(_split, chain.from_iterable(by_method)))
    ]


def _split(layer: _Layer) -> tuple[NDArray[Any], dict[str, Any]]:
    """Return the pixels of a layer and its other parameters."""
    parameters = layer._asdict()
    return parameters.pop("data"), parameters


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
