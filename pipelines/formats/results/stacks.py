"""Planes as stacks: their common scale and spacing, and the ImageJ hyperstack that states both."""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import tifffile
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.formats.files import writing
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.records import PlaneRecord
from faintfield.pipelines.formats.units import StatedUnits

STACK_FILE = "stack.tiff"

# Tolerance of equal steps, relative to a step: depths are rounded when they are given.
_EQUAL_STEPS = 1e-3


@dataclass(frozen=True)
class Scale:
    """The spacing of the samples of a stack, across in `unit` and in depth; x, y of the first sample are the `origin`.

    The unit is that of the records ("mm", "px", or none if it has no name) if all planes have the same pitch. By
    default the pitch of a plane grows with its depth, and its samples are a constant angle apart: then it is "mrad",
    thousandths of x/z, which is the same at every depth. `step_mm` leads to the next depth or disparity; None if the
    steps differ.
    """

    across: float
    unit: str
    origin: tuple[float, float]
    step_mm: float | None


def stack_scale(records: Sequence[PlaneRecord], units: StatedUnits) -> Scale:
    """Return the scale of planes, given their records in the order of their depths, and their units."""
    depths = np.array([record.depth_mm for record in records])
    pitches = np.array([record.pitch_mm for record in records])
    first = records[0]
    steps = np.diff(depths)
    equal = len(steps) > 0 and bool(np.ptp(steps) <= _EQUAL_STEPS * np.abs(steps).max())
    step_mm = float(steps.mean()) if equal else None
    if np.allclose(pitches, pitches[0], rtol=1e-9):
        return Scale(float(pitches[0]), units.length, first.origin_mm, step_mm)
    per_mrad = 1e3 / first.depth_mm
    x, y = (start * per_mrad for start in first.origin_mm)
    return Scale(float(np.mean(pitches / depths)) * 1e3, "mrad", (x, y), step_mm)


def at_depths(records: Sequence[PlaneRecord]) -> list[PlaneRecord]:
    """Return the records of planes perpendicular to the camera's axis; those given by a pose have no single depth."""
    return [record for record in records if record.rt_ref_plane is UNSET]


def planes_in_order(records: Sequence[PlaneRecord]) -> list[PlaneRecord]:
    """Return one record per plane of constant depth, the nearest first; a colour plane has several records."""
    by_file = {record.file: record for record in at_depths(records)}
    return sorted(by_file.values(), key=lambda record: record.depth_mm)


def write_stack(folder: Path, records: Sequence[PlaneRecord], units: StatedUnits) -> Path | None:
    """Write the planes of one method in a folder as one ImageJ hyperstack there, and return its path.

    Axes are depth, colour (if any), row, column; the calibration makes ImageJ show x, y and depth in their units, and
    each slice is labelled with its depth and pitch. Planes of different shapes do not fit into a stack: None.
    """
    planes = planes_in_order(records)
    if len({record.shape for record in planes}) > 1:
        return None
    scale = stack_scale(planes, units)
    colours = max(len(at_depths(records)) // len(planes), 1)
    path = folder / STACK_FILE
    with writing(path) as file:
        tifffile.imwrite(
            file,
            _slices(folder, planes),
            shape=(len(planes), colours, *planes[0].shape),
            dtype=np.float32,
            imagej=True,
            byteorder="<",
            photometric="minisblack",
            resolution=(1 / scale.across, 1 / scale.across),
            metadata=_imagej_metadata(planes, scale, colours, units),
        )
    return path


def _slices(folder: Path, planes: Sequence[PlaneRecord]) -> Iterator[NDArray[np.float32]]:
    """Yield each colour of each plane (row, column), one plane in memory at a time."""
    for record in planes:
        pixels = np.asarray(read_frame(folder / Path(record.file).name).pixels_dn, np.float32)
        yield from [pixels] if pixels.ndim == 2 else np.ascontiguousarray(np.moveaxis(pixels, 2, 0))


def _imagej_metadata(planes: Sequence[PlaneRecord], scale: Scale, colours: int, units: StatedUnits) -> dict[str, Any]:
    """Return the calibration of a stack in the words of ImageJ; origins are in samples there."""
    labels = [units.depths_text([record.depth_mm]) for record in planes]
    if units.depth == "mm":
        labels = [f"{label}, {record.pitch_mm:.4g} mm/px" for label, record in zip(labels, planes, strict=True)]
    metadata: dict[str, Any] = {
        "axes": "ZCYX",
        "unit": scale.unit or "relative",
        "zunit": units.length or "relative",
        "xorigin": -scale.origin[0] / scale.across,
        "yorigin": -scale.origin[1] / scale.across,
        "Labels": [label for label in labels for _ in range(colours)],
    }
    if scale.step_mm is not None:
        metadata |= {"spacing": scale.step_mm, "zorigin": -planes[0].depth_mm / scale.step_mm}
    if colours > 1:
        metadata["mode"] = "composite"
    return metadata
