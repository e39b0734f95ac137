"""Refuses frames of GenICam cameras whose exposure began before they were asked for, by two clocks."""

import time
from dataclasses import dataclass

from faintfield.rig.errors import CameraError

# An exposure may be this much shorter than it was set.
_SHORTEST_SHARE = 0.9

# The computer's date may run this much faster or slower than its clock while it is corrected, besides a jump in s.
_DATE_RATE = 1e-3
_DATE_JUMP_S = 0.01

# How often clock and date are read for one moment.
_READINGS = 3

# The camera's clock may run this much faster or slower than the computer's; and how exact its time stamps are, in s.
_CAMERA_RATE = 2e-4
_CAMERA_JITTER_S = 0.01


@dataclass(frozen=True)
class Moment:
    """A moment by the computer's clock and date, in ns."""

    clock_ns: int
    date_ns: int

    @classmethod
    def now(cls) -> "Moment":
        """Return the present moment.

        Another process may run between the two readings of a busy computer. Of several pairs, the closest is taken.
        """
        pairs = []
        for _ in range(_READINGS):
            before_ns, date_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            pairs.append((after_ns - before_ns, before_ns, date_ns))
        _, clock_ns, date_ns = min(pairs)
        return cls(clock_ns, date_ns)


@dataclass(frozen=True)
class Stamps:
    """Time stamps of a frame.

    Parameters
    ----------
    received_ns : int
        Date at which the computer received the beginning of the frame.
    camera_ns : int
        The camera's own time of the frame, since a moment of its choice; 0 if it has no clock.
    """

    received_ns: int
    camera_ns: int


class FrameTimes:
    """Compares the time stamps of each frame with the moment at which it was requested.

    A frame that is received sooner after its request than its exposure lasts began before the request. A frame that
    was held back on its way shows by the camera's clock, which is compared with the frame before of the same exposure
    time: whatever moment of a frame the camera stamps, it is the same in both.
    """

    def __init__(self) -> None:
        self._last: dict[float, tuple[int, int]] = {}  # when received, by the computer's clock; the camera's stamp
        self._newest_ns = 0

    def check(self, stamps: Stamps, requested: Moment, now: Moment, exposure_s: float) -> None:
        """Raise `CameraError` if the frame's exposure began before it was requested, or that cannot be told.

        `now` is a moment after the frame came. `exposure_s` is 0 if the camera only pretends to expose.
        """
        passed_s = 1e-9 * (now.clock_ns - requested.clock_ns)
        by_date_s = 1e-9 * (now.date_ns - requested.date_ns)
        if abs(by_date_s - passed_s) > _DATE_JUMP_S + _DATE_RATE * passed_s:
            raise CameraError(
                f"the computer's date jumped by {by_date_s - passed_s:+.3f} s during the exposure, so the frame's time "
                "is not known; take it again"
            )
        after_ns = stamps.received_ns - requested.date_ns // 1000 * 1000  # dates of the library end at microseconds
        after_s = 1e-9 * after_ns
        if after_s < _SHORTEST_SHARE * exposure_s:
            raise CameraError(
                f"a frame came {1e3 * after_s:.1f} ms after it was requested, sooner than its exposure of "
                f"{exposure_s:g} s lasts: it began before the request; take it again"
            )
        if stamps.camera_ns:
            self._check_own(stamps, requested, exposure_s)
            self._newest_ns = stamps.camera_ns
            self._last[exposure_s] = (requested.clock_ns + after_ns, stamps.camera_ns)

    def _check_own(self, stamps: Stamps, requested: Moment, exposure_s: float) -> None:
        if stamps.camera_ns <= self._newest_ns:
            raise CameraError(
                "a frame came that is not newer by the camera's clock than the one before; take it again, or open the "
                "camera again if its clock was reset"
            )
        last = self._last.get(exposure_s)
        if last is None:
            return
        received_ns, camera_ns = last
        earliest_s = 1e-9 * (requested.clock_ns - received_ns) + _SHORTEST_SHARE * exposure_s
        slack_s = _CAMERA_JITTER_S + _CAMERA_RATE * abs(earliest_s)
        passed_s = 1e-9 * (stamps.camera_ns - camera_ns)
        if passed_s < earliest_s - slack_s:
            raise CameraError(
                f"a frame came that is {1e3 * (earliest_s - passed_s):.0f} ms too old by the camera's clock: its "
                "exposure began before the request; take it again"
            )
