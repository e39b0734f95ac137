"""Series of statistics from the frames of a noise set; each frame is read once, a few ahead of its turn."""

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise import Series, SeriesSums
from faintfield.pipelines.calibration.reading_ahead import read_ahead
from faintfield.pipelines.console import progress
from faintfield.pipelines.errors import BadValue, UnreadableImage, WrongBitDepth, WrongSize
from faintfield.pipelines.formats.frames import Frame, at_phase, mosaic_period, read_frame
from faintfield.pipelines.formats.sets.noise_set import NoiseSet, Region, group_frames


@dataclass(frozen=True)
class MosaicPhase:
    """The pixels of one phase of the colour filter mosaic; of the whole sensor when there are no filters.

    Attributes
    ----------
    phase, period : (int, int)
        Row and column of its first pixel, and the distance to the next.
    colour : str
        Letter of its filter, "" without filters.
    series : list of Series
        Statistics of its pixels.
    black_dn : list of float
        Black level stated in each dark's file, from the sensor's masked pixels where it has any.
    """

    phase: tuple[int, int]
    period: tuple[int, int]
    colour: str
    series: list[Series] = field(default_factory=list)
    black_dn: list[float] = field(default_factory=list)

    @property
    def name(self) -> str:
        """Name of the phase in messages and file names, "" when it is the only one."""
        return f"{self.colour}_r{self.phase[0]}c{self.phase[1]}" if self.colour else ""

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the phase's part of an array (row, column), as a view."""
        return at_phase(pixels, self.phase, self.period)


@dataclass(frozen=True)
class Readout:
    """All frames of a noise set, reduced.

    Attributes
    ----------
    size_px : (int, int)
        Width and height of a frame.
    rows, columns : slice
        Region that was used.
    mosaic : tuple of str, optional
        Colour filters.
    saturation_dn : float
        As stated in `noise.toml`, else by the file, else the last value of the files' type.
    phases : list of MosaicPhase
        One per phase of the mosaic.
    """

    size_px: tuple[int, int]
    rows: slice
    columns: slice
    mosaic: tuple[str, ...] | None
    saturation_dn: float
    phases: list[MosaicPhase]


def read_series(folder: Path, settings: NoiseSet) -> Readout:
    """Read every frame of a noise set once.

    Raises
    ------
    InputError, CalibrationError
        A frame cannot be used; the message names it.
    """
    groups = group_frames(folder, settings)
    readout = _layout(next(iter(groups.values()))[0], settings)
    frames = [(conditions, path) for conditions, paths in groups.items() for path in paths]
    sums: list[SeriesSums] = []
    read = read_ahead(frames, lambda entry: read_frame(entry[1], readout.size_px, of="the other frames"))
    for index, ((conditions, path), frame) in enumerate(progress(read, "reading frames", len(frames))):
        if index == 0 or conditions != frames[index - 1][0]:
            sums = [SeriesSums(conditions, readout.saturation_dn) for _ in readout.phases]
        pixels = _check_frame(frame, path, readout)[readout.rows, readout.columns]
        for phase, phase_sums in zip(readout.phases, sums, strict=True):
            phase_sums.add(str(path), phase.of(pixels))
            if conditions.kind == "dark" and frame.black_dn is not None:
                phase.black_dn.append(float(frame.black_dn[phase.phase]))
        if index + 1 == len(frames) or conditions != frames[index + 1][0]:
            for phase, phase_sums in zip(readout.phases, sums, strict=True):
                phase.series.append(phase_sums.series())
    return readout


def _layout(first: Path, settings: NoiseSet) -> Readout:
    """Return the layout of all frames, from the first one and the settings."""
    frame = read_frame(first)
    if frame.pixels_dn.ndim != 2 or not np.issubdtype(frame.pixels_dn.dtype, np.integer):
        raise UnreadableImage(
            f"{first}: holds {frame.pixels_dn.dtype} of shape {frame.pixels_dn.shape}; the noise of a sensor shows "
            "only in whole digital numbers, one per pixel: give raw files or grey frames, not photographs"
        )
    height, width = frame.pixels_dn.shape
    mosaic = settings.mosaic or frame.mosaic
    period = mosaic_period(mosaic)
    rows, columns = _slices(settings.region, (height, width), period)
    phases = [MosaicPhase((r, c), period, "" if mosaic is None else mosaic[r][c]) for r, c in np.ndindex(*period)]
    last_dn = float(np.iinfo(frame.pixels_dn.dtype).max)
    if settings.saturation_dn and settings.saturation_dn > last_dn:
        raise BadValue(
            f"saturation_dn = {settings.saturation_dn:g}; the {frame.pixels_dn.dtype} values of {first} end at "
            f"{last_dn:g}; state the value from which the converter saturates, or leave it out"
        )
    saturation_dn = settings.saturation_dn or frame.saturation_dn or last_dn
    return Readout((width, height), rows, columns, mosaic, saturation_dn, phases)


def _slices(region: Region | None, shape: tuple[int, int], period: tuple[int, int]) -> tuple[slice, slice]:
    """Return the region as slices of whole periods of the mosaic."""
    if region is None:
        return slice(0, shape[0] // period[0] * period[0]), slice(0, shape[1] // period[1] * period[1])
    spans = {"rows": region.rows, "columns": region.columns}
    for (key, (first, end)), size, step in zip(spans.items(), shape, period, strict=True):
        if not 0 <= first < end <= size or first % step or (end - first) % step:
            raise BadValue(
                f"region.{key} = [{first}, {end}]; it must lie within 0…{size}, its first below its end, and hold "
                f"whole periods ({step}) of the mosaic"
            )
    return slice(*region.rows), slice(*region.columns)


def _check_frame(frame: Frame, path: Path, readout: Readout) -> NDArray[Any]:
    """Return a frame's pixels; a frame unlike the first is refused."""
    pixels = frame.pixels_dn
    width, height = readout.size_px
    if pixels.shape != (height, width):
        shape = " x ".join(str(length) for length in pixels.shape[1::-1] + pixels.shape[2:])
        raise WrongSize(
            f"{path}: is {shape} px, the other frames {width} x {height} px; record it again with the same region of "
            "interest and binning, or leave it out"
        )
    if not np.issubdtype(pixels.dtype, np.integer):
        raise WrongBitDepth(
            f"{path}: holds {pixels.dtype} pixels; noise is measured in whole digital numbers; record raw files"
        )
    return pixels
