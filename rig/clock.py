"""The clock of the rig, real or simulated, and a limit to the time of calls that may hang."""

import threading
import time
from collections.abc import Callable
from concurrent.futures import Future, wait
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


def result_within[T](bound_s: float, call: Callable[[], T], thread: str) -> T:
    """Return the result of `call`, or raise `TimeoutError` if there is none within `bound_s` seconds of real time.

    A library that hangs in a driver cannot be stopped from outside. It stays in a thread of its own, called `thread`,
    which does not keep the program from ending; the device must be opened again before it is used.
    """
    outcome: Future[T] = Future()

    def work() -> None:
        try:
            outcome.set_result(call())
        except BaseException as failure:
            outcome.set_exception(failure)

    threading.Thread(target=work, daemon=True, name=thread).start()
    wait([outcome], bound_s)
    if not outcome.done():
        raise TimeoutError(f"no result within {bound_s:g} s")
    return outcome.result()
