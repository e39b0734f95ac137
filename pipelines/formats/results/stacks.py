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

# Tolerance of whole samples between the first samples of planes, in samples.
_WHOLE_SAMPLES = 1e-3


@dataclass(frozen=True)
class Scale:
    """The spacing of the samples of a stack, across in `unit` and in depth; x, y of the first sample are the `origin`.

    The unit is that of the records ("mm", "px", or none if it has no name) if all planes have the same pitch. By
    default the pitch of a plane grows with its depth, and its samples are a constant angle apart: then it is "mrad",
    thousandths of x/z, which is the same at every depth. `step_mm` leads to the next depth or disparity; None if the
    steps differ. Planes of one pitch may be of several sizes: `corners` are the row and column of each plane's first
    sample in the smallest grid that holds all, of `shape`.
    """

    across: float
    unit: str
    origin: tuple[float, float]
    step_mm: float | None
    shape: tuple[int, int]
    corners: tuple[tuple[int, int], ...]


def stack_scale(records: Sequence[PlaneRecord], units: StatedUnits) -> Scale | None:
    """Return the scale of planes, given their records in the order of their depths, and their units.

    None if no grid holds the samples of all: planes of several sizes differ in pitch, or are not whole samples apart.
    """
    depths = np.array([record.depth_mm for record in records])
    pitches = np.array([record.pitch_mm for record in records])
    steps = np.diff(depths)
    equal = len(steps) > 0 and bool(np.ptp(steps) <= _EQUAL_STEPS * np.abs(steps).max())
    step_mm = float(steps.mean()) if equal else None
    if np.allclose(pitches, pitches[0], rtol=1e-9):
        return _scale_of_one_pitch(records, units, step_mm)
    if len({record.shape for record in records}) > 1:
        return None
    first, across = records[0], 1e3 * float(np.mean(pitches / depths))
    x, y = (start * 1e3 / first.depth_mm for start in first.origin_mm)
    return Scale(across, "mrad", (x, y), step_mm, first.shape, ((0, 0),) * len(records))


def _scale_of_one_pitch(records: Sequence[PlaneRecord], units: StatedUnits, step_mm: float | None) -> Scale | None:
    pitch = records[0].pitch_mm
    starts, shapes = (np.array([getattr(record, name) for record in records]) for name in ("origin_mm", "shape"))
    origin = starts.min(axis=0)
    offsets = (starts - origin)[:, ::-1] / pitch
    corners = np.rint(offsets).astype(int)
    if np.abs(offsets - corners).max() > _WHOLE_SAMPLES:
        return None
    (x, y), (rows, columns) = origin.tolist(), (corners + shapes).max(axis=0).tolist()
    places = tuple((row, column) for row, column in corners.tolist())
    return Scale(pitch, units.length, (x, y), step_mm, (rows, columns), places)


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
    each slice is labelled with its depth and pitch. None if no grid holds the samples of all planes.
    """
    planes = planes_in_order(records)
    scale = stack_scale(planes, units)
    if scale is None:
        return None
    colours = max(len(at_depths(records)) // len(planes), 1)
    path = folder / STACK_FILE
    with writing(path) as file:
        tifffile.imwrite(
            file,
            _slices(folder, planes, scale),
            shape=(len(planes), colours, *scale.shape),
            dtype=np.float32,
            imagej=True,
            byteorder="<",
            photometric="minisblack",
            resolution=(1 / scale.across, 1 / scale.across),
            metadata=_imagej_metadata(planes, scale, colours, units),
        )
    return path


def stacked_plane(folder: Path, planes: Sequence[PlaneRecord], scale: Scale, index: int) -> NDArray[np.float32]:
    """Read a plane (row, column[, colour]) in the grid of its stack, NaN beyond the edges of the plane."""
    plane = np.asarray(read_frame(folder / Path(planes[index].file).name).pixels_dn, np.float32)
    (row, column), (rows, columns) = scale.corners[index], plane.shape[:2]
    if (rows, columns) == scale.shape:
        return plane
    stacked = np.full((*scale.shape, *plane.shape[2:]), np.nan, np.float32)
    stacked[row : row + rows, column : column + columns] = plane
    return stacked


def _slices(folder: Path, planes: Sequence[PlaneRecord], scale: Scale) -> Iterator[NDArray[np.float32]]:
    """Yield each colour of each plane (row, column), one plane in memory at a time."""
    for index in range(len(planes)):
        pixels = stacked_plane(folder, planes, scale, index)
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
