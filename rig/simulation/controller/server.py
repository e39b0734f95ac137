"""A simulated controller on a pseudo-terminal in real time, for programs that run beside it."""

import os
import select
import time
import tty
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

from faintfield.rig.simulation.controller.clock import SimulatedClock
from faintfield.rig.simulation.controller.firmware import Firmware
from faintfield.rig.simulation.controller.wire import Wire

_LONGEST_NAP_S = 0.05


@dataclass
class Server:
    """A simulated controller and the port by which it is reached.

    Parameters
    ----------
    port : str
        What other programs open.
    """

    port: str
    _clock: SimulatedClock
    _wire: Wire
    _firmware: Firmware
    _far: int

    def run(self, speed: float = 1.0) -> None:
        """Serve until interrupted.

        Parameters
        ----------
        speed : float
            How many simulated seconds pass in one real one.
        """
        begun_s = time.monotonic()
        while True:
            self.turn(speed * (time.monotonic() - begun_s))
            next_s = self._clock.next_event_s()
            nap_s = _LONGEST_NAP_S if next_s is None else (next_s - self._clock.now_s()) / speed
            select.select([self._far], [], [], min(_LONGEST_NAP_S, max(0.0, nap_s)))

    def turn(self, now_s: float) -> None:
        """Let the simulated time reach `now_s`, and pass on what either side has to say."""
        self._clock.sleep_s(max(0.0, now_s - self._clock.now_s()))
        if self._wire.arrived():
            os.write(self._far, self._wire.take())
        if select.select([self._far], [], [], 0.0)[0]:
            self._firmware.receive(self._wire.to_controller(os.read(self._far, 4096)))


@contextmanager
def serving(firmware: Callable[[SimulatedClock, Wire], Firmware]) -> Iterator[Server]:
    """Open a pseudo-terminal with a simulated controller behind it, and close it in the end.

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
        # The near end stays open here, so that programs can come and go.
        yield Server(os.ttyname(near), clock, wire, firmware(clock, wire), far)
    finally:
        os.close(far)
        os.close(near)
