"""From the configuration to the devices it names, real or simulated."""

from functools import partial

import msgspec

from rig.clock import WallClock
from rig.errors import PlanRefused
from rig.simulation.controller.bench import Bench
from rig.simulation.controller.grbl import SimulatedGrbl
from rig.simulation.controller.marlin import SimulatedMarlin
from rig.stages.gantry import Gantry
from rig.stages.opening import stage_from
from rig.stages.settings import StageSettings
from rig.stages.transport import NoTrafficLog, SerialPort, TrafficLog

_SIMULATED = {"grbl": SimulatedGrbl, "marlin": SimulatedMarlin}


def open_stage(settings: StageSettings, traffic: TrafficLog | None = None) -> Gantry:
    """Return the stage that `settings` describe, not yet connected.

    Protocol `simulated`, or a port `simulated:grbl` or `simulated:marlin`, gives a simulated stage that keeps its own
    time: nothing takes any.

    Parameters
    ----------
    settings : StageSettings
        The `[stage]` table.
    traffic : TrafficLog, optional
        Where every byte is recorded.

    Raises
    ------
    PlanRefused
        No such stage is simulated.
    """
    traffic = traffic or NoTrafficLog()
    if settings.protocol == "simulated" or settings.port.startswith("simulated:"):
        bench = _simulated_bench(settings)
        port = settings.port or bench.link.url
        return bench.stage(msgspec.structs.replace(settings, protocol=bench.firmware.protocol, port=port), traffic)
    return stage_from(settings, WallClock(), traffic, partial(SerialPort, settings.port, settings.baud))


def _simulated_bench(settings: StageSettings) -> Bench:
    """Return the bench of the simulated stage that `settings` name."""
    name = settings.port.partition(":")[2] or "grbl"
    if name not in _SIMULATED:
        raise PlanRefused(f"{settings.port}: no such stage is simulated; there are {', '.join(_SIMULATED)}")
    return Bench(_SIMULATED[name])
