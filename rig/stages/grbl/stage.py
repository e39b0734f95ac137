"""GRBL 1.1 and grblHAL: jogs in machine coordinates, polled until the controller has been idle twice.

Jogs (`$J=`) are the safest motion that GRBL has: a target outside the travel is refused without an alarm, they can be
cancelled without losing the position, and they leave the parser's state alone. `G53` makes them machine coordinates
whatever work offset is stored in the controller.
"""

import re
from collections.abc import Sequence
from contextlib import suppress

from faintfield.rig.errors import StageLost, StageTimeout, WrongFirmware
from faintfield.rig.stages.grbl import messages as grbl
from faintfield.rig.stages.grbl.failures import LOCKED, alarm_failure, refusal, state_failure
from faintfield.rig.stages.grbl.settings import GrblSettings
from faintfield.rig.stages.motion import patience_s
from faintfield.rig.stages.protocol import AxisIndex, Identity, Point
from faintfield.rig.stages.transport import LineTransport

_POLL, _HOLD, _RESET, _CANCEL_JOG = b"?", b"!", b"\x18", b"\x85"
_POLL_INTERVAL_S = 0.2
_BOOT_S = 3.0
_RECOVERY_S = 2.0
_RESET_S = 0.4


class Grbl:
    """Speaks GRBL 1.1 over a line transport; a `Controller`.

    Parameters
    ----------
    line : LineTransport
        The connection.
    axes : (str, str)
        The controller's letters for the two axes.
    """

    def __init__(self, line: LineTransport, axes: tuple[str, str]) -> None:
        self._line = line
        self._clock = line.clock
        self._axes = axes
        self._index = tuple("XYZ".index(axis) for axis in axes)
        self._offset: tuple[float, ...] | None = None
        self._alarm: int | None = None
        self._count_lost = False
        self._homing = False
        self._braking_s = 0.0
        self._next_poll_s = 0.0

    def connect(self) -> None:
        """Open the connection; most boards restart when it opens, so wait for the banner."""
        self._offset = self._alarm = None
        self._count_lost = True
        self._line.open()
        if self._await_banner(_BOOT_S):
            return
        # Boards with a USB port of their own keep running. The line end makes other firmwares answer too, and is
        # itself answered with an ok, which must not be left for the first command to find.
        self._line.send(_POLL + b"\n")
        reported = False
        for text in self._line.lines_until(self._clock.now_s() + 1.0):
            _refuse_other_firmware(text)
            reported = reported or isinstance(grbl.parse(text), grbl.Report)
        if reported:
            return
        raise StageTimeout(
            f"no answer as from GRBL within {_BOOT_S + 1.0:g} s; check power, baud rate and protocol of the controller"
        )

    def identify(self) -> Identity:
        """Read build and settings, the settings twice: the line has no checksum."""
        build = {m.kind: m.text for m in self._command("$I") if isinstance(m, grbl.Feedback)}
        first, second = self._read_settings(), self._read_settings()
        if first != second:
            differing = ", ".join(
                f"${n}" for n in sorted(first.keys() | second.keys()) if first.get(n) != second.get(n)
            )
            raise StageLost(f"{differing} read differently twice in a row: the line is disturbed; try a shorter cable")
        identity = GrblSettings(first, build).identity(self._index)
        motion = identity.motion
        ratios = zip(motion.rate_mm_per_s, motion.acceleration_mm_per_s2, strict=True)
        self._braking_s = max(rate / acceleration for rate, acceleration in ratios)
        self._await_offset()
        return identity

    def home(self, axis: AxisIndex | None, bound_s: float) -> float:
        """Home with a bound of its own: GRBL answers nothing until the switches are found."""
        started_s = self._clock.now_s()
        self._command("$H" if axis is None else f"$H{self._axes[axis]}", bound_s)
        taken_s = self._clock.now_s() - started_s
        self._wait_until_still(0.0)
        self._alarm, self._count_lost = None, False
        return taken_s

    def follow(self, path: Sequence[Point], feed_mm_per_s: float, predicted_s: float) -> Point:
        """Queue one jog per point and wait for the last to end."""
        for point in path:
            self._command(self._jog("G90 G21 G53", point, feed_mm_per_s))
        return self._wait_until_still(predicted_s)

    def jog(self, by: Point, feed_mm_per_s: float, predicted_s: float, *, unlock: bool) -> Point:
        """Jog by a distance; a lock is cleared only when asked."""
        if unlock and self._poll().state == "Alarm":
            self._command("$X")
        self._command(self._jog("G91 G21", by, feed_mm_per_s))
        return self._wait_until_still(predicted_s)

    def read_position(self) -> Point:
        """Return the machine position of a report made now, by a stage that stands still."""
        report = self._poll()
        if report.state != "Idle":
            raise state_failure(report, self._alarm)
        return self._machine_point(report)

    def switches(self) -> frozenset[AxisIndex]:
        """Return the axes whose limit input is active."""
        pins = self._poll().pins
        return frozenset(index for index in (0, 1) if self._axes[index] in pins)

    def stop(self) -> bool:
        """Cancel the jog: GRBL slows down within its acceleration and keeps count."""
        self._line.send(_CANCEL_JOG)
        self._wait_until_still(self._braking_s)
        return True

    def abort(self) -> bool:
        """Cancel the jog, or break off homing, which nothing but a reset can."""
        with suppress(StageLost):  # what cannot be reached cannot be stopped
            self._line.send(_RESET if self._homing else _CANCEL_JOG)
        return not self._homing

    def recover(self) -> bool:
        """Bring GRBL back to listening, by the kind of its state; a lock stays unless the position was kept."""
        if not self._line.is_open:
            self.connect()
            return False
        self._line.send(b"\n")  # whatever is left of a damaged line must not be joined to the next
        deadline_s = self._clock.now_s() + _RECOVERY_S
        while self._clock.now_s() + _POLL_INTERVAL_S + _RESET_S < deadline_s:
            report = self._poll_anything()
            if report is None:
                # After alarms 1 and 2 GRBL answers nothing but a reset, and drops one that comes too early.
                self._reset()
            elif report.state == "Idle":
                return not self._count_lost
            elif report.state == "Alarm":
                return self._unlock_if_kept(self._machine_point(report))
            else:
                self._leave(report)
        raise StageTimeout(
            f"the controller is not ready {_RECOVERY_S:g} s after a reset; switch it off and on, then home it"
        )

    def close(self) -> None:
        """Close the connection."""
        self._line.close()

    def _leave(self, report: grbl.Report) -> None:
        """Do the next thing that leads from the state of `report` to one where commands are taken."""
        match report.state, report.substate:
            case "Jog", _:
                self._line.send(_CANCEL_JOG)
            case "Run", _:
                self._line.send(_HOLD)
            case "Door", 1:
                raise state_failure(report, self._alarm)
            case ("Hold", 1) | ("Door", 2 | 3):
                pass  # still slowing down, when a reset would lose the position
            case _:
                self._reset()

    def _unlock_if_kept(self, here: Point) -> bool:
        """Clear the lock after an alarm that keeps the position, and only then; return whether it was one."""
        # A controller that has restarted unseen counts from zero again.
        if self._alarm != 2 or self._count_lost or here == (0.0, 0.0):
            return False
        self._alarm = None
        self._command("$X")
        return True

    def _jog(self, modes: str, point: Point, feed_mm_per_s: float) -> str:
        """Return the jog command to `point`."""
        (x, y), feed = self._axes, 60.0 * feed_mm_per_s
        return f"$J={modes} {x}{point.x_mm:.3f} {y}{point.y_mm:.3f} F{feed:.1f}"

    def _command(self, text: str, bound_s: float = 2.0) -> list[grbl.Message]:
        """Send one command, wait for its response, and return what was said in between."""
        self._raise_pending()
        self._homing = text.startswith("$H")
        self._line.send(text.encode("ascii") + b"\n")
        deadline_s = self._clock.now_s() + bound_s
        said: list[grbl.Message] = []
        while (message := self._receive(deadline_s)) is not None:
            if isinstance(message, grbl.Ok):
                return said
            if isinstance(message, grbl.Error):
                if message.code == LOCKED and (locked := self._poll()).state not in ("Idle", "Jog", "Run"):
                    raise state_failure(locked, self._alarm)
                raise refusal(text, message.code)
            said.append(message)
        raise StageTimeout(
            f"no answer to {text!r} within {bound_s:g} s; check cable and power, then recover and home the stage"
        )

    def _receive(self, deadline_s: float) -> grbl.Message | None:
        """Return the next message; an alarm or a restart, which may come at any time, is raised."""
        text = self._line.next_line(deadline_s)
        if text is None:
            return None
        message = grbl.parse(text)
        self._note(message)
        if isinstance(message, grbl.Alarm):
            raise alarm_failure(message.code)
        if isinstance(message, grbl.Banner):
            raise StageLost("the controller has restarted, and its position is lost; check its power, then home it")
        return message

    def _note(self, message: grbl.Message) -> None:
        """Remember what outlasts a message: the work offset, the last alarm, and whether the count was lost."""
        if isinstance(message, grbl.Report) and message.offset is not None:
            self._offset = message.offset
        elif isinstance(message, grbl.Banner):
            self._count_lost = True
        elif isinstance(message, grbl.Alarm):
            self._alarm = message.code
            self._count_lost = self._count_lost or message.code != 2

    def _raise_pending(self) -> None:
        """Take what has arrived unasked, so that nothing old is mistaken for an answer to what is sent next."""
        while self._receive(self._clock.now_s()) is not None:
            pass

    def _poll(self) -> grbl.Report:
        """Ask for a status report and return it."""
        self._raise_pending()
        self._wait_for_turn()
        self._line.send(_POLL)
        deadline_s = self._clock.now_s() + patience_s(0.0)
        while (message := self._receive(deadline_s)) is not None:
            if isinstance(message, grbl.Report):
                return message
        raise StageTimeout(
            f"no status report within {patience_s(0.0):g} s; check cable and power, then recover and home the stage"
        )

    def _wait_for_turn(self) -> None:
        """Keep to five status requests a second, listening meanwhile."""
        while self._clock.now_s() < self._next_poll_s:
            self._receive(self._next_poll_s)
        self._next_poll_s = self._clock.now_s() + _POLL_INTERVAL_S

    def _wait_until_still(self, predicted_s: float) -> Point:
        """Poll until two reports in a row say idle at the same place, and return it.

        One is not enough: between taking a jog and starting it, GRBL is idle for a moment.
        """
        started_s = self._clock.now_s()
        while self._receive(started_s + predicted_s) is not None:
            pass
        last: grbl.Report | None = None
        while self._clock.now_s() < started_s + patience_s(predicted_s):
            report = self._poll()
            if report.state == "Idle":
                point = self._machine_point(report)
                if last is not None and self._machine_point(last) == point:
                    return point
                last = report
            elif report.state in ("Jog", "Run"):
                last = None
            else:
                raise state_failure(report, self._alarm)
        raise StageTimeout(
            f"the stage still moves after {patience_s(predicted_s):.1f} s, where {predicted_s:.1f} s were expected; "
            "it was told to stop: recover and home it"
        )

    def _machine_point(self, report: grbl.Report) -> Point:
        """Return the machine position of `report`, from the work position where that is what it tells."""
        values = report.position
        if not report.is_machine:
            if self._offset is None:
                raise StageTimeout("work position without its offset; set $10=1, so that machine positions are told")
            values = tuple(work + offset for work, offset in zip(values, self._offset, strict=False))
        if max(self._index) >= len(values):
            raise WrongFirmware(f"the controller reports {len(values)} axes, not {self._axes}; set stage.axes")
        return Point(*(values[index] for index in self._index))

    def _await_offset(self) -> None:
        """Poll until the work offset was told, if positions are work positions; GRBL tells it now and then."""
        for _ in range(40):
            if self._poll().is_machine or self._offset is not None:
                return
        raise WrongFirmware("work positions are reported and never their offset; set $10=1 for machine positions")

    def _await_banner(self, within_s: float) -> bool:
        """Return whether the controller said within `within_s` that it has started."""
        for text in self._line.lines_until(self._clock.now_s() + within_s):
            _refuse_other_firmware(text)
            message = grbl.parse(text)
            if isinstance(message, grbl.Banner):
                return True
            self._note(message)
        return False

    def _poll_anything(self) -> grbl.Report | None:
        """Ask for a status report, whatever else comes; None when there is no answer."""
        self._line.send(_POLL)
        self._next_poll_s = self._clock.now_s() + _POLL_INTERVAL_S
        newest: grbl.Report | None = None
        for text in self._line.lines_until(self._next_poll_s):
            message = grbl.parse(text)
            self._note(message)
            if isinstance(message, grbl.Report):
                newest = message
        return newest

    def _reset(self) -> None:
        """Reset GRBL and wait a moment for its banner."""
        self._line.send(_RESET)
        self._await_banner(_RESET_S)

    def _read_settings(self) -> dict[int, str]:
        """Return the `$` settings."""
        return {m.number: m.value for m in self._command("$$") if isinstance(m, grbl.Setting)}


def _refuse_other_firmware(text: str) -> None:
    """Raise `WrongFirmware` when a line is one that only another firmware sends."""
    if re.search(r"marlin|echo:unknown command|^start$", text, re.IGNORECASE):
        raise WrongFirmware(f"the controller answers as Marlin ({text[:60]!r}); use protocol 'marlin'")
