"""From settings to a stage."""

from collections.abc import Callable

from faintfield.rig.clock import Clock
from faintfield.rig.stages.gantry import Controller, Gantry
from faintfield.rig.stages.grbl.stage import Grbl
from faintfield.rig.stages.marlin.stage import Marlin
from faintfield.rig.stages.settings import StageSettings
from faintfield.rig.stages.transport import LineTransport, Port, TrafficLog


def stage_from(settings: StageSettings, clock: Clock, traffic: TrafficLog, open_port: Callable[[], Port]) -> Gantry:
    """Return the stage that `settings` describe, not yet connected.

    Parameters
    ----------
    settings : StageSettings
        Protocol, axes and limits.
    clock : Clock
        The rig's time.
    traffic : TrafficLog
        Where every byte is recorded.
    open_port : callable
        Opens the connection; `SerialPort` on `settings.port` for real hardware.
    """
    line = LineTransport(open_port, clock, traffic)
    controller: Controller
    if settings.protocol == "grbl":
        controller = Grbl(line, settings.axes)
    else:
        controller = Marlin(line, settings.axes, settings.travel_mm)
    return Gantry(controller, settings, clock)
