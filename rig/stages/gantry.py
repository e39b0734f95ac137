"""The stage with any driver: trust in reported positions, and checks of limits and arrival.

A `Controller` only sends motions and reads positions; the rules are here, in one place. The position is trusted from
homing until something happens after which the controller's count and the carriage may differ: an alarm that loses the
position, a restart, a lost connection, a timeout, a report that is off target, an interruption. Only homing of all
axes restores trust.
"""

import math
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from faintfield.rig.clock import Clock
from faintfield.rig.errors import NotHomed, OutsideTravel, PlanRefused, PositionLost, StageError, StageLost
from faintfield.rig.stages.grbl import GrblController
from faintfield.rig.stages.marlin import MarlinController
from faintfield.rig.stages.motion import StageWorkspace, duration_s, one_sided_path, path_duration_s
from faintfield.rig.stages.protocol import (
    AxisIndex,
    Box,
    Controller,
    Homing,
    Identity,
    Output,
    OutputController,
    Point,
    Position,
    StageSettings,
)
from faintfield.rig.stages.transport import LineTransport, Port, TrafficLog

# Longest jog without homing, in mm: enough to see which way an axis moves, too short to do damage.
_MAX_UNHOMED_JOG_MM = 10.0


class Gantry:
    """Two axes that carry the camera, driven from one thread.

    Every method that uses the controller is bounded in time, and raises a `StageError` if the controller does not obey.
    After an error nothing moves until `recover` and, unless the error kept the position, `home`.

    Attributes
    ----------
    trusted : bool
        Whether reported positions can be trusted.
    homings : int
        Number of homings: positions before and after a homing may differ by what the switches do.
    recoveries : int
        Number of connections and recoveries, any of which may have switched the outputs off.
    """

    def __init__(self, controller: Controller, settings: StageSettings, clock: Clock) -> None:
        self.clock = clock
        self.settings = settings
        self._controller = controller
        self._identity: Identity | None = None
        self.trusted = self._failed = False
        self._here: Point | None = None
        self.homings = self.recoveries = 0

    def connect(self) -> None:
        """Open the port, wait for the controller and read its settings, without moving; a failure closes the port."""
        self._distrust()
        self.recoveries += 1
        try:
            self._controller.connect()
            self._identity = self._controller.identify()
            self.workspace()
        except BaseException:
            self.close()
            raise

    def identify(self) -> Identity:
        """Return what the controller reported when it was connected."""
        if self._identity is None:
            raise StageLost("the stage is not connected; connect it first")
        return self._identity

    def travel(self) -> Box:
        """Return the allowed positions: the intersection of the controller's travel and the configured one."""
        reported, configured = self.identify().travel_mm, self.settings.travel_mm
        if configured is None:
            return reported
        try:
            return reported.intersection(configured)
        except ValueError as failure:
            problem = f"the travel {configured} lies outside the controller's {reported}"
            raise OutsideTravel(f"{problem}; correct stage.travel_mm") from failure

    def workspace(self) -> StageWorkspace:
        """Return the allowed positions and the keep-out boxes."""
        return StageWorkspace(self.travel(), self.settings.keep_out)

    def feed_mm_per_s(self) -> float:
        """Return the requested speed of motions; the controller limits each axis to its own rate."""
        configured = self.settings.feed_mm_per_min
        return min(self.identify().motion.rate_mm_per_s) if configured is None else configured / 60.0

    def home(self, axis: AxisIndex | None = None) -> Homing:
        """Home the stage, or one axis if the controller can; only homing of all axes together restores trust."""
        identity = self.identify()
        was_trusted = self.trusted
        with self._stopping_on_error():
            self.homings += 1
            time = self._controller.home(None if identity.homes_together else axis, identity.homing_bound_s)
            point = self._controller.read_position()
        self.trusted, self._here = was_trusted or axis is None or identity.homes_together, point
        return Homing(self._report(point), time)

    def move_to(self, x_mm: float, y_mm: float) -> Position:
        """Go to a position, wait until the stage stands still there, and return the verified report.

        Each axis arrives in the positive direction (`one_sided_path`), so play in the drive does not affect the place.
        Raises `NotHomed`, `OutsideTravel` or `KeepOutCrossed` before anything moves. After a `StageError` the stage did
        not arrive, and was told to stop.
        """
        target = Point(x_mm, y_mm)
        self._require_trust(target)
        start = self._here or self.position().point
        path = (start, *one_sided_path(start, target, self.settings.approach_mm))
        self.workspace().check_path(path)
        feed = self.feed_mm_per_s()
        predicted_s = path_duration_s(path, self.identify().motion, feed)
        with self._stopping_on_error():
            point = self._checked(self._controller.follow(path[1:], feed, predicted_s), target)
        return self._report(point)

    def jog(self, dx_mm: float, dy_mm: float, *, unlock: bool = False) -> Position:
        """Move by a distance, homed or not, to bring up hardware; `unlock` clears the lock of an unhomed controller.

        Raises `OutsideTravel` or `KeepOutCrossed` before anything moves, also for more than 10 mm without homing.
        """
        by, target = Point(dx_mm, dy_mm), None
        if self.trusted:
            start = self._here or self.position().point
            target = Point(start.x_mm + dx_mm, start.y_mm + dy_mm)
            self.workspace().check_path((start, target))
        elif not math.hypot(*by) <= _MAX_UNHOMED_JOG_MM:
            limit = f"{_MAX_UNHOMED_JOG_MM:g} mm"
            raise OutsideTravel(f"a jog by {by} without homing is longer than {limit}; jog less, or home first")
        feed = self.feed_mm_per_s()
        predicted_s = duration_s(Point(0.0, 0.0), by, self.identify().motion, feed)
        with self._stopping_on_error():
            point = self._controller.jog(by, feed, predicted_s, unlock=unlock)
            if target is not None:
                self._checked(point, target)
        return self._report(point)

    def position(self) -> Position:
        """Read the position from the controller; raises `StageError` in an alarm or in motion, too."""
        with self._tracking_trust():
            point = self._controller.read_position()
        self._here = point if self.trusted else None
        return self._report(point)

    def verify_at(self, x_mm: float, y_mm: float) -> Position:
        """Raise unless the stage is known to stand at this position: the last check before an exposure."""
        target = Point(x_mm, y_mm)
        self._require_trust(target)
        with self._tracking_trust():
            point = self._checked(self._controller.read_position(), target)
        return self._report(point)

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose homing switch is closed now."""
        with self._tracking_trust():
            return self._controller.switches()

    def switch_output(self, output: Output, *, on: bool) -> None:
        """Switch an output of the controller; raises `PlanRefused` if it has none.

        After a failure, an output can only be switched off, and the stage is stopped before.
        """
        controller = self._output_controller()
        with self._tracking_trust():
            if self._failed and not on:
                self.trusted &= self._controller.abort()
                controller.force_off(output)
            else:
                controller.switch_output(output, on=on)

    def read_output(self, output: Output) -> bool | None:
        """Return whether an output is on, as the controller reports it; None if it does not."""
        controller = self._output_controller()
        with self._tracking_trust():
            return controller.read_output(output)

    def unlock(self) -> None:
        """Clear the lock of a controller that was not homed, as it switches no output; nothing moves."""
        controller = self._output_controller()
        with self._tracking_trust():
            controller.unlock()

    def hold(self) -> None:
        """Stop at once; the position is kept if the controller decelerates without losing steps."""
        self._here = None
        with self._stopping_on_error():
            self.trusted &= self._controller.stop()

    def recover(self) -> None:
        """Make the controller accept commands again after an error, without moving, and read its settings again."""
        self._here = None
        self.recoveries += 1
        with self._tracking_trust():
            self.trusted &= self._controller.recover(self.settings.reconnect_s)
            self._identity = self._controller.identify()
        self._failed = False

    def close(self) -> None:
        """Close the port, without moving; the stage must be homed after the next `connect`.

        After a failure the controller is stopped first, so that it holds no motion that could go on.
        """
        self._distrust()
        try:
            if self._failed:
                self._controller.abort()
        finally:  # a plug-in may raise anything
            self._identity, self._failed = None, False
            self._controller.close()

    def _output_controller(self) -> OutputController:
        if not isinstance(self._controller, OutputController):
            raise PlanRefused(
                f"protocol = {self.settings.protocol!r} has no outputs for lights; switch them with driver = 'command'"
            )
        return self._controller

    def _require_trust(self, target: Point) -> None:
        if not self.trusted:
            raise NotHomed(f"the stage's position is not known, so it is not sent to {target}; home it first")

    def _checked(self, point: Point, target: Point) -> Point:
        """Record `point` as the stage's position and return it; raise `PositionLost` unless it is at `target`."""
        tolerance = self.identify().tolerance_mm
        if not Position(point, tolerance, trusted=True).is_at(target):
            problem = f"the stage reports {point} instead of {target}, more than {max(tolerance):.4f} mm off"
            raise PositionLost(f"{problem}; look for an obstacle or a disturbed cable, then home it")
        self._here = point
        return point

    def _report(self, point: Point) -> Position:
        return Position(point, self.identify().tolerance_mm, self.trusted)

    def _distrust(self) -> None:
        self.trusted, self._here = False, None

    @contextmanager
    def _tracking_trust(self) -> Iterator[None]:
        """Withdraw trust when an error inside loses the position."""
        try:
            yield
        except StageError as failure:
            self._here, self._failed = None, True
            self.trusted &= failure.position_kept
            raise
        except BaseException:
            self._distrust()
            self._failed = True
            raise

    @contextmanager
    def _stopping_on_error(self) -> Iterator[None]:
        """As `_tracking_trust`, and also stop the stage on any exception, Ctrl-C included."""
        try:
            with self._tracking_trust():
                yield
        except BaseException:
            self.trusted &= self._controller.abort()
            raise


def serial_stage(
    settings: StageSettings, clock: Clock, traffic: TrafficLog | None, open_port: Callable[[], Port]
) -> Gantry:
    """Return a stage with GRBL or Marlin, not yet connected; `traffic` gets every byte sent and received."""
    line = LineTransport(open_port, clock, traffic)
    if settings.protocol == "grbl":
        return Gantry(GrblController(line, settings.axes), settings, clock)
    return Gantry(MarlinController(line, settings.axes, settings.travel_mm), settings, clock)
