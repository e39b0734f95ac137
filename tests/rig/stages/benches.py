"""Benches of drivers: a homed stage, its controller, and a record of the serial traffic."""

from collections.abc import Callable

from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Point, StageSettings

type Controller = type[SimulatedGrbl] | type[SimulatedMarlin]

CONTROLLERS: list[Controller] = [SimulatedGrbl, SimulatedGrblHal, SimulatedMarlin]


class Traffic:
    """A `TrafficLog` that keeps all entries."""

    def __init__(self) -> None:
        self.entries: list[tuple[float, str, bytes]] = []

    def record(self, at_s: float, direction: str, data: bytes) -> None:
        self.entries.append((at_s, direction, data))

    def all(self, direction: str) -> bytes:
        return b"".join(self.chunks(direction))

    def chunks(self, direction: str) -> list[bytes]:
        return [data for _, way, data in self.entries if way == direction]


def homed(bench: Bench, traffic: Traffic | None = None, settings: StageSettings | None = None) -> Gantry:
    stage = bench.stage(settings, traffic)
    stage.connect()
    stage.home()
    return stage


def firmware[Kind: SimulatedGrbl | SimulatedMarlin](bench: Bench, kind: type[Kind]) -> Kind:
    """Return the controller of a bench, which must be of this kind."""
    assert isinstance(bench.firmware, kind)
    return bench.firmware


def diagonal(stage: Gantry, distance_mm: float) -> Point:
    """Return a point at a distance from the switches along both axes, within the travel."""
    sign = 1.0 if stage.travel().x_mm[0] == 0.0 else -1.0
    return Point(sign * distance_mm, sign * distance_mm)


def on_homing(bench: Bench, act: Callable[[int], object]) -> None:
    """Call `act` with the number of each homing from now on, as it begins."""
    homings: list[bool] = []

    def count(data: bytes) -> bytes:
        if b"$H" in data or b"G28" in data:
            homings.append(True)
            act(len(homings))
        return data

    bench.wire.filters_to_controller.append(count)


def keep_host_busy(bench: Bench, for_s: float = 3.0) -> None:
    """Let the driver read nothing for a while, from soon on."""
    bench.clock.after(0.3, lambda: setattr(bench, "host_busy_until_s", bench.clock.now_s() + for_s))
