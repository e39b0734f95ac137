"""The types of a stage, and `Controller`: what the driver of one firmware must be able to do.

Coordinates are the controller's machine coordinates in millimetres, along the two axes that carry the camera. They are
not shifted or flipped, so a position in a log can be compared with the controller's display.
"""

from collections.abc import Sequence
from typing import Literal, NamedTuple, Protocol, Self

from msgspec import Struct

type AxisIndex = Literal[0, 1]


class Point(NamedTuple):
    """A position on the stage, in machine coordinates."""

    x_mm: float
    y_mm: float

    def __str__(self) -> str:
        return f"({self.x_mm:.3f}, {self.y_mm:.3f}) mm"


class Box(Struct, frozen=True, forbid_unknown_fields=True):
    """A rectangle of positions, including its edges.

    Parameters
    ----------
    x_mm, y_mm : (float, float)
        Lower and upper end along each axis.
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
    """Highest rate and acceleration of each axis, as set in the controller."""

    rate_mm_per_s: tuple[float, float]
    acceleration_mm_per_s2: tuple[float, float]


class Identity(Struct, frozen=True):
    """What the controller reports about itself: firmware, limits, settings.

    Parameters
    ----------
    firmware : str
        Name and version, as reported.
    travel_mm : Box
        Positions that the controller allows.
    motion : MotionLimits
        Rates and accelerations.
    tolerance_mm : (float, float)
        Half a motor step plus the rounding of reports, per axis: how far a report may be from its target.
    homing_bound_s : float
        Time after which homing counts as failed.
    homes_together : bool
        Whether homing moves both axes at once, and neither can be homed alone.
    pull_off_mm : float
        Distance by which homing backs off the switches.
    settings : dict
        The controller's settings as reported, for the record.
    warnings : tuple of str
        Settings that work but should be changed, each with its remedy.
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


class Position(Struct, frozen=True):
    """A reported position, and whether it can be trusted.

    Parameters
    ----------
    point : Point
        The reported position.
    tolerance_mm : (float, float)
        How far a report may be from its target, per axis.
    trusted : bool
        Whether the stage was homed and nothing since could have changed its count of steps.
    """

    point: Point
    tolerance_mm: tuple[float, float]
    trusted: bool

    def is_at(self, target: Point) -> bool:
        """Return whether this trusted report puts the stage at `target`."""
        near = zip(self.point, target, self.tolerance_mm, strict=True)
        return self.trusted and all(abs(here - there) <= tolerance for here, there, tolerance in near)


class Homing(Struct, frozen=True):
    """The result of homing: the position at its end, and how long the controller took."""

    position: Position
    duration_s: float


class Controller(Protocol):
    """Takes motions and reports positions; `Gantry` adds trust, limits and verification.

    Every method is bounded in time, and raises a `StageError` if the controller does not obey.
    """

    def connect(self) -> None:
        """Open the connection and wait until the controller answers."""
        ...

    def identify(self) -> Identity:
        """Read the firmware's version and settings; raises `WrongFirmware`."""
        ...

    def home(self, axis: AxisIndex | None, bound_s: float) -> float:
        """Home, and return how long the controller took, in seconds."""
        ...

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Move through the points of `path`, wait until the stage stands still, and return the reported position."""
        ...

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Move relative to the present position, first clearing a lock if `unlock`; return the new position."""
        ...

    def read_position(self) -> Point:
        """Return the reported position; raises unless the stage stands still."""
        ...

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose switch is closed."""
        ...

    def stop(self) -> bool:
        """Stop the motion, wait until it has ended, and return whether the position is kept."""
        ...

    def abort(self) -> bool:
        """Tell the stage to stop, without waiting and without raising; return whether the position is kept."""
        ...

    def recover(self) -> bool:
        """Make the controller accept commands again, without moving; return whether the position is kept."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...
