"""Guided sessions with cameras and stages that laboratories own, by their makers' own simulators.

What the cameras see means nothing; that every file holds what the camera sent, and that the session can be verified,
calibrated and reconstructed, does.
"""

import dataclasses
import json
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tifffile

from faintfield.pipelines import cli
from faintfield.pipelines.formats.results.geometry import LensRecord
from faintfield.pipelines.formats.sets.noise_set import load_noise_set
from faintfield.pipelines.live import guided
from faintfield.rig.cameras.aravis import AravisCamera
from faintfield.rig.cameras.aravis_library import AravisLibrary
from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.protocol import Decode, Exposure
from faintfield.rig.devices import Rig, open_rig
from faintfield.rig.errors import MissingExtra
from faintfield.rig.plan import StepKind
from faintfield.rig.session.journal import CommittedFrame
from faintfield.rig.session.session import read_plan, taken_frames
from faintfield.rig.settings import RigSettings
from tests.end_to_end.rigs import write_geometry
from tests.pipelines.by_hand import write_by_hand

RIG = """
{stage}
{camera}

[grid]
rows = 3
columns = 3
pitch_mm = {pitch_mm}
origin_mm = {origin_mm}

[settle]
measure = {measure}
wait_s = 0.05

[drift]
check = {drift}

[[step]]
kind = "dark_scene"
exposure_s = 0.01

[[step]]
kind = "dark"
exposure_s = {dark_s}
frames_per_node = 8

[[step]]
kind = "flat"
exposure_s = {flat_s}
frames_per_node = 4
"""

ARAVIS = {
    "stage": '[stage]\nprotocol = "simulated"\nport = "simulated:grbl:pty"',
    "camera": '[camera]\nbackend = "aravis"\ncamera = "Fake_1"\npixel_format = "Mono8"\nregion_px = [0, 0, 96, 72]',
    "pitch_mm": 50.0,
    "origin_mm": [-350.0, -350.0],
    "drift": "true",
    "measure": "true",  # which a simulated stage leaves no real camera to do
    "dark_s": [0.0012, 0.0013],
    "flat_s": [0.005, 0.009],
}
MICROMANAGER = {
    "stage": """[stage]
protocol = "micromanager"
adapters = "{adapters}"
rate_mm_per_s = 10.0
acceleration_mm_per_s2 = 1000.0
approach_mm = 0.2
travel_mm = {{ x_mm = [0.0, 12.0], y_mm = [0.0, 12.0] }}""",
    "camera": """[camera]
backend = "micromanager"
adapters = "{adapters}"
properties = {{ Mode = "Noise", OnCameraCCDXSize = "64", OnCameraCCDYSize = "48", Offset = "100" }}""",
    "pitch_mm": 1.0,
    "origin_mm": [1.0, 1.0],
    "drift": "false",
    "measure": "false",
    "dark_s": [0.001, 0.02],
    "flat_s": [0.01, 0.02],
}
FRAMES = 9 + 2 * 8 + 2 * 4


def faintfield(*arguments: object) -> None:
    assert cli.run([str(argument) for argument in arguments]) == 0


def captured(folder: Path, changes: dict[str, Any]) -> Path:
    """Capture the session of a rig and return its folder."""
    (folder / "rig.toml").write_text(RIG.format(**changes))
    faintfield("check", folder / "rig.toml")
    faintfield("capture", folder / "rig.toml", folder / "session", "--yes")
    return folder / "session"


def check_session(session: Path, sent: dict[int, Exposure], fx_px: float, depth_mm: float) -> None:
    """Check that the session is whole, holds what the camera sent, and can be reconstructed with its noise.json."""
    assert (session / "SHA256SUMS").is_file()
    frames: list[CommittedFrame] = []
    for frame, committed, path in taken_frames(session):
        np.testing.assert_array_equal(tifffile.imread(path), sent[committed.intent].pixels)
        assert committed.record.position_mm == pytest.approx(frame.stop.target, abs=0.01)
        frames.append(committed)
    assert len(frames) == FRAMES
    pixels = sent[frames[0].intent].pixels
    assert pixels is not None
    height, width = pixels.shape
    lens = LensRecord("pinhole", fx_px, fx_px, width / 2, height / 2, ())
    geometry = write_geometry(session.with_name("geometry"), read_plan(session).rig.grid, lens, (width, height))
    out = session.with_name("planes")
    faintfield("reconstruct", session, "--geometry", geometry, "--out", out, "--depth-mm", depth_mm, "--passes", 3)
    result = json.loads((out / "reconstruction.json").read_text())
    assert [plane["depth_mm"] for plane in result["planes"]] == [depth_mm]
    faintfield("verify", session)


def record_exposures(monkeypatch: pytest.MonkeyPatch, camera: type[Any]) -> dict[int, Exposure]:
    """Return a dictionary into which every exposure of these cameras will be put, by its number."""
    sent: dict[int, Exposure] = {}
    expose: Callable[..., Exposure] = camera.expose

    def recorded(self: Any, exposure_s: float, number: int) -> Exposure:
        sent[number] = expose(self, exposure_s, number)
        return sent[number]

    monkeypatch.setattr(camera, "expose", recorded)
    return sent


def test_genicam_camera_on_simulated_grbl_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    try:
        AravisLibrary()
    except MissingExtra as failure:
        pytest.skip(f"Aravis' camera is not tried: {failure}")
    sent = record_exposures(monkeypatch, AravisCamera)
    session = captured(tmp_path, ARAVIS)
    # No frame was left over: the camera counts on. A busy computer may lose a frame; the camera is then opened again,
    # and counts from its first number.
    frame_ids = [int(str(exposure.metadata["frame_id"])) for _, exposure in sorted(sent.items())]
    assert all(after in (before + 1, frame_ids[0]) for before, after in pairwise(frame_ids)), frame_ids
    noise = load_noise_set(session).settings  # its ramp has no noise that could be measured
    assert [(frame.kind, frame.exposure_s) for frame in noise.frame] == [
        *[("dark", exposure_s) for exposure_s in (0.0012, 0.0013) for _ in range(8)],
        *[("flat", exposure_s) for exposure_s in (0.005, 0.009) for _ in range(4)],
    ]
    values = {"offset_dn": 0.0, "gain_dn_per_e": 1.0, "read_noise_e": 2.0, "dark_current_e_per_s": 0.0}
    write_by_hand(session / "noise.json", {name: {"value": value} for name, value in values.items()})
    check_session(session, sent, fx_px=300.0, depth_mm=500.0)


def test_micromanager_camera_on_its_stage(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    why = "pymmcore-plus and mm-test-adapters are not installed here: their devices are not tried"
    pytest.importorskip("pymmcore_plus", reason=why)
    adapters = pytest.importorskip("mm_test_adapters", reason=why).device_adapter_path()
    sent = record_exposures(monkeypatch, MicroManagerCamera)
    monkeypatch.setattr(guided, "open_rig", rig_with_a_lamp)
    changes = {
        key: text.format(adapters=adapters) if isinstance(text, str) else text for key, text in MICROMANAGER.items()
    }
    session = captured(tmp_path, changes)
    faintfield("noise", session)
    check_session(session, sent, fx_px=100.0, depth_mm=50.0)
    noise = json.loads((session / "noise.json").read_text())
    assert noise["gain_dn_per_e"]["value"] == pytest.approx(1.0, rel=0.05)  # as the demonstration camera is told
    assert noise["read_noise_e"]["value"] == pytest.approx(2.5, rel=0.1)


def rig_with_a_lamp(settings: RigSettings, traffic: Any = None, decode: Decode = lambda path: None) -> Rig:
    """Return Micro-Manager's rig, with somebody who switches the lamp before each step."""
    rig = open_rig(settings, traffic, decode)
    camera = rig.camera
    assert isinstance(camera, MicroManagerCamera)

    def arrange(kind: StepKind, sweep: int) -> None:
        core = camera._core  # noqa: SLF001 - the demonstration camera's light is one of its properties
        core.setProperty(core.getCameraDevice(), "Photon Flux", "50" if kind == "flat" else "2")

    return dataclasses.replace(rig, arrange=arrange)
