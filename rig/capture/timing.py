"""Measure how long the rig swings after a move, and estimate the remaining time of a capture."""

from collections.abc import Callable
from statistics import median

import cv2
import numpy as np
from msgspec import Struct
from numpy.typing import NDArray

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.clock import Clock
from faintfield.rig.plan import PlannedFrame
from faintfield.rig.settings import SettleSettings
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
    stage : Gantry
        A connected stage.
    clock : Clock
        The rig's time.
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
        """Return how long `frames` will take, without prompts.

        Parameters
        ----------
        frames : list of PlannedFrame
            The frames still to be taken, in order.
        drift_checks : int
            Number of drift checks still to come.
        """
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
        """Return how long the motion from `start` to `target` takes."""
        path = (start, *one_sided_path(start, target, self._stage.settings.approach_mm))
        return path_duration_s(path, self._stage.identify().motion, self._stage.feed_mm_per_s())


# Fewer leave the last third, which is taken as the picture at rest, a single frame.
_MIN_FRAMES = 6


class Settling(Struct, frozen=True):
    """Result of `measure_settling`.

    Parameters
    ----------
    wait_s : float
        Rest in s before an exposure.
    settled : bool
        Whether the rig was seen at rest.
    scatter_px : float
        Median shift at rest in pixels, which is due to noise.
    curve : tuple of (float, float)
        Time in s after the stop, and shift in pixels from the picture at rest.
    """

    wait_s: float
    settled: bool
    scatter_px: float
    curve: tuple[tuple[float, float], ...]


def measure_settling(expose: Callable[[float], Pixels], clock: Clock, settings: SettleSettings) -> Settling:
    """Measure when the rig comes to rest; call it right after a move.

    The mean of the last third of the frames is the picture r at rest. A small shift d changes a frame by ∇r · d, so d
    is the least-squares solution of ∇r · d = frame − r over all pixels.

    Parameters
    ----------
    expose : callable
        Takes and returns a frame, given its exposure time in s.
    clock : Clock
        The rig's time.
    settings : SettleSettings
        Duration, exposure time and largest harmless shift.
    """
    begun_s = clock.now_s()
    times_s: list[float] = []
    frames: list[Pixels] = []
    while clock.now_s() - begun_s < settings.longest_s or len(frames) < _MIN_FRAMES:
        times_s.append(clock.now_s() - begun_s)
        frames.append(_smooth(expose(settings.exposure_s)))
    at_rest = len(frames) - len(frames) // 3
    shifts_px = _shifts_px(frames, np.mean(frames[at_rest:], axis=0))
    scatter_px = float(np.median(shifts_px[at_rest:]))
    swinging = np.flatnonzero(shifts_px > max(settings.limit_px, 4.0 * scatter_px))
    first_still = int(swinging[-1]) + 1 if len(swinging) else 0
    # In the dark, shifts are noise; a rig that swings to the end has no picture at rest
    settled = first_still <= at_rest and scatter_px <= settings.limit_px
    return Settling(
        wait_s=times_s[first_still] if settled else settings.longest_s,
        settled=settled,
        scatter_px=round(scatter_px, 5),
        curve=tuple((round(t, 4), round(float(shift), 4)) for t, shift in zip(times_s, shifts_px, strict=True)),
    )


def _smooth(pixels: Pixels) -> NDArray[np.float32]:
    """Return a frame in grey, blurred a little, so that noise does not dominate the gradient."""
    grey = pixels if pixels.ndim == 2 else pixels.mean(axis=2)
    return np.asarray(cv2.GaussianBlur(np.asarray(grey, np.float32), (0, 0), 1.5), np.float32)


def _shifts_px(frames: list[Pixels], rest: Pixels) -> NDArray[np.float64]:
    """Return the shift in pixels of each frame from the picture at rest."""
    along_rows, along_columns = np.gradient(np.asarray(rest, float))
    gradients = np.stack([along_columns.ravel(), along_rows.ravel()])
    normal = gradients @ gradients.T + 1e-9 * np.eye(2)
    changes = np.stack([gradients @ (frame - rest).ravel() for frame in frames])
    return np.asarray(np.linalg.norm(np.linalg.solve(normal, changes.T), axis=0))
