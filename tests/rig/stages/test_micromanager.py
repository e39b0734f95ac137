"""XY stages of Micro-Manager, on a core that fails when it is told to."""

import sys
import threading
import time
from collections.abc import Callable
from typing import Any

import pytest
from msgspec.structs import replace

from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.settings import MicroManagerSettings, SimulatedSettings
from faintfield.rig.devices import open_rig
from faintfield.rig.errors import MissingExtra, NotHomed, PlanRefused, PositionLost, StageLost, StageTimeout, StageUnfit
from faintfield.rig.micromanager import SharedCore
from faintfield.rig.plan import Grid
from faintfield.rig.settings import DriftSettings, RigSettings, StepSettings
from faintfield.rig.simulation.controller.kinematics import SimulatedClock
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.micromanager import MicroManagerController, MicroManagerStage
from faintfield.rig.stages.protocol import Box, Point, StageSettings
from faintfield.testing import stage_contract

TRAVEL = Box((0.0, 12.0), (0.0, 12.0))
REST_S = 0.05


ANSWERS = {
    "getXYStageDevice": "XY",
    "getAllowedPropertyValues": ["1", "5"],
    "getDevicePropertyNames": ["Speed", "Position"],
    "getProperty": "5",
    "getDeviceLibrary": "Rehearsed",
    "getDeviceName": "XYStage",
    "getVersionInfo": "MMCore 0",
    "unloadAllDevices": None,
}


class Core:
    """The part of a core that a stage uses, on a simulated clock: axes of 5 mm/s that answer in micrometres."""

    def __init__(self, clock: SimulatedClock) -> None:
        self.clock = clock
        self.at_um = [0.0, 0.0]
        self.target_um = [0.0, 0.0]
        self.arrives_s = 0.0
        self.timeout_s = 5.0
        self.calls: list[str] = []
        self.fails: dict[str, Callable[[], object]] = {}
        self.creep_um_per_s = 0.0

    def __getattr__(self, name: str) -> Any:
        def call(*arguments: Any) -> Any:
            self.calls.append(name)
            if name in self.fails:
                self.fails[name]()
            return ANSWERS[name] if name in ANSWERS else getattr(self, f"on_{name}")(*arguments)

        return call

    def on_getLoadedDevicesOfType(self, kind: int) -> list[str]:
        return ["XY"] if kind == 6 else ["Camera", "Z"]

    def on_setProperty(self, label: str, name: str, value: str) -> None:
        assert (label, name) == ("XY", "Speed")

    def on_setXYPosition(self, label: str, x_um: float, y_um: float) -> None:
        self.settle()
        far_um = max(abs(x_um - self.at_um[0]), abs(y_um - self.at_um[1]))
        self.arrives_s = self.clock.now_s() + far_um / 5000.0
        self.target_um = [x_um, y_um]

    def on_setRelativeXYPosition(self, label: str, dx_um: float, dy_um: float) -> None:
        self.on_setXYPosition(label, self.at_um[0] + dx_um, self.at_um[1] + dy_um)

    def on_home(self, label: str) -> None:
        self.on_setXYPosition(label, 0.0, 0.0)

    def on_stop(self, label: str) -> None:
        self.arrives_s = self.clock.now_s()

    def on_getTimeoutMs(self) -> int:
        return round(1000.0 * self.timeout_s)

    def on_setTimeoutMs(self, bound_ms: int) -> None:
        self.timeout_s = bound_ms / 1000.0

    def on_waitForDevice(self, label: str) -> None:
        left_s = self.arrives_s - self.clock.now_s()
        self.clock.sleep_s(max(0.0, min(left_s, self.timeout_s)))
        if left_s > self.timeout_s:
            raise RuntimeError(f'Wait for device "{label}" timed out')
        self.settle()

    def on_deviceBusy(self, label: str) -> bool:
        return self.clock.now_s() < self.arrives_s

    def on_getXYPosition(self, label: str) -> tuple[float, float]:
        self.settle()
        return self.at_um[0] + self.creep_um_per_s * self.clock.now_s(), self.at_um[1]

    def on_isPropertyReadOnly(self, label: str, name: str) -> bool:
        return name == "Position"

    def settle(self) -> None:
        if self.clock.now_s() >= self.arrives_s:
            self.at_um = list(self.target_um)


class RehearsedCore(SharedCore):
    """A shared core whose core is a `Core`."""

    def __init__(self) -> None:
        super().__init__()
        self.clock = SimulatedClock()
        self.cores: list[Core] = []

    def import_package(self) -> None:
        pass

    def _load_core(self) -> Core:
        self.cores.append(Core(self.clock))
        return self.cores[-1]

    @property
    def core(self) -> Core:
        return self.cores[-1]


def rehearsed(**options: Any) -> tuple[RehearsedCore, Gantry]:
    """Return a stage on a rehearsed core."""
    shared = RehearsedCore()
    controller = MicroManagerController(shared, MicroManagerStage(**options), TRAVEL, shared.clock)
    return shared, Gantry(controller, StageSettings("micromanager", travel_mm=TRAVEL), shared.clock)


def homed(**options: Any) -> tuple[RehearsedCore, Gantry]:
    shared, stage = rehearsed(**options)
    stage.connect()
    stage.home()
    return shared, stage


def hang(shared: RehearsedCore, name: str) -> threading.Event:
    """Let a call of the core hang until the event is set."""
    end = threading.Event()
    shared.core.fails[name] = lambda: end.wait(30.0)
    return end


def test_contract_of_the_rehearsed_stage() -> None:
    stage_contract(rehearsed()[1])


def test_positions_are_micrometres_of_the_adapter() -> None:
    shared, stage = homed()
    stage.move_to(7.25, 3.5)
    assert shared.core.at_um == [7250.0, 3500.0]
    assert stage.position().point == Point(7.25, 3.5)
    assert stage.identify().settings == {"Speed": "5"}


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"device": "Camera"}, r"no XY stage 'Camera'; choose from XY$"),
        ({"properties": {"Speed": "2"}}, r"'Speed' of XY cannot be '2'; choose from 1, 5$"),
    ],
)
def test_missing_device_or_value_is_refused_with_choices(options: Any, message: str) -> None:
    shared, stage = rehearsed(**options)
    with pytest.raises(PlanRefused, match=rf"^\[stage\]: .*{message}"):
        stage.connect()
    assert "setProperty" not in shared.core.calls
    assert "unloadAllDevices" in shared.core.calls


def test_missing_package_names_its_installation(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "pymmcore_plus", None)
    controller = MicroManagerController(SharedCore(), MicroManagerStage(), TRAVEL, SimulatedClock())
    with pytest.raises(MissingExtra, match=r"pip install 'faintfield\[micromanager\]'"):
        controller.connect()


def test_report_counts_once_the_next_is_equal() -> None:
    shared, stage = homed()
    shared.core.creep_um_per_s = 0.4 / REST_S  # the limit is a tenth of 5 micrometres between two reports
    stage.position()
    shared.core.creep_um_per_s = 0.6 / REST_S
    with pytest.raises(StageTimeout, match="does not come to rest"):
        stage.position()
    assert not stage.trusted


def test_report_counts_once_the_adapter_is_idle() -> None:
    shared, stage = homed()
    shared.core.arrives_s = shared.clock.now_s() + 0.4  # it settles, and its reports do not show it
    stage.position()
    assert shared.clock.now_s() >= shared.core.arrives_s
    shared.core.arrives_s = shared.clock.now_s() + 60.0
    with pytest.raises(StageTimeout, match="does not come to rest"):
        stage.position()


def test_motion_that_takes_too_long_is_stopped() -> None:
    shared, stage = homed(rate_mm_per_s=100.0, acceleration_mm_per_s2=1000.0)
    with pytest.raises(StageTimeout, match=r"moving to \(11\.900, 0\.000\) mm within 2\.\d s .*lower stage.rate_"):
        stage.move_to(11.9, 0.0)
    assert "stop" in shared.core.calls
    assert not stage.trusted
    assert shared.core.timeout_s == 5.0  # which the camera may rely on


def test_failure_of_the_adapter_loses_the_position() -> None:
    shared, stage = homed()

    def unplugged() -> None:
        raise RuntimeError("Error in device XY:\n(serial port error)")

    shared.core.fails["getXYPosition"] = unplugged
    with pytest.raises(StageLost, match=r"failed at its report: Error in device XY: \(serial port error\); check"):
        stage.verify_at(0.0, 0.0)
    assert not stage.trusted
    shared.core.fails.clear()
    stage.recover()
    assert not stage.trusted
    stage.home()
    assert stage.trusted


@pytest.mark.parametrize("origin", ["home", "confirmed"])
def test_hanging_adapter_is_loaded_anew(origin: str) -> None:
    shared, stage = homed(origin=origin, answer_s=0.3)
    end = hang(shared, "getXYPosition")
    with pytest.raises(StageTimeout, match=r"did not finish its report within 0\.3 s, and its adapter hangs"):
        stage.position()
    end.set()
    with pytest.raises(StageLost, match="not connected"):
        stage.switches() or stage.position()
    stage.recover()
    assert len(shared.cores) == 2
    assert not stage.trusted
    if origin == "home":
        stage.home()
        assert stage.trusted
    else:
        with pytest.raises(StageUnfit, match="the position is lost"):
            stage.home()


def test_hanging_motion_is_stopped_and_again_on_return() -> None:
    shared, stage = homed(answer_s=0.1)
    core, end = shared.core, hang(shared, "setXYPosition")
    core.calls.clear()
    with pytest.raises(StageTimeout, match="its adapter hangs"):
        stage.move_to(1.0, 1.0)
    assert core.calls == ["setXYPosition", "stop"]
    end.set()
    while core.calls.count("stop") < 2:
        time.sleep(0.01)
    assert core.calls[-1] == "stop"
    assert core.calls.count("stop") == 2  # the motion began only when the call returned


def test_confirmed_origin_serves_one_homing_per_connection() -> None:
    shared, stage = rehearsed(origin="confirmed")
    stage.connect()
    with pytest.raises(NotHomed):
        stage.move_to(1.0, 1.0)
    stage.home()
    assert "home" not in shared.core.calls
    stage.move_to(1.0, 1.0)
    with pytest.raises(PositionLost):
        stage.verify_at(2.0, 2.0)
    with pytest.raises(StageUnfit, match=r"find the origin with the stage's own program"):
        stage.home()
    assert not stage.trusted
    stage.close()
    stage.connect()
    stage.home()
    assert stage.trusted


def rig(**options: Any) -> RigSettings:
    """Return a rig whose camera and stage are Micro-Manager's."""
    return RigSettings(
        stage=StageSettings("micromanager", travel_mm=TRAVEL, options=options),
        camera=MicroManagerSettings(),
        grid=Grid(rows=2, columns=2, pitch_mm=2.0, origin_mm=Point(1.0, 1.0)),
        step=(StepSettings("bright", 0.01),),
        drift=DriftSettings(check=False),
    )


def test_camera_and_stage_share_one_core() -> None:
    devices = open_rig(rig())
    camera, stage = devices.camera, devices.stage
    assert isinstance(camera, MicroManagerCamera)
    assert camera._shared is stage._controller._shared  # type: ignore[attr-defined]  # noqa: SLF001 - it is behind them
    with pytest.raises(PlanRefused, match=r"stage\.configuration = 'other\.cfg', or .*; Micro-Manager loads one"):
        open_rig(rig(configuration="other.cfg"))


def test_drift_check_by_the_switches_is_refused() -> None:
    with pytest.raises(PlanRefused, match=r"drift\.check = true times homing .*; set it to false"):
        open_rig(replace(rig(), drift=DriftSettings()))
    with pytest.raises(PlanRefused, match=r"needs stage\.protocol = 'simulated'"):
        open_rig(replace(rig(), camera=SimulatedSettings()))


def test_devices_are_unloaded_after_their_last_user() -> None:
    shared = RehearsedCore()
    core = shared.acquire("camera")
    assert shared.acquire("stage") is core
    shared.release("camera")
    assert "unloadAllDevices" not in shared.core.calls
    for _ in range(2):  # the second has no effect
        shared.release("stage")
        assert shared.core.calls.count("unloadAllDevices") == 1
    assert shared.acquire("stage") is not core


def test_hanging_camera_leaves_the_core_to_the_stage() -> None:
    shared = RehearsedCore()
    core = shared.acquire("stage")
    shared.acquire("camera")
    shared.abandon("camera")
    with pytest.raises(RuntimeError, match="a call of the camera hangs in Micro-Manager, which stage uses as well"):
        shared.acquire("camera")
    core.getXYPosition("XY")
    shared.release("stage")
    assert "unloadAllDevices" not in shared.core.calls  # it would wait for the call that hangs
