"""Send and receive lines over a serial port, with a log of every byte; what GRBL and Marlin have in common."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from itertools import combinations
from typing import Literal, Protocol

import serial
from msgspec import Struct
from serial.tools.list_ports import comports

from faintfield.rig.clock import Clock
from faintfield.rig.errors import StageLost, in_one_line
from faintfield.rig.stages.protocol import AnswerTime, Point

type Direction = Literal["sent", "received"]

# Bytes kept of a line without end, which is noise: longer than any line of the controllers.
_MAX_LINE_BYTES = 1024
# Time in s between two attempts to open a port that is missing.
_REOPEN_S = 0.5
# The port is looked at this often (s), so that it is known how long an answer may have waited there. Two such times are
# as much as serial adapters hold back a short answer.
_LOOK_S = 0.008
# Timeout of a write in s, for a port that has stopped accepting bytes.
_WRITE_TIMEOUT_S = 2.0


class TrafficLog(Protocol):
    """A log of serial traffic, such as the journal of a session."""

    def record(self, at_s: float, direction: Direction, data: bytes) -> None:
        """Record `data`, which passed at `at_s` on the rig's clock."""


class Port(Protocol):
    """An open connection that carries bytes in both directions."""

    def write(self, data: bytes) -> None:
        """Send `data`; raises `StageLost` if the connection is lost."""

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, waiting up to `timeout_s` for the first byte; raises `StageLost`."""

    def close(self) -> None:
        """Close the connection."""


class SerialPort:
    """A serial port, or another connection that pyserial has a URL for (`socket://host:port`)."""

    def __init__(self, url: str, baud: int) -> None:
        self._url = url
        try:
            # Exclusive: a second program on the same port would mix its commands with these.
            self._serial = serial.serial_for_url(
                url, baudrate=baud, timeout=0, write_timeout=_WRITE_TIMEOUT_S, exclusive=True
            )
        except (OSError, ValueError) as failure:
            present = ", ".join(port.device for port in comports()) or "none"
            problem = f"{url}: cannot be opened ({in_one_line(failure)}); serial ports here: {present}"
            raise StageLost(f"{problem}; check the cable, the name and that no other program has it") from failure

    def write(self, data: bytes) -> None:
        """Send `data`."""
        with self._reported_as_lost():
            self._serial.write(data)

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, waiting up to `timeout_s` for the first byte."""
        with self._reported_as_lost():
            if self._serial.timeout != timeout_s:  # setting it configures the port anew
                self._serial.timeout = timeout_s
            data = bytearray(self._serial.read(1))
            while data and (waiting := self._serial.in_waiting):
                data += self._serial.read(waiting)
            return bytes(data)

    def close(self) -> None:
        """Close the port."""
        self._serial.close()

    @contextmanager
    def _reported_as_lost(self) -> Iterator[None]:
        try:
            yield
        except (OSError, TypeError) as failure:  # the latter from a closed port
            problem = f"{self._url}: the connection is lost ({in_one_line(failure)})"
            raise StageLost(f"{problem}; check cable and power, then home it") from failure


class LineTransport:
    """A connection of bytes sent and lines received within time limits; each `open` calls `open_port`."""

    def __init__(self, open_port: Callable[[], Port], clock: Clock, traffic: TrafficLog | None = None) -> None:
        self.clock = clock
        self._open_port = open_port
        self._traffic = traffic
        self._port: Port | None = None
        self._buffer = b""
        self._sent_s = self._looked_s = self._read_s = clock.now_s()
        self._sending_s = self._late_s = 0.0

    @property
    def answer_time(self) -> AnswerTime:
        """Time from the last sending to the last bytes that were read.

        A computer that is busy may read an answer long after it has come. It came after the last look at the port that
        found nothing. The time since then and the time of sending, as far as they are more than usual, are `late_s`.
        """
        late_s = max(0.0, self._late_s - 2.0 * _LOOK_S) + max(0.0, self._sending_s - _LOOK_S)
        return AnswerTime(self._read_s - self._sent_s, late_s)

    @property
    def is_open(self) -> bool:
        """Return whether the connection was opened and has not been lost since."""
        return self._port is not None

    def open(self, wait_s: float = 0.0) -> None:
        """Open the connection, after closing an open one; try again for `wait_s` while it cannot be opened."""
        self.close()
        deadline_s = self.clock.now_s() + wait_s
        while self._port is None:
            try:
                self._port = self._open_port()
            except StageLost:
                if self.clock.now_s() >= deadline_s:
                    raise
                self.clock.sleep_s(_REOPEN_S)

    def close(self) -> None:
        """Close the connection, if it is open."""
        port, self._port, self._buffer = self._port, None, b""
        if port is not None:
            port.close()

    def send(self, data: bytes) -> None:
        """Send `data`; raises `StageLost`."""
        self._sent_s = self._looked_s = self.clock.now_s()
        with self._live_port() as port:
            port.write(data)
        self._sending_s = self.clock.now_s() - self._sent_s
        self._log("sent", data)

    def next_line(self, deadline_s: float) -> str | None:
        """Return the next line that is not empty, or None when the clock reaches `deadline_s`; raises `StageLost`.

        Bytes outside ASCII become U+FFFD, which no parser accepts in an answer.
        """
        while True:
            line, newline, rest = self._buffer.partition(b"\n")
            if newline:
                self._buffer = rest
                if text := line.decode("ascii", errors="replace").strip():
                    return text
                continue
            # Noise may go on without a line end: limit the buffer.
            self._buffer = line[-_MAX_LINE_BYTES:]
            asked_s = self.clock.now_s()
            with self._live_port() as port:
                data = port.read(min(_LOOK_S, max(0.0, deadline_s - asked_s)))
            if data:
                self._read_s = self.clock.now_s()
                self._late_s = self._read_s - self._looked_s
                self._log("received", data)
                self._buffer += data
            elif self.clock.now_s() >= deadline_s:
                return None
            self._looked_s = asked_s

    def lines_until(self, deadline_s: float) -> Iterator[str]:
        """Yield lines until the clock reaches `deadline_s`; if that is now, yield those already received."""
        while (line := self.next_line(deadline_s)) is not None:
            yield line

    def _log(self, direction: Direction, data: bytes) -> None:
        if self._traffic is not None:
            self._traffic.record(self.clock.now_s(), direction, data)

    @contextmanager
    def _live_port(self) -> Iterator[Port]:
        """Yield the port, and close it if the connection turns out to be lost."""
        if self._port is None:
            raise StageLost("the stage is not connected; connect it, or recover after the connection was lost")
        try:
            yield self._port
        except StageLost:
            self.close()
            raise


class Ok(Struct, frozen=True):
    """The controller has accepted a command; its motion may still be under way."""


class Unknown(Struct, frozen=True):
    """A line of no known form, such as a damaged one."""

    text: str


def motion_words(axes: tuple[str, str], point: Point, feed_mm_per_s: float) -> str:
    """Return the G-code words of coordinates and feed of a command that moves."""
    x, y = axes
    return f"{x}{point.x_mm:.3f} {y}{point.y_mm:.3f} F{60.0 * feed_mm_per_s:.1f}"


def read_twice[T](read: Callable[[], T], essential: Callable[[T], object] = lambda reading: reading) -> T:
    """Return what two readings agree on, as answers have no checksum; two that differ are followed by a third.

    Where no two of the three are the same, it is enough that their `essential` parts are. Raises `StageLost` if not
    even these agree.
    """
    readings = [read(), read()]
    if readings[0] != readings[1]:
        readings.append(read())
    pairs = list(combinations(readings, 2))
    for one, other in pairs:
        if one == other:
            return other
    for one, other in pairs:
        if essential(one) == essential(other):
            return other
    raise StageLost("the settings read differently three times: the line is disturbed; try a shorter cable")


def restart_failure() -> StageLost:
    """Return the exception for a controller that has reported a restart."""
    return StageLost("the controller has restarted, and its position is lost; check its power, then home it")
