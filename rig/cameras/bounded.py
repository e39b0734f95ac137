"""Limits the time of calls into camera libraries, which may hang."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait

from faintfield.rig.errors import CameraTimeout


def call_within[T](bound_s: float, call: Callable[[], T], what: str) -> T:
    """Return the result of `call`, or raise `CameraTimeout` if there is none within `bound_s`.

    A library that hangs in a driver cannot be stopped from outside. It stays in a thread of its own, which does not
    keep the program from ending; the camera must be opened again before it is used.

    Parameters
    ----------
    bound_s : float
        Time limit in seconds of real time, even if the rig's clock is simulated.
    call : callable
        The call that may hang.
    what : str
        What the call does, for the message.
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
