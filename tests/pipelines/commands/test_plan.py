"""`faintfield plan`: its numbers against formulas written out here, `check`, and frames of known light."""

import json
import math
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.rig.session.session import taken_frames
from faintfield.rig.simulation.optics import SimulatedSensor
from tests.pipelines.by_hand import FITTED, write_fitted_noise
from tests.pipelines.conftest import Command, assert_refused
from tests.pipelines.sessions import captured, rig_toml

type Predict = Callable[..., dict[str, Any]]

# The paper's camera, by default that of the simulated rig, which rounds to half an electron.
READ_E2, DARK_E, ROUNDING_E2 = 12.0, 0.02, 1 / 48

SIMULATED = """
stage = { protocol = "simulated" }
camera = { backend = "simulated", size_px = [640, 480]MORE }
grid = { rows = 5, columns = 5, pitch_mm = 20.0, origin_mm = [-250.0, -250.0] }
scene = { depth_mm = [500.0] }
step = [{ kind = "dark_scene", exposure_s = 0.1 }, { kind = "noise_reference", exposure_s = 0.1 }]
"""

# A rig whose stage does not answer, and of whose camera nothing is known.
REAL = """
stage = { protocol = "grbl", port = "/dev/no-such-port" }
camera = { backend = "folder", folder = "incoming" }
grid = { rows = 3, columns = 3, pitch_mm = 50.0, origin_mm = [-250.0, -250.0] }
step = [{ kind = "dark_scene", exposure_s = 0.1, frames_per_node = 4 }]
"""


@pytest.fixture
def rig(tmp_path: Path) -> Path:
    path = tmp_path / "rig.toml"
    path.write_text(SIMULATED.replace("MORE", ""))
    return path


@pytest.fixture
def real(tmp_path: Path) -> Path:
    path = tmp_path / "real.toml"
    path.write_text(REAL)
    return path


@pytest.fixture
def predict(done: Command) -> Predict:
    """Return the prediction of a call."""

    def call(*words: object) -> dict[str, Any]:
        prediction: dict[str, Any] = json.loads(done("--json", "plan", *words).stdout)
        return prediction

    return call


def sigma_of(light_e: float, views: int, read_e2: float, dark_e: float, *, between: float = 4 / 9) -> float:
    """σ of a sample where all views see it alike, with pixels between the samples in all views but the reference."""
    response, interpolation = 1.0, (1 + (views - 1) * between) / views
    return math.sqrt(interpolation * (response * light_e + dark_e + read_e2) / (views * response**2))


def test_snr_and_photons_match_paper_camera(rig: Path, predict: Predict) -> None:
    prediction = predict(rig, "--light-e", 0.97)
    power_of_dark = DARK_E**2 + DARK_E + READ_E2 + ROUNDING_E2
    power = (0.97 + DARK_E) ** 2 + 0.97 + DARK_E + READ_E2 + ROUNDING_E2
    assert prediction["snr"]["value"] == pytest.approx(power / power_of_dark - 1, rel=1e-9)
    assert prediction["snr_linear"]["value"] == pytest.approx(0.97 / (READ_E2 + ROUNDING_E2), rel=1e-9)
    assert prediction["photons"]["value"] == pytest.approx(1.94)
    per_s = predict(rig, "--light-e-per-s", 9.7)
    assert per_s["snr"]["value"] == pytest.approx(prediction["snr"]["value"], rel=1e-9)


def test_sigma_includes_vignetting(rig: Path, predict: Predict) -> None:
    prediction = predict(rig, "--light-e", 0.97)["depths"][0]
    information = 0.0
    for right, down in np.ndindex(5, 5):
        squared = ((20 * (right - 2)) ** 2 + (20 * (down - 2)) ** 2) / 500**2
        response = 1 / (1 + squared) ** 2
        information += response**2 / (response * 0.97 + DARK_E + READ_E2 + ROUNDING_E2)
    assert prediction["views"] == 25
    assert prediction["sigma_e"]["value"] == pytest.approx(math.sqrt(1 / information), rel=3e-3)  # whole pixels


def test_pixels_parallax_and_contrast_follow_formulas(rig: Path, predict: Predict) -> None:
    plane = predict(rig, "--light-e", 1, "--blur-px", 0.5, "--feature-mm", 5)["depths"][0]
    assert plane["mm_per_px"]["value"] == pytest.approx(500 / 800)
    assert plane["blur_mm"]["value"] == pytest.approx(0.25 * 500 / 400)
    assert plane["depth_step_mm"]["value"] == pytest.approx(500**2 / (800 * 80))
    assert plane["seen_by_all_mm"] == pytest.approx([640 * 0.625 - 80, 480 * 0.625 - 80])
    assert plane["features"][0]["side_px"] == pytest.approx(8.0)
    # The contrast of a large square is Rose's
    options = ("--light-e", 0.97, "--feature-px", 100, "--depth-mm", 1e7, "--rose-k", 3)
    feature = predict(rig, *options)["depths"][0]["features"][0]
    noise_e = math.sqrt((0.97 + DARK_E + READ_E2 + ROUNDING_E2) / 25) / (100 - 1 / 3)
    assert feature["smallest_contrast"]["value"] == pytest.approx(3 * noise_e / 0.97, rel=1e-3)
    near = predict(rig, "--light-e", 1, "--depth-mm", 100)["depths"][0]
    assert near["views"] == 4 * 3  # 160 px per node, from the axis at (323, 238) in 640 x 480
    assert near["seen_by_all_mm"][1] == 0


def test_time_is_that_of_check(rig: Path, predict: Predict, done: Command) -> None:
    checked = json.loads(done("--json", "check", rig).stdout)
    prediction = predict(rig, "--light-e", 1)
    assert prediction["time_s"]["value"] == pytest.approx(checked["duration_s"], rel=1e-12)
    (row,) = prediction["alternatives"]
    assert row["time_s"] == prediction["time_s"]
    assert row["scene_s"]["value"] < 0.6 * row["time_s"]["value"]


def test_frames_and_exposures_add_up(rig: Path, predict: Predict) -> None:
    words = ("--light-e", 0.5, "--exposures-ms", 100, 200, "--frames", 1, 2, 4, "--depth-mm", 1e9)
    rows = {(row["exposure_s"], row["frames_per_node"]): row for row in predict(rig, *words)["alternatives"]}
    sigma = {key: row["sigma_e"]["value"] for key, row in rows.items()}
    assert sigma[0.1, 1] == pytest.approx(sigma_of(0.5, 25, READ_E2 + ROUNDING_E2, DARK_E, between=1), rel=2e-3)
    assert sigma[0.1, 4] == pytest.approx(sigma[0.1, 1] / 2, rel=1e-6)
    longer = sigma_of(1.0, 25, READ_E2 + ROUNDING_E2, 2 * DARK_E, between=1) / 2
    assert sigma[0.2, 1] == pytest.approx(longer, rel=2e-3)
    times = [rows[0.1, frames]["time_s"]["value"] for frames in (1, 2)]
    assert times[1] - times[0] == pytest.approx(2 * 25 * (0.1 + 0.05))  # the scene's, and the noise reference's


def test_cheapest_possible_session_reaches_sigma(rig: Path, predict: Predict) -> None:
    words = ("--light-e", 0.97, "--grids", "3x3", "5x5", "41x41", "--frames", 1, 8)
    prediction = predict(rig, *words, "--sigma-e", 0.45)
    rows = prediction["alternatives"]
    assert {row["rows"] for row in rows if row["why_not"]} == {41}
    able = [row for row in rows if not row["why_not"] and row["sigma_e"]["value"] <= 0.45]
    assert prediction["cheapest"] == min(able, key=lambda row: row["time_s"]["value"])
    assert (prediction["cheapest"]["rows"], prediction["cheapest"]["frames_per_node"]) == (3, 8)
    assert predict(rig, *words[:2], "--sigma-e", 0.01)["cheapest"] is None


def test_rounds_follow_wanted_noise(rig: Path, predict: Predict, faintfield: Command) -> None:
    once = predict(rig, "--light-e", 2.0)
    one_e = once["alternatives"][0]["sigma_e"]["value"]
    until = f"exposure_s = 0.1, until = {{ sigma_e = {0.9 * one_e / math.sqrt(2)}, at_most_rounds = MOST }}"
    text = rig.read_text().replace("exposure_s = 0.1", until, 1)
    rig.write_text(text.replace("MOST", "8"))
    prediction = predict(rig, "--light-e", 2.0, "--exposures-ms", 100, 400)
    assert (prediction["rounds"], [row["rounds"] for row in prediction["alternatives"]]) == (3, [3, 4])
    assert prediction["reached_e"]["value"] == pytest.approx(one_e / math.sqrt(3), rel=1e-3)
    assert prediction["frames_per_node"] == 3
    scene_s = [row["scene_s"]["value"] for row in (prediction["alternatives"][0], once["alternatives"][0])]
    assert scene_s[0] == pytest.approx(3 * scene_s[1], rel=0.05)
    rig.write_text(text.replace("MOST", "2"))
    assert "rounds: all 2 reach" in faintfield("plan", rig, "--light-e", 2.0).stderr


def test_scarcest_colour_has_quarter_of_pixels(rig: Path, predict: Predict) -> None:
    grey = predict(rig, "--light-e", 0.97)
    rig.write_text(SIMULATED.replace("MORE", ', mosaic = ["RG", "GB"]'))
    coloured = predict(rig, "--light-e", 0.97)
    assert coloured["pixel_share"] == 0.25
    assert coloured["snr"] == grey["snr"]
    sigmas = [row["depths"][0]["sigma_e"]["value"] for row in (grey, coloured)]
    assert sigmas[1] == pytest.approx(2 * sigmas[0])


def test_unknown_numbers_have_reasons(real: Path, faintfield: Command) -> None:
    ended = faintfield("--json", "plan", real, "--light-e", 1)
    assert ended.returncode == 0, ended.stderr
    prediction = json.loads(ended.stdout)
    (plane,) = prediction["depths"]
    unknown = (prediction["snr"], plane["sigma_e"], prediction["time_s"], prediction["photons"], plane["mm_per_px"])
    for number, reason in zip(unknown, ("--noise", "--noise", "no-such-port", "--noise", "--depth-mm"), strict=True):
        assert number["value"] is None
        assert reason in number["why"]
        assert f"unknown: {number['why']}" in ended.stderr
    assert "vignetting: unknown" in ended.stderr


def test_numbers_of_data_sheet_are_used(real: Path, predict: Predict) -> None:
    for read_e in (2.0, 0.0):
        prediction = predict(real, "--light-e", 1, "--read-noise-e", read_e, "--dark-current-e-per-s", 0)
        assert prediction["frames_per_node"] == 4
        sigma_e = prediction["depths"][0]["sigma_e"]["value"]  # in electrons of all four frames
        assert sigma_e == pytest.approx(sigma_of(4.0, 9, 4 * read_e**2, 0.0), rel=1e-6)
        assert prediction["photons"]["value"] is None
    no_noise = {"value": None, "why": "there is no noise to compare with"}
    assert (prediction["snr"], prediction["snr_linear"]) == (no_noise, no_noise)


def test_calibration_gives_numbers_or_reasons(real: Path, tmp_path: Path, predict: Predict) -> None:
    write_fitted_noise(tmp_path, size_px=[400, 300], quantum_efficiency=0.5)
    prediction = predict(real, "--light-e", 1, "--fx-px", 500, "--depth-mm", 500)
    assert prediction["noise_from"] == str(tmp_path / "noise.json")
    assert prediction["photons"]["value"] == 2
    assert prediction["depths"][0]["views"] == 9
    expected = sigma_of(4.0, 9, 4 * (9 + ROUNDING_E2), 4 * 0.02)
    assert prediction["depths"][0]["sigma_e"]["value"] == pytest.approx(expected, rel=1e-6)
    lacking = FITTED | {"dark_current_e_per_s": {"value": None, "why": "all exposures are equally long"}}
    (tmp_path / "other.json").write_text(json.dumps(lacking))
    prediction = predict(real, "--light-e", 1, "--noise", tmp_path / "other.json")
    assert prediction["snr"] == {"value": None, "why": "all exposures are equally long"}


def write_frame(path: Path, light_e: float, exposure_s: float, shape: tuple[int, int] = (60, 80)) -> Path:
    """Take a frame of even light by the paper's camera."""
    photons = np.full(shape, light_e / 0.5)
    tifffile.imwrite(path, SimulatedSensor().expose(photons, exposure_s, np.random.default_rng(5)))
    return path


def test_light_of_test_frame_has_interval(rig: Path, tmp_path: Path, predict: Predict) -> None:
    frame = write_frame(tmp_path / "test.tiff", 30.0, 2.0)
    prediction = predict(rig, "--test-frame", frame, "--frame-exposure-ms", 2000)
    low, high = prediction["light_e"]["ci95"]
    assert low < 30.0 * 0.1 / 2 < high
    margin_e = 1.96 * math.sqrt((30.0 + 0.4 + READ_E2 + ROUNDING_E2) / 4800)
    assert (high - low) / 2 == pytest.approx(margin_e * 0.1 / 2, rel=0.02)
    plane, row = prediction["depths"][0], prediction["alternatives"][0]
    for number in (prediction["snr"], plane["sigma_e"], row["smallest_contrast"]):
        assert number["ci95"][0] < number["value"] < number["ci95"][1]


def test_exposure_of_session_frame_is_known(rig: Path, tmp_path: Path, predict: Predict) -> None:
    session = captured(tmp_path / "taken", rig_toml(["dark_scene"]))
    frame = next(path for _, _, path in taken_frames(session))
    stated = predict(rig, "--test-frame", frame, "--frame-exposure-ms", 100)
    assert predict(rig, "--test-frame", frame)["light_e"] == stated["light_e"]


def test_interval_includes_error_of_calibration(real: Path, tmp_path: Path, predict: Predict) -> None:
    write_fitted_noise(tmp_path)
    frame = write_frame(tmp_path / "test.tiff", 30.0, 2.0)
    words = (real, "--test-frame", frame, "--frame-exposure-ms", 2000)
    alone = predict(*words)["light_e"]
    counted = (30.0 + 0.4 + 9 + ROUNDING_E2) / 4800
    calibrated = (0.1 / 2) ** 2 + (30.4 * 0.01 / 2) ** 2 + (0.01 * 2) ** 2
    margin_e = (alone["ci95"][1] - alone["ci95"][0]) / 2 * 20
    assert margin_e == pytest.approx(1.96 * math.sqrt(counted + calibrated), rel=0.02)
    names = ["offset_dn", "gain_dn_per_e", "read_noise_e", "dark_current_e_per_s"]
    matrix = np.diag([0.1**2, 0.01**2, 0.0, 0.01**2])
    matrix[0, 1] = matrix[1, 0] = 0.9 * 0.1 * 0.01
    write_fitted_noise(tmp_path, covariance={"names": names, "matrix": matrix.tolist()})
    together = predict(*words)["light_e"]["ci95"]
    calibrated += 2 * 0.9 * (0.1 / 2) * (30.4 * 0.01 / 2)
    assert (together[1] - together[0]) * 10 == pytest.approx(1.96 * math.sqrt(counted + calibrated), rel=0.02)


def test_region_of_frame_is_measured(rig: Path, tmp_path: Path, predict: Predict) -> None:
    pixels = np.full((60, 80), 100, np.uint16)
    pixels[25:35, 35:45] = 300
    tifffile.imwrite(tmp_path / "flat.tiff", pixels)
    exposure = ("--frame-exposure-ms", 100)
    bright = 100.0 - DARK_E
    assert predict(rig, "--flat", tmp_path / "flat.tiff", *exposure)["light_e"]["value"] == pytest.approx(bright)
    region = ("--region-px", 35, 25, 10, 10)
    prediction = predict(rig, "--test-frame", tmp_path / "flat.tiff", *exposure, *region)
    assert prediction["light_e"]["value"] == pytest.approx(bright)
    whole = predict(rig, "--test-frame", tmp_path / "flat.tiff", *exposure)
    assert whole["light_e"]["value"] == pytest.approx(100 * 100 / 4800 - DARK_E)


def test_wrong_usage_is_named(rig: Path, faintfield: Command) -> None:
    cases: list[tuple[tuple[object, ...], str]] = [
        ((), "0 lights are given"),
        (("--light-e", 1, "--frame-exposure-ms", 5), "are those of a frame"),
        (("--light-e", 1, "--grids", "5"), "--grids 5: is no grid"),
        (("--light-e", 1, "--frames", *range(1, 600)), "the table has 599 rows, at most 500"),
    ]
    for words, message in cases:
        ended = faintfield("plan", rig, *words)
        assert ended.returncode == 2, ended.stderr
        assert message in " ".join(ended.stderr.split())


def test_frames_without_measurable_light_are_refused(rig: Path, tmp_path: Path, faintfield: Command) -> None:
    cases: list[tuple[float, tuple[object, ...], str]] = [
        (0.0, (), "which may be none; expose it for longer than 100 ms"),
        (1e5, (), "are saturated, at most 1% may be; expose it for less than 100 ms"),
        (30.0, ("--region-px", 70, 0, 20, 20), "is not within its 80 x 60 px"),
    ]
    for light_e, words, message in cases:
        frame = write_frame(tmp_path / "test.tiff", light_e, 0.1)
        ended = faintfield("plan", rig, "--test-frame", frame, "--frame-exposure-ms", 100, *words)
        assert_refused(ended, "BadValue", message)
