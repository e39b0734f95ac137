"""Estimate the remaining time of a capture, from the controller's rates and from the times measured so far."""

from statistics import median

from faintfield.rig.clock import Clock
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.motion import one_sided_path, path_duration_s
from faintfield.rig.stages.protocol import Point

# Time in s of a stop besides motion and rest, and of a frame besides exposure and readout, until one has been measured:
# two status reports, and writing a file.
_STOP_S, _FRAME_S = 0.5, 0.2


class Pace:
    """Tracks where the stage is, and learns how long a stop takes besides motion and a frame besides exposure.

    Parameters
    ----------
    stage, clock : Gantry, Clock
        A connected stage, and the rig's time.
    rest_s, readout_s : float
        The planned rest at each stop, and a frame's time besides its exposure.

    Attributes
    ----------
    here : Point or None
        Position of the stage, None if it is not known.
    check_s : float
        Duration of a drift check.
    """

    def __init__(self, stage: Gantry, clock: Clock, rest_s: float, readout_s: float) -> None:
        self._stage = stage
        self._clock = clock
        self._stop_s: list[float] = []
        self._frame_s: dict[bool, list[float]] = {False: [], True: []}
        self._guess_s = (_STOP_S + rest_s, _FRAME_S + readout_s)
        self._departed_s = 0.0
        self._start: Point | None = None
        self._repeated = False
        self.here: Point | None = None
        self.check_s = 0.0

    def depart(self) -> None:
        """Note that the stage leaves its position."""
        self._departed_s, self._start = self._clock.now_s(), self.here
        self.here, self._repeated = None, False

    def arrive(self, target: Point, *, timed: bool) -> None:
        """Note that the stage is at rest at `target`; learn from the time it took if `timed`."""
        if timed and self._start is not None:
            self._stop_s.append(self._clock.now_s() - self._departed_s - self._motion_s(self._start, target))
        self.here = target

    def finish_frame(self, begun_s: float, exposure_s: float) -> None:
        """Note that a frame that was begun at `begun_s` is committed.

        The first frame at a stop is told from the next ones, which are faster: a controller that was just asked for its
        position is not asked again at once.
        """
        self._frame_s[self._repeated].append(self._clock.now_s() - begun_s - exposure_s)
        self._repeated = True

    def remaining_s(self, frames: list[PlannedFrame], drift_checks: int) -> float:
        """Return how long `frames`, in this order, and a number of drift checks will take, without prompts."""
        stop_s = median(self._stop_s) if self._stop_s else self._guess_s[0]
        first_s = median(self._frame_s[False] or [self._guess_s[1]])
        again_s = median(self._frame_s[True] or [first_s])
        total_s = drift_checks * self.check_s
        here, last_step = self.here, None
        for frame in frames:
            target = frame.stop.target
            arrives = target != here or frame.step != last_step
            if arrives:
                total_s += stop_s + (self._motion_s(here, target) if here is not None else 0.0)
            total_s += frame.exposure_s + (first_s if arrives else again_s)
            here, last_step = target, frame.step
        return total_s

    def _motion_s(self, start: Point, target: Point) -> float:
        path = (start, *one_sided_path(start, target, self._stage.settings.approach_mm))
        return path_duration_s(path, self._stage.identify().motion, self._stage.feed_mm_per_s())
