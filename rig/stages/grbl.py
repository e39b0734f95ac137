"""Drive GRBL 1.1 and grblHAL: jogs in machine coordinates, polled until two reports in a row are idle.

Jogs (`$J=`) are the safest motion that GRBL has: it refuses a target outside the travel without an alarm, a jog can be
cancelled without losing the position, and the parser's state does not change. With `G53` the target is in machine
coordinates, whatever work offset is stored in the controller.
"""

import math
import re
from collections.abc import Sequence
from contextlib import suppress
from operator import truediv

from faintfield.rig.errors import StageAlarm, StageError, StageRejected, StageTimeout, WrongFirmware
from faintfield.rig.stages import grbl_alarms as failures
from faintfield.rig.stages import grbl_lines as grbl
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.protocol import AnswerTime, AxisIndex, Identity, Output, OutputKind, Point
from faintfield.rig.stages.transport import LineTransport, Ok, motion_words, read_twice, restart_failure

# GRBL's real-time characters.
_CANCEL_JOG, _RESET, _HOLD, _STATUS_REQUEST = b"\x85", b"\x18", b"!", b"?"
# Between status requests, in s; GRBL's documentation recommends at most five a second. Where a capture waits for the
# answer, at the end of a motion and before and after an exposure, it is asked sooner.
_POLL_INTERVAL_S, _SOON_S = 0.2, 0.05
# How long (s) after the predicted end of a motion it is asked so often.
_ARRIVAL_S = 0.5
# Waits in s: for the banner after the port was opened and the boot loader has run; for the banner after a reset; for
# the status report of a board that did not restart; for the response to a command.
_BOOT_S = 3.0
_RESET_S = 0.4
_FIRST_REPORT_S = 1.0
_ANSWER_S = timeout_s(0.0)
# Longest recovery besides slowing down, in s: enough for three resets, each with its wait for the banner.
_RECOVERY_S = 2.0
# Reports in a row that show the same position before a motion that was told to stop counts as stuck.
_UNCHANGED_REPORTS = 2
# GRBL reports the work offset in at least every 30th report.
_MAX_REPORTS_TO_OFFSET = 40
# It reports the outputs in at least every 20th report, or in the one after it if the work offset is due as well.
_MAX_REPORTS_TO_OUTPUTS = 22
# Command that switches an output on, and its letters in reports.
_OUTPUTS: dict[OutputKind, tuple[str, str]] = {"flood": ("M8", "F"), "mist": ("M7", "M"), "spindle": ("M3 S", "SC")}
_SPINDLE_LEVEL = 1000.0


class GrblController:
    """A `Controller` that speaks GRBL 1.1 over `line`; `axes` are its letters for the two axes."""

    def __init__(self, line: LineTransport, axes: tuple[str, str]) -> None:
        self._line = line
        self._clock = line.clock
        self._axes = axes
        self._index = tuple("XYZ".index(axis) for axis in axes)
        self._braking_s, self._polled_s = 0.0, -math.inf
        self._offset_mm: tuple[float, ...] | None = None
        self._alarm: int | None = None
        self._outputs: frozenset[str] | None = None  # as last reported
        self._outputs_due = self._outputs_unreported = False
        self._reported_s = 0.0
        self._coolants: set[OutputKind] = set()  # as commanded: M9 switches both off
        self._count_lost = False  # since the stage was homed
        self._homing = False  # by the last command
        self._door_opened = False  # since the last report of rest

    def connect(self, wait_s: float = 0.0) -> None:
        """Open the connection, waiting up to `wait_s` for its port, and wait for the banner, as most boards restart."""
        self._offset_mm = self._alarm = None
        self._count_lost, self._homing, self._door_opened = True, False, False
        self._forget_outputs()
        self._line.open(wait_s)
        if self._await_banner(_BOOT_S):
            return
        # Boards with native USB keep running. The newline makes other firmware answer too; GRBL answers it with an ok,
        # which has to be read here so that the first command does not take it for its own.
        self._line.send(_STATUS_REQUEST + b"\n")
        reported = False
        for text in self._line.lines_until(self._clock.now_s() + _FIRST_REPORT_S):
            _refuse_other_firmware(text)
            reported = reported or isinstance(grbl.parse(text), grbl.Report)
        # A reset ends what an earlier program may have left, and revives a GRBL that an alarm has silenced.
        if not self._reset(_FIRST_REPORT_S) and not reported:
            problem = f"no answer as from GRBL within {_BOOT_S + 2.0 * _FIRST_REPORT_S:g} s, and none to a reset"
            raise StageTimeout(f"{problem}; check power, baud rate and protocol of the controller")

    def identify(self) -> Identity:
        """Read build information and settings, the settings twice since the line has no checksum."""
        build = {message.kind: message.text for message in self._command("$I") if isinstance(message, grbl.Feedback)}
        values = read_twice(self._read_settings, grbl.motion_settings)
        identity = grbl.GrblSettings(values, build).identity(self._index)
        motion = identity.motion
        self._braking_s = max(map(truediv, motion.rate_mm_per_s, motion.acceleration_mm_per_s2))
        for _ in range(_MAX_REPORTS_TO_OFFSET):
            if self._poll().is_machine or self._offset_mm is not None:
                return identity
        raise WrongFirmware("work positions are reported without their offset; set $10=1 for machine positions")

    def home(self, axis: AxisIndex | None, bound_s: float) -> AnswerTime:
        """Home within `bound_s`: GRBL answers nothing until the switches are found."""
        self._command("$H" if axis is None else f"$H{self._axes[axis]}", bound_s)
        time = self._line.answer_time
        self._wait_until_still(0.0)
        self._alarm, self._count_lost, self._homing = None, False, False
        return time

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Queue one jog per point and wait for the last to end."""
        begun_s = self._clock.now_s()
        for point in path:
            self._command(f"$J=G90 G21 G53 {motion_words(self._axes, point, feed_mm_per_s)}")
        return self._wait_until_still(max(0.0, predicted_s - (self._clock.now_s() - begun_s)))

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Jog by a distance, first clearing a lock if `unlock`."""
        if unlock and self._poll().state == "Alarm":
            self._command("$X")
        self._command(f"$J=G91 G21 {motion_words(self._axes, by, feed_mm_per_s)}")
        return self._wait_until_still(predicted_s)

    def read_position(self) -> Point:
        """Return the machine position of a new report; raises unless the state is idle."""
        report = self._poll(_SOON_S)
        if report.state != "Idle":
            raise self._state_failure(report)
        return self._machine_point(report)

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose limit input is active."""
        pins = self._poll().pins
        return frozenset(index for index in (0, 1) if self._axes[index] in pins)

    def switch_output(self, output: Output, *, on: bool) -> None:
        """Switch flood, mist or the spindle; M9 ends both coolants, so that the other one is switched on again."""
        if output.kind not in _OUTPUTS:
            raise StageRejected(f"GRBL has no output {output.kind!r}; choose from {', '.join(_OUTPUTS)}")
        command = _OUTPUTS[output.kind][0]
        try:
            if output.kind == "spindle":
                level = _SPINDLE_LEVEL if output.level is None else output.level
                self._command(f"{command}{level:g}" if on else "M5")
            elif on:
                self._command(command)
                self._coolants.add(output.kind)
            else:
                self._command("M9")
                self._coolants.discard(output.kind)
                for other in self._coolants:
                    self._command(_OUTPUTS[other][0])
        except StageRejected as failure:
            state = f"the firmware does not switch {output.kind}: {failure}"
            raise StageRejected(
                f"{state}; GRBL needs to be built with ENABLE_M7 for mist: choose another output"
            ) from None
        self._reported_s = -math.inf  # a report from before is not asked

    def force_off(self, output: Output) -> None:
        """Reset GRBL, which obeys nothing else in an alarm: all outputs go off, and a stage at rest loses no step."""
        if not self._reset(_RESET_S) and self.read_output(output) is not False:
            raise StageTimeout(f"no answer to a reset within {_RESET_S:g} s; switch {output.kind} off by hand")

    def read_output(self, output: Output) -> bool | None:
        """Return whether a report of this moment has the output among those that are on.

        GRBL reports the outputs in the next report after a change, or in the one after it if the work offset is due.
        """
        for _ in range(1 if self._outputs_unreported else _MAX_REPORTS_TO_OUTPUTS):
            if self._clock.now_s() - self._reported_s >= _POLL_INTERVAL_S or self._outputs is None or self._outputs_due:
                self._poll()
            if self._outputs is not None and not self._outputs_due:
                return not self._outputs.isdisjoint(_OUTPUTS[output.kind][1])
        self._outputs_unreported = True
        return None

    def unlock(self) -> None:
        """Clear the lock ($X)."""
        if self._poll().state == "Alarm":
            self._command("$X")

    def stop(self) -> bool:
        """Cancel the jog: GRBL slows down within its acceleration and keeps its count."""
        self._line.send(_CANCEL_JOG)
        self._wait_until_still(self._braking_s)
        return True

    def abort(self) -> bool:
        """Cancel the jog, or reset while homing, which nothing else interrupts; reset what does not end."""
        with suppress(StageError):  # a stage that cannot be reached cannot be stopped
            self._line.send(_RESET if self._homing else _CANCEL_JOG)
            if not self._homing:
                self._bring_to_rest()
                return not self._count_lost
        return False

    def recover(self, wait_s: float) -> bool:
        """Bring GRBL to a state that accepts commands; a lock is cleared only if the position was kept."""
        if not self._line.is_open:
            self.connect(wait_s)
            return False
        self._line.send(b"\n")  # ends a damaged line, which would otherwise be joined to the next
        report = self._bring_to_rest()
        if report.state == "Alarm":
            # A controller that has restarted unseen reports zero.
            restarted = self._machine_point(report) == (0.0, 0.0)
            if self._alarm != failures.SOFT_LIMIT_ALARM or self._count_lost or restarted:
                return False
            self._alarm = None
            self._command("$X")
            return True
        return not self._count_lost

    def close(self) -> None:
        """Close the connection."""
        self._line.close()

    def _command(self, text: str, bound_s: float = _ANSWER_S) -> list[grbl.Message]:
        """Send one command, wait for its response, and return the messages before the response."""
        self._read_until(self._clock.now_s())  # what has come unasked is not the answer
        self._homing = text.startswith("$H")
        self._line.send(text.encode("ascii") + b"\n")
        deadline_s = self._clock.now_s() + bound_s
        messages: list[grbl.Message] = []
        while (message := self._receive(deadline_s)) is not None:
            if isinstance(message, Ok):
                return messages
            if isinstance(message, grbl.ErrorCode):
                if message.code in failures.LOCKED_ERRORS:
                    report = self._poll()
                    if self._is_frozen(report) or report.state not in ("Idle", "Jog", "Run"):
                        raise self._state_failure(report)
                raise failures.error_failure(text, message.code)
            messages.append(message)
        raise StageTimeout(f"no answer to {text!r} within {bound_s:g} s; check cable and power, recover and home it")

    def _poll(self, interval_s: float = _POLL_INTERVAL_S) -> grbl.Report:
        """Request a status report, not sooner than an interval after the last request, and return it."""
        self._read_until(self._clock.now_s())
        while self._clock.now_s() < self._polled_s + interval_s:
            self._receive(self._polled_s + interval_s)
        self._request_status()
        deadline_s = self._clock.now_s() + _ANSWER_S
        while (message := self._receive(deadline_s)) is not None:
            if isinstance(message, grbl.Report):
                return message
        raise StageTimeout(f"no status report within {_ANSWER_S:g} s; check cable and power, recover and home it")

    def _request_status(self) -> None:
        self._polled_s = self._clock.now_s()
        self._line.send(_STATUS_REQUEST)

    def _bring_to_rest(self) -> grbl.Report:
        """Stop what moves, end what is on hold, and return a report of the state `Idle` or `Alarm`.

        A soft reset at rest keeps the position, and forgets the rest of a motion that was on hold. A motion that is
        told to stop and neither moves nor ends (a jog of grblHAL after its door was opened) is reset as well, which
        loses the position.
        """
        within_s = _RECOVERY_S + self._braking_s
        deadline_s = self._clock.now_s() + within_s
        last: tuple[str, tuple[float, ...]] | None = None
        unchanged, was_reset = 0, False
        while self._clock.now_s() + _POLL_INTERVAL_S + _RESET_S < deadline_s:
            report = self._poll_despite_failures()
            state = None if report is None else (report.state, report.position)
            unchanged = unchanged + 1 if state is not None and state == last else 0
            last = state
            if report is not None:
                if report.state == "Alarm" and report.emergency_stop:
                    raise failures.state_failure(report, self._alarm)
                critical = not was_reset and (report.substate or self._alarm) in failures.CRITICAL_ALARMS
                if report.state == "Idle" or (report.state == "Alarm" and not critical):
                    return report
                if report.is_moving and unchanged < _UNCHANGED_REPORTS:
                    self._line.send({"Jog": _CANCEL_JOG, "Run": _HOLD}.get(report.state, b""))
                    continue
                if report.state == "Door" and was_reset:
                    raise failures.state_failure(report, self._alarm)
                self._count_lost = self._count_lost or report.is_moving
            # After critical alarms GRBL answers nothing but a reset, and ignores one that comes too early.
            self._reset(_RESET_S)
            was_reset, unchanged = True, 0
        self._count_lost = True
        self._line.send(_RESET)
        problem = f"the controller is not ready {within_s:g} s after it was told to stop, and was reset"
        raise StageTimeout(f"{problem}; switch it off and on, then home it")

    def _poll_despite_failures(self) -> grbl.Report | None:
        self._request_status()
        newest: grbl.Report | None = None
        for text in self._line.lines_until(self._polled_s + _POLL_INTERVAL_S):
            message = grbl.parse(text)
            self._note(message)
            if isinstance(message, grbl.Report):
                newest = message
        return newest

    def _wait_until_still(self, predicted_s: float) -> Point:
        """Poll until two reports in a row are idle at the same position, and return it.

        One report is not enough: between accepting a jog and starting it, GRBL is idle for a moment.
        """
        started_s, bound_s = self._clock.now_s(), timeout_s(predicted_s)
        self._read_until(started_s + predicted_s)
        last: Point | None = None
        while self._clock.now_s() < started_s + bound_s:
            arriving = self._clock.now_s() < started_s + predicted_s + _ARRIVAL_S
            report = self._poll(_SOON_S if arriving else _POLL_INTERVAL_S)
            if report.state == "Idle":
                point = self._machine_point(report)
                if point == last:
                    return point
                last = point
            elif report.state in ("Jog", "Run") and not self._is_frozen(report):
                last = None
            else:
                raise self._state_failure(report)
        state = f"the stage still moves after {bound_s:.1f} s, where {predicted_s:.1f} s were expected"
        raise StageTimeout(f"{state}; it was told to stop: recover and home it")

    def _is_frozen(self, report: grbl.Report) -> bool:
        """Return whether a door has frozen a jog: grblHAL still reports it as one, GRBL cancels it."""
        return self._door_opened and report.state == "Jog"

    def _state_failure(self, report: grbl.Report) -> StageAlarm:
        return failures.door_failure() if self._is_frozen(report) else failures.state_failure(report, self._alarm)

    def _machine_point(self, report: grbl.Report) -> Point:
        values = report.position
        if not report.is_machine:
            if self._offset_mm is None:
                raise StageTimeout("a work position without its offset; set $10=1 for machine positions")
            values = tuple(work + shift for work, shift in zip(values, self._offset_mm, strict=False))
        if max(self._index) >= len(values):
            raise WrongFirmware(f"the controller reports {len(values)} axes, not {self._axes}; set stage.axes")
        return Point(*(values[index] for index in self._index))

    def _read_settings(self) -> dict[int, str]:
        messages = self._command("$$")
        return {message.number: message.value for message in messages if isinstance(message, grbl.GrblSetting)}

    def _read_until(self, deadline_s: float) -> None:
        while self._receive(deadline_s) is not None:
            pass

    def _reset(self, within_s: float) -> bool:
        self._line.send(_RESET)
        self._forget_outputs()
        return self._await_banner(within_s)

    def _receive(self, deadline_s: float) -> grbl.Message | None:
        """Return the next message, None at the deadline; raise an alarm or a restart, which can come at any time."""
        text = self._line.next_line(deadline_s)
        if text is None:
            return None
        message = grbl.parse(text)
        self._note(message)
        # grblHAL raises the alarm that it must be homed whenever it has started: that is no failure
        if isinstance(message, grbl.Alarm) and message.code != failures.HOMING_REQUIRED_ALARM:
            raise failures.alarm_failure(message.code)
        if isinstance(message, grbl.Banner):
            raise restart_failure()
        return message

    def _note(self, message: grbl.Message) -> None:
        if isinstance(message, grbl.Report):
            self._offset_mm = self._offset_mm if message.offset is None else message.offset
            self._door_opened = (self._door_opened or message.door_is_open) and message.state != "Idle"
            self._reported_s = self._clock.now_s()
            self._outputs_due = message.outputs is None and not message.is_brief
            self._outputs = self._outputs if message.outputs is None else message.outputs
            self._outputs_unreported = self._outputs_unreported and message.outputs is None
        elif isinstance(message, grbl.Feedback):
            self._door_opened = self._door_opened or message.is_door
        elif isinstance(message, grbl.Banner):
            self._count_lost = True
            self._forget_outputs()
        elif isinstance(message, grbl.Alarm):
            self._alarm = message.code
            self._forget_outputs()
            self._count_lost = self._count_lost or message.code != failures.SOFT_LIMIT_ALARM

    def _forget_outputs(self) -> None:
        self._outputs = None
        self._coolants.clear()

    def _await_banner(self, within_s: float) -> bool:
        for text in self._line.lines_until(self._clock.now_s() + within_s):
            _refuse_other_firmware(text)
            message = grbl.parse(text)
            if isinstance(message, grbl.Banner):
                return True
            self._note(message)
        return False


def _refuse_other_firmware(text: str) -> None:
    if re.search(r"marlin|echo:unknown command|^start$", text, re.IGNORECASE):
        raise WrongFirmware(f"the controller answers as Marlin ({text[:60]!r}); use protocol 'marlin'")
