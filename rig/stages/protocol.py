"""What a stage is: the vocabulary that drivers, plans and simulators share.

Coordinates are the controller's own machine coordinates in millimetres, along the two axes that carry the camera.
Nothing is shifted or flipped on the way, so a position in a log can be compared with the controller's display.
"""

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
    """A rectangle of positions, its edges included.

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
        """Return whether `point` lies in the box grown by `slack_mm` on every side."""
        return all(
            low - slack_mm <= value <= high + slack_mm
            for value, (low, high) in zip(point, (self.x_mm, self.y_mm), strict=True)
        )

    def intersection(self, other: Self) -> "Box":
        """Return the box of positions that both boxes hold; `ValueError` when there are none."""
        (ax, ay), (bx, by) = (self.x_mm, self.y_mm), (other.x_mm, other.y_mm)
        return Box((max(ax[0], bx[0]), min(ax[1], bx[1])), (max(ay[0], by[0]), min(ay[1], by[1])))


class MotionLimits(Struct, frozen=True):
    """How fast each axis may go and change its speed, as set in the controller."""

    rate_mm_per_s: tuple[float, float]
    acceleration_mm_per_s2: tuple[float, float]


class Identity(Struct, frozen=True):
    """Who the controller says it is, and what it is set to.

    Parameters
    ----------
    firmware : str
        Name and version, as reported.
    travel_mm : Box
        The positions that the controller itself allows.
    motion : MotionLimits
        Rates and accelerations.
    tolerance_mm : (float, float)
        Half a motor step plus the rounding of reports, per axis: a reported position within it is on target.
    homing_bound_s : float
        How long homing may take before it counts as failed.
    homes_together : bool
        Whether one homing command moves both axes at once and none can be homed alone.
    pull_off_mm : float
        How far homing backs off the switches.
    settings : dict
        The controller's settings as reported, for the record.
    warnings : tuple of str
        Settings that work but should be changed, each with what to do.
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
    """Where the controller says the stage is, and whether that may be believed.

    Parameters
    ----------
    point : Point
        The reported position.
    tolerance_mm : (float, float)
        By how much a report may differ from a target that was reached.
    trusted : bool
        Whether the stage was homed and nothing has happened since that could have moved its scale.
    """

    point: Point
    tolerance_mm: tuple[float, float]
    trusted: bool

    def is_at(self, target: Point) -> bool:
        """Return whether the stage stands at `target`, by a report that may be believed."""
        near = zip(self.point, target, self.tolerance_mm, strict=True)
        return self.trusted and all(abs(here - there) <= tolerance for here, there, tolerance in near)


class Homing(Struct, frozen=True):
    """What homing came to: where it ended, and how long the controller took."""

    position: Position
    duration_s: float


class Stage(Protocol):
    """Two axes that carry the camera, driven from one thread.

    Every method that talks to the controller ends within a bound, and raises a `StageError` when the controller does
    not do what it was told. After an error nothing moves again until `recover`, and, unless the error kept the
    position, `home`.
    """

    @property
    def trusted(self) -> bool:
        """Whether reported positions may be believed."""
        ...

    def connect(self) -> None:
        """Open the port, wait for the controller and read its settings; nothing moves."""
        ...

    def identify(self) -> Identity:
        """Return what the controller said about itself when it was connected."""
        ...

    def home(self, axis: AxisIndex | None = None) -> Homing:
        """Find the switches; positions are trusted from here on.

        Parameters
        ----------
        axis : 0 or 1, optional
            Home this axis alone where the controller can (see `Identity.homes_together`).
        """
        ...

    def travel(self) -> Box:
        """Return the positions that may be asked for."""
        ...

    def move_to(self, x_mm: float, y_mm: float) -> Position:
        """Go to a position, wait until the stage stands still there, and return the verified report."""
        ...

    def position(self) -> Position:
        """Ask the controller where it stands."""
        ...

    def verify_at(self, x_mm: float, y_mm: float) -> Position:
        """Ask again, and raise unless the stage stands at this position: the last step before an exposure."""
        ...

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose homing switch is closed now."""
        ...

    def hold(self) -> None:
        """Stop moving, now."""
        ...

    def recover(self) -> None:
        """After an error, make the controller listen again, without moving; see `trusted` for what was lost."""
        ...

    def close(self) -> None:
        """Give the port back; the stage stays where it is."""
        ...
