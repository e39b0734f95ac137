"""Common parts of the simulated GRBL and Marlin: restarts, lines, homing, and a server that gives them a real port."""

import os
import re
import select
import time
import tty
from abc import ABC, abstractmethod
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import ClassVar

from faintfield.rig.simulation.controller.kinematics import Mechanics
from faintfield.rig.simulation.controller.wire import ScheduledEvent, SimulatedClock, Wire
from faintfield.rig.stages.protocol import ProtocolName

WORD = re.compile(r"([A-Z])(-?\d+(?:\.\d+)?)")


def parse_parameters(text: str) -> dict[str, float]:
    """Return the numbers of a line by letter; the last word of a letter counts."""
    return {letter: float(value) for letter, value in WORD.findall(text)}


class SimulatedFirmware(ABC):
    """A simulated controller.

    Parameters
    ----------
    clock, wire, mechanics : SimulatedClock, Wire, Mechanics
        The simulated time, the serial line to the host, and the motors.
    boot_s : float
        Time from a restart to the first line that it sends.

    Attributes
    ----------
    homing_slowdown : float
        Factor on the time of homing; faults raise it.
    """

    protocol: ClassVar[ProtocolName]
    _line_end: ClassVar[bytes]

    def __init__(self, clock: SimulatedClock, wire: Wire, mechanics: Mechanics, boot_s: float) -> None:
        self.clock = clock
        self.wire = wire
        self.mechanics = mechanics
        self.boot_s = boot_s
        self.homing_slowdown = 1.0
        self._line, self._waiting = bytearray(), deque[str]()
        self._boot: ScheduledEvent | None = None
        self._homing: ScheduledEvent | None = None
        mechanics.on_idle = self._motion_ended
        self.restart()

    def restart(self) -> None:
        """Restart as after power-up: the step count is lost, the settings stay."""
        self.mechanics.stop_dead()
        self.mechanics.set_count((0.0, 0.0))
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

    @abstractmethod
    def receive(self, data: bytes) -> None:
        """Take bytes from the host."""

    def say(self, *lines: str) -> None:
        """Send lines to the host."""
        for text in lines:
            self.wire.to_host(text.encode("ascii", errors="replace") + self._line_end)

    @abstractmethod
    def _reset_state(self) -> None:
        """Set the state that a restart leaves until `_booted`."""

    @abstractmethod
    def _booted(self) -> None:
        """Finish the restart."""

    @abstractmethod
    def _motion_ended(self) -> None:
        """React to the end of the last motion."""

    def _start_homing(self, duration_s: float, finish: Callable[[], None]) -> None:
        def end() -> None:
            self._homing = None
            finish()

        self._homing = self.clock.after(self.homing_slowdown * duration_s, end)

    def _cancel_homing(self) -> None:
        if self._homing is not None:
            self._homing.cancel()
            self._homing = None


# Longest wait in s between two looks at the port.
_MAX_WAIT_S = 0.05


@dataclass
class Server:
    """A simulated controller, and the device `port` that other programs open."""

    port: str
    _clock: SimulatedClock
    _wire: Wire
    _firmware: SimulatedFirmware
    _far: int

    def run(self, speed: float = 1.0) -> None:
        """Serve until interrupted, `speed` simulated seconds per real second."""
        begun_s = time.monotonic()
        while True:
            self.turn(speed * (time.monotonic() - begun_s))
            next_s = self._clock.next_event_s()
            wait_s = _MAX_WAIT_S if next_s is None else (next_s - self._clock.now_s()) / speed
            select.select([self._far], [], [], min(_MAX_WAIT_S, max(0.0, wait_s)))

    def turn(self, now_s: float) -> None:
        """Advance simulated time to `now_s`, and pass on the bytes in both directions."""
        self._clock.sleep_s(max(0.0, now_s - self._clock.now_s()))
        if self._wire.arrived():
            os.write(self._far, self._wire.take())
        if select.select([self._far], [], [], 0.0)[0]:
            self._firmware.receive(self._wire.to_controller(os.read(self._far, 4096)))


@contextmanager
def serving(firmware: Callable[[SimulatedClock, Wire], SimulatedFirmware]) -> Iterator[Server]:
    """Open a pseudo-terminal with the controller behind it that `firmware` makes, and close it at the end."""
    clock = SimulatedClock()
    wire = Wire(clock)
    far, near = os.openpty()
    tty.setraw(near)
    try:
        # The near end stays open, so that programs can connect again.
        yield Server(os.ttyname(near), clock, wire, firmware(clock, wire), far)
    finally:
        os.close(far)
        os.close(near)
