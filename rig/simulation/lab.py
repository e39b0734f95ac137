"""The simulated lab and its camera: renders what the camera sees in each step, from the true position of the stage."""

import math
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property, lru_cache

import numpy as np
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import CameraReport, Exposure
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.clock import Clock
from faintfield.rig.errors import CameraError, LightError
from faintfield.rig.plan import StepKind
from faintfield.rig.settings import BoardSettings
from faintfield.rig.simulation.boards import standing_board
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from faintfield.rig.simulation.optics import through_mosaic
from faintfield.rig.simulation.scene import TexturedPlane, render
from faintfield.rig.stages.protocol import Point

# Bent rails and eccentric pulleys: number of waves over the travel, and the range of their lengths in mm.
_WAVES, _WAVE_LENGTHS_MM = 8, (80.0, 400.0)


@lru_cache(maxsize=1)
def _rail_waves(seed: int) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Return the wave vectors' x and y and the phases of the errors of the rails, each (6, wave)."""
    generator = np.random.default_rng([seed, 1])
    direction, phase = generator.uniform(0.0, 2.0 * np.pi, (2, 6, _WAVES))
    per_mm = 2.0 * np.pi / generator.uniform(*_WAVE_LENGTHS_MM, (6, _WAVES))
    return per_mm * np.cos(direction), per_mm * np.sin(direction), phase


def _rail_errors(seed: int, x_mm: float, y_mm: float) -> NDArray[np.float64]:
    """Return the errors (6,) of the rails; the difference of two distant positions has variance 1."""
    x_per_mm, y_per_mm, phase = _rail_waves(seed)
    return np.asarray(np.sin(x_per_mm * x_mm + y_per_mm * y_mm + phase).sum(axis=1) / np.sqrt(_WAVES))


def _carriage_pose(settings: SimulatedSettings, right_mm: float, down_mm: float) -> NDArray[np.float64]:
    """Return the camera pose (6,) at a motor position relative to the centre, where it is without error."""
    sd = np.repeat([settings.rotation_error_mrad * 1e-3, settings.position_error_mm], 3)
    pose: NDArray[np.float64] = sd * (
        _rail_errors(settings.seed, right_mm, down_mm) - _rail_errors(settings.seed, 0.0, 0.0)
    )
    right_mm = right_mm * (1.0 + settings.scale_error) + down_mm * np.sin(settings.squareness_mrad * 1e-3)
    down_mm *= np.cos(settings.squareness_mrad * 1e-3)
    # A camera moved right and down by c maps reference points by −c
    pose[3:5] -= right_mm, down_mm
    return pose


# Light of a flat relative to that of a white object.
_FLAT = 0.5

# After a stop the carriage swings along both axes, as an undamped gantry does: amplitude, frequency, decay time.
_SWING_MM, _SWING_HZ, _SWING_DECAY_S = 1.5, 7.0, 0.25
# Nothing swings after this time in s.
_AT_REST_S = 60.0

# Lights of the lab that the rig may switch: two as bright as what a person turns on, the faint one, and a shutter.
_BRIGHT, _FAINT, _SHUTTER = {"room", "board"}, "scene", "shutter"


@dataclass(eq=False)
class SimulatedLab:
    """Scene, light and sensor around a simulated stage, whose position of the reference pose is `centre`.

    The callables return the true position of the carriages, and the time since they stopped. `lights` tell for each
    light that the rig switches whether it is on; a person sees to the light only if there is none but the shutter, and
    otherwise leaves the objects where they are.
    """

    centre: Point
    true_position: Callable[[], Point]
    still_s: Callable[[], float]
    boards: tuple[BoardSettings, ...]
    settings: SimulatedSettings
    lights: Mapping[str, Callable[[], bool]] = field(default_factory=dict)
    _planes: tuple[TexturedPlane, ...] = ()
    _photons_per_s: float = 0.0
    _flat: bool = False

    @cached_property
    def experiment(self) -> SimulatedExperiment:
        """The objects and the camera."""
        return lab_experiment(self.settings)

    @cached_property
    def _illumination(self) -> NDArray[np.float32]:
        return self.experiment.optics.relative_illumination()

    def arrange(self, kind: StepKind, sweep: int) -> None:
        """Do what a person does at the beginning of a step: objects or boards, light, lens cap."""
        self._planes = ()
        if kind == "charuco":
            optics = self.experiment.optics
            self._planes = tuple(standing_board(board, sweep, at, optics) for at, board in enumerate(self.boards))
        elif kind in ("bright", "dark_scene") or (self._switches_lamps and kind != "flat"):
            self._planes = self.experiment.planes
        lit, unlit = self.settings.lit_photons_per_s, self.settings.unlit_photons_per_s
        self._photons_per_s = unlit if kind == "dark_scene" else lit
        self._flat = kind == "flat"

    @property
    def _switches_lamps(self) -> bool:
        return bool(self.lights.keys() & {*_BRIGHT, _FAINT})

    def lights_on(self) -> tuple[str, ...]:
        """Return the names of the lights that are on."""
        return tuple(name for name in sorted(self.lights) if self.lights[name]())

    def photons_per_s(self) -> float:
        """Return the photons on a pixel that sees a white object now."""
        on = set(self.lights_on())
        if _SHUTTER in self.lights and _SHUTTER not in on:
            return 0.0
        if not self._switches_lamps:
            return self._photons_per_s
        return len(on & _BRIGHT) * self.settings.lit_photons_per_s + (_FAINT in on) * self.settings.unlit_photons_per_s

    def expose(self, exposure_s: float, number: int) -> NDArray[np.uint16]:
        """Return a frame (row, column) in DN, taken now; its noise depends only on its number and the seed."""
        light: NDArray[np.floating] = np.zeros_like(self._illumination)
        if self._flat:
            light = _FLAT * self._illumination
        elif self._planes:
            pose = self.rt_cam_ref(exposure_s)[np.newaxis]
            light = next(render(self._planes, self.experiment.optics, pose, samples_per_px=1)).light
            if light.ndim == 3 and self.settings.mosaic is not None:
                light = through_mosaic(light, self.settings.mosaic)
        generator = np.random.default_rng([self.settings.seed, number])
        return self.experiment.sensor.expose(light * self.photons_per_s() * exposure_s, exposure_s, generator)

    def rt_cam_ref(self, exposure_s: float) -> NDArray[np.float64]:
        """Return the true pose (6,) in the middle of an exposure that begins now, including the swing."""
        x_mm, y_mm = self.true_position()
        after_s = min(self.still_s(), _AT_REST_S) + 0.5 * exposure_s  # infinite before the first motion
        swing_mm = _SWING_MM * math.exp(-after_s / _SWING_DECAY_S) * math.cos(2.0 * math.pi * _SWING_HZ * after_s)
        right_mm, down_mm = x_mm + swing_mm - self.centre.x_mm, y_mm + swing_mm - self.centre.y_mm
        return _carriage_pose(self.settings, right_mm, down_mm)


def flat_photons_per_s(settings: SimulatedSettings) -> float:
    """Return the mean light of a flat over the detector, in photons per pixel and second."""
    illumination = lab_experiment(settings).optics.relative_illumination()
    return float(_FLAT * settings.lit_photons_per_s * illumination.mean(dtype=np.float64))


def lab_experiment(settings: SimulatedSettings) -> SimulatedExperiment:
    """Return the objects and the camera of a simulated lab."""
    paper = paper_experiment(*settings.size_px)
    sensor = replace(
        paper.sensor,
        read_noise_e=settings.read_noise_e,
        gain_dn_per_e=settings.gain_dn_per_e,
        saturation_dn=settings.saturation_dn,
    )
    experiment = replace(paper, sensor=sensor)
    return experiment if settings.mosaic else experiment.grey()


# Temperature of a sensor whose cooling is not simulated, and the set point of one whose is, unless it is stated.
SET_POINT_C = -20.0

# What the cooler's control leaves: three waves of this amplitude, and the range of their periods.
_RIPPLE_K, _RIPPLES, _PERIODS_S = 0.03, 3, (40.0, 200.0)


class Cooling:
    """The temperature of a sensor that is `start_c` at time 0, and swings a little about the set point in the end.

    The distance from it falls to 1/e in `time_s`. Without a start it stays at the set point, without any ripple.
    """

    def __init__(self, start_c: float | None, set_point_c: float, time_s: float, seed: int) -> None:
        self._start_c = start_c
        self._set_point_c = set_point_c
        self._time_s = time_s
        generator = np.random.default_rng([seed, 2])
        self._per_s = 2.0 * np.pi / generator.uniform(*_PERIODS_S, _RIPPLES)
        self._phase = generator.uniform(0.0, 2.0 * np.pi, _RIPPLES)

    def temperature_c(self, after_s: float) -> float:
        """Return the temperature at a time after the camera was switched on."""
        if self._start_c is None:
            return self._set_point_c
        ripple_k = _RIPPLE_K * float(np.sin(self._per_s * after_s + self._phase).sum())
        return self._set_point_c + (self._start_c - self._set_point_c) * math.exp(-after_s / self._time_s) + ripple_k


# Keys of the true pose in a frame's metadata, and of the lights that were on, separated by commas.
TRUE_POSE, TRUE_LIGHTS = "true_rt_cam_ref", "true_lights"

# Time to read a frame.
_READOUT_S = 0.05

# Upper estimate of what a TIFF file holds besides its pixels.
_TIFF_HEADER_BYTES = 512


class SimulatedCamera:
    """A `Camera` that renders the frames of a lab; exposures take simulated time."""

    def __init__(self, settings: SimulatedSettings, clock: Clock, lab: SimulatedLab) -> None:
        self._settings = settings
        self._clock = clock
        self._lab = lab
        self._open = False
        set_point_c = SET_POINT_C if settings.settle_temperature_c is None else settings.settle_temperature_c
        self._cooling = Cooling(settings.start_temperature_c, set_point_c, settings.cooling_s, settings.seed)
        self._switched_on_s: float | None = None

    def open(self) -> None:
        """Connect; the cooler starts when this is done first."""
        self._open = True
        if self._switched_on_s is None:
            self._switched_on_s = self._clock.now_s()

    def report(self) -> CameraReport:
        """Return the size of a frame."""
        self._require_open()
        width, height = self._settings.size_px
        return CameraReport("simulated camera", 2 * width * height + _TIFF_HEADER_BYTES, readout_s=_READOUT_S)

    def expose(self, exposure_s: float, number: int) -> Exposure:
        """Render the scene from the camera's pose at the beginning of the exposure."""
        self._require_open()
        temperature_c = self.temperature_c()
        truth: dict[str, str | list[float]] = {TRUE_POSE: [float(value) for value in self._lab.rt_cam_ref(exposure_s)]}
        before = self._lab.lights_on()
        pixels = self._lab.expose(exposure_s, number)
        self._clock.sleep_s(exposure_s)
        if self._lab.lights:
            truth[TRUE_LIGHTS] = " then ".join(",".join(on) for on in dict.fromkeys((before, self._lab.lights_on())))
        self._clock.sleep_s(_READOUT_S)
        return Exposure(
            ".tiff",
            pixels=pixels,
            metadata={"camera": "simulated camera", "temperature_c": temperature_c, **truth},
        )

    def temperature_c(self) -> float:
        """Return the temperature of the sensor in °C."""
        self._require_open()
        return self._cooling.temperature_c(self._clock.now_s() - (self._switched_on_s or 0.0))

    def close(self) -> None:
        """Disconnect."""
        self._open = False

    def _require_open(self) -> None:
        if not self._open:
            raise CameraError("the camera is not connected; open it first")


class SimulatedLight:
    """A `Light` of the lab, with faults: it answers nothing (`broken`), or reports what it does not do.

    That is a lamp which is `burnt_out`, or a shutter which is `stuck_open`.
    """

    def __init__(self, name: str) -> None:
        self._name = name
        self._open = self._switched_on = False
        self.broken = self.burnt_out = self.stuck_open = False

    @property
    def shines(self) -> bool:
        """Return whether there is light, whatever the lamp reports."""
        return (self._switched_on or self.stuck_open) and not self.burnt_out

    def open(self) -> None:
        """Connect."""
        self._open = True

    def switch(self, on: bool, /) -> None:
        """Switch the light."""
        self._require_answer()
        self._switched_on = on

    def is_on(self) -> bool:
        """Return whether the light was switched on."""
        self._require_answer()
        return self._switched_on

    def close(self) -> None:
        """Disconnect."""
        self._open = False

    def _require_answer(self) -> None:
        if not self._open or self.broken:
            state = "does not answer; check its cable" if self._open else "is not open; open it first"
            raise LightError(f"light {self._name}: {state}")
