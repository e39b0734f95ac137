"""`faintfield stage`: bring up a stage by hand, with the driver that captures use."""

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

import msgspec
from cyclopts import App, Parameter

from faintfield.pipelines.console import console, inform, visible
from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.rig.errors import StageUnfit
from faintfield.rig.stages.conformance import Check, check_conformance
from faintfield.rig.stages.protocol import Identity, Point, Position, StageSettings

if TYPE_CHECKING:
    from faintfield.rig.stages.gantry import Gantry


app = App(name="stage", help_epilogue="Example: faintfield stage test --port simulated:grbl")


class _RigFile(msgspec.Struct):
    """The part of a rig.toml that describes the stage; other tables are ignored."""

    stage: StageSettings


@Parameter(name="*")
@dataclass(frozen=True)
class Connection:
    """The stage to use: a port, or the stage of a rig.toml.

    Parameters
    ----------
    port
        Serial device, pyserial URL, or simulated:grbl, simulated:grblhal, simulated:marlin.
    protocol
        Firmware of the controller at the port; grbl by default.
    baud
        Bits per second; 115200 by default.
    rig
        Use the [stage] table of this rig.toml instead, with its limits and keep-out boxes.
    """

    port: str | None = None
    protocol: Literal["grbl", "marlin"] | None = None
    baud: int | None = None
    rig: Path | None = None

    def settings(self) -> StageSettings:
        """Return the settings of the stage."""
        from faintfield.pipelines.formats.rig_file import read_rig_tables
        from faintfield.rig.devices import SIMULATED, SIMULATED_FIRMWARE

        stated = [name for name in ("port", "protocol", "baud") if getattr(self, name) is not None]
        if self.rig is not None:
            if stated:
                raise WrongUsage(f"--rig describes the whole stage; leave out --{stated[0]}, or --rig")
            return read_rig_tables(self.rig, _RigFile).stage
        if self.port is None:
            raise WrongUsage(
                "no stage is named; give --port, such as /dev/ttyUSB0 or simulated:grbl, or --rig rig.toml"
            )
        if self.port.startswith(SIMULATED):
            if self.protocol is not None:
                raise WrongUsage(f"--port {self.port} names its protocol; leave out --protocol")
            if self.port.removeprefix(SIMULATED) not in SIMULATED_FIRMWARE:
                raise WrongUsage(
                    f"--port {self.port}: no such stage is simulated; name one of {', '.join(SIMULATED_FIRMWARE)}"
                )
            return StageSettings(protocol="simulated", port=self.port)
        return StageSettings(protocol=self.protocol or "grbl", port=self.port, baud=self.baud or 115200)


@app.command(sort_key=1, help_epilogue="Example: faintfield stage info --port /dev/ttyUSB0")
def info(connection: Connection = Connection()) -> Identity:
    """Show firmware, travel and settings of the controller, without moving."""
    with _connected(connection) as stage:
        identity = stage.identify()
        inform(f"{identity.firmware}, travel {stage.travel()}")
        rates = " and ".join(f"{60.0 * rate:g}" for rate in identity.motion.rate_mm_per_s)
        inform(f"rates {rates} mm/min; a position counts as reached within {max(identity.tolerance_mm):.4f} mm")
        return identity


@app.command(sort_key=3, help_epilogue="Example: faintfield stage home --rig rig.toml")
def home(connection: Connection = Connection()) -> Position:
    """Find the homing switches."""
    with _connected(connection) as stage:
        homing = stage.home()
        inform(f"homed to {homing.position.point} in {homing.duration_s:.1f} s")
        return homing.position


@app.command(sort_key=4, help_epilogue="Example: faintfield stage goto 100 50 --home --rig rig.toml")
def goto(
    x_mm: float,
    y_mm: float,
    *,
    home: Annotated[bool, Parameter(negative=())] = False,
    connection: Connection = Connection(),
) -> Position:
    """Move to a position in machine coordinates, and verify it.

    Parameters
    ----------
    x_mm
        Position along the first axis.
    y_mm
        Position along the second axis.
    home
        Home first; needed because opening the port restarts most controllers.
    """
    with _connected(connection) as stage:
        stage.workspace().check_path([Point(x_mm, y_mm)])
        if home:
            stage.home()
        position = stage.move_to(x_mm, y_mm)
        inform(f"arrived at {position.point}")
        return position


@app.command(sort_key=2, help_epilogue="Example: faintfield stage jog 1 0 --port /dev/ttyUSB0")
def jog(
    dx_mm: float,
    dy_mm: float,
    *,
    unlock: Annotated[bool, Parameter(negative=())] = False,
    connection: Connection = Connection(),
) -> Position:
    """Move by at most 10 mm without homing, to find the directions of the axes.

    Parameters
    ----------
    dx_mm
        Distance along the first axis.
    dy_mm
        Distance along the second axis.
    unlock
        Clear the lock that GRBL keeps until it is homed.
    """
    with _connected(connection) as stage:
        position = stage.jog(dx_mm, dy_mm, unlock=unlock)
        inform(f"reported at {position.point}; not homed, so the true position is unknown")
        return position


@app.command(name="test", sort_key=5, help_epilogue="Example: faintfield stage test --port simulated:grbl")
def conform(connection: Connection = Connection()) -> list[Check]:
    """Test what a capture relies on: limits, speed, repeatability. The stage homes and moves.

    Raises
    ------
    StageUnfit
        A check failed; the table shows which.
    """
    from rich.table import Table
    from rich.text import Text

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
            + "; mend that before a capture (docs/stage.md)"
        )
    return checks


@app.command(sort_key=6, help_epilogue="Example: faintfield stage simulate grbl --speed 10")
def simulate(protocol: Literal["grbl", "grblhal", "marlin"] = "grbl", *, speed: float = 1.0) -> None:
    """Serve a simulated controller on a port for other programs, until Ctrl-C.

    Parameters
    ----------
    protocol
        Firmware of the controller.
    speed
        Simulated seconds per real second.
    """
    from faintfield.rig.devices import SIMULATED_FIRMWARE
    from faintfield.rig.simulation.controller.firmware import serving

    with serving(SIMULATED_FIRMWARE[protocol]) as server:
        inform(f"a simulated {protocol} stage is at {server.port}; Ctrl-C ends it")
        with suppress(KeyboardInterrupt):
            server.run(speed)


@contextmanager
def _connected(connection: Connection) -> "Iterator[Gantry]":
    """Connect to a stage, print its warnings, and close the port at the end."""
    from faintfield.rig.devices import open_stage

    try:
        settings = connection.settings()
    except ValueError as failure:
        raise BadValue(f"{failure}") from failure
    stage = open_stage(settings)
    stage.connect()
    try:
        for warning in stage.identify().warnings:
            inform(f"warning: {warning}")
        yield stage
    finally:
        stage.close()
