"""Simulated time, and the simulated serial wire: its speed, and filters that change bytes on the way."""

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(order=True)
class ScheduledEvent:
    """An action at a future time."""

    at_s: float
    order: int
    action: Callable[[], None] = field(compare=False)
    cancelled: bool = field(default=False, compare=False)

    def cancel(self) -> None:
        """Prevent the action."""
        self.cancelled = True


class SimulatedClock:
    """A `Clock` that runs scheduled events.

    Waiting runs the events that are due, in order and each at its own time. Time does not pass otherwise, so a
    simulation gives the same result on any computer, however busy.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._events: list[ScheduledEvent] = []
        self._order = itertools.count()

    def now_s(self) -> float:
        """Return the simulated time in seconds since the clock was made."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Advance by `duration_s` simulated seconds."""
        deadline_s = self._now_s + duration_s
        while self.step(deadline_s):
            pass

    def after(self, delay_s: float, action: Callable[[], None]) -> ScheduledEvent:
        """Schedule `action` after `delay_s`."""
        event = ScheduledEvent(self._now_s + max(0.0, delay_s), next(self._order), action)
        heapq.heappush(self._events, event)
        return event

    def step(self, until_s: float) -> bool:
        """Run the next event up to `until_s`; if there is none, advance to `until_s` and return False."""
        while self._events and self._events[0].at_s <= until_s:
            event = heapq.heappop(self._events)
            if not event.cancelled:
                self._now_s = max(self._now_s, event.at_s)
                event.action()
                return True
        self._now_s = max(self._now_s, until_s)
        return False

    def next_event_s(self) -> float | None:
        """Return the time of the next event, None if there is none."""
        while self._events and self._events[0].cancelled:
            heapq.heappop(self._events)
        return self._events[0].at_s if self._events else None


# At 115200 baud; a byte takes ten bits.
_SECONDS_PER_BYTE = 10.0 / 115200.0

# Time in s until the controller's first byte is on the wire.
_LATENCY_S = 0.002

type ByteFilter = Callable[[bytes], bytes]
"""Returns the bytes that arrive for the bytes that were sent."""


class Wire:
    """Carries bytes in both directions at 115200 baud, through filters.

    Attributes
    ----------
    filters_to_controller, filters_to_host : list
        Filters of the bytes, in order; faults add filters.
    connected : bool
        Whether the cable is plugged in.
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
