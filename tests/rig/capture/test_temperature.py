"""A capture waits for the temperature of the sensor, by the simulated clock."""

import math
from pathlib import Path
from typing import Any
from unittest import mock

import msgspec
import numpy as np
import pytest

from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.protocol import Camera, Thermometer
from faintfield.rig.cameras.settings import CoolingSettings, FolderSettings, MicroManagerSettings, SimulatedSettings
from faintfield.rig.capture.guide import OperatorRequest, Status
from faintfield.rig.capture.loop import Capture
from faintfield.rig.capture.survey import survey
from faintfield.rig.capture.temperature import require_temperature
from faintfield.rig.devices import Rig, open_rig
from faintfield.rig.errors import CameraTimeout, CaptureStopped, PlanRefused, RigError
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.resume import open_session
from faintfield.rig.session.session import FrozenPlan, taken_frames
from faintfield.rig.settings import RigSettings
from faintfield.rig.simulation.cooling import Cooling
from faintfield.rig.simulation.lab import SimulatedCamera
from tests.faults.capturing import FRAMES, SMALL_RIG, Unattended

# The sensor cools from 20 °C to -5 °C with a time constant of a minute.
COOLED = SimulatedSettings(
    size_px=(16, 12), settle_temperature_c=-5.0, start_temperature_c=20.0, cooling_s=60.0, settle_limit_s=600.0
)


class Watching(Unattended):
    """A person who keeps what is shown, and may make one request."""

    def __init__(self, request_at: str = "", request: OperatorRequest = "stop") -> None:
        self.said: list[str] = []
        self.request_at, self.request = request_at, request

    def show_status(self, status: Status) -> None:
        self.said += [status.doing, *status.warnings]

    def take_request(self) -> OperatorRequest | None:
        if self.request_at and self.request_at in self.said[-1]:
            self.request_at = ""
            return self.request
        return None


def capture(folder: Path, camera: CoolingSettings, person: Unattended | None = None) -> RigError | None:
    settings: RigSettings = msgspec.structs.replace(SMALL_RIG, camera=camera)
    plan = FrozenPlan(survey(open_rig(settings), settings).plan, settings)
    try:
        with open_session(folder, plan) as session:
            Capture(session, open_rig(settings, session.journal), person or Watching(), lambda path: None).run()
    except RigError as failure:
        return failure
    return None


def events(folder: Path) -> list[dict[str, Any]]:
    with Journal(folder / "journal.sqlite", read_only=True) as journal:
        return [{"frame": event.frame, **event.detail} for event in journal.events("temperature")]


def test_every_step_begins_with_a_sensor_that_is_cool(tmp_path: Path) -> None:
    person = Watching()
    assert capture(tmp_path / "session", COOLED, person) is None
    temperatures = [it.record.temperature_c for _, it, _ in taken_frames(tmp_path / "session")]
    assert len(temperatures) == FRAMES
    assert all(found is not None and abs(found + 5.0) <= 0.5 for found in temperatures)
    assert len(set(temperatures)) == FRAMES  # each is that of its own time
    found = events(tmp_path / "session")
    assert [it["frame"] for it in found] == [0, 6, 12]
    # 25 K fall to 0.5 K in 60 s ln 50, less what passed since the camera was opened; then it stays there for 10 s
    until_s = 60.0 * math.log(50.0) + 10.0
    assert until_s - 60.0 <= found[0]["waited_s"] <= until_s + 15.0
    assert [it["waited_s"] for it in found[1:]] == [10.0, 10.0]
    waiting = [line for line in person.said if line.startswith("sensor at")]
    assert any(line.startswith("sensor at 1") and line.endswith("C, waiting for -5.0 C") for line in waiting)
    assert person.said.index(waiting[0]) < person.said.index("moving")


def test_nothing_is_waited_for_by_default(tmp_path: Path) -> None:
    warm = SimulatedSettings(size_px=(16, 12), start_temperature_c=20.0, cooling_s=60.0)
    person = Watching()
    assert capture(tmp_path / "session", warm, person) is None
    assert not any("waiting for -" in line for line in person.said)
    assert events(tmp_path / "session") == []
    first = taken_frames(tmp_path / "session")[0][1].record.temperature_c
    assert first is not None
    assert first > -10.0
    assert capture(tmp_path / "steady", SimulatedSettings(size_px=(16, 12))) is None
    assert {it.record.temperature_c for _, it, _ in taken_frames(tmp_path / "steady")} == {-20.0}


def test_a_sensor_that_does_not_get_cool_is_told(tmp_path: Path) -> None:
    camera = msgspec.structs.replace(COOLED, cooling_s=600.0, settle_limit_s=30.0)
    failure = capture(tmp_path / "session", camera)
    assert isinstance(failure, CameraTimeout)
    assert "after 30 s, and did not stay within 0.5 K of -5.0 C for 10 s; check its cooler" in str(failure)
    assert taken_frames(tmp_path / "session") == []
    with Journal(tmp_path / "session" / "journal.sqlite", read_only=True) as journal:
        assert journal.uncommitted() == []  # nothing was exposed
        assert len(journal.events("camera_failed")) == 3


def test_a_person_can_stop_while_the_sensor_cools(tmp_path: Path) -> None:
    failure = capture(tmp_path / "session", COOLED, Watching("waiting for -5.0 C"))
    assert isinstance(failure, CaptureStopped)
    assert taken_frames(tmp_path / "session") == []
    assert capture(tmp_path / "session", COOLED) is None


def test_a_cooler_that_overshoots_is_not_settled_when_it_passes(tmp_path: Path) -> None:
    # Within 0.5 K at 0 s, 2 s and 8 s, and from 14 s on
    readings = [-4.8, -5.2, -6.0, -6.5, -5.4, -5.6, -5.6, *[-5.0] * 1000]
    with mock.patch.object(SimulatedCamera, "temperature_c", side_effect=readings):
        settings: RigSettings = msgspec.structs.replace(SMALL_RIG, camera=COOLED)
        plan = FrozenPlan(survey(open_rig(SMALL_RIG), SMALL_RIG).plan, settings)
        with open_session(tmp_path / "session", plan) as session:
            Capture(session, open_rig(settings, session.journal), Watching(), lambda path: None).run()
    assert events(tmp_path / "session")[0]["waited_s"] == pytest.approx(14.0 + 10.0)


class Mute:
    """A camera without a thermometer, or with a broken one."""

    def __init__(self, camera: Camera, **more: Any) -> None:
        self.open, self.close = camera.open, camera.close
        self.report, self.expose = camera.report, camera.expose
        vars(self).update(more)


def test_a_camera_without_temperature_is_refused_before_anything_moves() -> None:
    settings: RigSettings = msgspec.structs.replace(SMALL_RIG, camera=COOLED)
    rig = open_rig(settings)
    mute = Rig(rig.stage, Mute(rig.camera), rig.clock, rig.arrange)
    with pytest.raises(PlanRefused, match=r"settle_temperature_c = -5, but the camera reports no temperature; remove"):
        survey(mute, settings)
    broken = Rig(rig.stage, Mute(rig.camera, temperature_c=lambda: None), rig.clock, rig.arrange)
    with pytest.raises(PlanRefused, match=r"reports no temperature"):
        survey(broken, settings)
    assert survey(rig, settings).plan.frame_count() == FRAMES
    require_temperature(mute.camera, FolderSettings("incoming"))
    with pytest.raises(PlanRefused):
        require_temperature(mute.camera, FolderSettings("incoming", settle_temperature_c=-5.0))


def test_the_temperature_of_a_simulated_sensor() -> None:
    cooling = Cooling(20.0, -10.0, 100.0, seed=1)
    times_s = np.linspace(0.0, 2000.0, 4001)
    curve = np.array([cooling.temperature_c(at_s) for at_s in times_s])
    ripple = curve - (-10.0 + 30.0 * np.exp(-times_s / 100.0))
    assert 0.02 < np.abs(ripple).max() <= 0.09
    assert abs(ripple.mean()) < 0.01
    assert cooling.temperature_c(7.0) == Cooling(20.0, -10.0, 100.0, seed=1).temperature_c(7.0)
    assert cooling.temperature_c(7.0) != Cooling(20.0, -10.0, 100.0, seed=2).temperature_c(7.0)
    assert Cooling(None, -20.0, 100.0, seed=1).temperature_c(7.0) == -20.0


class Core:
    """The few calls of Micro-Manager's core that a frame needs, with any properties."""

    def __init__(self, **properties: str) -> None:
        self.properties = properties

    def getCameraDevice(self) -> str:
        return "Camera"

    def getDevicePropertyNames(self, label: str) -> tuple[str, ...]:
        return tuple(self.properties)

    def getProperty(self, label: str, name: str) -> str:
        return self.properties[name]

    def setExposure(self, exposure_ms: float) -> None:
        pass

    def snap(self) -> Any:
        return np.zeros((2, 3), np.uint16)


@pytest.mark.parametrize(
    ("properties", "found_c"),
    [
        ({"Temperature": "7", "Gain": "1"}, 7.0),
        ({"Temperature": "30", "CCDTemperature": "-20"}, -20.0),
        ({"Temperature": "nan"}, None),
        ({"Gain": "1"}, None),
    ],
)
def test_the_temperature_that_micromanager_reports(properties: dict[str, str], found_c: float | None) -> None:
    camera = MicroManagerCamera(MicroManagerSettings())
    camera._core = Core(**properties)  # noqa: SLF001 - the real core reads no temperature without a camera
    assert isinstance(camera, Thermometer)
    assert camera.temperature_c() == found_c
    assert camera.expose(0.1, 1).metadata["temperature_c"] == found_c
