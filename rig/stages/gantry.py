"""The stage that never lies about where it is: trust, limits and verification, the same for every protocol.

A controller (`Controller`) only talks: it sends motions and reads positions. Whether a position may be believed is
decided here, in one place. Trust begins with homing, and ends with any event after which the controller's count and
the carriage may differ: an alarm that loses the position, a restart, a lost connection, a wait that ran out, a report
that is off target, an interruption. Nothing but homing brings it back.
"""

import math
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from typing import Protocol

from faintfield.rig.clock import Clock
from faintfield.rig.errors import NotHomed, OutsideTravel, PositionLost, StageError, StageLost
from faintfield.rig.stages.motion import duration_s, one_sided, path_duration_s
from faintfield.rig.stages.protocol import AxisIndex, Box, Homing, Identity, Point, Position
from faintfield.rig.stages.settings import StageSettings
from faintfield.rig.stages.workspace import Workspace

_BLIND_JOG_MM = 10.0


class Controller(Protocol):
    """What a protocol must be able to do. Every method is bounded in time and raises a `StageError`."""

    def connect(self) -> None:
        """Open the connection and wait until the controller answers."""
        ...

    def identify(self) -> Identity:
        """Read what the controller is and how it is set; raises `WrongFirmware`."""
        ...

    def home(self, axis: AxisIndex | None, bound_s: float) -> float:
        """Home, and return how long the controller took, in seconds."""
        ...

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Go through the points of `path`, wait until the stage stands still, and return where it says it is."""
        ...

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Move relative to the present position, first clearing a lock if `unlock`; return the new position."""
        ...

    def read_position(self) -> Point:
        """Return where the stage says it stands; raises unless it stands still."""
        ...

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose switch is closed."""
        ...

    def stop(self) -> bool:
        """Stop moving, wait until it stands, and return whether the position is kept."""
        ...

    def abort(self) -> bool:
        """Send what stops any motion, without waiting for it and without fail; return whether it keeps the position."""
        ...

    def recover(self) -> bool:
        """Make the controller listen again, without moving, and return whether the position is kept."""
        ...

    def close(self) -> None:
        """Close the connection."""
        ...


class Gantry:
    """A `Stage` made of a controller and the rules by which its word is taken.

    Parameters
    ----------
    controller : Controller
        Speaks the protocol.
    settings : StageSettings
        Feed, approach, keep-out boxes and, where the controller does not know it, the travel.
    clock : Clock
        The rig's time.
    """

    def __init__(self, controller: Controller, settings: StageSettings, clock: Clock) -> None:
        self.clock = clock
        self.settings = settings
        self._controller = controller
        self._identity: Identity | None = None
        self._trusted = False
        self._here: Point | None = None

    @property
    def trusted(self) -> bool:
        """Whether reported positions may be believed."""
        return self._trusted

    def connect(self) -> None:
        """Open the port, wait for the controller and read its settings; nothing moves.

        Raises
        ------
        StageLost, StageTimeout, WrongFirmware
            The port is closed again.
        """
        self._distrust()
        try:
            self._controller.connect()
            self._identity = self._controller.identify()
            self.workspace()
        except BaseException:
            self.close()
            raise

    def identify(self) -> Identity:
        """Return what the controller said about itself when it was connected."""
        if self._identity is None:
            raise StageLost("the stage is not connected; connect it first")
        return self._identity

    def travel(self) -> Box:
        """Return the positions that may be asked for: the controller's travel within the configured one."""
        theirs, ours = self.identify().travel_mm, self.settings.travel_mm
        if ours is None:
            return theirs
        try:
            return theirs.intersection(ours)
        except ValueError as failure:
            raise OutsideTravel(
                f"the configured travel {ours} lies outside the controller's {theirs}; correct stage.travel_mm"
            ) from failure

    def workspace(self) -> Workspace:
        """Return where the stage may go."""
        return Workspace(self.travel(), self.settings.keep_out)

    def feed_mm_per_s(self) -> float:
        """Return the speed that motions ask for; the controller keeps each axis within its own rate."""
        configured = self.settings.feed_mm_per_min
        return min(self.identify().motion.rate_mm_per_s) if configured is None else configured / 60.0

    def home(self, axis: AxisIndex | None = None) -> Homing:
        """Find the switches; positions are trusted from here on.

        Raises
        ------
        StageAlarm, StageTimeout, StageLost
            No switch was found, or not in time.
        """
        identity = self.identify()
        was_trusted = self._trusted
        with self._in_motion():
            taken_s = self._controller.home(None if identity.homes_together else axis, identity.homing_bound_s)
            point = self._controller.read_position()
        self._trusted, self._here = was_trusted or axis is None or identity.homes_together, point
        return Homing(self._report(point), taken_s)

    def move_to(self, x_mm: float, y_mm: float) -> Position:
        """Go to a position, wait until the stage stands still there, and return the verified report.

        No axis arrives downwards (`one_sided`), so play in the drive has no say in where the carriage stops.

        Raises
        ------
        NotHomed, OutsideTravel, KeepOutCrossed
            Before anything moves.
        StageError
            The stage did not arrive; it was told to stop.
        """
        target = Point(x_mm, y_mm)
        start = self._trusted_start(target)
        path = (start, *one_sided(start, target, self.settings.approach_mm))
        self.workspace().check_path(path)
        feed = self.feed_mm_per_s()
        predicted_s = path_duration_s(path, self.identify().motion, feed)
        with self._in_motion():
            point = self._checked(self._controller.follow(path[1:], feed, predicted_s), target)
        return self._report(point)

    def jog(self, dx_mm: float, dy_mm: float, *, unlock: bool = False) -> Position:
        """Move by a distance: for bringing up hardware, when it may not be homed yet.

        Parameters
        ----------
        dx_mm, dy_mm : float
            How far to move. At most 10 mm at once while the position is not known.
        unlock : bool
            Clear the lock that the controller keeps until it is homed.

        Raises
        ------
        OutsideTravel, KeepOutCrossed
            Before anything moves: outside what is known, or too far blindly.
        """
        by, target = Point(dx_mm, dy_mm), None
        if self._trusted:
            start = self._here or self.position().point
            target = Point(start.x_mm + dx_mm, start.y_mm + dy_mm)
            self.workspace().check_path((start, target))
        elif not math.hypot(*by) <= _BLIND_JOG_MM:
            raise OutsideTravel(
                f"a jog by {by} is longer than {_BLIND_JOG_MM:g} mm and the stage is not homed; jog less, or home first"
            )
        feed = self.feed_mm_per_s()
        predicted_s = duration_s(Point(0.0, 0.0), by, self.identify().motion, feed)
        with self._in_motion():
            point = self._controller.jog(by, feed, predicted_s, unlock=unlock)
            if target is not None:
                self._checked(point, target)
        return self._report(point)

    def position(self) -> Position:
        """Ask the controller where it stands.

        Raises
        ------
        StageError
            It does not answer, has stopped, or is moving.
        """
        with self._judged():
            point = self._controller.read_position()
        self._here = point if self._trusted else None
        return self._report(point)

    def verify_at(self, x_mm: float, y_mm: float) -> Position:
        """Ask again, and raise unless the stage stands at this position: the last step before an exposure.

        Raises
        ------
        NotHomed, PositionLost, StageError
            No exposure may be made.
        """
        target = Point(x_mm, y_mm)
        self._require_trust(target)
        with self._judged():
            point = self._checked(self._controller.read_position(), target)
        return self._report(point)

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose homing switch is closed now."""
        with self._judged():
            return self._controller.switches()

    def hold(self) -> None:
        """Stop moving, now; the position is kept where the controller slows down in good order."""
        self._here = None
        with self._judged():
            self._trusted &= self._controller.stop()

    def recover(self) -> None:
        """After an error, make the controller listen again, without moving, and read its settings anew.

        Raises
        ------
        StageError, WrongFirmware
            It cannot be made to; the message says what the operator should do.
        """
        self._here = None
        with self._judged():
            self._trusted &= self._controller.recover()
            self._identity = self._controller.identify()

    def close(self) -> None:
        """Give the port back; the stage stays where it is, and must be homed after the next connect."""
        self._distrust()
        self._identity = None
        self._controller.close()

    def _trusted_start(self, target: Point) -> Point:
        """Return where a motion to `target` begins; raises `NotHomed` when that is not known."""
        self._require_trust(target)
        return self._here or self.position().point

    def _require_trust(self, target: Point) -> None:
        """Raise `NotHomed` unless reported positions may be believed."""
        if not self._trusted:
            raise NotHomed(f"the stage's position is not known, so it is not sent to {target}; home it first")

    def _checked(self, point: Point, target: Point) -> Point:
        """Take `point` as the stage's position if it is at `target`; raise `PositionLost` if not."""
        tolerance = self.identify().tolerance_mm
        if not Position(point, tolerance, trusted=True).is_at(target):
            raise PositionLost(
                f"the stage reports {point} instead of {target}, more than {max(tolerance):.4f} mm off; "
                "look for an obstacle or a disturbed cable, then home it"
            )
        self._here = point
        return point

    def _report(self, point: Point) -> Position:
        """Return `point` as a report of the present trustworthiness."""
        return Position(point, self.identify().tolerance_mm, self._trusted)

    def _distrust(self) -> None:
        """Forget where the stage is."""
        self._trusted, self._here = False, None

    @contextmanager
    def _judged(self) -> Iterator[None]:
        """Stop believing the stage when an error inside says that its position is lost."""
        try:
            yield
        except StageError as failure:
            self._here = None
            self._trusted &= failure.position_kept
            raise
        except BaseException:
            self._distrust()
            raise

    @contextmanager
    def _in_motion(self) -> Iterator[None]:
        """As `_judged`, and stop the stage when anything at all goes wrong, Ctrl-C included."""
        try:
            with self._judged():
                yield
        except BaseException:
            self._trusted &= self._controller.abort()
            raise
