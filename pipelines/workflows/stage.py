"""A stage brought up by hand, with the driver that captures use: `faintfield stage`."""

from collections.abc import Iterator
from contextlib import closing, contextmanager, suppress

import msgspec
from rich.table import Table
from rich.text import Text

from faintfield.pipelines.arguments import StageConnection
from faintfield.pipelines.console import console, inform, visible
from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.pipelines.formats.toml_files import read_rig_tables
from faintfield.pipelines.termination import interrupt_on_termination
from faintfield.rig.devices import SIMULATED_FIRMWARE, open_stage
from faintfield.rig.errors import NotHomed, StageAlarm, StageRejected, StageUnfit
from faintfield.rig.simulation.controller.bench import Server
from faintfield.rig.stages.conformance import Check, check_conformance
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import SIMULATED, Identity, Point, Position, StageSettings


class _RigFile(msgspec.Struct):
    """The part of a rig.toml that describes the stage; other tables are ignored."""

    stage: StageSettings


def identify_stage(connection: StageConnection) -> Identity:
    """Print firmware, travel and rates of a controller, and return its settings, too."""
    with _connected(connection) as stage:
        identity = stage.identify()
        inform(f"{identity.firmware}, travel {stage.travel()}")
        rates = " and ".join(f"{60.0 * rate:g}" for rate in identity.motion.rate_mm_per_s)
        inform(f"rates {rates} mm/min; a position counts as reached within {max(identity.tolerance_mm):.4f} mm")
        return identity


def home_stage(connection: StageConnection) -> Position:
    """Home a stage."""
    with _connected(connection) as stage:
        homing = stage.home()
        inform(f"homed to {homing.position.point} in {homing.duration_s:.1f} s")
        return homing.position


def move_stage(connection: StageConnection, target: Point, home: bool) -> Position:
    """Move to a position in machine coordinates, after homing if `home`; the path is checked before any motion."""
    with _connected(connection) as stage:
        stage.workspace().check_path([target])
        if home:
            stage.home()
        if not stage.trusted:
            raise NotHomed(
                "the stage's position is not known, as opening the port restarts most controllers; give --home, "
                "which homes before the motion"
            )
        position = stage.move_to(target.x_mm, target.y_mm)
        inform(f"arrived at {position.point}")
        return position


def jog_stage(connection: StageConnection, dx_mm: float, dy_mm: float, unlock: bool) -> Position:
    """Move by a short distance without homing."""
    with _connected(connection) as stage:
        try:
            position = stage.jog(dx_mm, dy_mm, unlock=unlock)
        except StageAlarm as failure:
            if unlock or failure.position_kept:  # by a door, say, which is no lock
                raise
            raise StageAlarm(f"{failure}; or give --unlock to jog without homing") from failure
        except StageRejected as failure:
            start = stage.position().point
            target = Point(start.x_mm + dx_mm, start.y_mm + dy_mm)
            if stage.travel().holds(target):
                raise
            raise StageRejected(
                f"the jog from {start} to {target} ends outside the travel {stage.travel()}; jog the other way, or "
                f"home first ({failure})"
            ) from failure
        inform(f"reported at {position.point}; not homed, so the true position is unknown")
        return position


def check_stage(connection: StageConnection) -> list[Check]:
    """Check what a capture relies on, and print a table; raise StageUnfit if a check failed."""
    table, checks = Table("", "check", "measured", "limit"), []
    with _connected(connection) as stage:
        for check in check_conformance(stage):
            inform(f"tried: {check.name}")
            mark = "[green]passed[/]" if check.passed else "[bold red]FAILED[/]"
            table.add_row(mark, *(Text(visible(text)) for text in (check.name, check.measured, check.limit)))
            checks.append(check)
    console.print(table)
    failed = [check for check in checks if not check.passed]
    if failed:
        raise StageUnfit(
            "; ".join(f"{check.name}: {check.measured}, and {check.limit} is asked for" for check in failed)
            + "; mend that before a capture (docs/reference/stage_controllers.md)"
        )
    return checks


def serve_simulated_stage(protocol: str, speed: float) -> None:
    """Serve a simulated controller on a port until Ctrl-C, with `speed` simulated seconds per real second."""
    with closing(Server(SIMULATED_FIRMWARE[protocol])) as server, suppress(KeyboardInterrupt):
        inform(f"a simulated {protocol} stage is at {server.port}; Ctrl-C ends it")
        server.run(speed)


@contextmanager
def _connected(connection: StageConnection) -> Iterator[Gantry]:
    try:
        settings = _settings(connection)
    except ValueError as failure:
        raise BadValue(f"{failure}") from failure
    stage = open_stage(settings)
    with interrupt_on_termination():
        stage.connect()
        try:
            for warning in stage.identify().warnings:
                inform(f"warning: {warning}")
            yield stage
        finally:
            stage.close()


def _settings(connection: StageConnection) -> StageSettings:
    port, protocol = connection.port, connection.protocol
    stated = [name for name in ("port", "protocol", "baud") if getattr(connection, name) is not None]
    if connection.rig is not None:
        if stated:
            raise WrongUsage(f"--rig describes the whole stage; leave out --{stated[0]}, or --rig")
        return read_rig_tables(connection.rig, _RigFile).stage
    if port is None:
        raise WrongUsage("no stage is named; give --port, such as /dev/ttyUSB0 or simulated:grbl, or --rig rig.toml")
    if not port.startswith(SIMULATED):
        return StageSettings(protocol=protocol or "grbl", port=port, baud=connection.baud or 115200)
    if protocol is not None:
        raise WrongUsage(f"--port {port} names its protocol; leave out --protocol")
    if port.removeprefix(SIMULATED) not in SIMULATED_FIRMWARE:
        raise WrongUsage(f"--port {port}: no such stage is simulated; name one of {', '.join(SIMULATED_FIRMWARE)}")
    return StageSettings(protocol="simulated", port=port)
