"""Serves a simulated controller on a pseudo-terminal in real time, for other programs."""

import os
import select
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from faintfield.rig.simulation.controller.firmware import SimulatedFirmware
from faintfield.rig.simulation.controller.wire import SimulatedClock, Wire

# Longest wait in s between two looks at the port.
_MAX_WAIT_S = 0.05


@dataclass
class Server:
    """A simulated controller and its port.

    Parameters
    ----------
    port : str
        Device that other programs open.
    """

    port: str
    _clock: SimulatedClock
    _wire: Wire
    _firmware: SimulatedFirmware
    _far: int

    def run(self, speed: float = 1.0) -> None:
        """Serve until interrupted.

        Parameters
        ----------
        speed : float
            Simulated seconds per real second.
        """
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
    """Open a pseudo-terminal with a simulated controller behind it, and close it at the end.

    Parameters
    ----------
    firmware : callable
        Makes the controller from a clock and a wire.
    """
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
