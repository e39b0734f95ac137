"""`faintfield stage`: bring up a stage by hand."""

from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import App, Parameter

from faintfield.pipelines.arguments import StageConnection
from faintfield.rig.stages.protocol import Identity, Point, Position

if TYPE_CHECKING:
    from faintfield.rig.stages.conformance import Check

app = App(name="stage", help_epilogue="Example: faintfield stage test --port simulated:grbl")

_NOWHERE = StageConnection()

type Checks = list[Check]


@app.command(sort_key=1, help_epilogue="Example: faintfield stage info --port /dev/ttyUSB0")
def info(connection: StageConnection = _NOWHERE) -> Identity:
    """Show firmware, travel and settings of the controller, without moving."""
    from faintfield.pipelines.workflows.stage import identify_stage

    return identify_stage(connection)


@app.command(sort_key=3, help_epilogue="Example: faintfield stage home --rig rig.toml")
def home(connection: StageConnection = _NOWHERE) -> Position:
    """Find the homing switches."""
    from faintfield.pipelines.workflows.stage import home_stage

    return home_stage(connection)


@app.command(sort_key=4, help_epilogue="Example: faintfield stage goto -100 -50 --home --port simulated:grbl")
def goto(
    x_mm: float,
    y_mm: float,
    *,
    home: Annotated[bool, Parameter(negative=())] = False,
    connection: StageConnection = _NOWHERE,
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
    from faintfield.pipelines.workflows.stage import move_stage

    return move_stage(connection, Point(x_mm, y_mm), home)


@app.command(sort_key=2, help_epilogue="Example: faintfield stage jog -1 0 --unlock --port simulated:grbl")
def jog(
    dx_mm: float,
    dy_mm: float,
    *,
    unlock: Annotated[bool, Parameter(negative=())] = False,
    connection: StageConnection = _NOWHERE,
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
    from faintfield.pipelines.workflows.stage import jog_stage

    return jog_stage(connection, dx_mm, dy_mm, unlock)


@app.command(name="test", sort_key=5, help_epilogue="Example: faintfield stage test --port simulated:grbl")
def conform(connection: StageConnection = _NOWHERE) -> Checks:
    """Test what a capture relies on: limits, speed, repeatability. The stage homes and moves.

    Raises
    ------
    StageUnfit
        A check failed; the table shows which.
    """
    from faintfield.pipelines.workflows.stage import check_stage

    return check_stage(connection)


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
    from faintfield.pipelines.workflows.stage import serve_simulated_stage

    serve_simulated_stage(protocol, speed)
