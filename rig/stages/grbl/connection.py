"""Exchanges commands, responses and status reports with GRBL, and brings it to rest."""

import re

from faintfield.rig.errors import StageTimeout, WrongFirmware
from faintfield.rig.stages.grbl.failures import (
    CRITICAL_ALARMS,
    HOMING_REQUIRED_ALARM,
    LOCKED_ERRORS,
    SOFT_LIMIT_ALARM,
    alarm_failure,
    error_failure,
    state_failure,
)
from faintfield.rig.stages.grbl.messages import Alarm, Banner, ErrorCode, Message, Report, parse
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.transport import LineTransport, Ok, restart_failure

# GRBL's real-time characters.
CANCEL_JOG, RESET = b"\x85", b"\x18"
_HOLD, _STATUS_REQUEST = b"!", b"?"

# Between status requests, in s; GRBL's documentation recommends at most five a second.
_POLL_INTERVAL_S = 0.2

# Waits in s: for the banner after the port was opened and the boot loader has run; for the banner after a reset; for
# the status report of a board that did not restart; for the response to a command.
_BOOT_S = 3.0
_RESET_S = 0.4
_FIRST_REPORT_S = 1.0
_ANSWER_S = timeout_s(0.0)

# Reports in a row that show the same position before a motion that was told to stop counts as stuck.
_UNCHANGED_REPORTS = 2


class GrblConnection:
    """A line transport to GRBL.

    Attributes
    ----------
    line : LineTransport
        The connection.
    offset : tuple of float or None
        Last work offset that was reported, in mm.
    alarm : int or None
        Code of the last alarm.
    count_lost : bool
        Whether the controller may have lost its count of steps since it was homed.
    homing : bool
        Whether the last command was to home.
    """

    def __init__(self, line: LineTransport) -> None:
        self.offset: tuple[float, ...] | None = None
        self.alarm: int | None = None
        self.count_lost = False
        self.homing = False
        self.line = line
        self._clock = line.clock
        self._next_poll_s = 0.0

    def open(self, wait_s: float = 0.0) -> None:
        """Open the connection, waiting up to `wait_s` for its port, and wait for the banner, as most boards restart."""
        self.offset = self.alarm = None
        self.count_lost, self.homing = True, False
        self.line.open(wait_s)
        if self._await_banner(_BOOT_S):
            return
        # Boards with native USB keep running. The newline makes other firmware answer too; GRBL answers it with an ok,
        # which has to be read here so that the first command does not take it for its own.
        self.line.send(_STATUS_REQUEST + b"\n")
        reported = False
        for text in self.line.lines_until(self._clock.now_s() + _FIRST_REPORT_S):
            _refuse_other_firmware(text)
            reported = reported or isinstance(parse(text), Report)
        # A reset ends what an earlier program may have left, and revives a GRBL that an alarm has silenced.
        if not self._reset(_FIRST_REPORT_S) and not reported:
            raise StageTimeout(
                f"no answer as from GRBL within {_BOOT_S + 2.0 * _FIRST_REPORT_S:g} s, and none to a reset; "
                "check power, baud rate and protocol of the controller"
            )

    def command(self, text: str, bound_s: float = _ANSWER_S) -> list[Message]:
        """Send one command, wait for its response, and return the messages before the response."""
        self.read_until(self._clock.now_s())  # what has come unasked is not the answer
        self.homing = text.startswith("$H")
        self.line.send(text.encode("ascii") + b"\n")
        deadline_s = self._clock.now_s() + bound_s
        messages: list[Message] = []
        while (message := self._receive(deadline_s)) is not None:
            if isinstance(message, Ok):
                return messages
            if isinstance(message, ErrorCode):
                if message.code in LOCKED_ERRORS:
                    report = self.poll()
                    if report.state not in ("Idle", "Jog", "Run"):
                        raise state_failure(report, self.alarm)
                raise error_failure(text, message.code)
            messages.append(message)
        raise StageTimeout(
            f"no answer to {text!r} within {bound_s:g} s; check cable and power, recover and home the stage"
        )

    def poll(self) -> Report:
        """Request a status report and return it."""
        self.read_until(self._clock.now_s())
        while self._clock.now_s() < self._next_poll_s:
            self._receive(self._next_poll_s)
        self._next_poll_s = self._clock.now_s() + _POLL_INTERVAL_S
        self.line.send(_STATUS_REQUEST)
        deadline_s = self._clock.now_s() + _ANSWER_S
        while (message := self._receive(deadline_s)) is not None:
            if isinstance(message, Report):
                return message
        raise StageTimeout(
            f"no status report within {_ANSWER_S:g} s; check cable and power, recover and home the stage"
        )

    def bring_to_rest(self, within_s: float) -> Report:
        """Stop what moves, end what is on hold, and return a report of the state `Idle` or `Alarm`.

        A soft reset at rest keeps the position, and forgets the rest of a motion that was on hold. A motion that is
        told to stop and neither moves nor ends (a jog of grblHAL after its door was opened) is reset as well, which
        loses the position.

        Raises
        ------
        StageAlarm
            An open door or an emergency stop prevents it; nothing is left that could go on.
        StageTimeout
            The controller is not at rest within `within_s`; it was reset.
        """
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
                    raise state_failure(report, self.alarm)
                critical = not was_reset and (report.substate or self.alarm) in CRITICAL_ALARMS
                if report.state == "Idle" or (report.state == "Alarm" and not critical):
                    return report
                if report.is_moving and unchanged < _UNCHANGED_REPORTS:
                    self.line.send({"Jog": CANCEL_JOG, "Run": _HOLD}.get(report.state, b""))
                    continue
                if report.state == "Door" and was_reset:
                    raise state_failure(report, self.alarm)
                self.count_lost = self.count_lost or report.is_moving
            # After critical alarms GRBL answers nothing but a reset, and ignores one that comes too early.
            self._reset(_RESET_S)
            was_reset, unchanged = True, 0
        self.count_lost = True
        self.line.send(RESET)
        raise StageTimeout(
            f"the controller is not ready {within_s:g} s after it was told to stop, and was reset; "
            "switch it off and on, then home it"
        )

    def _poll_despite_failures(self) -> Report | None:
        self.line.send(_STATUS_REQUEST)
        self._next_poll_s = self._clock.now_s() + _POLL_INTERVAL_S
        newest: Report | None = None
        for text in self.line.lines_until(self._next_poll_s):
            message = parse(text)
            self._note(message)
            if isinstance(message, Report):
                newest = message
        return newest

    def read_until(self, deadline_s: float) -> None:
        """Read messages until the clock reaches `deadline_s`, and raise alarms and restarts."""
        while self._receive(deadline_s) is not None:
            pass

    def _reset(self, within_s: float) -> bool:
        self.line.send(RESET)
        return self._await_banner(within_s)

    def _receive(self, deadline_s: float) -> Message | None:
        """Return the next message, None at the deadline; raise an alarm or a restart, which can come at any time."""
        text = self.line.next_line(deadline_s)
        if text is None:
            return None
        message = parse(text)
        self._note(message)
        # grblHAL raises the alarm that it must be homed whenever it has started: that is no failure
        if isinstance(message, Alarm) and message.code != HOMING_REQUIRED_ALARM:
            raise alarm_failure(message.code)
        if isinstance(message, Banner):
            raise restart_failure()
        return message

    def _note(self, message: Message) -> None:
        if isinstance(message, Report) and message.offset is not None:
            self.offset = message.offset
        elif isinstance(message, Banner):
            self.count_lost = True
        elif isinstance(message, Alarm):
            self.alarm = message.code
            self.count_lost = self.count_lost or message.code != SOFT_LIMIT_ALARM

    def _await_banner(self, within_s: float) -> bool:
        for text in self.line.lines_until(self._clock.now_s() + within_s):
            _refuse_other_firmware(text)
            message = parse(text)
            if isinstance(message, Banner):
                return True
            self._note(message)
        return False


def _refuse_other_firmware(text: str) -> None:
    if re.search(r"marlin|echo:unknown command|^start$", text, re.IGNORECASE):
        raise WrongFirmware(f"the controller answers as Marlin ({text[:60]!r}); use protocol 'marlin'")
