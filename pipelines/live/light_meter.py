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

# Deviations from the plan within so many standard deviations are noise.
_MIN_DEVIATIONS = 2.0


class LightReading(Struct, frozen=True):
    """SNR of the brightest part of a frame, with its σ, and the light there in electrons per pixel; those of the plan.

    What is not known is None. `advice` says in a sentence what follows.
    """

    snr: float
    snr_sigma: float
    light_e: float | None
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
        snr = shown.findings.values.get("snr")
        if shown.frame.kind != "dark_scene" or snr is None:
            return None
        exposure_s = shown.frame.exposure_s
        pixels = math.prod(length // PARTS for length in shown.pixels.shape[:2])
        # The power of the brightest part and the noise of an eighth of all parts, as sample variances
        sigma = (1 + max(snr, 0.0)) * (2 / pixels * (1 + 8 / PARTS**2)) ** 0.5
        noise_e2 = self._noise_e2(exposure_s)
        planned_e = None if self._light_e_per_s is None else self._light_e_per_s * exposure_s
        planned_snr = light_e = None
        if noise_e2 is not None:
            light_e = _light_e(snr, noise_e2)
            if planned_e is not None:
                # As in the check, the mean of the dark parts is subtracted, and with it the dark charge
                planned_snr = expected_snr_from_powers(np.array([planned_e]), 0.0, noise_e2**0.5)
        advice = self._advice(snr, sigma, planned_snr, noise_e2, planned_e)
        return LightReading(snr, sigma, light_e, planned_snr, planned_e, advice)

    def _advice(
        self, snr: float, sigma: float, planned_snr: float | None, noise_e2: float | None, planned_e: float | None
    ) -> str:
        if noise_e2 is None:
            return f"no light in electrons: {self._problem}"
        if planned_snr is None or planned_e is None:
            return "no light was planned; state that of `faintfield plan` as --light-e to compare"
        if abs(snr - planned_snr) <= _MIN_DEVIATIONS * sigma:
            return "as planned, within the noise of one frame"
        if snr <= _MIN_DEVIATIONS * sigma:
            return "hardly any light is seen; open the lamp, or look for what hides the scene"
        factor = planned_e / _light_e(snr, noise_e2)
        if factor > 1:
            return f"too dark: give {factor:.2g} times the light"
        return f"brighter than planned: {1 / factor:.2g} times the light"

    def _noise_e2(self, exposure_s: float) -> float | None:
        """Return the variance of a frame without light in (e⁻)², None if it is not known."""
        if self.sensor is None:
            return None
        read_noise_e, dark_e_per_s = self.sensor.read_noise_e.value, self.sensor.dark_current_e_per_s.value
        if read_noise_e is None or dark_e_per_s is None:
            return None
        variance_e2 = view_noise_e(read_noise_e, self.sensor.gain_dn_per_e.value, 1) ** 2
        return variance_e2 + max(dark_e_per_s, 0.0) * exposure_s or None

    def _load(self, load_sensor: Callable[[], Sensor]) -> None:
        try:
            sensor = load_sensor()
        except InputError as failure:
            self._problem = str(failure)
            return
        self._problem = sensor.read_noise_e.why or sensor.dark_current_e_per_s.why or ""
        self.sensor = sensor


def _light_e(snr: float, noise_e2: float) -> float:
    """Return the light λ that solves SNR = (λ² + λ)/σ², eq. (4) of an even object."""
    return (math.sqrt(1 + 4 * max(snr, 0.0) * noise_e2) - 1) / 2
