"""The serial wire between host and controller: its pace, and what happens to bytes on the way."""

from collections.abc import Callable

from faintfield.rig.simulation.controller.clock import ScheduledEvent, SimulatedClock

_SECONDS_PER_BYTE = 10.0 / 115200.0
_LATENCY_S = 0.002

type ByteFilter = Callable[[bytes], bytes]
"""Turns bytes that pass into those that arrive."""


class Wire:
    """Carries bytes both ways, at 115200 baud, through whatever spoils them.

    Parameters
    ----------
    clock : SimulatedClock
        The world's time.

    Attributes
    ----------
    filters_to_controller, filters_to_host : list
        What happens to bytes on the way, in order; faults add to it.
    connected : bool
        Whether the cable is in.
    """

    def __init__(self, clock: SimulatedClock) -> None:
        self.filters_to_controller: list[ByteFilter] = []
        self.filters_to_host: list[ByteFilter] = []
        self.connected = True
        self._clock = clock
        self._free_at_s = 0.0
        self._arrived = bytearray()
        self._under_way: list[ScheduledEvent] = []

    def to_controller(self, data: bytes) -> bytes:
        """Return what arrives at the controller of what the host sends."""
        return _spoilt(data, self.filters_to_controller)

    def to_host(self, data: bytes) -> None:
        """Put what the controller says on the wire, behind what is on it."""
        now_s = self._clock.now_s()
        self._free_at_s = max(self._free_at_s, now_s + _LATENCY_S) + len(data) * _SECONDS_PER_BYTE
        self._under_way.append(self._clock.after(self._free_at_s - now_s, lambda: self._arrive(data)))

    def hold_up(self, duration_s: float) -> None:
        """Let nothing more through to the host for a while; it arrives afterwards."""
        self._free_at_s = self._clock.now_s() + duration_s

    def arrived(self) -> bool:
        """Return whether bytes wait for the host."""
        return bool(self._arrived)

    def take(self) -> bytes:
        """Return the bytes that have arrived at the host."""
        data = bytes(self._arrived)
        self._arrived.clear()
        return data

    def clear(self) -> None:
        """Lose what is under way or not yet read."""
        for event in self._under_way:
            event.cancel()
        self._under_way.clear()
        self._arrived.clear()
        self._free_at_s = 0.0

    def _arrive(self, data: bytes) -> None:
        """Let the host have `data`, if the cable is in."""
        del self._under_way[0]
        if self.connected:
            self._arrived += _spoilt(data, self.filters_to_host)


def _spoilt(data: bytes, spoils: list[ByteFilter]) -> bytes:
    """Return `data` after everything that happens to it."""
    for spoil in tuple(spoils):
        data = spoil(data)
    return data
