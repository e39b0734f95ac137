"""The clock of the rig: real time, or the time of a simulation."""

import time
from typing import Protocol


class Clock(Protocol):
    """A clock that never runs backwards."""

    def now_s(self) -> float:
        """Return the time in seconds since a fixed moment."""

    def sleep_s(self, duration_s: float) -> None:
        """Wait for `duration_s` seconds."""


class WallClock:
    """Real time, unaffected by changes of the system's date."""

    def now_s(self) -> float:
        """Return the time in seconds since a fixed moment."""
        return time.monotonic()

    def sleep_s(self, duration_s: float) -> None:
        """Wait for `duration_s` seconds."""
        time.sleep(duration_s)
