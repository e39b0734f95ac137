"""`faintfield noise` names the dark frames of a session that were not taken at the temperature of its scene."""

from collections.abc import Callable
from pathlib import Path
from typing import Any
from unittest import mock

import pytest

from faintfield.pipelines.formats.sets.noise_set import load_noise_set, scene_temperature_warnings
from faintfield.rig.plan import StepKind
from faintfield.rig.session.session import taken_frames
from faintfield.rig.simulation.lab import SimulatedCamera, SimulatedLab
from tests.calib.noise.darkroom import specimen
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames
from tests.pipelines.sessions import captured, rig_toml

type Temperature = Callable[[StepKind, int], float]


def session_at(folder: Path, temperature_c: Temperature, *steps: StepKind) -> Path:
    """Capture a session whose sensor has a temperature that depends on the step and on the frames read before."""
    arrange = SimulatedLab.arrange
    now: list[Any] = ["dark_scene", 0]

    def arranged(lab: SimulatedLab, kind: StepKind, sweep: int) -> None:
        now[:] = [kind, 0]
        arrange(lab, kind, sweep)

    def read(camera: SimulatedCamera) -> float:
        now[1] += 1
        return temperature_c(now[0], now[1])

    with (
        mock.patch.object(SimulatedLab, "arrange", arranged),
        mock.patch.object(SimulatedCamera, "temperature_c", read),
    ):
        return captured(folder, rig_toml(steps, rows=1, columns=2))


def warnings_of(session: Path) -> list[str]:
    return scene_temperature_warnings(*load_noise_set(session))


def test_warm_darks_are_named(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    # Of 32 darks, the first ten are at -17.9 to -17.0 °C, the others at -18.1 °C
    def temperature_c(kind: StepKind, number: int) -> float:
        if kind == "dark":
            return -18.0 + 0.1 * number if number <= 10 else -18.1
        return -20.0 - 0.1 * number

    session = session_at(tmp_path, temperature_c, "dark_scene", "dark", "flat")
    scene = [it.record.temperature_c for frame, it, _ in taken_frames(session) if frame.kind == "dark_scene"]
    assert scene == pytest.approx([-20.1, -20.2])
    capfd.readouterr()
    record = measure_sensor(session)
    (warning,) = [it for it in record.warnings if "away from the scene" in it]
    assert warning.startswith("32 of 32 dark frames are more than 2 K away from the scene (frames/")
    assert "have -18.1 to -17.0 °C, the 2 frames of the scene -20.2 to -20.1 °C; take them again" in warning
    assert f"warning: {warning}" in capfd.readouterr().err


def test_nothing_is_said_without_a_scene_or_its_temperature(tmp_path: Path) -> None:
    warm = session_at(tmp_path / "no scene", lambda kind, number: {"dark": 5.0}.get(kind, -20.0), "bright", "dark")
    assert warnings_of(warm) == []
    set_of_files = write_frames(tmp_path / "set", take_set(*specimen(1)))
    assert warnings_of(set_of_files) == []
    (warm / "noise.toml").write_text((set_of_files / "noise.toml").read_text())
    assert scene_temperature_warnings(warm, load_noise_set(set_of_files)[1]) == []


def test_only_darks_beyond_the_limit_are_named(tmp_path: Path) -> None:
    def temperature_c(kind: StepKind, number: int) -> float:
        return {"dark_scene": -20.0, "dark": -18.0 + 0.5 * (number <= 2) - 4.5 * (number == 3), "flat": 10.0}[kind]

    session = session_at(tmp_path, temperature_c, "dark_scene", "dark", "flat")
    darks = [path.name for frame, _, path in taken_frames(session) if frame.kind == "dark"]
    (warning,) = warnings_of(session)
    assert warning.startswith(
        f"3 of 32 dark frames are more than 2 K away from the scene ({', '.join(f'frames/{it}' for it in darks[:3])}): "
        "they have -22.5 to -17.5 °C, the 2 frames of the scene -20.0 to -20.0 °C; "
    )
