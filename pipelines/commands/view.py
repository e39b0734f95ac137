"""`faintfield view`: the planes of a folder in napari."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from msgspec import UNSET

from faintfield.pipelines.errors import MissingPackage
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import white_level
from faintfield.pipelines.formats.results.records import PlaneRecord, ReconstructionRecord
from faintfield.pipelines.formats.results.result_files import results_below
from faintfield.pipelines.formats.results.stacks import planes_in_order, stack_scale
from faintfield.pipelines.pages.report_planes import method_title

# From so many depths in equal steps on, planes are one layer with a slider.
_LEAST_DEPTHS_OF_A_STACK = 3


def view(directory: Path, /) -> dict[str, Any]:
    """Open the planes of a folder in napari, if that is installed: in millimetres, on one grey scale.

    A few planes are a layer each; a sweep in equal steps is one layer per method with a slider over depth.

    Parameters
    ----------
    directory
        Folder with reconstruction.json, or whose folders have one: what `reconstruct` wrote, or a session.
    """
    results = [_layers(directory, folder, result) for folder, result in results_below(directory).items()]
    try:
        import napari
    except ImportError as failure:
        raise MissingPackage(
            "napari is not installed; it is an extra: pip install 'faintfield[view]', or pip install 'napari[pyqt6]'"
        ) from failure
    # The least noisy method sets the scale, as in the report: noise may clip, planes not.
    white = min(max(white_level(layer["data"]) for layer in layers) for layers in results)
    viewer = napari.Viewer(title=f"faintfield: {directory.resolve().name}")
    layers = [layer for of_one_method in results for layer in of_one_method]
    for index, layer in enumerate(layers):
        viewer.add_image(
            layer.pop("data"), **layer, contrast_limits=(0.0, max(white, 1e-6)), colormap="gray", visible=index == 0
        )
    napari.run()
    return {"layers": [layer["name"] for layer in layers]}


def _layers(directory: Path, folder: Path, result: ReconstructionRecord) -> list[dict[str, Any]]:
    """Return what napari is told of the planes in one folder."""
    planes = planes_in_order(result.planes)
    tilted = {record.file: record for record in result.planes if record.rt_ref_plane is not UNSET}.values()
    method = result.planes[0].method
    where = folder.relative_to(directory).as_posix()
    name = method_title(result.planes) + (f", {where}" if where not in (".", method) else "")
    alone = [_layer(folder, [plane], f"{name}, {plane.name}") for plane in tilted]
    if not planes:
        return alone
    scale = stack_scale(planes)
    one_shape = len({record.shape for record in planes}) == 1
    if len(planes) < _LEAST_DEPTHS_OF_A_STACK or scale.step_mm is None or not one_shape:
        return [*(_layer(folder, [plane], f"{name}, {plane.depth_mm:g} mm") for plane in planes), *alone]
    layer = _layer(folder, planes, name)
    layer["scale"] = (scale.step_mm, scale.across, scale.across)
    layer["translate"] = (planes[0].depth_mm, scale.origin[1], scale.origin[0])
    layer |= {"units": ("mm", scale.unit, scale.unit), "axis_labels": ("depth", "y", "x")}
    return [layer, *alone]


def _layer(folder: Path, planes: Sequence[PlaneRecord], name: str) -> dict[str, Any]:
    """Return the pixels of one plane (row, column[, colour]), or of several (plane, row, column[, colour])."""
    pixels = [read_frame(folder / Path(plane.file).name).pixels_dn for plane in planes]
    x_mm, y_mm = planes[0].origin_mm
    pitch_mm = planes[0].pitch_mm
    return {
        "data": pixels[0] if len(pixels) == 1 else np.stack(pixels),
        "name": name,
        "rgb": pixels[0].ndim == 3,
        "scale": (pitch_mm, pitch_mm),
        "translate": (y_mm, x_mm),
        "units": ("mm", "mm"),
        "axis_labels": ("y", "x"),
    }
