"""Every light meets the contract; what outputs of controllers and commands do besides."""

from collections.abc import Callable
from pathlib import Path
from unittest import mock

import pytest
from msgspec import Struct, ValidationError, convert

from faintfield.rig.clock import WallClock
from faintfield.rig.errors import LightError, PlanRefused, StageRejected
from faintfield.rig.lights.command import CommandLight
from faintfield.rig.lights.controller import ControllerLight
from faintfield.rig.lights.protocol import Light
from faintfield.rig.lights.settings import BUILT_IN_DRIVERS, CommandSettings, LightSettings, PluginSettings
from faintfield.rig.plugins import LightPlugin, PluginLight, fold_plugins, plugin_light
from faintfield.rig.settings import RigSettings, StepSettings
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.simulation.lab import SimulatedLight
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Controller as ControllerProtocol
from faintfield.rig.stages.protocol import Output
from faintfield.testing import light_contract
from tests.faults.capturing import SMALL_RIG
from tests.rig.stages.benches import CONTROLLERS, Controller, firmware, homed

FLOOD, MIST, SPINDLE = Output("flood"), Output("mist"), Output("spindle")
OF_CONTROLLER: list[tuple[Controller, Output]] = [
    *((controller, output) for controller in CONTROLLERS[:2] for output in (FLOOD, MIST, SPINDLE)),
    (SimulatedMarlin, Output("pin", 57)),
    (SimulatedMarlin, Output("fan", 1, level=128.0)),
]


@pytest.mark.parametrize(("controller", "output"), OF_CONTROLLER)
def test_contract_of_an_output(controller: Controller, output: Output) -> None:
    bench = Bench(controller)
    light = ControllerLight("room", homed(bench), output)
    light_contract(light)
    light.open()
    for on in (True, False):
        light.switch(on)
        assert bench.firmware.output_on(output) == on
        assert light.is_on() == (None if controller is SimulatedMarlin else on)


def command_light(folder: Path, **changes: tuple[str, ...] | float) -> CommandLight:
    """Return a light whose state is that of a file."""
    lamp = str(folder / "lamp")
    write = ("/bin/sh", "-c", 'echo "$2" > "$1"', "sh", lamp)
    commands = {"on": (*write, "ON"), "off": (*write, "0"), "state": ("/bin/cat", lamp)}
    return CommandLight(convert({"name": "lamp", **commands, **changes}, CommandSettings))


@pytest.mark.parametrize("light", [SimulatedLight("room"), PluginLight("sky", SimulatedLight("room"))])
def test_contract(light: Light) -> None:
    light_contract(light)


def test_contract_of_a_command(tmp_path: Path) -> None:
    light = command_light(tmp_path)
    light_contract(light)
    light.open()
    light.switch(True)
    assert light.is_on() is True
    assert command_light(tmp_path, state=()).is_on() is None


@pytest.mark.parametrize(
    ("command", "words"),
    [
        (("/no/such/program",), r"cannot be run \(.*; correct the command"),
        (("/bin/sh", "-c", "echo no relay >&2; exit 3"), r"exit code 3, saying 'no relay'; run it by hand"),
        (("/bin/sh", "-c", "sleep 60; true"), r"did not end within 0\.3 s; raise limit_s"),
    ],
)
def test_failing_command_is_named(tmp_path: Path, command: tuple[str, ...], words: str) -> None:
    light = command_light(tmp_path, on=command, limit_s=0.3)
    light.open()
    with pytest.raises(LightError, match=words):
        light.switch(True)


def test_command_sees_no_shell(tmp_path: Path) -> None:
    light = command_light(tmp_path, state=("/bin/echo", "on;", "$(touch", f"{tmp_path}/made)"))
    light.open()
    with pytest.raises(LightError, match=r"printed 'on; \$\(touch .*'; let it print 'on' or 'off'"):
        light.is_on()
    assert not (tmp_path / "made").exists()


def test_other_coolant_stays_on() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    for output in (FLOOD, MIST, SPINDLE):
        stage.switch_output(output, on=True)
    stage.switch_output(FLOOD, on=False)
    assert bench.firmware.outputs == {"mist", "spindle"}
    assert [stage.read_output(output) for output in (FLOOD, MIST, SPINDLE)] == [False, True, True]


EVENTS: list[Callable[[SimulatedGrbl], None]] = [
    lambda grbl: grbl.receive(b"\xa0"),
    lambda grbl: grbl.receive(b"\x18"),
    lambda grbl: grbl.alarm(2),
    SimulatedGrbl.open_door,
    SimulatedGrbl.restart,
]


@pytest.mark.parametrize("reports", range(12))
@pytest.mark.parametrize("controller", CONTROLLERS[:2])
def test_any_report_tells_an_output_that_went_off(controller: Controller, reports: int) -> None:
    """Whatever report is due next: the work offset puts the outputs off."""
    bench = Bench(controller)
    stage = homed(bench)
    stage.switch_output(FLOOD, on=True)
    for _ in range(reports):
        stage.position()
    assert stage.read_output(FLOOD) is True
    bench.firmware.receive(b"\xa0")  # a button of the machine
    stage.position()
    assert stage.read_output(FLOOD) is False


@pytest.mark.parametrize("event", EVENTS)
@pytest.mark.parametrize("controller", [SimulatedGrbl, SimulatedGrblHal])
def test_output_is_off_after_recovery(controller: type[SimulatedGrbl], event: Callable[[SimulatedGrbl], None]) -> None:
    bench = Bench(controller)
    stage = homed(bench)
    before = stage.recoveries
    stage.switch_output(FLOOD, on=True)
    event(firmware(bench, SimulatedGrbl))
    bench.clock.sleep_s(2.0)
    stage.recover()
    stage.home()
    assert stage.read_output(FLOOD) is bench.firmware.output_on(FLOOD) is False
    assert stage.recoveries == before + 1
    stage.switch_output(FLOOD, on=True)
    assert stage.read_output(FLOOD) is True


def test_moving_stage_is_stopped_before_lights_go_off() -> None:
    for controller in CONTROLLERS:
        bench = Bench(controller)
        stage = homed(bench)
        output = FLOOD if controller is not SimulatedMarlin else Output("pin", 57)
        stage.switch_output(output, on=True)

        def interrupt() -> None:
            raise KeyboardInterrupt

        bench.clock.after(1.0, interrupt)
        target = (-300.0, -300.0) if controller is not SimulatedMarlin else (300.0, 300.0)
        with pytest.raises(KeyboardInterrupt):
            stage.move_to(*target)
        stage.switch_output(output, on=False)
        assert not bench.firmware.outputs
        assert not bench.firmware.mechanics.moving


def test_firmware_that_never_reports_outputs_is_believed() -> None:
    bench = Bench(SimulatedGrbl)
    bench.wire.filters_to_host.append(lambda data: data.replace(b"|Ov:100,100,100", b"").replace(b"|A:F", b""))
    stage = homed(bench)
    stage.switch_output(FLOOD, on=True)
    assert stage.read_output(FLOOD) is None
    begun_s = bench.clock.now_s()
    assert stage.read_output(FLOOD) is None
    assert bench.clock.now_s() - begun_s < 0.5


@pytest.mark.parametrize(
    ("controller", "output", "words"),
    [
        (SimulatedGrbl, Output("pin", 3), "GRBL has no output 'pin'; choose from flood, mist, spindle"),
        (SimulatedMarlin, FLOOD, "Marlin has no output 'flood'; choose pin or fan"),
    ],
)
def test_foreign_output_is_refused(controller: Controller, output: Output, words: str) -> None:
    stage = homed(Bench(controller))
    with pytest.raises(StageRejected, match=words):
        stage.switch_output(output, on=True)
    assert stage.trusted


def test_stage_without_outputs_refuses_lights() -> None:
    bench = Bench(SimulatedGrbl)
    stage = Gantry(mock.create_autospec(ControllerProtocol, instance=True), bench.stage().settings, bench.clock)
    with pytest.raises(PlanRefused, match="has no outputs for lights; switch them with driver = 'command'"):
        stage.switch_output(FLOOD, on=True)


@pytest.mark.parametrize(
    ("table", "words"),
    [
        ({"driver": "controller", "output": "laser"}, "Invalid enum value 'laser'"),
        ({"driver": "controller", "output": "pin", "number": -1}, "number = -1; give 0 to 999"),
        ({"driver": "controller", "output": "fan", "level": 0.0}, "level = 0; give more than 0"),
        ({"driver": "command", "on": [], "off": ["relay"]}, r"\[\] is no command; give a program"),
        ({"driver": "command", "on": ["relay"], "off": ["relay"], "limit_s": 0.0}, "limit_s = 0; give more than 0"),
        ({"driver": "simulated", "steady_s": -1.0}, "steady_s = -1; give 0 to 3600 s"),
    ],
)
def test_impossible_light_is_refused(table: dict[str, object], words: str) -> None:
    with pytest.raises(ValidationError, match=words):
        convert({"name": "room", **table}, LightSettings)


def test_steps_name_lights_of_the_rig() -> None:
    room = convert({"name": "room", "driver": "simulated"}, LightSettings)
    step = StepSettings("bright", 0.1, lights=("room", "rom"))
    for lights, words in (
        ((room,), r"step\.lights has 'rom'; .* are: 'room'"),
        ((room, room), "two lights .* 'room'"),
        ((), r"there is no \[\[light\]\]"),
    ):
        with pytest.raises(ValueError, match=words):
            RigSettings(SMALL_RIG.stage, SMALL_RIG.camera, SMALL_RIG.grid, (step,), light=lights)


class Sky(Struct, frozen=True, forbid_unknown_fields=True):
    port: int = 1


def test_light_of_another_package(monkeypatch: pytest.MonkeyPatch) -> None:
    made: list[Sky] = []

    def make(settings: Sky, clock: object) -> Light:
        made.append(settings)
        return SimulatedLight("sky")

    monkeypatch.setattr("faintfield.rig.plugins._entry_points", lambda group, name: [])
    monkeypatch.setattr("faintfield.rig.plugins._load", lambda group, name, kind: LightPlugin(Sky, make))
    table = {"name": "room", "driver": "sky", "steady_s": 0.5, "port": 7}
    folded = fold_plugins({"light": [table, {"name": "lamp", "driver": "simulated"}]})["light"]
    settings = convert(folded[0], LightSettings)
    assert settings == PluginSettings(name="room", steady_s=0.5, plugin="sky", options={"port": 7})
    assert folded[1] == {"name": "lamp", "driver": "simulated"}
    light_contract(plugin_light(settings, WallClock()))
    assert made == [Sky(7)]


def test_built_in_drivers_are_those_with_settings() -> None:
    tags = {settings.__struct_config__.tag for settings in LightSettings.__value__.__args__}
    assert tags == {*BUILT_IN_DRIVERS, "plugin"}
