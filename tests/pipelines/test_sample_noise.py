"""Noise of the planes by the light of the frames so far, against formulas written out here."""

import math
from pathlib import Path

import pytest
from msgspec.structs import replace

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.planning.sample_noise import MeasuredNoise
from faintfield.rig.cameras.settings import FolderSettings, SimulatedSettings
from faintfield.rig.plan import CaptureStep, Grid, Until
from faintfield.rig.session.journal import FrameRecord
from faintfield.rig.settings import RigSettings, StepSettings
from faintfield.rig.simulation.optics import SimulatedSensor
from faintfield.rig.stages.protocol import Point, StageSettings

STEP = CaptureStep("dark_scene", (0.1,), 2, until=Until(0.1, 9))
RIG = RigSettings(
    StageSettings("simulated"),
    SimulatedSettings(),
    Grid(3, 3, 20.0, Point(-350.0, -350.0)),
    (StepSettings("dark_scene", 0.1, 2, until=STEP.until),),
)
SENSOR = SimulatedSensor(read_noise_e=12**0.5, gain_dn_per_e=2.0)
# The mean over the views of the sum of the squared weights of a sample
BETWEEN = (1 + 8 * 4 / 9) / 9


def noise(settings: RigSettings = RIG, light_e_per_s: float | None = None) -> MeasuredNoise:
    return MeasuredNoise(settings, Path("rig.toml"), Path("no-session"), None, None, None, light_e_per_s=light_e_per_s)


def record(light_e: float, charge_e: float) -> FrameRecord:
    offset_dn = SENSOR.offset_dn + 2.0 * charge_e
    return FrameRecord(Point(0.0, 0.0), 0.1, checks={"light_dn": 2.0 * light_e, "darkest_dn": offset_dn})


@pytest.mark.parametrize("charge_e", [0.02, 3.0])  # dark current alone, and stray light
def test_noise_follows_light_and_stray_light(charge_e: float) -> None:
    sigma_e = noise().predict(STEP, [record(4.0, charge_e), record(6.0, charge_e)])
    assert sigma_e is not None
    for rounds in (1, 4):
        variance_e2 = 5.0 + charge_e + 12.0 + 1 / 48  # of a frame
        expected = math.sqrt(BETWEEN * variance_e2 / (9 * 2 * rounds))
        assert sigma_e(rounds) == pytest.approx(expected, rel=0.002)


def test_planned_light_counts_until_one_is_measured() -> None:
    assert noise().predict(STEP, []) is None
    planned = noise(light_e_per_s=50.0)
    predicted, measured = planned.predict(STEP, []), planned.predict(STEP, [record(5.0, 0.02)])
    assert predicted is not None
    assert measured is not None
    assert predicted(2) == pytest.approx(measured(2))


def test_rounds_without_known_noise_are_refused() -> None:
    with pytest.raises(MissingFile, match=r"a step has until\.sigma_e, but the noise of the sensor is not known"):
        noise(replace(RIG, camera=FolderSettings("incoming")))
