"""Makes the stage that rig.toml describes, with the driver of its firmware."""

from collections.abc import Callable

from faintfield.rig.clock import Clock
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.grbl.controller import GrblController
from faintfield.rig.stages.marlin.controller import MarlinController
from faintfield.rig.stages.protocol import StageSettings
from faintfield.rig.stages.transport import LineTransport, Port, TrafficLog


def make_stage(
    settings: StageSettings, clock: Clock, traffic: TrafficLog | None, open_port: Callable[[], Port]
) -> Gantry:
    """Return the stage that `settings` describe, not yet connected.

    Parameters
    ----------
    settings : StageSettings
        Protocol, axes and limits.
    clock : Clock
        Clock of the rig.
    traffic : TrafficLog, optional
        Log of every byte sent and received.
    open_port : callable
        Opens the connection; for real hardware, a `SerialPort` on `settings.port`.
    """
    line = LineTransport(open_port, clock, traffic)
    if settings.protocol == "grbl":
        return Gantry(GrblController(line, settings.axes), settings, clock)
    return Gantry(MarlinController(line, settings.axes, settings.travel_mm), settings, clock)
