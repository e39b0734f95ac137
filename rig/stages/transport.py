"""Lines over a serial port, every byte logged with its time."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Literal, Protocol

import serial
from serial.tools.list_ports import comports

from faintfield.rig.clock import Clock
from faintfield.rig.errors import StageLost

type Direction = Literal["sent", "received"]

_LONGEST_LINE_BYTES = 1024
_WRITE_BOUND_S = 2.0


class TrafficLog(Protocol):
    """Where serial traffic is recorded, such as the journal of a session."""

    def record(self, at_s: float, direction: Direction, data: bytes) -> None:
        """Keep `data`, which passed at `at_s` on the rig's clock."""
        ...


class NoTrafficLog:
    """Keeps nothing."""

    def record(self, at_s: float, direction: Direction, data: bytes) -> None:
        """Let `data` go."""


class Port(Protocol):
    """An open connection that carries bytes both ways."""

    def write(self, data: bytes) -> None:
        """Send `data`; raises `StageLost` when the connection is gone."""
        ...

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, waiting up to `timeout_s` for the first byte; raises `StageLost`."""
        ...

    def close(self) -> None:
        """Give the connection back."""
        ...


class SerialPort:
    """A port of this computer, or anything else that pyserial has a URL for (`socket://host:port`).

    Parameters
    ----------
    url : str
        Device or pyserial URL.
    baud : int
        Bits per second.

    Raises
    ------
    StageLost
        The port cannot be opened; the message names the ports that exist.
    """

    def __init__(self, url: str, baud: int) -> None:
        self._url = url
        try:
            # A second program on the same port would mix its commands with ours: take it alone.
            self._serial = serial.serial_for_url(
                url, baudrate=baud, timeout=0, write_timeout=_WRITE_BOUND_S, exclusive=True
            )
        except (serial.SerialException, OSError, ValueError) as failure:
            present = ", ".join(port.device for port in comports()) or "none"
            raise StageLost(
                f"{url}: cannot be opened ({_in_one_line(failure)}); serial ports here: {present}; "
                "check the cable, the name and that no other program has it"
            ) from failure

    def write(self, data: bytes) -> None:
        """Send `data`."""
        with self._reported_as_lost():
            self._serial.write(data)

    def read(self, timeout_s: float) -> bytes:
        """Return what has arrived, waiting up to `timeout_s` for the first byte."""
        with self._reported_as_lost():
            self._serial.timeout = timeout_s
            data = bytearray(self._serial.read(1))
            while data and (waiting := self._serial.in_waiting):
                data += self._serial.read(waiting)
            return bytes(data)

    def close(self) -> None:
        """Give the port back."""
        self._serial.close()

    @contextmanager
    def _reported_as_lost(self) -> Iterator[None]:
        """Turn what pyserial says about a dead connection into a named failure."""
        try:
            yield
        except (serial.SerialException, OSError, TypeError) as failure:  # TypeError: pyserial, on a port just closed
            raise StageLost(
                f"{self._url}: the connection is gone ({_in_one_line(failure)}); "
                "check cable and power; the stage must be homed again"
            ) from failure


class LineTransport:
    """Sends bytes and receives lines, with a bound on every wait.

    Parameters
    ----------
    open_port : callable
        Opens the connection, anew each time.
    clock : Clock
        What bounds are measured by.
    traffic : TrafficLog
        Where every byte is recorded.
    """

    def __init__(self, open_port: Callable[[], Port], clock: Clock, traffic: TrafficLog) -> None:
        self.clock = clock
        self._open_port = open_port
        self._traffic = traffic
        self._port: Port | None = None
        self._buffer = b""

    @property
    def is_open(self) -> bool:
        """Whether the connection was opened and has not been found dead since."""
        return self._port is not None

    def open(self) -> None:
        """Open the connection, closing an older one first."""
        self.close()
        self._port = self._open_port()

    def close(self) -> None:
        """Close the connection, if it is open."""
        port, self._port, self._buffer = self._port, None, b""
        if port is not None:
            port.close()

    def send(self, data: bytes) -> None:
        """Send `data`; raises `StageLost`."""
        with self._live_port() as port:
            port.write(data)
        self._traffic.record(self.clock.now_s(), "sent", data)

    def next_line(self, deadline_s: float) -> str | None:
        """Return the next line that is not empty, or None when the clock reaches `deadline_s`; raises `StageLost`.

        Bytes that are no ASCII text become U+FFFD, which no parser takes for an answer.
        """
        while True:
            line, newline, rest = self._buffer.partition(b"\n")
            if newline:
                self._buffer = rest
                if text := line.decode("ascii", errors="replace").strip():
                    return text
                continue
            # A line without an end is noise; keep it from growing for ever.
            self._buffer = line[-_LONGEST_LINE_BYTES:]
            remaining_s = max(0.0, deadline_s - self.clock.now_s())
            with self._live_port() as port:
                data = port.read(remaining_s)
            if data:
                self._traffic.record(self.clock.now_s(), "received", data)
                self._buffer += data
            elif self.clock.now_s() >= deadline_s:
                return None

    def lines_until(self, deadline_s: float) -> Iterator[str]:
        """Yield lines as they come until the clock reaches `deadline_s`; when that is now, those that are there."""
        while (line := self.next_line(deadline_s)) is not None:
            yield line

    @contextmanager
    def _live_port(self) -> Iterator[Port]:
        """Yield the port, and forget it when it turns out to be dead."""
        if self._port is None:
            raise StageLost("the stage is not connected; connect it, or recover after the connection was lost")
        try:
            yield self._port
        except StageLost:
            self.close()
            raise


def _in_one_line(failure: BaseException) -> str:
    """Return the message of `failure` without line breaks."""
    return " ".join(str(failure).split()) or type(failure).__name__
