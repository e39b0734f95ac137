"""Knowledge of a rig before a capture: its sensor, its lens, the light of the scene, and how fast it is."""

import math
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate
from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.pipelines.formats.results.geometry import CameraPoses, read_geometry
from faintfield.pipelines.formats.results.noise import NOISE_MAPS, NoiseRecord, read_fitted_noise, read_maps, read_noise
from faintfield.pipelines.planning.options import PlanOptions
from faintfield.recon.prediction import interpolation, interpolation_at
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import RigError
from faintfield.rig.plan import Grid, centre_node, grid_nodes
from faintfield.rig.session.session import FRAMES, has_session, taken_frames
from faintfield.rig.settings import RigSettings
from faintfield.rig.simulation.lab import lab_experiment
from faintfield.rig.stages.motion import StageWorkspace
from faintfield.rig.stages.protocol import MotionLimits

# The response of a view is that of the pixels this near to where it sees a sample.
_NEAR_PX = 4

# Two-sided 95 % of the normal distribution.
_Z95 = 1.96

# Largest part of saturated pixels whose light is still that of the others.
_MAX_SATURATED = 0.01

# The middle of a flat reaches to either side by the frame's larger side over this.
_MIDDLE_DIVISOR = 20

# What is known of a sensor, by the names of `Sensor` and of records of noise.
_NUMBERS = ("read_noise_e", "dark_current_e_per_s", "gain_dn_per_e", "quantum_efficiency")

_NOT_MEASURED = "no noise calibration; give the result of `faintfield noise` as --noise, or --read-noise-e"

# Its objects take a while to draw.
_simulated_experiment = lru_cache(maxsize=1)(lab_experiment)


@dataclass(frozen=True)
class Sensor:
    """Numbers of a sensor's noise, their `source` in words, and the calibration or the simulated camera's model."""

    source: str
    read_noise_e: Estimate
    dark_current_e_per_s: Estimate
    gain_dn_per_e: Estimate
    quantum_efficiency: Estimate
    record: NoiseRecord | None = None
    path: Path | None = None
    model: NoiseModel | None = None

    def offset_dn(self) -> float | None:
        """Return the mean or median offset in DN, None if it is not known."""
        if self.model is not None:
            return float(np.median(self.model.offset_dn))
        return None if self.record is None else self.record.offset_dn.value


def pixel_share(settings: RigSettings, sensor: Sensor) -> float:
    """Return the part of the pixels that have the scarcest colour."""
    measured = sensor.record.mosaic if sensor.record is not None else None
    filters = "".join(settings.mosaic or measured or "X")
    return min(filters.count(letter) for letter in filters) / len(filters)


def grid_centres_mm(grid: Grid) -> NDArray[np.float64]:
    """Return the places (view, 2) of the cameras of a grid relative to the reference camera, right and down."""
    nodes = np.array(grid_nodes(grid.rows, grid.columns)) - centre_node(grid.rows, grid.columns)
    return np.asarray(grid.pitch_mm * nodes[:, ::-1], np.float64)


def known_sensor(settings: RigSettings, noise: Path | None, **options: float | None) -> Sensor:
    """Return the sensor by `options`, named as attributes of `Sensor`, else measured (`noise`), else simulated."""
    record = model = None
    if noise is not None:
        source, record = str(noise), read_noise(noise)
        numbers = {name: getattr(record, name) for name in _NUMBERS}
        if record.quantum_efficiency is None:
            numbers["quantum_efficiency"] = Estimate(None, why="not stated")
    elif isinstance(settings.camera, SimulatedSettings):
        source, sensor = "the simulated camera", _simulated_experiment(settings.camera).sensor
        numbers = {name: getattr(sensor, name) for name in _NUMBERS}
        model = NoiseModel(sensor.offset_dn, saturation_dn=sensor.saturation_dn, **numbers)
    else:
        source, numbers = "no calibration", dict.fromkeys(_NUMBERS, Estimate(None, why=_NOT_MEASURED))
    stated = {name: value for name, value in options.items() if value is not None}
    known: dict[str, Any] = {
        name: value if isinstance(value, Estimate) else Estimate(value) for name, value in (numbers | stated).items()
    }
    return Sensor(f"options and {source}" if stated else source, **known, record=record, path=noise, model=model)


def view_noise_e(read_noise_e: float, gain_dn_per_e: float | None, frames: float) -> float:
    """Return the standard deviation of read noise and of rounding to DN in the sum of so many frames, in electrons."""
    rounding_e2 = 0.0 if gain_dn_per_e is None else 1 / (12 * gain_dn_per_e**2)
    return math.sqrt(frames * (read_noise_e**2 + rounding_e2))


class SeenSample(NamedTuple):
    """Response of each view (view,) where it sees the middle of the reference view, and the `interpolation` of all."""

    response: NDArray[np.float64]
    spread: float


@dataclass(frozen=True)
class KnownLens:
    """Focal length, width and height of a frame, the point where the axis meets it, and the relative response.

    `position_error_mm` and `rotation_error_rad` are standard deviations of the camera's pose, None if not known: then
    pixels of the views lie on all places between the samples.
    """

    f_px: Estimate
    size_px: tuple[int, int] | None
    centre_px: tuple[float, float] | None
    response: NDArray[np.floating] | None
    position_error_mm: float | None = None
    rotation_error_rad: float | None = None

    def sample(self, centres_mm: NDArray[np.float64], depth_mm: float | None) -> SeenSample:
        """Return how the views see the middle of the reference view; the response is 0 where they do not.

        `centres_mm` (view, 2) are the cameras relative to the reference camera, right and down.
        Without a depth, a lens or a response all views see it, or see it equally well.
        """
        responses = np.ones(len(centres_mm))
        if depth_mm is None or self.f_px.value is None or self.size_px is None or self.centre_px is None:
            return SeenSample(responses, interpolation(len(responses)))
        shifts_px = self.f_px.value / depth_mm * centres_mm
        places = np.rint(np.array(self.centre_px) - shifts_px).astype(int)
        responses[((places < 0) | (places >= self.size_px)).any(axis=1)] = 0
        if self.response is not None:
            axis = _mean_around(self.response, *np.rint(self.centre_px).astype(int).tolist())
            for view in np.flatnonzero(responses):
                responses[view] = _mean_around(self.response, *places[view].tolist()) / axis
        seeing = responses > 0
        if self.position_error_mm is None or self.rotation_error_rad is None:
            return SeenSample(responses, interpolation(int(np.count_nonzero(seeing))))
        error_px = self.f_px.value * math.hypot(self.position_error_mm / depth_mm, self.rotation_error_rad)
        return SeenSample(responses, interpolation_at(shifts_px[seeing], error_px))


def fewest_seen(samples: Sequence[SeenSample]) -> SeenSample:
    """Return the sample that the fewest views see, weighted by their response."""
    return min(samples, key=lambda sample: float(np.square(sample.response).sum()))


def _mean_around(response: NDArray[np.floating], column: int, row: int) -> float:
    rows, columns = (slice(max(middle - _NEAR_PX, 0), middle + _NEAR_PX + 1) for middle in (row, column))
    return float(response[rows, columns].mean())


def known_lens(settings: RigSettings, sensor: Sensor, geometry: Path | None, fx_px: float | None) -> KnownLens:
    """Return the lens as stated (`fx_px`), else measured (`geometry`, a geometry.json), else simulated."""
    camera = settings.camera
    simulated = _simulated_experiment(camera).optics if isinstance(camera, SimulatedSettings) else None
    size_px = sensor.record.size_px if sensor.record is not None else None
    centre_px = None
    f_px = Estimate(None, why="no focal length; give --fx-px, or the result of `faintfield geometry` as --geometry")
    lens = simulated if geometry is None else read_geometry(geometry, CameraPoses).camera_lens()
    if lens is not None:
        size_px, centre_px, f_px = lens.size_px, (lens.cx_px, lens.cy_px), Estimate(lens.fx_px)
    if fx_px is not None:
        f_px = Estimate(fx_px)
    if centre_px is None and size_px is not None:
        centre_px = (size_px[0] - 1) / 2, (size_px[1] - 1) / 2
    response: NDArray[np.floating] | None = None
    if sensor.path is not None and sensor.record is not None and size_px is not None:
        maps = read_maps(sensor.path.with_name(NOISE_MAPS), sensor.record, size_px[::-1], ("relative_response",))
        response = maps.get("relative_response")
    elif simulated is not None:
        response = simulated.relative_illumination()
    if geometry is not None or not isinstance(camera, SimulatedSettings):
        return KnownLens(f_px, size_px, centre_px, response)
    return KnownLens(
        *(f_px, size_px, centre_px, response),
        position_error_mm=camera.position_error_mm,
        rotation_error_rad=1e-3 * camera.rotation_error_mrad,
    )


@dataclass(frozen=True)
class Light:
    """Light of the scene in electrons per pixel and second, and where it is from."""

    e_per_s: Estimate
    source: str


def planned_light(options: PlanOptions, exposure_s: float, sensor: Sensor) -> Light:
    """Return the light of the scene: as stated, in a frame of `exposure_s` or per second, or measured in a frame.

    Raises WrongUsage if not exactly one of these is given, BadValue if the frame shows no light to be measured.
    """
    per_frame_e, per_s, path = options.light_e, options.light_e_per_s, options.flat or options.test_frame
    count = sum(value is not None for value in (per_frame_e, per_s, options.flat, options.test_frame))
    if count != 1:
        raise WrongUsage(
            f"{count} lights are given, and one is wanted; give --light-e, --light-e-per-s, --flat or --test-frame"
        )
    if path is not None:
        return _light_of_frame(path, options, sensor)
    if (options.frame_exposure_ms, options.region_px) != (None, None):
        raise WrongUsage("--frame-exposure-ms and --region-px are those of a frame; give --test-frame or --flat")
    return Light(Estimate(per_s if per_frame_e is None else per_frame_e / exposure_s), "as stated")


def _light_of_frame(path: Path, options: PlanOptions, sensor: Sensor) -> Light:
    """Return the light of a frame, with its interval: by the noise of its pixels, and by that of the calibration."""
    frame = read_frame(path)
    stated_ms = options.frame_exposure_ms
    exposure_s = _exposure_in_session(path) or frame.exposure_s if stated_ms is None else 1e-3 * stated_ms
    if exposure_s is None:
        raise BadValue(f"{path}: states no exposure time; give --frame-exposure-ms")
    if frame.pixels_dn.ndim != 2:
        raise BadValue(f"{path}: is a colour picture; give a grey or raw frame as the sensor counts it")
    height, width = frame.pixels_dn.shape
    if sensor.model is not None:
        model, unusable = sensor.model, np.zeros((height, width), bool)
    elif sensor.path is not None:
        fitted = read_fitted_noise(sensor.path, (width, height))
        model, unusable = fitted.model, fitted.unusable
    else:
        raise BadValue(
            f"{path}: its DN tell no electrons, as there is no noise calibration; give the result of `faintfield "
            "noise` as --noise, or the light as --light-e"
        )
    where = _region(path, options, width, height)
    usable = ~unusable[where]
    saturated = model.saturated(frame.pixels_dn)[where] & usable
    if not usable.any() or saturated.sum() > _MAX_SATURATED * usable.sum():
        raise BadValue(
            f"{path}: {saturated.sum()} of {usable.sum()} usable pixels are saturated, at most "
            f"{_MAX_SATURATED:.0%} may be; expose it for less than {1e3 * exposure_s:g} ms"
        )
    usable &= ~saturated
    count = int(usable.sum())
    dark_e = np.broadcast_to(model.background_e(exposure_s), frame.pixels_dn.shape)[where][usable]
    electrons = model.electrons(frame.pixels_dn)[where][usable]
    light_e = float(np.mean(electrons, dtype=np.float64) - np.mean(dark_e))
    known_e2 = float(np.mean(dark_e) + np.mean(model.read_variance_e2()))
    variance_e2 = (max(light_e, 0.0) + known_e2) / count + _variance_of_calibration(sensor, light_e, exposure_s)
    margin_e = _Z95 * variance_e2**0.5
    low_e, high_e = light_e - margin_e, light_e + margin_e
    if low_e <= 0:
        raise BadValue(
            f"{path}: shows {light_e:.3g} e⁻ per pixel (95 %: {low_e:.3g} to {high_e:.3g}), which may be none; "
            f"expose it for longer than {1e3 * exposure_s:g} ms"
        )
    part = "its middle" if options.flat is not None and options.region_px is None else f"{count} pixels"
    exact = "" if sensor.record is not None else ", the sensor's numbers taken as exact"
    source = f"{path.name}, {1e3 * exposure_s:g} ms, mean of {part}{exact}"
    ends = low_e / exposure_s, high_e / exposure_s
    return Light(Estimate(light_e / exposure_s, margin_e / _Z95 / exposure_s, ends), source)


def _exposure_in_session(path: Path) -> float | None:
    """Return the exposure of a frame by the plan of its session; None for a file that is no frame of one."""
    folder = path.absolute().parent
    if folder.name != FRAMES or not has_session(folder.parent):
        return None
    exposures_s = {taken.file: frame.exposure_s for frame, taken, _ in taken_frames(folder.parent)}
    return exposures_s.get(path.name)


def _region(path: Path, options: PlanOptions, width: int, height: int) -> tuple[slice, slice]:
    if options.region_px is not None:
        left, upper, wide, high = options.region_px
        if min(left, upper) < 0 or min(wide, high) < 1 or left + wide > width or upper + high > height:
            raise BadValue(
                f"{path}: --region-px {left} {upper} {wide} {high} is not within its {width} x {height} px; give left "
                "column, upper row, width and height"
            )
        return slice(upper, upper + high), slice(left, left + wide)
    if options.flat is None:
        return slice(None), slice(None)
    near = max(width, height) // _MIDDLE_DIVISOR + 1
    row, column = height // 2, width // 2
    return slice(max(row - near, 0), row + near), slice(max(column - near, 0), column + near)


def _variance_of_calibration(sensor: Sensor, light_e: float, exposure_s: float) -> float:
    """Return the variance in (e⁻)² of a mean `(dn − offset)/gain − D t` by its calibration, with the frame's jitter."""
    record, gain = sensor.record, sensor.gain_dn_per_e.value
    if record is None or gain is None:
        return 0.0
    charge_e = light_e + (record.dark_current_e_per_s.value or 0.0) * exposure_s
    slopes = {"offset_dn": -1 / gain, "gain_dn_per_e": -charge_e / gain, "dark_current_e_per_s": -exposure_s}
    jitter_e = (record.frame_jitter_dn.value or 0.0) / gain
    names = record.covariance.names
    if slopes.keys() <= {*names}:
        slope = np.array([slopes.get(name, 0.0) for name in names])
        return float(slope @ np.array(record.covariance.matrix) @ slope) + jitter_e**2
    errors = [slope * (getattr(record, name).se or 0.0) for name, slope in slopes.items()]
    return float(np.square(errors).sum()) + jitter_e**2


@dataclass(frozen=True)
class KnownPace:
    """Limits, feed and allowed positions of the stage, and the readout of the camera."""

    motion: MotionLimits
    feed_mm_per_s: float
    readout_s: float
    workspace: StageWorkspace


def known_pace(settings: RigSettings) -> KnownPace | str:
    """Ask stage and camera, which do nothing; return why it is not known if they do not answer."""
    try:
        rig = open_rig(settings)
        try:
            rig.stage.connect()
            rig.camera.open()
            readout_s = rig.camera.report().readout_s
            motion = rig.stage.identify().motion
            return KnownPace(motion, rig.stage.feed_mm_per_s(), readout_s, rig.stage.workspace())
        finally:
            rig.camera.close()
            rig.stage.close()
    except RigError as failure:
        return str(failure)


def calibration_file(path: Path | None, name: str, *folders: Path) -> Path | None:
    """Return the file of a calibration: `path` or the file in that folder; else the first that lies in `folders`."""
    if path is not None:
        return path / name if is_folder(path) else path
    return next((folder / name for folder in folders if is_file(folder / name)), None)
