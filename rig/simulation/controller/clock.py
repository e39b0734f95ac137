"""Simulated time, which advances from event to event while somebody waits."""

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
