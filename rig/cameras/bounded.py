"""Calls into camera libraries that may never come back, with an end to the waiting."""

import queue
import threading
from collections.abc import Callable

from rig.errors import CameraTimeout


def call_within[T](bound_s: float, call: Callable[[], T], what: str) -> T:
    """Return what `call` returns, or raise `CameraTimeout` when it does not within `bound_s`.

    A library stuck in a driver cannot be stopped from outside. It is left behind in a thread of its own, which does
    not keep the program from ending; the camera must not be used again before it was opened anew.

    Parameters
    ----------
    bound_s : float
        How long to wait, in real seconds: cameras know no others.
    call : callable
        What may hang.
    what : str
        What it does, for the message.
    """
    outcome: queue.SimpleQueue[tuple[T | None, BaseException | None]] = queue.SimpleQueue()

    def work() -> None:
        try:
            outcome.put((call(), None))
        except BaseException as failure:
            outcome.put((None, failure))

    threading.Thread(target=work, daemon=True, name="camera").start()
    try:
        value, failure = outcome.get(timeout=bound_s)
    except queue.Empty:
        raise CameraTimeout(
            f"the camera did not finish {what} within {bound_s:g} s; check its cable and battery, switch it off and on"
        ) from None
    if failure is not None:
        raise failure
    return value  # type: ignore[return-value]
