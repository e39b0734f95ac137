"""Time as the rig sees it, so that a simulated rig can bring a clock of its own."""

import time
from typing import Protocol


class Clock(Protocol):
    """A clock that only runs forward."""

    def now_s(self) -> float:
        """Return the seconds since some fixed moment."""
        ...

    def sleep_s(self, duration_s: float) -> None:
        """Let `duration_s` seconds go by."""
        ...


class WallClock:
    """The real time, unmoved by changes to the date."""

    def now_s(self) -> float:
        """Return the seconds since some fixed moment."""
        return time.monotonic()

    def sleep_s(self, duration_s: float) -> None:
        """Let `duration_s` seconds go by."""
        time.sleep(duration_s)
