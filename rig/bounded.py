"""Limits the time of calls into libraries of devices, which may hang."""

import threading
from collections.abc import Callable
from concurrent.futures import Future, wait


def result_within[T](bound_s: float, call: Callable[[], T], thread: str) -> T:
    """Return the result of `call`, or raise `TimeoutError` if there is none within `bound_s`.

    A library that hangs in a driver cannot be stopped from outside. It stays in a thread of its own, which does not
    keep the program from ending; the device must be opened again before it is used.

    Parameters
    ----------
    bound_s : float
        Time limit in seconds of real time, even if the rig's clock is simulated.
    call : callable
        The call that may hang.
    thread : str
        Name of its thread.
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
