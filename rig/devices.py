"""Construct the stage, the camera and the lights that rig.toml describes, real or simulated."""

import weakref
from collections.abc import Callable, Mapping
from dataclasses import dataclass, field
from functools import partial

import msgspec

from faintfield.rig.cameras import settings as cameras
from faintfield.rig.cameras.aravis import AravisCamera
from faintfield.rig.cameras.folder import FolderCamera
from faintfield.rig.cameras.gphoto2 import GPhoto2Camera
from faintfield.rig.cameras.micromanager import MicroManagerCamera
from faintfield.rig.cameras.protocol import Camera, Decode
from faintfield.rig.clock import Clock, WallClock
from faintfield.rig.errors import PlanRefused
from faintfield.rig.lights import settings as lights
from faintfield.rig.lights.command import CommandLight
from faintfield.rig.lights.controller import ControllerLight
from faintfield.rig.lights.protocol import Light
from faintfield.rig.micromanager import SharedCore
from faintfield.rig.plan import StepKind
from faintfield.rig.plugins import convert_options, plugin_camera, plugin_controller, plugin_light
from faintfield.rig.settings import RigSettings
from faintfield.rig.simulation.controller.bench import Bench, PtyLink
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.simulation.lab import SimulatedCamera, SimulatedLab, SimulatedLight
from faintfield.rig.stages.gantry import Gantry, serial_stage
from faintfield.rig.stages.micromanager import MicroManagerController, MicroManagerStage
from faintfield.rig.stages.protocol import SERIAL_PROTOCOLS, SIMULATED, OutputKind, StageSettings
from faintfield.rig.stages.transport import SerialPort, TrafficLog

SIMULATED_FIRMWARE = {"grbl": SimulatedGrbl, "grblhal": SimulatedGrblHal, "marlin": SimulatedMarlin}


# Outputs of the controllers that are known here.
_GRBL_OUTPUTS: tuple[OutputKind, ...] = ("flood", "mist", "spindle")
_OUTPUTS: dict[str, tuple[OutputKind, ...]] = {
    "grbl": _GRBL_OUTPUTS,
    "grblhal": _GRBL_OUTPUTS,
    "marlin": ("pin", "fan"),
}


@dataclass(frozen=True)
class Rig:
    """The devices of a capture, not yet connected, and their clock.

    Attributes
    ----------
    stage, camera : Gantry, Camera
        The stage and the camera.
    clock : Clock
        Clock of all devices.
    arrange : callable
        Is called with kind and sweep at the beginning of each step; a simulated lab then does what a person does in a
        real one.
    camera_sees_stage : bool
        False if a real camera looks on while a simulated stage moves: it neither swings with the stage nor shares its
        clock.
    lights : mapping of str to Light
        Lights that the rig switches, by name.
    """

    stage: Gantry
    camera: Camera
    clock: Clock
    arrange: Callable[[StepKind, int], None]
    camera_sees_stage: bool = True
    lights: Mapping[str, Light] = field(default_factory=dict)


def open_rig(settings: RigSettings, traffic: TrafficLog | None = None, decode: Decode = lambda path: None) -> Rig:
    """Construct the stage, the camera and the lights of a rig.toml; none is connected yet.

    Parameters
    ----------
    settings : RigSettings
        Content of the rig.toml.
    traffic : TrafficLog, optional
        Log of every byte to and from the stage.
    decode : callable, optional
        Reads the pixels of a file, so that a watched folder knows when a file is complete.

    Returns
    -------
    Rig
        `stage`, `camera`, `lights` by name, and their `clock`. Its `arrange` does in a simulated lab what a person does
        in a real one at the beginning of each step.

    Raises
    ------
    PlanRefused
        Camera, stage, lights and drift check cannot be used together.

    Examples
    --------
    >>> import msgspec
    >>> from faintfield import RigSettings, open_rig
    >>> rig_toml = '''
    ... stage = {protocol = "simulated"}
    ... camera = {backend = "simulated", size_px = [64, 48]}
    ... grid = {rows = 3, columns = 3, pitch_mm = 50.0, origin_mm = [-250.0, -250.0]}
    ... step = [{kind = "dark", exposure_s = 0.1}]
    ... '''
    >>> rig = open_rig(msgspec.toml.decode(rig_toml, type=RigSettings))
    >>> rig.camera.open()
    >>> rig.arrange("dark", 0)
    >>> rig.camera.expose(0.1, number=0).pixels.shape
    (48, 64)
    >>> rig.camera.close()
    """
    if settings.stage.protocol == "micromanager" and settings.drift.check:
        raise PlanRefused("drift.check = true times homing switches, which Micro-Manager lacks; set it to false")
    bench = _simulated_bench(settings.stage) if settings.stage.simulated else None
    core = _shared_core(settings)
    stage = open_stage(settings.stage, traffic, bench, core)
    for light in settings.light:
        if isinstance(light, lights.ControllerSettings):
            _check_output(light, bench.firmware.protocol if bench is not None else settings.stage.protocol)
    lamps = {light.name: _open_light(light, stage) for light in settings.light}
    if not isinstance(settings.camera, cameras.SimulatedSettings):
        camera = _open_camera(settings.camera, core, decode)
        return Rig(stage, camera, stage.clock, lambda kind, sweep: None, bench is None, lamps)
    if bench is None:
        raise PlanRefused("camera.backend = 'simulated' needs stage.protocol = 'simulated'; change one of them")
    centre = settings.grid.centre().target
    lab = SimulatedLab(
        *(centre, bench.true_position, bench.still_s, settings.board, settings.camera),
        lights=true_lights(settings.light, lamps, bench),
    )
    return Rig(stage, SimulatedCamera(settings.camera, stage.clock, lab), stage.clock, lab.arrange, lights=lamps)


def _check_output(light: lights.ControllerSettings, protocol: str) -> None:
    """Raise `PlanRefused` if a controller has no such output; those of other packages are found out by trying."""
    if protocol == "micromanager" or light.output not in _OUTPUTS.get(protocol, (light.output,)):
        offered = ", ".join(_OUTPUTS.get(protocol, ())) or "no outputs"
        raise PlanRefused(
            f"light {light.name}: output = '{light.output}', and a stage of protocol {protocol} has {offered}; choose "
            "another output or driver"
        )


def _open_light(settings: lights.LightSettings, stage: Gantry) -> Light:
    match settings:
        case lights.ControllerSettings():
            return ControllerLight(settings.name, stage, settings.in_controller())
        case lights.CommandSettings():
            return CommandLight(settings)
        case lights.SimulatedSettings():
            return SimulatedLight(settings.name)
        case lights.PluginSettings():
            return plugin_light(settings, WallClock())


def true_lights(
    settings: tuple[lights.LightSettings, ...], lamps: Mapping[str, Light], bench: Bench
) -> dict[str, Callable[[], bool]]:
    """Return for each light of a simulated lab what tells whether it shines; it does not know those of commands."""
    truth: dict[str, Callable[[], bool]] = {}
    for light in settings:
        lamp = lamps[light.name]
        if isinstance(lamp, SimulatedLight):
            truth[light.name] = partial(getattr, lamp, "shines")
        elif isinstance(light, lights.ControllerSettings):
            truth[light.name] = partial(bench.firmware.output_on, light.in_controller())
    return truth


def _open_camera(settings: cameras.CameraSettings, core: SharedCore | None, decode: Decode) -> Camera:
    match settings:
        case cameras.GPhoto2Settings():
            return GPhoto2Camera(settings)
        case cameras.MicroManagerSettings():
            return MicroManagerCamera(settings, core)
        case cameras.AravisSettings():
            return AravisCamera(settings)
        case cameras.FolderSettings():
            return FolderCamera(settings, WallClock(), decode)
        case cameras.PluginSettings():
            return plugin_camera(settings, WallClock())
    raise TypeError(f"no driver for {type(settings).__name__}")


def _shared_core(settings: RigSettings) -> SharedCore | None:
    if not isinstance(settings.camera, cameras.MicroManagerSettings) or settings.stage.protocol != "micromanager":
        return None
    camera, stage = settings.camera, _micromanager_stage(settings.stage)
    if (camera.configuration, camera.adapters) != (stage.configuration, stage.adapters):
        raise PlanRefused(
            f"camera.configuration = {camera.configuration!r} and stage.configuration = {stage.configuration!r}, or "
            "their adapters, differ; Micro-Manager loads one configuration with all devices: name the same in both"
        )
    return SharedCore(camera.configuration, camera.adapters)


def _micromanager_stage(settings: StageSettings) -> MicroManagerStage:
    return convert_options(settings.options, MicroManagerStage, "[stage] with protocol = 'micromanager'")


def open_stage(
    settings: StageSettings,
    traffic: TrafficLog | None = None,
    bench: Bench | None = None,
    core: SharedCore | None = None,
) -> Gantry:
    """Return the stage that `settings` describe, not yet connected.

    Protocol `simulated`, or a port `simulated:grbl`, `simulated:grblhal` or `simulated:marlin`, gives a simulated stage
    with a clock of its own, so that motions take no real time. With `:pty` after it, every byte passes through a
    pseudo-terminal and pyserial.

    Parameters
    ----------
    settings : StageSettings
        The `[stage]` table of rig.toml.
    traffic : TrafficLog, optional
        Log of every byte sent and received over a serial port.
    bench : Bench, optional
        Bench of a simulated stage, by default a new one.
    core : SharedCore, optional
        Micro-Manager's core, if the camera uses it as well.

    Returns
    -------
    Gantry
        The stage, with `connect`, `home`, `move_to` and `close`; see docs/explanation/stage.md on trust in positions.

    Raises
    ------
    PlanRefused
        The port names no simulated stage, or a driver cannot be used with these settings.

    Examples
    --------
    >>> from faintfield import StageSettings, open_stage
    >>> stage = open_stage(StageSettings("grbl", port="simulated:grbl"))  # or port="/dev/ttyUSB0"
    >>> stage.connect()
    >>> print(stage.travel())
    [-400, 0] x [-400, 0] mm
    >>> _ = stage.home()
    >>> position = stage.move_to(-100.0, -50.0)
    >>> print(position.point, "trusted" if position.trusted else "not trusted")
    (-100.000, -50.000) mm trusted
    >>> stage.close()
    """
    clock = WallClock()
    if settings.simulated:
        bench = bench or _simulated_bench(settings)
        port = bench.link.url if isinstance(bench.link, PtyLink) else settings.port or bench.link.url
        simulated = msgspec.structs.replace(settings, protocol=bench.firmware.protocol, port=port, options={})
        return bench.stage(simulated, traffic)
    if settings.protocol in SERIAL_PROTOCOLS:
        return serial_stage(settings, clock, traffic, partial(SerialPort, settings.port, settings.baud))
    if settings.protocol == "micromanager":
        options = _micromanager_stage(settings)
        core = core or SharedCore(options.configuration, options.adapters)
        return Gantry(MicroManagerController(core, options, settings.travel_mm, clock), settings, clock)
    return Gantry(plugin_controller(settings, clock), settings, clock)


def _simulated_bench(settings: StageSettings) -> Bench:
    name, _, cable = settings.port.removeprefix(SIMULATED).partition(":")
    firmware = SIMULATED_FIRMWARE.get(name or "grbl")
    if firmware is None or cable not in ("", "pty"):
        raise PlanRefused(f"{settings.port}: no such stage; choose {', '.join(SIMULATED_FIRMWARE)}, alone or with :pty")
    if not cable:
        return Bench(firmware)
    link = PtyLink()
    bench = Bench(firmware, link)
    weakref.finalize(bench, link.close)
    return bench
