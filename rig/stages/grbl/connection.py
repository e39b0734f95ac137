"""Exchanges commands, responses and status reports with GRBL."""

import re

from faintfield.rig.errors import StageTimeout, WrongFirmware
from faintfield.rig.stages.grbl.failures import (
    HOMING_REQUIRED_ALARM,
    LOCKED_ERRORS,
    SOFT_LIMIT_ALARM,
    alarm_failure,
    error_failure,
    state_failure,
)
from faintfield.rig.stages.grbl.messages import Alarm, Banner, ErrorCode, Message, Report, parse
from faintfield.rig.stages.motion import timeout_s
from faintfield.rig.stages.protocol import AnswerTime
from faintfield.rig.stages.transport import LineTransport, Ok, restart_failure

# GRBL's real-time characters.
HOLD, CANCEL_JOG, RESET = b"!", b"\x85", b"\x18"
_STATUS_REQUEST = b"?"

# Between status requests, in s; GRBL's documentation recommends at most five a second.
POLL_INTERVAL_S = 0.2

# Waits in s: for the banner after the port was opened and the boot loader has run; for the banner after a reset; for
# the status report of a board that did not restart; for the response to a command.
_BOOT_S = 3.0
RESET_S = 0.4
_FIRST_REPORT_S = 1.0
_ANSWER_S = timeout_s(0.0)


class GrblConnection:
    """A line transport to GRBL.

    Parameters
    ----------
    line : LineTransport
        The connection.

    Attributes
    ----------
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
        self._line = line
        self._clock = line.clock
        self._next_poll_s = 0.0

    @property
    def is_open(self) -> bool:
        """Return whether the connection was opened and has not been lost since."""
        return self._line.is_open

    @property
    def answer_time(self) -> AnswerTime:
        """Time from the last sending to the last bytes that were read."""
        return self._line.answer_time

    def open(self, wait_s: float = 0.0) -> None:
        """Open the connection and wait for the banner, since most boards restart when the port is opened.

        Parameters
        ----------
        wait_s : float
            How long to wait for a port that is missing.
        """
        self.offset = self.alarm = None
        self.count_lost, self.homing = True, False
        self._line.open(wait_s)
        if self._await_banner(_BOOT_S):
            return
        # Boards with native USB keep running. The newline makes other firmware answer too; GRBL answers it with an ok,
        # which has to be read here so that the first command does not take it for its own.
        self._line.send(_STATUS_REQUEST + b"\n")
        reported = False
        for text in self._line.lines_until(self._clock.now_s() + _FIRST_REPORT_S):
            _refuse_other_firmware(text)
            reported = reported or isinstance(parse(text), Report)
        # A reset ends what an earlier program may have left, and revives a GRBL that an alarm has silenced.
        if not self.reset(_FIRST_REPORT_S) and not reported:
            raise StageTimeout(
                f"no answer as from GRBL within {_BOOT_S + 2.0 * _FIRST_REPORT_S:g} s, and none to a reset; "
                "check power, baud rate and protocol of the controller"
            )

    def close(self) -> None:
        """Close the connection."""
        self._line.close()

    def send(self, data: bytes) -> None:
        """Send real-time characters, which GRBL obeys at once and does not answer."""
        self._line.send(data)

    def command(self, text: str, bound_s: float = _ANSWER_S) -> list[Message]:
        """Send one command, wait for its response, and return the messages before the response."""
        self._read_pending()
        self.homing = text.startswith("$H")
        self._line.send(text.encode("ascii") + b"\n")
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
            f"no answer to {text!r} within {bound_s:g} s; check cable and power, then recover and home the stage"
        )

    def poll(self) -> Report:
        """Request a status report and return it."""
        self._read_pending()
        while self._clock.now_s() < self._next_poll_s:
            self._receive(self._next_poll_s)
        self._next_poll_s = self._clock.now_s() + POLL_INTERVAL_S
        self._line.send(_STATUS_REQUEST)
        deadline_s = self._clock.now_s() + _ANSWER_S
        while (message := self._receive(deadline_s)) is not None:
            if isinstance(message, Report):
                return message
        raise StageTimeout(
            f"no status report within {_ANSWER_S:g} s; check cable and power, then recover and home the stage"
        )

    def poll_despite_failures(self) -> Report | None:
        """Request a status report without raising alarms and restarts; return None if none comes."""
        self._line.send(_STATUS_REQUEST)
        self._next_poll_s = self._clock.now_s() + POLL_INTERVAL_S
        newest: Report | None = None
        for text in self._line.lines_until(self._next_poll_s):
            message = parse(text)
            self._note(message)
            if isinstance(message, Report):
                newest = message
        return newest

    def read_until(self, deadline_s: float) -> None:
        """Read messages until the clock reaches `deadline_s`, and raise alarms and restarts."""
        while self._receive(deadline_s) is not None:
            pass

    def reset(self, within_s: float = RESET_S) -> bool:
        """Reset GRBL, and return whether its banner comes within `within_s`."""
        self._line.send(RESET)
        return self._await_banner(within_s)

    def _read_pending(self) -> None:
        """Read what has arrived unasked, so that it is not taken for the answer to the next command."""
        self.read_until(self._clock.now_s())

    def _receive(self, deadline_s: float) -> Message | None:
        """Return the next message, None at the deadline; raise an alarm or a restart, which can come at any time."""
        text = self._line.next_line(deadline_s)
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
        for text in self._line.lines_until(self._clock.now_s() + within_s):
            _refuse_other_firmware(text)
            message = parse(text)
            if isinstance(message, Banner):
                return True
            self._note(message)
        return False


def _refuse_other_firmware(text: str) -> None:
    if re.search(r"marlin|echo:unknown command|^start$", text, re.IGNORECASE):
        raise WrongFirmware(f"the controller answers as Marlin ({text[:60]!r}); use protocol 'marlin'")
