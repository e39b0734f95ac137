"""Makes the stage and the camera that rig.toml describes, real or simulated."""

import weakref
from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import msgspec

from faintfield.rig.cameras.folder import FolderCamera
from faintfield.rig.cameras.gphoto2 import GPhoto2Camera
from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.protocol import Camera
from faintfield.rig.cameras.settings import FolderSettings, GPhoto2Settings, MicroManagerSettings, SimulatedSettings
from faintfield.rig.clock import Clock, WallClock
from faintfield.rig.errors import PlanRefused
from faintfield.rig.plan import StepKind
from faintfield.rig.settings import RigSettings
from faintfield.rig.simulation.controller.bench import Bench, PtyLink
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.simulation.lab import SimulatedCamera, SimulatedLab
from faintfield.rig.stages.gantry import Gantry, make_stage
from faintfield.rig.stages.protocol import StageSettings
from faintfield.rig.stages.transport import SerialPort, TrafficLog

# Prefix of the port of a simulated stage; the name of its controller follows.
SIMULATED = "simulated:"
SIMULATED_FIRMWARE = {"grbl": SimulatedGrbl, "marlin": SimulatedMarlin}


@dataclass(frozen=True)
class Rig:
    """The devices of a capture, not yet connected.

    Parameters
    ----------
    stage, camera : Gantry, Camera
        The devices.
    clock : Clock
        Their clock.
    arrange : callable
        Called with kind and sweep at the beginning of each step; a simulated lab then does what a person does in a
        real one.
    """

    stage: Gantry
    camera: Camera
    clock: Clock
    arrange: Callable[[StepKind, int], None]


def open_rig(settings: RigSettings, traffic: TrafficLog | None = None) -> Rig:
    """Construct the stage and the camera of a rig.toml; neither is connected yet.

    Raises
    ------
    PlanRefused
        The camera is simulated and the stage is not, so that the camera's true position is not known.
    """
    bench = _simulated_bench(settings.stage) if is_simulated(settings.stage) else None
    stage = open_stage(settings.stage, traffic, bench)
    match settings.camera:
        case GPhoto2Settings():
            camera: Camera = GPhoto2Camera(settings.camera)
        case MicroManagerSettings():
            camera = MicroManagerCamera(settings.camera)
        case FolderSettings():
            camera = FolderCamera(settings.camera, WallClock())
        case SimulatedSettings() if bench is not None:
            centre = settings.grid.centre().target
            lab = SimulatedLab(centre, bench.true_position, bench.still_s, settings.board, settings.camera)
            camera = SimulatedCamera(settings.camera, stage.clock, lab)
            return Rig(stage, camera, stage.clock, lab.arrange)
        case SimulatedSettings():
            raise PlanRefused("camera.backend = 'simulated' needs stage.protocol = 'simulated'; change one of them")
    return Rig(stage, camera, stage.clock, lambda kind, sweep: None)


def open_stage(settings: StageSettings, traffic: TrafficLog | None = None, bench: Bench | None = None) -> Gantry:
    """Return the stage that `settings` describe, not yet connected.

    Protocol `simulated`, or a port `simulated:grbl` or `simulated:marlin`, gives a simulated stage with a clock of its
    own, so that motions take no real time.

    Parameters
    ----------
    settings : StageSettings
        The `[stage]` table.
    traffic : TrafficLog, optional
        Log of every byte sent and received.
    bench : Bench, optional
        Bench of a simulated stage; by default a new one.

    Raises
    ------
    PlanRefused
        The port names no simulated stage.
    """
    if is_simulated(settings):
        bench = bench or _simulated_bench(settings)
        port = bench.link.url if isinstance(bench.link, PtyLink) else settings.port or bench.link.url
        return bench.stage(msgspec.structs.replace(settings, protocol=bench.firmware.protocol, port=port), traffic)
    return make_stage(settings, WallClock(), traffic, partial(SerialPort, settings.port, settings.baud))


def is_simulated(settings: StageSettings) -> bool:
    """Return whether `settings` describe a simulated stage."""
    return settings.protocol == "simulated" or settings.port.startswith(SIMULATED)


def _simulated_bench(settings: StageSettings) -> Bench:
    """Return the bench of the simulated stage that `settings` name, such as `simulated:grbl` or `simulated:grbl:pty`.

    With `:pty`, every byte passes through a pseudo-terminal and pyserial.
    """
    name, _, cable = settings.port.removeprefix(SIMULATED).partition(":")
    if (name or "grbl") not in SIMULATED_FIRMWARE or cable not in ("", "pty"):
        raise PlanRefused(
            f"{settings.port}: no such stage is simulated; name one of {', '.join(SIMULATED_FIRMWARE)}, "
            "with or without :pty after it"
        )
    if not cable:
        return Bench(SIMULATED_FIRMWARE[name or "grbl"])
    link = PtyLink()
    bench = Bench(SIMULATED_FIRMWARE[name], link)
    weakref.finalize(bench, link.close)
    return bench
