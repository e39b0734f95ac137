"""Common parts of the simulated GRBL and Marlin: the serial wire, restarts, lines and homing."""

import math
import re
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterable
from typing import ClassVar

from faintfield.rig.simulation.controller.kinematics import Mechanics, ScheduledEvent, SimulatedClock
from faintfield.rig.stages.protocol import Output, ProtocolName

# At 115200 baud; a byte takes ten bits.
_SECONDS_PER_BYTE = 10.0 / 115200.0

# Time in s until the controller's first byte is on the wire.
_LATENCY_S = 0.002

# Motions that the planner holds.
_PLANNER_BLOCKS = 16

WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")

type ByteFilter = Callable[[bytes], bytes]
"""Returns the bytes that arrive for the bytes that were sent."""


class Wire:
    """Carries bytes in both directions at 115200 baud, through filters, which faults add, while it is connected."""

    def __init__(self, clock: SimulatedClock) -> None:
        self.filters_to_controller: list[ByteFilter] = []
        self.filters_to_host: list[ByteFilter] = []
        self.connected = True
        self._clock = clock
        self._free_at_s = 0.0
        self._arrived = bytearray()
        self._under_way: list[ScheduledEvent] = []

    def to_controller(self, data: bytes) -> bytes:
        """Return the bytes that arrive at the controller when the host sends `data`."""
        return _apply_filters(data, self.filters_to_controller)

    def to_host(self, data: bytes) -> None:
        """Send `data` to the host, after what is already on the wire."""
        now_s = self._clock.now_s()
        self._free_at_s = max(self._free_at_s, now_s + _LATENCY_S) + len(data) * _SECONDS_PER_BYTE
        self._under_way.append(self._clock.after(self._free_at_s - now_s, lambda: self._arrive(data)))

    def hold_up(self, duration_s: float) -> None:
        """Delay all further bytes to the host by `duration_s`."""
        self._free_at_s = self._clock.now_s() + duration_s

    def arrived(self) -> bool:
        """Return whether bytes have arrived at the host."""
        return bool(self._arrived)

    def take(self) -> bytes:
        """Return and remove the bytes that have arrived at the host."""
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def clear(self) -> None:
        """Discard the bytes that are under way or not yet read."""
        for event in self._under_way:
            event.cancel()
        self._under_way.clear()
        self._arrived.clear()
        self._free_at_s = 0.0

    def _arrive(self, data: bytes) -> None:
        del self._under_way[0]
        if self.connected:
            self._arrived += _apply_filters(data, self.filters_to_host)


def _apply_filters(data: bytes, filters: list[ByteFilter]) -> bytes:
    for apply in tuple(filters):
        data = apply(data)
    return data


def parse_parameters(text: str) -> dict[str, float]:
    """Return the numbers of a line by letter; the last word of a letter counts."""
    return {letter: float(value) for letter, value in WORD.findall(text)}


class SimulatedFirmware(ABC):
    """A simulated controller; `boot_s` is the time from a restart to the first line that it sends.

    Homing takes `homing_slowdown` times as long, which faults raise. `outputs` are those that are on.
    """

    protocol: ClassVar[ProtocolName]
    _line_end: ClassVar[bytes]

    def __init__(self, clock: SimulatedClock, wire: Wire, mechanics: Mechanics, boot_s: float) -> None:
        self.clock = clock
        self.wire = wire
        self.mechanics = mechanics
        self.boot_s = boot_s
        self.homing_slowdown = 1.0
        self.outputs: frozenset[str] = frozenset()
        self._boot: ScheduledEvent | None = None
        self._homing: ScheduledEvent | None = None
        mechanics.on_idle = self._motion_ended
        self.restart()

    def restart(self) -> None:
        """Restart as after power-up: the step count is lost, the settings stay."""
        self.mechanics.stop_dead()
        self.mechanics.set_count((0.0, 0.0))
        self.outputs = frozenset()
        self.wire.clear()
        self._line, self._waiting = bytearray(), deque[str]()
        self._cancel_homing()
        self._reset_state()
        if self._boot is not None:
            self._boot.cancel()
        self._boot = self.clock.after(self.boot_s, self._booted)

    @property
    def homing(self) -> bool:
        """Return whether the carriages are searching their switches."""
        return self._homing is not None

    def output_on(self, output: Output) -> bool:
        """Return whether an output is on, whatever the controller reports."""
        return (f"{output.kind} {output.number}" if output.kind in ("pin", "fan") else output.kind) in self.outputs

    @abstractmethod
    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""

    def say(self, *lines: str) -> None:
        """Send lines to the host."""
        for text in lines:
            self.wire.to_host(text.encode("ascii", errors="replace") + self._line_end)

    @abstractmethod
    def _reset_state(self) -> None: ...

    @abstractmethod
    def _booted(self) -> None: ...

    @abstractmethod
    def _motion_ended(self) -> None: ...

    @abstractmethod
    def _ready(self) -> bool: ...

    @abstractmethod
    def _run_line(self, line: str) -> None: ...

    @abstractmethod
    def _homed(self, axes: Iterable[int]) -> None: ...

    def _run_lines(self) -> None:
        while self._waiting and self._ready() and self.mechanics.queued() < _PLANNER_BLOCKS:
            self._run_line(self._waiting.popleft())

    def _distances_to_switches(self, axes: Iterable[int], reach_mm: float) -> list[float]:
        """Return the distance of each carriage from its switch, infinity where it is not found within `reach_mm`."""
        distances_mm = map(abs, self.mechanics.true_mm())
        ways = list(zip(self.mechanics.axes, distances_mm, strict=True))
        return [math.inf if ways[i][0].stuck or ways[i][1] > reach_mm else ways[i][1] for i in axes]

    def _start_homing(
        self, axes: Iterable[int], position_mm: float, duration_s: float, fail: Callable[[], None] | None
    ) -> None:
        """Let axes be at `position_mm` after some time, or `fail`."""

        def end() -> None:
            self._homing = None
            if fail is not None:
                fail()
                return
            for axis in axes:
                self.mechanics.set_homed(axis, position_mm)
            self._homed(axes)
            self.say("ok")
            self._run_lines()

        self._homing = self.clock.after(self.homing_slowdown * duration_s, end)

    def _cancel_homing(self) -> None:
        if self._homing is not None:
            self._homing.cancel()
            self._homing = None
