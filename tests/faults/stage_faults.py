"""Faults of stages: each strikes a bench once and its effect remains: a byte is lost, a cable is unplugged."""

from collections.abc import Callable
from dataclasses import dataclass
from operator import methodcaller
from typing import Literal

from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.firmware import ByteFilter, SimulatedFirmware
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from tests.rig.stages.benches import firmware

type Nature = Literal["wire", "controller", "mechanics"]


@dataclass(frozen=True)
class Fault:
    """Fault of a stage: the part affected, and the function that causes it on a bench.

    Faults of the mechanics show in no report; only a drift check finds them. `kind` is that of the controllers that can
    have it.
    """

    name: str
    nature: Nature
    strike: Callable[[Bench], None]
    kind: type = object

    def __str__(self) -> str:
        return self.name


def _drop(data: bytes) -> bytes:
    return data[: len(data) // 2] + data[len(data) // 2 + 1 :]


def _double(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[: middle + 1] + data[middle:]


def _flip(data: bytes) -> bytes:
    middle = len(data) // 2
    return data[:middle] + bytes([data[middle] ^ 0x04]) + data[middle + 1 :] if data else data


def filter_once(filters: list[ByteFilter], change: ByteFilter, applies: Callable[[bytes], bool] = bool) -> None:
    """Change only the next bytes to which `applies`."""

    def once(data: bytes) -> bytes:
        if not applies(data):
            return data
        filters.remove(once)
        return change(data)

    filters.append(once)


def _silence(bench: Bench, filters: list[ByteFilter], duration_s: float) -> None:
    """Lose all bytes for `duration_s`."""

    def nothing(data: bytes) -> bytes:
        return b""

    filters.append(nothing)
    bench.clock.after(duration_s, lambda: filters.remove(nothing))


def _to_controller(change: ByteFilter) -> Callable[[Bench], None]:
    return lambda bench: filter_once(bench.wire.filters_to_controller, change)


def _to_host(change: ByteFilter) -> Callable[[Bench], None]:
    return lambda bench: filter_once(bench.wire.filters_to_host, change)


def _lose_ok(bench: Bench) -> None:
    filter_once(bench.wire.filters_to_host, lambda data: b"", lambda data: data.strip() == b"ok")


def _babble(bench: Bench) -> None:
    """Send nonsense a hundred times a second for a minute."""
    for line in range(6000):
        bench.clock.after(0.01 * line, lambda: bench.firmware.say("<Jog|MPos:0.0"))


def restart_unseen(bench: Bench) -> None:
    bench.firmware.restart()
    _silence(bench, bench.wire.filters_to_host, bench.firmware.boot_s + 0.1)


def unplug_for(duration_s: float) -> Callable[[Bench], None]:
    """Return what unplugs a bench, and plugs it in again later."""

    def strike(bench: Bench) -> None:
        bench.unplug()
        bench.clock.after(duration_s, bench.plug)

    return strike


def _keep_host_busy(bench: Bench) -> None:
    bench.host_busy_until_s = bench.clock.now_s() + 1.0


def _await_button(marlin: SimulatedMarlin) -> None:
    marlin.wait_for_button()
    marlin.clock.after(10.0, marlin.press_button)


def stick(bench: Bench) -> None:
    bench.true_position()
    bench.firmware.mechanics.axes[0].stuck = True


def _stick_briefly(bench: Bench) -> None:
    stick(bench)

    def free() -> None:
        bench.true_position()
        bench.firmware.mechanics.axes[0].stuck = False

    bench.clock.after(2.0, free)


def lose_steps(axis: int, by_mm: float) -> Callable[[Bench], None]:
    def strike(bench: Bench) -> None:
        bench.true_position()
        bench.firmware.mechanics.axes[axis].slip_mm += by_mm

    return strike


def _push_by_pendant(bench: Bench) -> None:
    """Move the stage as if by a hand control."""
    x, y = bench.firmware.mechanics.commanded_mm()
    inward = -3.0 if isinstance(bench.firmware, SimulatedGrbl) else 3.0
    bench.firmware.mechanics.queue((x + inward, y + inward), 20.0, 500.0)


def report_idle_early(bench: Bench) -> None:
    """Report idle once while the stage moves."""
    filter_once(bench.wire.filters_to_host, lambda data: data.replace(b"<Jog", b"<Idle"), lambda data: b"<Jog" in data)


def _lose_settings(grbl: SimulatedGrbl) -> None:
    grbl.settings.update({130: "200.000", 131: "200.000", 22: "0"})
    grbl.restart()


def _stop_briefly(hal: SimulatedGrblHal) -> None:
    hal.press_emergency_stop()
    hal.clock.after(4.0, hal.release_emergency_stop)


def _damage_every_line(bench: Bench) -> None:
    bench.wire.filters_to_controller.append(lambda data: _flip(data) if len(data) > 4 else data)


_COMMON = (
    Fault("byte to the controller lost", "wire", _to_controller(_drop)),
    Fault("byte to the controller doubled", "wire", _to_controller(_double)),
    Fault("bit to the controller flipped", "wire", _to_controller(_flip)),
    Fault("byte to the host lost", "wire", _to_host(_drop)),
    Fault("byte to the host doubled", "wire", _to_host(_double)),
    Fault("bit to the host flipped", "wire", _to_host(_flip)),
    Fault("line to the host doubled", "wire", _to_host(lambda data: data + data)),
    Fault("ok lost", "wire", _lose_ok),
    Fault("ok too many", "wire", lambda bench: bench.firmware.say("ok")),
    Fault("noise", "wire", lambda bench: bench.wire.to_host(bytes(range(128, 256)) + b"\x00ok\x00\n")),
    Fault("controller mute", "wire", lambda bench: bench.wire.filters_to_host.append(lambda data: b"")),
    Fault("controller deaf", "wire", lambda bench: bench.wire.filters_to_controller.append(lambda data: b"")),
    Fault("silence for a moment", "wire", lambda bench: _silence(bench, bench.wire.filters_to_host, 0.5)),
    Fault("answers late", "wire", lambda bench: bench.wire.hold_up(1.0)),
    Fault("babble", "wire", _babble),
    Fault("every line damaged", "wire", _damage_every_line),
    Fault("unplugged", "wire", Bench.unplug),
    Fault("unplugged and back", "wire", unplug_for(0.3)),
    Fault("port gone for three seconds", "wire", unplug_for(3.0)),
    Fault("computer busy", "wire", _keep_host_busy),
    Fault("restart", "controller", lambda bench: bench.firmware.restart()),
    Fault("restart unseen", "controller", restart_unseen),
    Fault("busy for ever", "controller", lambda bench: setattr(bench.firmware.mechanics, "endless", True)),
    Fault("slow homing", "controller", lambda bench: setattr(bench.firmware, "homing_slowdown", 40.0)),
    Fault("moved by pendant", "controller", _push_by_pendant),
    Fault("axis stuck", "mechanics", stick),
    Fault("axis stuck for a moment", "mechanics", _stick_briefly),
    Fault("steps lost towards the switch", "mechanics", lose_steps(0, 0.8)),
    Fault("steps lost the other way", "mechanics", lose_steps(1, -0.8)),
)


def _of[Kind: SimulatedGrbl | SimulatedMarlin](
    name: str, kind: type[Kind], act: Callable[[Kind], None], nature: Nature = "controller"
) -> Fault:
    return Fault(name, nature, lambda bench: act(firmware(bench, kind)), kind)


_GRBL = (
    *(_of(f"alarm {code}", SimulatedGrbl, methodcaller("alarm", code)) for code in range(1, 10)),
    _of("hold button", SimulatedGrbl, SimulatedGrbl.pause),
    _of("door open", SimulatedGrbl, methodcaller("open_door")),
    _of("settings lost", SimulatedGrbl, _lose_settings),
    Fault("idle reported too early", "wire", report_idle_early, SimulatedGrbl),
    _of("emergency stop", SimulatedGrblHal, SimulatedGrblHal.press_emergency_stop),
    _of("emergency stop for a moment", SimulatedGrblHal, _stop_briefly),
)
_MARLIN = (
    _of("killed", SimulatedMarlin, methodcaller("kill", "MINTEMP triggered")),
    _of("button awaited for a moment", SimulatedMarlin, _await_button),
    _of("motors released", SimulatedMarlin, SimulatedMarlin.release_motors, "mechanics"),
)

FAULTS = (*_COMMON, *_GRBL, *_MARLIN)


def faults_of(controller: type[SimulatedFirmware]) -> tuple[Fault, ...]:
    """Return the faults that a controller can have."""
    return tuple(fault for fault in FAULTS if issubclass(controller, fault.kind))
