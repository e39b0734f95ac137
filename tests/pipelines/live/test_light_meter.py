"""The light meter of the dark scene, on frames whose light is known."""

import numpy as np
import pytest

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.live.light_meter import LightMeter
from faintfield.pipelines.planning.known import Sensor
from faintfield.rig.capture.checks import check_frame
from faintfield.rig.capture.guide import ShownFrame
from faintfield.rig.plan import PlannedFrame, StepKind, Stop
from faintfield.rig.settings import CheckSettings
from faintfield.rig.stages.protocol import Point

_EXPOSURE_S, _OFFSET_DN, _GAIN, _READ_NOISE_E, _DARK_E_PER_S = 0.5, 100.0, 2.0, 3.5, 4.0
_SENSOR = Sensor(
    "known", Estimate(_READ_NOISE_E), Estimate(_DARK_E_PER_S), Estimate(_GAIN), Estimate(None, why="not stated")
)


def dark_frame(light_e: float, kind: StepKind = "dark_scene") -> ShownFrame:
    """Return a frame whose middle has a light in electrons per pixel."""
    rng = np.random.default_rng(7)
    expected_e = np.full((480, 640), _DARK_E_PER_S * _EXPOSURE_S)
    expected_e[180:300, 240:400] += light_e
    electrons = rng.poisson(expected_e) + rng.normal(0.0, _READ_NOISE_E, expected_e.shape)
    pixels = np.rint(_OFFSET_DN + _GAIN * electrons).astype(np.uint16)
    frame = PlannedFrame(0, 0, kind, 0, Stop((0, 0), Point(0.0, 0.0)), _EXPOSURE_S, 0)
    return ShownFrame(frame, pixels, check_frame(pixels, kind, CheckSettings()))


@pytest.mark.parametrize(
    ("light_e", "advice"),
    [
        (1.0, "the light is as planned"),
        (0.5, "too dark: give about "),
        (3.0, "brighter than planned: about "),
        (0.0, "hardly any light is seen"),
    ],
)
def test_light_is_measured_and_compared(light_e: float, advice: str) -> None:
    reading = LightMeter(lambda: _SENSOR, 1.0 / _EXPOSURE_S).wait().read(dark_frame(light_e))
    assert reading is not None
    variance_e2 = _READ_NOISE_E**2 + _DARK_E_PER_S * _EXPOSURE_S + 1 / (12 * _GAIN**2)
    assert reading.planned_snr == pytest.approx(2.0 / variance_e2)
    assert reading.planned_light_e == pytest.approx(1.0)
    # The check takes the brightest of 64 parts
    assert abs(reading.snr - (light_e**2 + light_e) / variance_e2) < 3.5 * reading.snr_sigma
    assert reading.light_e is not None
    assert reading.light_sigma_e is not None
    assert abs(reading.light_e - light_e) < 3.5 * reading.light_sigma_e
    assert reading.advice.startswith(advice)


def test_unknown_noise_tells_no_electrons() -> None:
    def fail() -> Sensor:
        raise MissingFile("noise.json: is missing; run `faintfield noise`")

    reading = LightMeter(fail, 2.0).wait().read(dark_frame(1.0))
    assert reading is not None
    assert (reading.light_e, reading.planned_snr) == (None, None)
    assert reading.advice == "light in electrons is not known: noise.json: is missing; run `faintfield noise`"
    assert LightMeter(lambda: _SENSOR, None).wait().read(dark_frame(1.0, "dark")) is None
