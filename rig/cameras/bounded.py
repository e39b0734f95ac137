"""Calls into camera libraries that may never come back, with an end to the waiting."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait

from faintfield.rig.errors import CameraTimeout


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
    outcome: Future[T] = Future()

    def work() -> None:
        try:
            outcome.set_result(call())
        except BaseException as failure:
            outcome.set_exception(failure)

    threading.Thread(target=work, daemon=True, name="camera").start()
    wait([outcome], bound_s)
    if not outcome.done():
        raise CameraTimeout(
            f"the camera did not finish {what} within {bound_s:g} s; check its cable and battery, switch it off and on"
        )
    return outcome.result()
