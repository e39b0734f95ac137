"""What the tests of drivers share: a homed stage, and a record of the serial traffic."""

from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import StageSettings

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


def hal(bench: Bench) -> SimulatedGrblHal:
    assert isinstance(bench.firmware, SimulatedGrblHal)
    return bench.firmware


def grbl(bench: Bench) -> SimulatedGrbl:
    assert isinstance(bench.firmware, SimulatedGrbl)
    return bench.firmware


def marlin(bench: Bench) -> SimulatedMarlin:
    assert isinstance(bench.firmware, SimulatedMarlin)
    return bench.firmware
