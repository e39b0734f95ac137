"""The time to go, from the controller's own rates and from how long things have really taken."""

from statistics import median

from faintfield.rig.clock import Clock
from faintfield.rig.session.frames import PlannedFrame
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.motion import one_sided, path_duration_s
from faintfield.rig.stages.protocol import Point

# Guesses until the first stop and the first frame have been timed: two status reports, and writing a file.
_STOP_S, _FRAME_S = 0.5, 0.2


class Pace:
    """Learns what a stop takes besides its motion, and a frame besides its exposure.

    Parameters
    ----------
    stage : Gantry
        A connected stage.
    clock : Clock
        The rig's time.
    rest_s, readout_s : float
        The planned rest at each stop, and a frame's time besides its exposure.
    """

    def __init__(self, stage: Gantry, clock: Clock, rest_s: float, readout_s: float) -> None:
        self._stage = stage
        self._clock = clock
        self._stop_s: list[float] = []
        self._frame_s: dict[bool, list[float]] = {False: [], True: []}
        self._guess_s = (_STOP_S + rest_s, _FRAME_S + readout_s)
        self.check_s = 0.0

    def stopped(self, begun_s: float, start: Point | None, target: Point) -> None:
        """Note that the way from `start` to readiness at `target` ends now."""
        if start is not None:
            self._stop_s.append(self._clock.now_s() - begun_s - self.motion_s(start, target))

    def exposed(self, begun_s: float, exposure_s: float, *, repeated: bool) -> None:
        """Note that a frame ends now, from its intent to its commit; `repeated` if it is not the first at its stop.

        The two differ: a controller that was just asked for its position is not asked again at once.
        """
        self._frame_s[repeated].append(self._clock.now_s() - begun_s - exposure_s)

    def motion_s(self, start: Point, target: Point) -> float:
        """Return how long the stage itself takes."""
        path = (start, *one_sided(start, target, self._stage.settings.approach_mm))
        return path_duration_s(path, self._stage.identify().motion, self._stage.feed_mm_per_s())

    def to_go_s(self, frames: list[PlannedFrame], here: Point | None, checks: int) -> float:
        """Return how long `frames` will take, prompts aside.

        Parameters
        ----------
        frames : list of PlannedFrame
            What is still to be taken, in order.
        here : Point, optional
            Where the stage is.
        checks : int
            How many drift checks are still to come.
        """
        stop_s = median(self._stop_s) if self._stop_s else self._guess_s[0]
        first_s = median(self._frame_s[False] or [self._guess_s[1]])
        again_s = median(self._frame_s[True] or [first_s])
        total_s = checks * self.check_s
        last_step = None
        for frame in frames:
            target = frame.stop.target
            arrives = target != here or frame.step != last_step
            if arrives:
                total_s += stop_s + (self.motion_s(here, target) if here is not None else 0.0)
            total_s += frame.exposure_s + (first_s if arrives else again_s)
            here, last_step = target, frame.step
        return total_s
