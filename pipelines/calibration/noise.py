"""A sensor measured: the frames of a noise set reduced to statistics, and each phase of its mosaic calibrated."""

from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import CalibrationError
from faintfield.calib.estimate import Estimate
from faintfield.calib.noise import NoiseCalibration, Series, SeriesSums, calibrate
from faintfield.pipelines.calibration.noise_emva import EmvaMeasurement, measure_emva
from faintfield.pipelines.console import progress, working
from faintfield.pipelines.errors import BadValue, UnreadableImage, WrongSize
from faintfield.pipelines.formats.frames import Frame, at_phase, mosaic_period, read_ahead, read_frame
from faintfield.pipelines.formats.sets.noise_set import FrameSeries, NoiseSet, Region

# Black levels of masked pixels and of covered ones differ by less in a sound camera.
_BLACK_TOLERANCE_DN = 2.0


@dataclass(frozen=True)
class MosaicPhase:
    """The statistics of one phase of the colour filter mosaic; of the whole sensor when there are no filters.

    `phase` and `period` are row and column of its first pixel, and the distance to the next; `black_dn` the black level
    stated in each dark's file, from the sensor's masked pixels where it has any.
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


class Lattice(NamedTuple):
    """Places of a phase's pixels on the sensor: row and column of the first, and the distance to the next, in px."""

    first: tuple[int, int]
    period: tuple[int, int]


@dataclass(frozen=True)
class Readout:
    """All frames of a noise set, reduced: their width and height, the region that was used, and its phases.

    `saturation_dn` is as stated in `noise.toml`, else by the file, else the last value of the files' type.
    """

    size_px: tuple[int, int]
    rows: slice
    columns: slice
    mosaic: tuple[str, ...] | None
    saturation_dn: float
    phases: list[MosaicPhase]

    @property
    def lattices(self) -> list[Lattice]:
        """Places of the pixels of each phase."""
        top, left = self.rows.start, self.columns.start
        return [Lattice((top + phase.phase[0], left + phase.phase[1]), phase.period) for phase in self.phases]


@dataclass(frozen=True)
class SensorCalibration:
    """A sensor's frames, and for each phase of its mosaic the calibration with the quantities of EMVA 1288."""

    frames: FrameSeries
    readout: Readout
    phases: list[EmvaMeasurement]


def calibrate_sensor(frames: FrameSeries) -> SensorCalibration:
    """Read the frames of a noise set and calibrate every phase of the mosaic.

    Raises
    ------
    InputError, CalibrationError
        A frame cannot be used, or the frames do not determine the noise; the message says what to record.
    """
    readout = _read_frames(frames)
    with working("fitting noise and response"):
        calibrations = [_calibrate_phase(phase, readout.saturation_dn) for phase in readout.phases]
    phases = [
        measure_emva(phase.name, phase.series, calibration, frames.temperature_c)
        for phase, calibration in zip(readout.phases, calibrations, strict=True)
    ]
    return SensorCalibration(frames, readout, phases)


def _read_frames(frames: FrameSeries) -> Readout:
    """Read every frame once, a few ahead of their turn, and reduce it."""
    queue = [(conditions, path) for conditions, paths in frames.series.items() for path in paths]
    sums: list[SeriesSums] = []
    read = read_ahead(queue, lambda entry: read_frame(entry[1]))
    for index, ((conditions, path), frame) in enumerate(progress(read, "reading frames", len(queue))):
        if index == 0:
            readout = _layout(frame, path, frames.settings)
        if index == 0 or conditions != queue[index - 1][0]:
            sums = [SeriesSums(conditions, readout.saturation_dn) for _ in readout.phases]
        pixels = _pixels_of(frame, path, readout.size_px)[readout.rows, readout.columns]
        for phase, phase_sums in zip(readout.phases, sums, strict=True):
            phase_sums.add(str(path), phase.of(pixels))
            if conditions.kind == "dark" and frame.black_dn is not None:
                phase.black_dn.append(float(frame.black_dn[phase.phase]))
            if index + 1 == len(queue) or conditions != queue[index + 1][0]:
                phase.series.append(phase_sums.series())
    return readout


def _layout(frame: Frame, path: Path, settings: NoiseSet) -> Readout:
    """Return how the frames are read out, without their statistics, by the first of them."""
    height, width = _pixels_of(frame, path).shape
    mosaic = settings.mosaic or frame.mosaic
    period = mosaic_period(mosaic)
    rows, columns = _slices(settings.region, (height, width), period)
    phases = [MosaicPhase((r, c), period, "" if mosaic is None else mosaic[r][c]) for r, c in np.ndindex(*period)]
    last_dn = float(np.iinfo(frame.pixels_dn.dtype).max)
    if settings.saturation_dn and settings.saturation_dn > last_dn:
        raise BadValue(
            f"saturation_dn = {settings.saturation_dn:g}; the {frame.pixels_dn.dtype} values of {path} end at "
            f"{last_dn:g}; state the value from which the converter saturates, or leave it out"
        )
    saturation_dn = settings.saturation_dn or frame.saturation_dn or last_dn
    return Readout((width, height), rows, columns, mosaic, saturation_dn, phases)


def _slices(region: Region | None, shape: tuple[int, int], period: tuple[int, int]) -> tuple[slice, slice]:
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


def _pixels_of(frame: Frame, path: Path, size_px: tuple[int, int] | None = None) -> NDArray[np.integer]:
    """Return the values of a frame (row, column), which are whole numbers, and as many as in the others."""
    if frame.pixels_dn.ndim != 2 or not np.issubdtype(frame.pixels_dn.dtype, np.integer):
        raise UnreadableImage(
            f"{path}: holds {frame.pixels_dn.dtype} of shape {frame.pixels_dn.shape}; the noise of a sensor shows "
            "only in whole digital numbers, one per pixel: give raw files or grey frames, not photographs"
        )
    height, width = frame.pixels_dn.shape
    if size_px not in (None, (width, height)):
        raise WrongSize(
            f"{path}: is {width} x {height} px, the other frames {size_px[0]} x {size_px[1]} px; record it again with "
            "the same region of interest and binning, or leave it out"
        )
    return frame.pixels_dn


def _calibrate_phase(phase: MosaicPhase, saturation_dn: float) -> NoiseCalibration:
    """Calibrate one phase of the mosaic; its name goes into its failures."""
    prefix = f"plane {phase.name}: " if phase.name else ""
    try:
        calibration = calibrate(phase.series, saturation_dn)
    except CalibrationError as failure:
        raise type(failure)(f"{prefix}{failure}") from failure
    warnings = [*calibration.warnings, *_black_level_warnings(phase, calibration.estimates["offset_dn"])]
    estimates = calibration.estimates
    if why := _why_impossible(estimates["quantum_efficiency"]):
        estimates = estimates | {"quantum_efficiency": Estimate(None, why=why)}
        warnings.append(why)
    return replace(calibration, estimates=estimates, warnings=tuple(warnings))


def _why_impossible(efficiency: Estimate) -> str:
    """Return why a quantum efficiency that is certainly above 100 % cannot be, "" for any other."""
    if efficiency.value is None or efficiency.ci95 is None or efficiency.ci95[0] <= 1.0:
        return ""
    return (
        f"the flats hold {efficiency.value:.4g} electrons per stated photon (95 %: {efficiency.ci95[0]:.4g} to "
        f"{efficiency.ci95[1]:.4g}; limit 1): the photons, or the pixel area that they were computed with, are wrong, "
        "or the light is not the one that was measured; correct `photons` (the mean per pixel and exposure)"
    )


def _black_level_warnings(phase: MosaicPhase, offset: Estimate) -> list[str]:
    """Return a warning where masked pixels and covered ones disagree on the black level."""
    if not phase.black_dn or offset.value is None:
        return []
    black_dn = sum(phase.black_dn) / len(phase.black_dn)
    if abs(offset.value - black_dn) <= _BLACK_TOLERANCE_DN + 3 * (offset.se or 0.0):
        return []
    return [
        f"the darks' offset is {offset.value:.1f} DN, the black level stated in the files {black_dn:.1f} DN (at most "
        f"{_BLACK_TOLERANCE_DN:g} DN apart is usual); the lens was not quite covered, or the amplifier glows"
    ]
