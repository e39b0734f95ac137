"""A capture waits for the temperature of the sensor, by the simulated clock."""

import math
from pathlib import Path
from typing import Any
from unittest import mock

import pytest
from msgspec.structs import replace

from faintfield.rig.cameras.protocol import Camera
from faintfield.rig.cameras.settings import CameraSettings, FolderSettings, SimulatedSettings
from faintfield.rig.capture.guide import Status
from faintfield.rig.capture.survey import require_temperature, survey
from faintfield.rig.devices import Rig, open_rig
from faintfield.rig.errors import CameraTimeout, CaptureStopped, PlanRefused
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import taken_frames
from faintfield.rig.settings import RigSettings
from faintfield.rig.simulation.lab import SimulatedCamera
from tests.faults.capturing import FRAMES, SMALL_RIG, Operator, capture, events

# The sensor cools from 20 °C to -5 °C with a time constant of a minute.
COOLED = SimulatedSettings(
    size_px=(16, 12), settle_temperature_c=-5.0, start_temperature_c=20.0, cooling_s=60.0, settle_limit_s=600.0
)


def rig(camera: CameraSettings) -> RigSettings:
    return replace(SMALL_RIG, camera=camera)


def waits(folder: Path) -> list[dict[str, Any]]:
    return [{"frame": event.frame, **event.detail} for event in events(folder, "temperature")]


def temperatures_c(folder: Path) -> list[float | None]:
    return [committed.record.temperature_c for _, committed, _ in taken_frames(folder)]


def test_every_step_begins_with_a_cool_sensor(tmp_path: Path) -> None:
    operator, folder = Operator(), tmp_path / "session"
    assert capture(folder, operator, rig(COOLED)) is None
    temperatures = temperatures_c(folder)
    assert len(set(temperatures)) == FRAMES  # each is that of its own time
    assert all(temperature is not None and abs(temperature + 5.0) <= 0.5 for temperature in temperatures)
    first, *others = waits(folder)
    assert [wait["frame"] for wait in (first, *others)] == [0, 6, 12]
    # 25 K fall to 0.5 K in 60 s ln 50, less what passed since the camera was opened; then it stays there for 10 s
    until_s = 60.0 * math.log(50.0) + 10.0
    assert until_s - 60.0 <= first["waited_s"] <= until_s + 15.0
    assert [wait["waited_s"] for wait in others] == [10.0, 10.0]
    lines = [status.doing for status in operator.statuses]
    waiting = [line for line in lines if line.startswith("sensor at")]
    assert any(line.startswith("sensor at 1") and line.endswith("C, waiting for -5.0 C") for line in waiting)
    assert lines.index(waiting[0]) < lines.index("moving")


@pytest.mark.parametrize("start_c", [20.0, None])
def test_default_is_not_to_wait(tmp_path: Path, start_c: float | None) -> None:
    camera = SimulatedSettings(size_px=(16, 12), start_temperature_c=start_c, cooling_s=60.0)
    assert capture(tmp_path / "session", settings=rig(camera)) is None
    assert waits(tmp_path / "session") == []
    temperatures = temperatures_c(tmp_path / "session")
    if start_c is None:
        assert set(temperatures) == {-20.0}
    else:
        assert temperatures[0] is not None
        assert temperatures[0] > -10.0


def test_sensor_that_stays_warm_fails_the_capture(tmp_path: Path) -> None:
    camera = replace(COOLED, cooling_s=600.0, settle_limit_s=30.0)
    failure = capture(tmp_path / "session", settings=rig(camera))
    assert isinstance(failure, CameraTimeout)
    assert "after 30 s, and did not stay within 0.5 K of -5.0 C for 10 s; check its cooler" in str(failure)
    assert taken_frames(tmp_path / "session") == []
    with Journal(tmp_path / "session" / "journal.sqlite", read_only=True) as journal:
        assert journal.uncommitted() == []  # nothing was exposed
        assert len(journal.events("camera_failed")) == 3


def test_operator_can_stop_the_wait(tmp_path: Path) -> None:
    operator = Operator()

    def stop_when_waiting(status: Status) -> None:
        if "waiting for -5.0 C" in status.doing:
            operator.requests[0] = "stop"

    operator.on_status = stop_when_waiting
    assert isinstance(capture(tmp_path / "session", operator, rig(COOLED)), CaptureStopped)
    assert taken_frames(tmp_path / "session") == []


def test_temperature_that_overshoots_is_not_settled(tmp_path: Path) -> None:
    # Within 0.5 K at 0 s, 2 s and 8 s, and from 14 s on
    readings = [-4.8, -5.2, -6.0, -6.5, -5.4, -5.6, -5.6, *[-5.0] * 1000]
    with mock.patch.object(SimulatedCamera, "temperature_c", side_effect=[-20.0, *readings]):
        assert capture(tmp_path / "session", settings=rig(COOLED)) is None
    assert waits(tmp_path / "session")[0]["waited_s"] == pytest.approx(14.0 + 10.0)


class CameraWithout:
    """A camera without a thermometer, or with a broken one."""

    def __init__(self, camera: Camera, **more: Any) -> None:
        self.open, self.close = camera.open, camera.close
        self.report, self.expose = camera.report, camera.expose
        vars(self).update(more)


def test_camera_without_temperature_is_refused_before_motion() -> None:
    settings = rig(COOLED)
    devices = open_rig(settings)
    for more in ({}, {"temperature_c": lambda: None}):
        mute = Rig(devices.stage, CameraWithout(devices.camera, **more), devices.clock, devices.arrange)
        with pytest.raises(PlanRefused, match=r"settle_temperature_c = -5, but the camera reports no temperature; "):
            survey(mute, settings)
    assert survey(devices, settings).plan.frame_count() == FRAMES
    require_temperature(mute.camera, FolderSettings("incoming"))
    with pytest.raises(PlanRefused):
        require_temperature(mute.camera, FolderSettings("incoming", settle_temperature_c=-5.0))
