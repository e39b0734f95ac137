"""Drive Marlin: numbered lines with checksums, motion awaited with M400, the position read with M114.

The line numbers also reveal a restart that was not seen: after one, Marlin asks for line 1 at the next command.
"""

import re
from collections.abc import Sequence
from contextlib import suppress
from itertools import count

from faintfield.rig.errors import StageAlarm, StageError, StageLost, StageRejected, StageTimeout, WrongFirmware
from faintfield.rig.stages import marlin_lines as marlin
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.protocol import AnswerTime, AxisIndex, Box, Identity, Output, Point
from faintfield.rig.stages.transport import LineTransport, Ok, motion_words, read_twice, restart_failure

# Waits in s: for the first line after the port was opened and the boot loader has run; for the answer to a command; for
# the echo of a marker.
_BOOT_S = 3.0
_ANSWER_S = timeout_s(0.0)
_ECHO_S = 0.7
# How much longer (s) a command may take while Marlin says every two seconds that it is busy, or that it waits for its
# button to be pressed; and how long after each such message the next one is waited for.
_MAX_BUSY_S, _MAX_PAUSED_S = 15.0, 600.0
_BUSY_S = 5.0
# A controller that has sent nothing for this long (s) has finished its greeting.
_QUIET_S = 0.2
# Answers that are under way when a motion is aborted arrive within this time (s).
_DISCARD_S = 0.1
# Attempts: to send a line, and to start counting lines.
_MAX_SENDINGS = 6
_MAX_STARTS = 3
# Value that switches a pin or a fan fully on.
_FULL_LEVEL = 255.0


class MarlinController:
    """A `Controller` that speaks Marlin over `line`; `axes` are its letters for the two axes.

    `travel_mm` is the travel, for firmware that does not report it.
    """

    def __init__(self, line: LineTransport, axes: tuple[str, str], travel_mm: Box | None) -> None:
        self._line = line
        self._clock = line.clock
        self._axes = axes
        self._travel_mm = travel_mm
        self._line_number = 0
        self._markers = (f"faintfield-{number}." for number in count(1))

    def connect(self, wait_s: float = 0.0) -> None:
        """Open the connection and wait for the end of the greeting, since most boards restart when it is opened."""
        self._line.open(wait_s)
        self._await_start()
        self._start_counting()

    def identify(self) -> Identity:
        """Read capabilities and settings, the settings twice since answers have no checksum."""
        about = self._command("M115")
        settings = read_twice(self._read_settings)
        return marlin.marlin_identity((*about, *settings), self._axes, self._travel_mm)

    def home(self, axis: AxisIndex | None, bound_s: float) -> AnswerTime:
        """Home the named axis or both, and no others, such as a focus drive."""
        axes = self._axes if axis is None else (self._axes[axis],)
        self._command(f"G28 {' '.join(axes)}", bound_s)
        time = self._line.answer_time
        self._command("M400")
        return time

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Queue one motion per point, wait for the last to end, and read the position."""
        for point in path:
            self._command(f"G1 {motion_words(self._axes, point, feed_mm_per_s)}")
        self._command("M400", timeout_s(predicted_s))
        return self.read_position()

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Move by a distance, as an absolute motion so that no relative mode remains set; Marlin has no lock."""
        here = self.read_position()
        return self.follow((Point(here.x_mm + by.x_mm, here.y_mm + by.y_mm),), feed_mm_per_s, predicted_s)

    def read_position(self) -> Point:
        """Return the real position (R) if the firmware reports it, otherwise the last target."""
        for message in self._command("M114 R"):
            if isinstance(message, marlin.PositionReport):
                try:
                    return Point(*(message.axes_mm[axis] for axis in self._axes))
                except KeyError as missing:
                    raise WrongFirmware(f"M114 reports no position of axis {missing}; set stage.axes") from missing
        raise StageTimeout("M114 was answered without a position: answers are out of step; recover and home the stage")

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes with a closed limit switch."""
        switches = [message for message in self._command("M119") if isinstance(message, marlin.Switch)]
        closed = {switch.name[0].upper() for switch in switches if switch.closed}
        return frozenset(index for index in (0, 1) if self._axes[index] in closed)

    def switch_output(self, output: Output, *, on: bool) -> None:
        """Switch a pin (M42) or a fan (M106, M107)."""
        level = _FULL_LEVEL if output.level is None else output.level
        if output.kind == "pin":
            self._command(f"M42 P{output.number} S{level if on else 0.0:g}")
        elif output.kind == "fan":
            self._command(f"M106 P{output.number} S{level:g}" if on else f"M107 P{output.number}")
        else:
            raise StageRejected(f"Marlin has no output {output.kind!r}; choose pin or fan, with its number")

    def force_off(self, output: Output) -> None:
        """Switch an output off, after making Marlin answer again; a restart, which also does it, is the last resort."""
        try:
            self.recover(0.0)
        except StageError:
            self.connect()
        self.switch_output(output, on=False)

    def read_output(self, output: Output) -> None:
        """Return None: Marlin does not report its outputs."""

    def unlock(self) -> None:
        """Do nothing: Marlin has no lock."""

    def stop(self) -> bool:
        """Stop dead: Marlin does not slow down, so steps may be lost."""
        self.abort()
        self._command("M400")
        return False

    def abort(self) -> bool:
        """Send the emergency stop, which firmware with an emergency parser obeys at once."""
        with suppress(StageLost):  # a stage that cannot be reached cannot be stopped
            self._line.send(b"M410\n")
            self._discard_input()  # its ok belongs to no numbered line and must not be taken for the next answer
        return False

    def recover(self, wait_s: float) -> bool:
        """Make Marlin answer again; a killed controller restarts when the port is opened again."""
        if self._line.is_open:
            self._discard_input()
            keeps_count = self._keeps_count()
            if keeps_count is not None:
                self._start_counting()
                return keeps_count
        self.connect(wait_s)
        return False

    def close(self) -> None:
        """Close the connection."""
        self._line.close()

    def _discard_input(self) -> None:
        for _ in self._line.lines_until(self._clock.now_s() + _DISCARD_S):
            pass

    def _start_counting(self) -> None:
        """Restart the line numbers, and set what every motion relies on: mm, absolute positions, motors kept on.

        Answers to earlier commands may still be under way. They end where the controller echoes a marker, and the next
        `ok` is the first that counts.
        """
        for _ in range(_MAX_STARTS):
            marker, echoed = next(self._markers), False
            self._line.send(marlin.number_line(0, "M110 N0") + f"M118 {marker}\n".encode("ascii"))
            for text in self._line.lines_until(self._clock.now_s() + _ECHO_S):
                if echoed and isinstance(marlin.parse(text), Ok):
                    self._line_number = 0
                    for command in ("G21", "G90", "M84 S0"):
                        self._command(command)
                    return
                echoed = echoed or marker in text
        raise StageTimeout(f"no answer as from Marlin to {_MAX_STARTS} attempts; check power, baud rate and protocol")

    def _keeps_count(self) -> bool | None:
        """Return whether the controller accepts the next line number, as none does after a restart; None if mute."""
        marker = next(self._markers)
        self._line_number += 1
        self._line.send(marlin.number_line(self._line_number, f"M118 {marker}"))
        answered = None
        for text in self._line.lines_until(self._clock.now_s() + _QUIET_S):
            if marker in text:
                return True
            answered = False
        return answered

    def _await_start(self) -> None:
        """Wait until the controller has started and fallen silent, or did not restart."""
        deadline_s = last_s = self._clock.now_s() + _BOOT_S
        started = False
        while (text := self._line.next_line(deadline_s)) is not None:
            if re.match(r"Grbl", text, re.IGNORECASE):
                raise WrongFirmware(f"the controller answers as GRBL ({text[:60]!r}); use protocol 'grbl'")
            if not started and isinstance(marlin.parse(text), marlin.Start):
                started, last_s = True, self._clock.now_s() + 2.0 * _QUIET_S
            if started:
                deadline_s = min(self._clock.now_s() + _QUIET_S, last_s)

    def _read_settings(self) -> list[marlin.Message]:
        messages = [*self._command("M503"), *self._command("M211")]
        return [message for message in messages if isinstance(message, marlin.MarlinSetting | marlin.Limits)]

    def _command(self, command: str, bound_s: float = _ANSWER_S) -> list[marlin.Message]:
        for text in self._line.lines_until(self._clock.now_s()):
            self._check(marlin.parse(text), command)
        self._line_number += 1
        for _ in range(_MAX_SENDINGS):
            self._line.send(marlin.number_line(self._line_number, command))
            messages = self._await_ok(command, bound_s)
            if messages is not None:
                return messages
        raise StageLost(f"line {self._line_number} arrived damaged {_MAX_SENDINGS} times in a row; use a shorter cable")

    def _await_ok(self, command: str, bound_s: float) -> list[marlin.Message] | None:
        """Return the messages up to the `ok`, or None if the controller asks for the line again."""
        started_s = self._clock.now_s()
        deadline_s = started_s + bound_s
        messages: list[marlin.Message] = []
        why = ""
        while (text := self._line.next_line(deadline_s)) is not None:
            message = marlin.parse(text)
            self._check(message, command)
            messages.append(message)
            if isinstance(message, marlin.Busy):
                limit_s = started_s + bound_s + (_MAX_PAUSED_S if message.for_user else _MAX_BUSY_S)
                deadline_s = max(deadline_s, min(self._clock.now_s() + _BUSY_S, limit_s))
                why = ", it waits for its button to be pressed" if message.for_user else ", it says that it is busy"
            if isinstance(message, Ok) or (isinstance(message, marlin.PositionReport) and message.is_ok):
                if any(isinstance(earlier, marlin.Resend) for earlier in messages):
                    return None
                refusals = [earlier for earlier in messages if isinstance(earlier, marlin.Refusal)]
                if refusals:
                    raise StageRejected(f"the controller refused {command!r}: {refusals[0].text}; home the stage first")
                return messages
        problem = f"no answer to {command!r} within {self._clock.now_s() - started_s:.1f} s{why}"
        raise StageTimeout(
            f"{problem}; look whether the stage still moves, check cable and power, then recover and home it"
        )

    def _check(self, message: marlin.Message, command: str) -> None:
        if isinstance(message, marlin.Start):
            raise restart_failure()
        if isinstance(message, marlin.Resend) and message.number != self._line_number:
            problem = f"the controller waits for line {message.number} and was sent {self._line_number}"
            raise StageLost(f"{problem}: it has restarted, and its position is lost; recover and home it")
        if isinstance(message, marlin.ErrorText) and not message.in_transmission:
            raise StageAlarm(f"{command!r} was answered by {message.text!r}; find the cause, recover and home it")
