"""Drives GRBL 1.1 and grblHAL: jogs in machine coordinates, polled until two reports in a row are idle.

Jogs (`$J=`) are the safest motion that GRBL has: it refuses a target outside the travel without an alarm, a jog can be
cancelled without losing the position, and the parser's state does not change. With `G53` the target is in machine
coordinates, whatever work offset is stored in the controller.
"""

from collections.abc import Sequence
from contextlib import suppress
from operator import truediv

from faintfield.rig.errors import StageError, StageLost, StageTimeout, WrongFirmware
from faintfield.rig.stages.grbl.connection import CANCEL_JOG, RESET, GrblConnection
from faintfield.rig.stages.grbl.failures import SOFT_LIMIT_ALARM, state_failure
from faintfield.rig.stages.grbl.messages import Feedback, GrblSetting, Report
from faintfield.rig.stages.grbl.settings import GrblSettings
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.protocol import AnswerTime, AxisIndex, Identity, Point
from faintfield.rig.stages.transport import LineTransport

# Longest recovery besides slowing down, in s: enough for three resets, each with its wait for the banner.
_RECOVERY_S = 2.0

# GRBL reports the work offset in at least every 30th report.
_MAX_REPORTS_TO_OFFSET = 40


class GrblController:
    """A `Controller` that speaks GRBL 1.1 over `line`; `axes` are its letters for the two axes."""

    def __init__(self, line: LineTransport, axes: tuple[str, str]) -> None:
        self._grbl = GrblConnection(line)
        self._clock = line.clock
        self._axes = axes
        self._index = tuple("XYZ".index(axis) for axis in axes)
        self._braking_s = 0.0

    def connect(self, wait_s: float = 0.0) -> None:
        """Open the connection, waiting up to `wait_s` for its port, and wait until the controller answers."""
        self._grbl.open(wait_s)

    def identify(self) -> Identity:
        """Read build information and settings, the settings twice since the line has no checksum."""
        build = {message.kind: message.text for message in self._grbl.command("$I") if isinstance(message, Feedback)}
        first, second = self._read_settings(), self._read_settings()
        if first != second:
            numbers = sorted(first.keys() | second.keys())
            differing = ", ".join(f"${number}" for number in numbers if first.get(number) != second.get(number))
            raise StageLost(f"{differing} read differently twice in a row: the line is disturbed; try a shorter cable")
        identity = GrblSettings(first, build).identity(self._index)
        motion = identity.motion
        self._braking_s = max(map(truediv, motion.rate_mm_per_s, motion.acceleration_mm_per_s2))
        for _ in range(_MAX_REPORTS_TO_OFFSET):
            if self._grbl.poll().is_machine or self._grbl.offset is not None:
                return identity
        raise WrongFirmware("work positions are reported without their offset; set $10=1 for machine positions")

    def home(self, axis: AxisIndex | None, bound_s: float) -> AnswerTime:
        """Home within `bound_s`: GRBL answers nothing until the switches are found."""
        self._grbl.command("$H" if axis is None else f"$H{self._axes[axis]}", bound_s)
        time = self._grbl.line.answer_time
        self._wait_until_still(0.0)
        self._grbl.alarm, self._grbl.count_lost = None, False
        return time

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Queue one jog per point and wait for the last to end."""
        for point in path:
            self._grbl.command(self._jog_command("G90 G21 G53", point, feed_mm_per_s))
        return self._wait_until_still(predicted_s)

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Jog by a distance, first clearing a lock if `unlock`."""
        if unlock and self._grbl.poll().state == "Alarm":
            self._grbl.command("$X")
        self._grbl.command(self._jog_command("G91 G21", by, feed_mm_per_s))
        return self._wait_until_still(predicted_s)

    def read_position(self) -> Point:
        """Return the machine position of a new report; raises unless the state is idle."""
        report = self._grbl.poll()
        if report.state != "Idle":
            raise state_failure(report, self._grbl.alarm)
        return self._machine_point(report)

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose limit input is active."""
        pins = self._grbl.poll().pins
        return frozenset(index for index in (0, 1) if self._axes[index] in pins)

    def stop(self) -> bool:
        """Cancel the jog: GRBL slows down within its acceleration and keeps its count."""
        self._grbl.line.send(CANCEL_JOG)
        self._wait_until_still(self._braking_s)
        return True

    def abort(self) -> bool:
        """Cancel the jog, or reset while homing, which nothing else interrupts; reset what does not end."""
        with suppress(StageError):  # a stage that cannot be reached cannot be stopped
            self._grbl.line.send(RESET if self._grbl.homing else CANCEL_JOG)
            if not self._grbl.homing:
                self._grbl.bring_to_rest(_RECOVERY_S + self._braking_s)
                return not self._grbl.count_lost
        return False

    def recover(self, wait_s: float) -> bool:
        """Bring GRBL to a state that accepts commands; a lock is cleared only if the position was kept."""
        if not self._grbl.line.is_open:
            self.connect(wait_s)
            return False
        self._grbl.line.send(b"\n")  # ends a damaged line, which would otherwise be joined to the next
        report = self._grbl.bring_to_rest(_RECOVERY_S + self._braking_s)
        if report.state == "Alarm":
            # A controller that has restarted unseen reports zero.
            restarted = self._machine_point(report) == (0.0, 0.0)
            if self._grbl.alarm != SOFT_LIMIT_ALARM or self._grbl.count_lost or restarted:
                return False
            self._grbl.alarm = None
            self._grbl.command("$X")
            return True
        return not self._grbl.count_lost

    def close(self) -> None:
        """Close the connection."""
        self._grbl.line.close()

    def _jog_command(self, modes: str, point: Point, feed_mm_per_s: float) -> str:
        x, y = self._axes
        return f"$J={modes} {x}{point.x_mm:.3f} {y}{point.y_mm:.3f} F{60.0 * feed_mm_per_s:.1f}"

    def _wait_until_still(self, predicted_s: float) -> Point:
        """Poll until two reports in a row are idle at the same position, and return it.

        One report is not enough: between accepting a jog and starting it, GRBL is idle for a moment.
        """
        started_s = self._clock.now_s()
        self._grbl.read_until(started_s + predicted_s)
        last: Point | None = None
        while self._clock.now_s() < started_s + timeout_s(predicted_s):
            report = self._grbl.poll()
            if report.state == "Idle":
                point = self._machine_point(report)
                if point == last:
                    return point
                last = point
            elif report.state in ("Jog", "Run"):
                last = None
            else:
                raise state_failure(report, self._grbl.alarm)
        raise StageTimeout(
            f"the stage still moves after {timeout_s(predicted_s):.1f} s, where {predicted_s:.1f} s were expected; "
            "it was told to stop: recover and home it"
        )

    def _machine_point(self, report: Report) -> Point:
        values = report.position
        if not report.is_machine:
            offset = self._grbl.offset
            if offset is None:
                raise StageTimeout("a work position without its offset; set $10=1 for machine positions")
            values = tuple(work + shift for work, shift in zip(values, offset, strict=False))
        if max(self._index) >= len(values):
            raise WrongFirmware(f"the controller reports {len(values)} axes, not {self._axes}; set stage.axes")
        return Point(*(values[index] for index in self._index))

    def _read_settings(self) -> dict[int, str]:
        messages = self._grbl.command("$$")
        return {message.number: message.value for message in messages if isinstance(message, GrblSetting)}
