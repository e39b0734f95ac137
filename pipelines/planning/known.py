"""Knowledge of a rig before a capture: its sensor, its lens, and how fast it is."""

from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.pipelines.formats.results.geometry import CameraPoses, read_geometry
from faintfield.pipelines.formats.results.noise import NOISE_MAPS, NoiseRecord, read_maps, read_noise
from faintfield.pipelines.formats.results.noise_fit import Measured
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import RigError
from faintfield.rig.settings import RigSettings
from faintfield.rig.simulation.lab import lab_experiment
from faintfield.rig.stages.motion import StageWorkspace
from faintfield.rig.stages.protocol import MotionLimits

# The response of a view is that of the pixels this near to where it sees a sample.
_NEAR_PX = 4

_NOT_MEASURED = "no noise calibration; give the result of `faintfield noise` as --noise, or --read-noise-e"

# Its objects take a while to draw.
_simulated_experiment = lru_cache(maxsize=1)(lab_experiment)


@dataclass(frozen=True)
class Sensor:
    """Knowledge of the noise.

    Attributes
    ----------
    source : str
        Its source, in words.
    record, path : NoiseRecord and Path, optional
        The calibration that it is from, and its file.
    model : NoiseModel, optional
        Noise model of a simulated camera.
    """

    source: str
    read_noise_e: Measured
    dark_current_e_per_s: Measured
    gain_dn_per_e: Measured
    quantum_efficiency: Measured
    record: NoiseRecord | None = None
    path: Path | None = None
    model: NoiseModel | None = None


def known_sensor(settings: RigSettings, noise: Path | None, **options: float | None) -> Sensor:
    """Return what is known of the sensor: `options`, else measured (`noise`, a noise.json), else simulated.

    `options` are named as attributes of `Sensor`.

    Raises
    ------
    MissingFile, BadValue
        noise.json cannot be read.
    """
    if noise is not None:
        sensor = _measured_sensor(noise)
    elif isinstance(settings.camera, SimulatedSettings):
        sensor = _simulated_sensor(settings.camera)
    else:
        unknown = Measured(None, why=_NOT_MEASURED)
        sensor = Sensor("no calibration", unknown, unknown, unknown, unknown)
    numbers: dict[str, Any] = {name: Measured(value) for name, value in options.items() if value is not None}
    return replace(sensor, source=f"options and {sensor.source}", **numbers) if numbers else sensor


def _measured_sensor(path: Path) -> Sensor:
    record = read_noise(path)
    efficiency = record.quantum_efficiency
    if not isinstance(efficiency, Measured):  # a record holds it with or without its error
        efficiency = Measured(efficiency, why="not stated" if efficiency is None else None)
    return Sensor(
        str(path), record.read_noise_e, record.dark_current_e_per_s, record.gain_dn_per_e, efficiency, record, path
    )


def _simulated_sensor(settings: SimulatedSettings) -> Sensor:
    sensor = _simulated_experiment(settings).sensor
    names = ("read_noise_e", "dark_current_e_per_s", "gain_dn_per_e", "quantum_efficiency")
    numbers = {name: getattr(sensor, name) for name in names}
    model = NoiseModel(sensor.offset_dn, saturation_dn=sensor.saturation_dn, **numbers)
    measured: dict[str, Any] = {name: Measured(value) for name, value in numbers.items()}
    return Sensor("the simulated camera", **measured, model=model)


@dataclass(frozen=True)
class KnownLens:
    """Knowledge of the lens.

    Attributes
    ----------
    f_px : Measured
        Focal length in pixels.
    size_px : (int, int), optional
        Width and height of a frame.
    centre_px : (float, float), optional
        Point where the axis meets the detector.
    response : array (row, column), optional
        Relative response, vignetting included.
    """

    f_px: Measured
    size_px: tuple[int, int] | None
    centre_px: tuple[float, float] | None
    response: NDArray[np.floating] | None

    def responses(self, centres_mm: NDArray[np.float64], depth_mm: float | None) -> NDArray[np.float64]:
        """Return the response of each view (view,) where it sees the middle of the reference view; 0 if it does not.

        Without a depth, a lens or a response all views see it, or see it equally well.

        Parameters
        ----------
        centres_mm : array (view, 2)
            Positions of the cameras relative to the reference camera, right and down.
        depth_mm : float, optional
            Depth of the plane.
        """
        responses = np.ones(len(centres_mm))
        if depth_mm is None or self.f_px.value is None or self.size_px is None or self.centre_px is None:
            return responses
        places = np.rint(np.array(self.centre_px) - self.f_px.value / depth_mm * centres_mm).astype(int)
        responses[((places < 0) | (places >= self.size_px)).any(axis=1)] = 0
        if self.response is not None:
            axis = _mean_around(self.response, *np.rint(self.centre_px).astype(int).tolist())
            for view in np.flatnonzero(responses):
                responses[view] = _mean_around(self.response, *places[view].tolist()) / axis
        return responses


def _mean_around(response: NDArray[np.floating], column: int, row: int) -> float:
    rows, columns = (slice(max(middle - _NEAR_PX, 0), middle + _NEAR_PX + 1) for middle in (row, column))
    return float(response[rows, columns].mean())


def known_lens(settings: RigSettings, sensor: Sensor, geometry: Path | None, fx_px: float | None) -> KnownLens:
    """Return what is known of the lens: stated, else measured (`geometry`, a geometry.json), else simulated.

    Raises
    ------
    MissingFile, BadValue
        geometry.json or the maps beside noise.json cannot be read.
    """
    camera = settings.camera
    simulated = _simulated_experiment(camera).optics if isinstance(camera, SimulatedSettings) else None
    size_px = sensor.record.size_px if sensor.record is not None else None
    centre_px = None
    f_px = Measured(None, why="no focal length; give --fx-px, or the result of `faintfield geometry` as --geometry")
    lens = simulated if geometry is None else read_geometry(geometry, CameraPoses).camera_lens()
    if lens is not None:
        size_px, centre_px, f_px = lens.size_px, (lens.cx_px, lens.cy_px), Measured(lens.fx_px)
    if fx_px is not None:
        f_px = Measured(fx_px)
    if centre_px is None and size_px is not None:
        centre_px = (size_px[0] - 1) / 2, (size_px[1] - 1) / 2
    response: NDArray[np.floating] | None = None
    if sensor.path is not None and sensor.record is not None and size_px is not None:
        maps = read_maps(sensor.path.with_name(NOISE_MAPS), sensor.record, size_px[::-1], ("relative_response",))
        response = maps.get("relative_response")
    elif simulated is not None:
        response = simulated.relative_illumination()
    return KnownLens(f_px, size_px, centre_px, response)


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
