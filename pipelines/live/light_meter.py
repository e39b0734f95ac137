"""Light meter of the dark scene: the SNR and the light of a frame against those of `faintfield plan`."""

import math
import threading
from collections.abc import Callable

import numpy as np
from msgspec import Struct

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.planning.known import Sensor, view_noise_e
from faintfield.recon.metrics import expected_snr_from_powers
from faintfield.rig.capture.checks import PARTS
from faintfield.rig.capture.guide import ShownFrame

# Deviations from the plan within so many standard deviations are noise, and such a part of the light is of no matter.
_MIN_DEVIATIONS, _TOLERANCE = 3.0, 0.05


class LightReading(Struct, frozen=True):
    """SNR of the brightest part of a frame, and the light there in electrons per pixel, with their σ, and the plan's.

    What is not known is None. `advice` says in a sentence what follows.
    """

    snr: float
    snr_sigma: float
    light_e: float | None
    light_sigma_e: float | None
    planned_snr: float | None
    planned_light_e: float | None
    advice: str


class LightMeter:
    """Reads frames of the dark scene; `light_e_per_s` is the planned light, None if none was stated.

    `load_sensor` runs in a thread, as it may take a second. Until it has ended, and if it fails, the `sensor` is None:
    then light is not known in electrons.
    """

    def __init__(self, load_sensor: Callable[[], Sensor], light_e_per_s: float | None) -> None:
        self.sensor: Sensor | None = None
        self._problem = "the noise of the sensor is being read"
        self._light_e_per_s = light_e_per_s
        self._loader = threading.Thread(target=self._load, args=(load_sensor,), daemon=True, name="light meter")
        self._loader.start()

    def wait(self) -> "LightMeter":
        """Wait until the sensor is known, or known not to be, and return the meter."""
        self._loader.join()
        return self

    def read(self, shown: ShownFrame) -> LightReading | None:
        """Return the reading of a frame, None unless it is one of the dark scene with noise."""
        values, exposure_s = shown.findings.values, shown.frame.exposure_s
        if shown.frame.kind != "dark_scene" or "snr" not in values:
            return None
        pixels = math.prod(length // PARTS for length in shown.pixels.shape[:2])
        # Noise of the brightest part and of the darkest ones, an eighth of all, in standard deviations of a pixel
        scatter = math.sqrt((1 + 8 / PARTS**2) / pixels)
        snr = values["snr"]
        snr_sigma = math.sqrt(2) * scatter * (1 + max(snr, 0.0))
        planned_e = None if self._light_e_per_s is None else self._light_e_per_s * exposure_s
        known = self._gain_and_noise(exposure_s)
        if known is None or "light_dn" not in values:
            advice = f"light in electrons is not known: {self._problem}"
            return LightReading(snr, snr_sigma, None, None, None, planned_e, advice)
        gain, noise_e2 = known
        light_e = values["light_dn"] / gain
        sigma_e = math.sqrt(2) * scatter * math.sqrt(noise_e2 + max(light_e, 0.0))  # of every other pair of rows
        planned_snr = None
        if planned_e is not None and noise_e2:
            # As in the check, the mean of the dark parts is subtracted, and with it the dark charge
            planned_snr = expected_snr_from_powers(np.array([planned_e]), 0.0, math.sqrt(noise_e2))
        advice = _advice(light_e, sigma_e, planned_e)
        return LightReading(snr, snr_sigma, light_e, sigma_e, planned_snr, planned_e, advice)

    def _gain_and_noise(self, exposure_s: float) -> tuple[float, float] | None:
        """Return the gain in DN per electron, and the variance of a frame without light in (e⁻)²."""
        if self.sensor is None:
            return None
        gain, read_noise_e = self.sensor.gain_dn_per_e.value, self.sensor.read_noise_e.value
        dark_e_per_s = self.sensor.dark_current_e_per_s.value
        if gain is None or read_noise_e is None or dark_e_per_s is None:
            return None
        return gain, view_noise_e(read_noise_e, gain, 1) ** 2 + max(dark_e_per_s, 0.0) * exposure_s

    def _load(self, load_sensor: Callable[[], Sensor]) -> None:
        try:
            sensor = load_sensor()
        except InputError as failure:
            self._problem = str(failure)
            return
        self._problem = sensor.read_noise_e.why or sensor.dark_current_e_per_s.why or ""
        self.sensor = sensor


def _advice(light_e: float, sigma_e: float, planned_e: float | None) -> str:
    if light_e <= _MIN_DEVIATIONS * sigma_e:
        return "hardly any light is seen; open the lamp, or look for what hides the scene"
    if planned_e is None:
        return "no light was planned; state that of `faintfield plan` as --light-e to compare"
    if abs(light_e - planned_e) <= max(_MIN_DEVIATIONS * sigma_e, _TOLERANCE * planned_e):
        return "the light is as planned"
    if light_e < planned_e:
        return f"too dark: give about {planned_e / light_e:.2g} times the light"
    return f"brighter than planned: about {light_e / planned_e:.2g} times the light"
