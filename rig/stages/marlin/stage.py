"""Marlin: numbered lines with checksums, motion awaited with M400, the position asked for with M114.

The line numbers do more than guard against damage: a controller that has restarted unseen asks for line 1, and so
gives itself away at the next command, whatever it was.
"""

import re
from collections.abc import Sequence
from contextlib import suppress

from faintfield.rig.errors import RigError, StageAlarm, StageLost, StageRejected, StageTimeout, WrongFirmware
from faintfield.rig.stages.marlin import messages as marlin
from faintfield.rig.stages.marlin.settings import MarlinSettings
from faintfield.rig.stages.motion import patience_s
from faintfield.rig.stages.protocol import AxisIndex, Box, Identity, Point
from faintfield.rig.stages.transport import LineTransport

_BOOT_S = 3.0
_QUIET_S = 0.2
_ANSWER_S = patience_s(0.0)
_RESENDS = 5
_BEGINNINGS = 3
_ECHO_S = 0.7


class Marlin:
    """Speaks Marlin over a line transport; a `Controller`.

    Parameters
    ----------
    line : LineTransport
        The connection.
    axes : (str, str)
        The controller's letters for the two axes.
    travel_mm : Box, optional
        The travel, for firmware that does not tell it.
    """

    def __init__(self, line: LineTransport, axes: tuple[str, str], travel_mm: Box | None) -> None:
        self._line = line
        self._clock = line.clock
        self._axes = axes
        self._travel_mm = travel_mm
        self._sent = 0
        self._words = 0

    def connect(self) -> None:
        """Open the connection; most boards restart when it opens, so wait until they have said all."""
        self._line.open()
        self._await_start()
        self._begin()

    def identify(self) -> Identity:
        """Read capabilities and settings, the settings twice: answers have no checksum."""
        about = self._command("M115")
        first, second = self._read_settings(), self._read_settings()
        if first != second:
            raise StageLost("the settings read differently twice in a row: the line is disturbed; try a shorter cable")
        return MarlinSettings.from_messages((*about, *first)).identity(self._axes, self._travel_mm)

    def home(self, axis: AxisIndex | None, bound_s: float) -> float:
        """Home the named axis, or both; others, such as a focus drive, are left alone."""
        started_s = self._clock.now_s()
        axes = self._axes if axis is None else (self._axes[axis],)
        self._command(f"G28 {' '.join(axes)}", bound_s)
        taken_s = self._clock.now_s() - started_s
        self._command("M400")
        return taken_s

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Queue one motion per point, wait for the last to end, and ask where it ended."""
        x, y = self._axes
        for point in path:
            self._command(f"G1 {x}{point.x_mm:.3f} {y}{point.y_mm:.3f} F{60.0 * feed_mm_per_s:.1f}")
        self._command("M400", patience_s(predicted_s))
        return self.read_position()

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Move by a distance, commanded as a position, so that no relative mode can stay behind; Marlin has no lock."""
        here = self.read_position()
        return self.follow((Point(here.x_mm + by.x_mm, here.y_mm + by.y_mm),), feed_mm_per_s, predicted_s)

    def read_position(self) -> Point:
        """Return where the stage is: really (R), where the firmware can, otherwise where it was sent."""
        for message in self._command("M114 R"):
            if isinstance(message, marlin.PositionReport):
                try:
                    return Point(*(message.axes_mm[axis] for axis in self._axes))
                except KeyError as missing:
                    raise WrongFirmware(f"M114 tells no position of axis {missing}; set stage.axes") from missing
        raise StageTimeout("M114 was answered without a position: answers are out of step; recover and home the stage")

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes of which a limit switch is closed."""
        closed = {m.name[0].upper() for m in self._command("M119") if isinstance(m, marlin.Switch) and m.closed}
        return frozenset(index for index in (0, 1) if self._axes[index] in closed)

    def stop(self) -> bool:
        """Stop dead. Marlin drops its motion without slowing down, so steps may be lost."""
        self.abort()
        self._command("M400")
        return False

    def abort(self) -> bool:
        """Send the emergency stop of motion, which firmware with an emergency parser obeys at once."""
        with suppress(StageLost):  # what cannot be reached cannot be stopped
            self._line.send(b"M410\n")
            # Its own ok, which answers no numbered line, must not be taken for the next answer.
            self._ignore_for(0.1)
        return False

    def recover(self) -> bool:
        """Get Marlin to answer again; a controller that was killed has to restart, by opening the port anew."""
        if self._line.is_open:
            self._ignore_for(0.1)
            still_counts = self._still_counts()
            if still_counts is not None:
                self._begin()
                return still_counts
        self.connect()
        return False

    def close(self) -> None:
        """Close the connection."""
        self._line.close()

    def _ignore_for(self, duration_s: float) -> None:
        """Take no notice of what is said for a while."""
        for _ in self._line.lines_until(self._clock.now_s() + duration_s):
            pass

    def _begin(self) -> None:
        """Begin counting lines, and set what every motion relies on: millimetres, absolute, motors kept on.

        Answers to what was sent before may still be on their way. They end where the controller echoes a word of ours,
        and the next `ok` is the first that counts.
        """
        for _ in range(_BEGINNINGS):
            word = self._new_word()
            self._line.send(marlin.numbered(0, "M110 N0") + f"M118 {word}\n".encode("ascii"))
            echoed = False
            for text in self._line.lines_until(self._clock.now_s() + _ECHO_S):
                if echoed and isinstance(marlin.parse(text), marlin.Ok):
                    self._sent = 0
                    for command in ("G21", "G90", "M84 S0"):
                        self._command(command)
                    return
                echoed = echoed or word in text
        raise StageTimeout(
            f"no answer as from Marlin to {_BEGINNINGS} attempts; check power, baud rate and protocol of the controller"
        )

    def _still_counts(self) -> bool | None:
        """Return whether the controller takes the next line number, as none does that has restarted; None if mute."""
        word = self._new_word()
        self._sent += 1
        self._line.send(marlin.numbered(self._sent, f"M118 {word}"))
        heard = None
        for text in self._line.lines_until(self._clock.now_s() + _QUIET_S):
            if word in text:
                return True
            heard = False
        return heard

    def _new_word(self) -> str:
        """Return a word that was not said before, for the controller to echo."""
        self._words += 1
        return f"faintfield-{self._words}."

    def _await_start(self) -> None:
        """Wait until the controller has started and fallen silent, or has shown that it did not restart."""
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
        """Return what the controller says of its settings and limits."""
        said = [*self._command("M503"), *self._command("M211")]
        return [message for message in said if isinstance(message, marlin.Setting | marlin.Limits)]

    def _command(self, command: str, bound_s: float = _ANSWER_S) -> list[marlin.Message]:
        """Send one command, again if it arrived damaged, and return what was said before its `ok`."""
        for text in self._line.lines_until(self._clock.now_s()):
            self._judge(marlin.parse(text), command)
        self._sent += 1
        for _ in range(1 + _RESENDS):
            self._line.send(marlin.numbered(self._sent, command))
            said = self._await_ok(command, bound_s)
            if said is not None:
                return said
        raise StageLost(
            f"line {self._sent} arrived damaged {1 + _RESENDS} times in a row; use a shorter or shielded cable"
        )

    def _await_ok(self, command: str, bound_s: float) -> list[marlin.Message] | None:
        """Return what was said up to the `ok`, or None when the line is wanted again."""
        deadline_s = self._clock.now_s() + bound_s
        said: list[marlin.Message] = []
        resend = False
        while (text := self._line.next_line(deadline_s)) is not None:
            message = marlin.parse(text)
            self._judge(message, command)
            said.append(message)
            if isinstance(message, marlin.Resend):
                resend = True
            if isinstance(message, marlin.Ok) or (isinstance(message, marlin.PositionReport) and message.is_ok):
                return None if resend else self._accepted(said, command)
        raise StageTimeout(
            f"no answer to {command!r} within {bound_s:.1f} s; look whether the stage still moves, "
            "check cable and power, then recover and home it"
        )

    def _accepted(self, said: list[marlin.Message], command: str) -> list[marlin.Message]:
        """Return `said` unless it holds a refusal."""
        for message in said:
            if isinstance(message, marlin.Refusal):
                raise StageRejected(f"the controller refused {command!r}: {message.text}; home the stage first")
        return said

    def _judge(self, message: marlin.Message, command: str) -> None:
        """Raise for a message that says that all is lost."""
        failure: RigError | None = None
        if isinstance(message, marlin.Start):
            failure = StageLost("the controller has restarted, and its position is lost; check its power, then home it")
        elif isinstance(message, marlin.Resend) and message.number != self._sent:
            failure = StageLost(
                f"the controller waits for line {message.number} and was sent {self._sent}: it has restarted, "
                "and its position is lost; recover and home it"
            )
        elif isinstance(message, marlin.Error) and not message.in_transmission:
            failure = StageAlarm(
                f"the controller says {message.text!r} to {command!r}; look for the cause, then recover and home it"
            )
        if failure is not None:
            raise failure
