"""Limits the time of calls into camera libraries, which may hang."""

from collections.abc import Callable

from faintfield.rig.bounded import result_within
from faintfield.rig.errors import CameraTimeout


def call_within[T](bound_s: float, call: Callable[[], T], what: str) -> T:
    """Return the result of `call`, or raise `CameraTimeout` if there is none within `bound_s`; see `result_within`.

    Parameters
    ----------
    bound_s : float
        Time limit in seconds of real time, even if the rig's clock is simulated.
    call : callable
        The call that may hang.
    what : str
        What the call does, for the message.
    """
    try:
        return result_within(bound_s, call, "camera")
    except TimeoutError as failure:
        raise CameraTimeout(
            f"the camera did not finish {what} within {bound_s:g} s; check its cable and battery, switch it off and on"
        ) from failure
