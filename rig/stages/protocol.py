"""The types and settings of a stage, and the protocol that its drivers implement.

Coordinates are the controller's machine coordinates in millimetres, along the two axes that carry the camera. They are
not shifted or flipped, so a position in a log can be compared with the controller's display.
"""

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol, Self, runtime_checkable

from msgspec import Struct

type AxisIndex = Literal[0, 1]

# Homing may take this long (s) even where settings predict less: a slow stage must not fail half way.
MIN_HOMING_BOUND_S = 240.0


class Point(NamedTuple):
    """A position (x, y) on the stage in mm, in machine coordinates.

    Parameters
    ----------
    x_mm, y_mm : float
        Coordinates along the two axes that carry the camera.

    Examples
    --------
    >>> from faintfield import Point
    >>> corner = Point(x_mm=-250.0, y_mm=-200.0)
    >>> print(corner)
    (-250.000, -200.000) mm
    >>> corner.x_mm + 50.0
    -200.0
    """

    x_mm: float
    y_mm: float

    def __str__(self) -> str:
        return f"({self.x_mm:.3f}, {self.y_mm:.3f}) mm"


class Box(Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangle of positions from the lower to the upper end along each axis, including its edges.

    Parameters
    ----------
    x_mm, y_mm : (float, float)
        Lower and upper end along x; lower and upper end along y.
    """

    x_mm: tuple[float, float]
    y_mm: tuple[float, float]

    def __post_init__(self) -> None:
        if self.x_mm[0] >= self.x_mm[1] or self.y_mm[0] >= self.y_mm[1]:
            raise ValueError(f"a box runs from a lower to a higher end; {self} does not: swap its ends")

    def __str__(self) -> str:
        return f"[{self.x_mm[0]:g}, {self.x_mm[1]:g}] x [{self.y_mm[0]:g}, {self.y_mm[1]:g}] mm"

    def holds(self, point: Point, slack_mm: float = 0.0) -> bool:
        """Return whether `point` lies in the box enlarged by `slack_mm` on every side."""
        return all(
            low - slack_mm <= value <= high + slack_mm
            for value, (low, high) in zip(point, (self.x_mm, self.y_mm), strict=True)
        )

    def intersection(self, other: Self) -> "Box":
        """Return the box of positions that both boxes hold; raises `ValueError` if there are none."""
        (ax, ay), (bx, by) = (self.x_mm, self.y_mm), (other.x_mm, other.y_mm)
        return Box((max(ax[0], bx[0]), min(ax[1], bx[1])), (max(ay[0], by[0]), min(ay[1], by[1])))


class MotionLimits(Struct, frozen=True):
    """Highest rate and acceleration of each axis, as set in the controller.

    Parameters
    ----------
    rate_mm_per_s, acceleration_mm_per_s2 : (float, float)
        Limits of the two axes.

    Examples
    --------
    The duration of a capture depends on them:

    >>> from faintfield import CapturePlan, CaptureStep, Grid, MotionLimits, Point
    >>> limits = MotionLimits(rate_mm_per_s=(100.0, 100.0), acceleration_mm_per_s2=(500.0, 500.0))
    >>> grid = Grid(rows=7, columns=7, pitch_mm=50.0, origin_mm=Point(-350.0, -350.0))
    >>> plan = CapturePlan.of(grid, [CaptureStep("bright", (0.1,))], approach_mm=2.0, frame_bytes=48_000_000)
    >>> round(plan.duration_s(limits, feed_mm_per_s=100.0))
    48
    """

    rate_mm_per_s: tuple[float, float]
    acceleration_mm_per_s2: tuple[float, float]


class Identity(Struct, frozen=True):
    """Description of a controller.

    Parameters
    ----------
    firmware, settings : str, dict
        Name and version, and the controller's settings, as reported; for the record.
    travel_mm : Box
        Positions that the controller allows.
    tolerance_mm : (float, float)
        Half a motor step plus the rounding of reports, per axis: how far a report may be from its target.
    homing_bound_s : float
        Time after which homing counts as failed.
    homes_together : bool
        Whether homing moves both axes at once, and neither can be homed alone.
    pull_off_mm : float
        Distance by which homing backs off the switches.
    warnings : tuple of str
        Settings that work but should be changed, each with its remedy.
    has_switches : bool
        Whether homing ends at switches, so that its time shows lost steps.
    """

    firmware: str
    travel_mm: Box
    motion: MotionLimits
    tolerance_mm: tuple[float, float]
    homing_bound_s: float
    homes_together: bool
    pull_off_mm: float
    settings: dict[str, str]
    warnings: tuple[str, ...] = ()
    has_switches: bool = True


class Position(Struct, frozen=True):
    """A reported position.

    Attributes
    ----------
    point : Point
        The position.
    tolerance_mm : (float, float)
        Distance by which the report may be from its target, per axis.
    trusted : bool
        True if nothing since homing could have changed the stage's count of steps.
    """

    point: Point
    tolerance_mm: tuple[float, float]
    trusted: bool

    def is_at(self, target: Point) -> bool:
        """Return whether this trusted report puts the stage at `target`."""
        axes = zip(self.point, target, self.tolerance_mm, strict=True)
        return self.trusted and all(abs(here - there) <= tolerance for here, there, tolerance in axes)


class AnswerTime(NamedTuple):
    """Duration of a command.

    Attributes
    ----------
    taken_s, late_s : float
        Duration in s, and by how much less it may have been because its answer was read late.
    """

    taken_s: float
    late_s: float


class Homing(Struct, frozen=True):
    """The result of homing.

    Attributes
    ----------
    position : Position
        Position at the end of homing.
    time : AnswerTime
        Time that the controller took.
    """

    position: Position
    time: AnswerTime

    @property
    def duration_s(self) -> float:
        """Longest time that the controller may have taken (s)."""
        return self.time.taken_s


class Controller(Protocol):
    """The driver of one firmware; `Gantry` adds trust, limits and verification.

    Every method is bounded in time, and raises a `StageError` if the controller does not obey.
    """

    def connect(self, wait_s: float = 0.0) -> None:
        """Open the connection, waiting up to `wait_s` for its port, and wait until the controller answers."""

    def identify(self) -> Identity:
        """Read the firmware's version and settings; raises `WrongFirmware`."""

    def home(self, axis: AxisIndex | None, bound_s: float) -> AnswerTime:
        """Home, and return how long the controller took."""

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Move through the points of `path`, wait until the stage stands still, and return the reported position."""

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Move relative to the present position, first clearing a lock if `unlock`; return the new position."""

    def read_position(self) -> Point:
        """Return the reported position; raises unless the stage stands still."""

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose switch is closed."""

    def stop(self) -> bool:
        """Stop the motion, wait until it has ended, and return whether the position is kept."""

    def abort(self) -> bool:
        """Stop the stage and leave no motion that could go on, without raising; return whether the position is kept."""

    def recover(self, wait_s: float) -> bool:
        """Make the controller accept commands again, without moving; return whether the position is kept.

        It waits up to `wait_s` for a port that is lost.
        """

    def close(self) -> None:
        """Close the connection."""


type OutputKind = Literal["flood", "mist", "spindle", "pin", "fan"]


class Output(Struct, frozen=True):
    """An output of a controller besides its motors, to which a lamp is connected.

    Parameters
    ----------
    kind, number : str, int
        `flood`, `mist` or `spindle` of GRBL; `pin` or `fan` of Marlin, with its number.
    level : float, optional
        Value (S) that switches a spindle, pin or fan on; by default 1000 for the spindle, and 255.
    """

    kind: OutputKind
    number: int = 0
    level: float | None = None


@runtime_checkable
class OutputController(Protocol):
    """A `Controller` that can switch outputs; a restart, and with GRBL an alarm, a door or a reset, switch them off."""

    def switch_output(self, output: Output, *, on: bool) -> None:
        """Switch an output while the stage is at rest; raises `StageRejected` if the firmware does not have it."""

    def force_off(self, output: Output) -> None:
        """Switch an output off after a failure, when the stage was stopped; others may go off as well."""

    def read_output(self, output: Output) -> bool | None:
        """Return whether an output is on, as the controller reports it; None if it does not."""

    def unlock(self) -> None:
        """Clear the lock of a controller that was not homed, since it switches no output; nothing moves."""


type ProtocolName = Literal["grbl", "marlin", "simulated"]

# Firmware that is driven over a serial port; protocols without options; all that are built in.
SERIAL_PROTOCOLS = ("grbl", "marlin")
WITHOUT_OPTIONS = (*SERIAL_PROTOCOLS, "simulated")
BUILT_IN_PROTOCOLS = (*WITHOUT_OPTIONS, "micromanager")
# Prefix of the port of a simulated stage; the name of its controller follows.
SIMULATED = "simulated:"
_MAX_RECONNECT_S = 86400.0
# pyserial has others, of which one writes a file (`spy://`), and a rig.toml may come from anyone.
_URL_SCHEMES = ("socket", "rfc2217", "hwgrep", "alt")


class StageSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """Connection and limits of the stage: the `[stage]` table of rig.toml.

    Parameters
    ----------
    protocol : str
        Firmware of the controller: "grbl" or "marlin"; "micromanager", or the name of a plug-in
        (docs/tutorials/camera_driver.md); "simulated" needs no port and no hardware.
    port : str
        Serial device, or a pyserial URL such as "socket://127.0.0.1:7000"; "simulated:grbl", "simulated:grblhal" or
        "simulated:marlin" need no hardware.
    baud : int
        Bits per second.
    axes : (str, str)
        The controller's letters for the two axes of the grid, columns first.
    feed_mm_per_min : float, optional
        Speed of motions; by default the highest rate of the slower axis.
    approach_mm : float
        Distance by which an axis goes past a position to arrive from below; it must exceed the play of the drive.
    travel_mm : Box, optional
        Allowed positions, if the controller allows more or does not report its travel.
    keep_out : tuple of Box
        Boxes that the stage must neither enter nor cross.
    reconnect_s : float
        Time to wait for a port that was lost, such as one that USB lists anew.
    options : dict
        The other keys of the table, for "micromanager" and plug-ins, which check them.

    Raises
    ------
    ValueError
        The port is missing or does not fit the protocol, or a value is impossible; the message names it.

    Examples
    --------
    >>> from faintfield import StageSettings
    >>> settings = StageSettings("grbl", port="/dev/ttyUSB0", feed_mm_per_min=6000.0)
    >>> settings.axes, settings.approach_mm, settings.simulated
    (('X', 'Y'), 2.0, False)
    >>> StageSettings("grbl")
    Traceback (most recent call last):
    ...
    ValueError: stage.port is missing; give the serial device, such as /dev/ttyUSB0
    """

    protocol: str
    port: str = ""
    baud: int = 115200
    axes: tuple[str, str] = ("X", "Y")
    feed_mm_per_min: float | None = None
    approach_mm: float = 2.0
    travel_mm: Box | None = None
    keep_out: tuple[Box, ...] = ()
    reconnect_s: float = 60.0
    options: dict[str, Any] = {}

    def __post_init__(self) -> None:
        if not self.port and self.protocol in SERIAL_PROTOCOLS:
            raise ValueError("stage.port is missing; give the serial device, such as /dev/ttyUSB0")
        if self.options and self.protocol in WITHOUT_OPTIONS:
            raise ValueError(f"stage.options are not for protocol = {self.protocol!r}; remove them")
        firmware = self.port.removeprefix(SIMULATED).partition(":")[0]
        if self.simulated and self.protocol in SERIAL_PROTOCOLS and firmware and not firmware.startswith(self.protocol):
            raise ValueError(f"stage.port = {self.port!r} is not {self.protocol!r}; set stage.protocol to 'simulated'")
        scheme, of_url, _ = self.port.partition("://")
        if of_url and scheme not in _URL_SCHEMES:
            known = ":// or ".join(_URL_SCHEMES)
            raise ValueError(f"stage.port = {self.port!r}; give a serial device, or a URL that begins with {known}://")
        if self.axes[0] == self.axes[1] or not set(self.axes) <= set("XYZ"):
            raise ValueError(f"stage.axes must be two different letters of X, Y, Z; got {', '.join(self.axes)}")
        if self.approach_mm < 0.0:
            raise ValueError(f"stage.approach_mm must not be negative; got {self.approach_mm:g}")
        if not 0.0 <= self.reconnect_s <= _MAX_RECONNECT_S:
            raise ValueError(f"stage.reconnect_s = {self.reconnect_s:g}; give 0 to {_MAX_RECONNECT_S:g} s")
        if self.feed_mm_per_min is not None and not self.feed_mm_per_min > 0.0:
            raise ValueError(f"stage.feed_mm_per_min must be positive; got {self.feed_mm_per_min:g}")

    @property
    def simulated(self) -> bool:
        """Return whether the stage is simulated."""
        return self.protocol == "simulated" or self.port.startswith(SIMULATED)
