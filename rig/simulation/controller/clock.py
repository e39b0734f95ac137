"""Simulated time: it stands still until somebody waits, and then jumps from event to event."""

import heapq
import itertools
from collections.abc import Callable
from dataclasses import dataclass, field


@dataclass(order=True)
class ScheduledEvent:
    """Something that will happen at a time."""

    at_s: float
    order: int
    action: Callable[[], None] = field(compare=False)
    cancelled: bool = field(default=False, compare=False)

    def cancel(self) -> None:
        """Let it not happen."""
        self.cancelled = True


class SimulatedClock:
    """A `Clock` that is the agenda of the simulated world.

    Whoever waits on it makes the world go on: events happen in order, each at its own time, until the wait is over.
    No time passes otherwise, so a simulation gives the same result however fast or busy the computer is.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._agenda: list[ScheduledEvent] = []
        self._order = itertools.count()

    def now_s(self) -> float:
        """Return the simulated seconds since the clock was made."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Let `duration_s` simulated seconds go by."""
        deadline_s = self._now_s + duration_s
        while self.step(deadline_s):
            pass

    def after(self, delay_s: float, action: Callable[[], None]) -> ScheduledEvent:
        """Put `action` on the agenda, `delay_s` from now."""
        event = ScheduledEvent(self._now_s + max(0.0, delay_s), next(self._order), action)
        heapq.heappush(self._agenda, event)
        return event

    def step(self, until_s: float) -> bool:
        """Let the next event up to `until_s` happen; without one, go to `until_s` and return False."""
        while self._agenda and self._agenda[0].at_s <= until_s:
            event = heapq.heappop(self._agenda)
            if not event.cancelled:
                self._now_s = max(self._now_s, event.at_s)
                event.action()
                return True
        self._now_s = max(self._now_s, until_s)
        return False

    def next_event_s(self) -> float | None:
        """Return when the next event is due, None when there is none."""
        while self._agenda and self._agenda[0].cancelled:
            heapq.heappop(self._agenda)
        return self._agenda[0].at_s if self._agenda else None
