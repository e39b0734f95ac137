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
from faintfield.rig.settings import RigSettings, SceneSettings, StepSettings
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
# The mean over the views of the sum of the squared weights of a sample, without and with a depth that is known
BETWEEN, WHOLE_PIXELS, HALF_PIXELS = (1 + 8 * 4 / 9) / 9, 1.0, (1 + 4 * 0.5 + 4 * 0.25) / 9


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


@pytest.mark.parametrize(
    ("depth_mm", "spread"), [((), BETWEEN), ((500.0,), WHOLE_PIXELS), ((16000 / 32.5,), HALF_PIXELS)]
)
def test_shift_between_nodes_counts_without_errors(depth_mm: tuple[float, ...], spread: float) -> None:
    settings = replace(RIG, scene=SceneSettings(depth_mm))
    with_errors = replace(settings, camera=SimulatedSettings(rotation_error_mrad=1.0))
    sigmas = [noise(each).predict(STEP, [record(5.0, 0.02)]) for each in (settings, with_errors)]
    assert sigmas[0] is not None
    assert sigmas[1] is not None
    assert sigmas[0](1) / sigmas[1](1) == pytest.approx(math.sqrt(spread / BETWEEN), rel=1e-3)


def test_scarcest_colour_and_all_exposures_count() -> None:
    step = CaptureStep("dark_scene", (0.1, 0.3), until=Until(0.1, 9))
    coloured = replace(RIG, camera=SimulatedSettings(mosaic=("RG", "GB")))
    grey, colour = (noise(settings).predict(step, [record(5.0, 0.02)]) for settings in (RIG, coloured))
    assert grey is not None
    assert colour is not None
    assert colour(3) == pytest.approx(2 * grey(3), rel=1e-3)
    variance_e2 = 4 * (5.0 + 0.02) + 2 * (12.0 + 1 / 48)  # of both frames, in which there is four times the light
    assert grey(1) == pytest.approx(math.sqrt(BETWEEN * variance_e2 / 9) / 4, rel=0.002)


def test_planned_light_counts_until_one_is_measured() -> None:
    assert noise().predict(STEP, []) is None
    planned = noise(light_e_per_s=50.0)
    predicted, measured = planned.predict(STEP, []), planned.predict(STEP, [record(5.0, 0.02)])
    assert predicted is not None
    assert measured is not None
    assert predicted(2) == pytest.approx(measured(2))


def test_rounds_without_known_noise_are_refused() -> None:
    with pytest.raises(
        MissingFile, match=r"a step has until\.sigma_e, but read_noise_e, gain.* is not known by no calibration; give"
    ):
        noise(replace(RIG, camera=FolderSettings("incoming")))
