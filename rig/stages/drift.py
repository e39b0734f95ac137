"""Detect lost steps, which no report shows, by timing homing again, and recover the stage after an error.

When a motor loses steps, the carriage is not where the controller counts it. Homing from a known position then takes
longer or shorter than before, since the distance to the switch has changed. The speed of homing is measured at the
beginning, from two distances, so that it does not depend on the controller's settings.

Controllers that home both axes at once (GRBL) finish when the farther axis reaches its switch, so the time shows only
drift away from the switches. For these, the stage first moves so close to the switches that one closes if its axis has
drifted towards it. A controller that does not let the stage come so close (grblHAL) must home each axis by itself.

A computer or a line that is busy delays answers, and a homing then seems to take longer. How late an answer was read is
known to the transport; other delays show in that homing again does not take the usual time either. A check that such
delays prevent says so, and finds no drift.
"""

import math
from collections.abc import Callable

from msgspec import Struct

from faintfield.rig.errors import DriftUnknown, NotHomed, PlanRefused, PositionDrifted, StageError
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import AnswerTime, AxisIndex, Point

# Longest delay in s by which serial adapters hold back a short answer; it limits the resolution.
_JITTER_S = 0.016
# Distance in mm from which homing is timed; half of it serves to measure the speed.
_RUN_UP_MM = 10.0
# Attempts, while answers are delayed: to time one homing, and to measure all times at the beginning.
_MAX_TIMINGS, _MAX_BEGINNINGS = 5, 3


class Drift(Struct, frozen=True):
    """Distance of the carriages from their count, away from the switches, and the largest that passes.

    There is one number per axis, or one for both if they home together.
    """

    away_mm: tuple[float, ...]
    limit_mm: float

    @property
    def passed(self) -> bool:
        """Return whether no axis has drifted by more than the limit."""
        return all(abs(value) <= self.limit_mm for value in self.away_mm)


class DriftWatch:
    """Drift checks of a connected stage; drift up to `limit_mm` passes.

    Attributes
    ----------
    unchecked : list
        Frames at positions that no check has judged since the stage was homed.
    """

    def __init__(self, stage: Gantry, *, limit_mm: float = 0.5) -> None:
        self._stage = stage
        self._limit_mm = limit_mm
        self.unchecked: list[object] = []
        self._home = Point(math.nan, math.nan)
        self._taken_s: dict[AxisIndex | None, float] = {}
        self._speed_mm_per_s: dict[AxisIndex | None, float] = {}

    @property
    def begun(self) -> bool:
        """Return whether there is a reference, so that drift can be checked."""
        return set(self._speed_mm_per_s) == set(self._homing_axes())

    def begin(self) -> None:
        """Home, and measure how long homing takes from known distances; call again whenever the stage was homed.

        Homing resets the count: frames that were recorded before and not checked can no longer be checked. Raises
        `PlanRefused` if the limit cannot be resolved, or the time of homing shows no drift, and `PositionDrifted` or
        `DriftUnknown` if homing does not take the same time twice.
        """
        self.unchecked.clear()
        self._speed_mm_per_s.clear()
        self._home = self._stage.home().position.point
        if self._stage.identify().homes_together:
            self._require_switches_within_reach()
        for attempts_left in reversed(range(_MAX_BEGINNINGS)):
            try:
                for axis in self._homing_axes():
                    near_s = self._time_homing_undelayed(axis, 0.5 * _RUN_UP_MM)
                    self._taken_s[axis] = self._time_homing_undelayed(axis, _RUN_UP_MM)
                    self._speed_mm_per_s[axis] = self._homing_speed(self._taken_s[axis] - near_s)
                self.check()  # a disturbance during the timing would falsify every later check
            except (PositionDrifted, DriftUnknown, PlanRefused) as failure:
                # What a device failed at has to be seen to; a delay passes
                if failure.__cause__ is not None or not attempts_left:
                    self._speed_mm_per_s.clear()
                    raise
            else:
                return

    def check(self) -> Drift:
        """Home again: the unchecked frames are confirmed if this returns.

        They are suspect if it raises `PositionDrifted`, after which the stage may need `recover` and `home`, or
        `DriftUnknown`, when delayed answers hide whether there is drift. `PlanRefused` means that `begin` did not
        succeed.
        """
        if not self.begun:
            raise PlanRefused("drift cannot be checked: homing was not timed at the beginning; begin the watch first")
        try:
            if self._stage.identify().homes_together:
                self._require_open_switches()
            most, least = self._measure_drift()
            passed = most.passed and least.passed
            # Homing takes the usual time now that the count is right again, unless answers are delayed
            delayed = not passed and (most != least or not all(drift.passed for drift in self._measure_drift()))
        except PositionDrifted:
            raise
        except StageError as failure:
            raise self._drift_failure(f"the check ended in: {failure}") from failure
        worst = max(most.away_mm, key=abs)
        if delayed:
            suspect = self._take_unchecked()
            raise DriftUnknown(
                f"homing seemed {worst:+.2f} mm off its scale, but answers were delayed; {len(suspect)} positions "
                "since the last passed check are in doubt: take them again, and give this computer less to do",
                suspect=suspect,
            )
        if not passed:
            raise self._drift_failure(f"{worst:+.2f} mm off its scale, more than {self._limit_mm:g} mm")
        self.unchecked.clear()
        return most

    def _measure_drift(self) -> tuple[Drift, Drift]:
        """Home again, and return the drift by the time that it took at most, and at least."""
        most, least = [], []
        for axis in self._homing_axes():
            time = self._time_homing(axis, _RUN_UP_MM)
            most.append((time.taken_s - self._taken_s[axis]) * self._speed_mm_per_s[axis])
            least.append(most[-1] - time.late_s * self._speed_mm_per_s[axis])
        return Drift(tuple(most), self._limit_mm), Drift(tuple(least), self._limit_mm)

    def _require_switches_within_reach(self) -> None:
        """Raise unless the stage can move to where a switch closes if its axis has drifted by the limit."""
        pull_off_mm = self._stage.identify().pull_off_mm
        if pull_off_mm <= self._limit_mm:
            problem = f"drift limit {self._limit_mm:g} mm, but homing pulls off the switches by only {pull_off_mm:g} mm"
            raise PlanRefused(f"{problem}; pull off farther ($27) or lower the limit")
        if not self._stage.travel().holds(self._inward_point(self._limit_mm - pull_off_mm)):
            raise PlanRefused(
                f"drift of {self._limit_mm:g} mm cannot be seen: homing pulls off by {pull_off_mm:g} mm, and the "
                f"travel {self._stage.travel()} ends there; let each axis home by itself (grblHAL: add 2 to $22), "
                "or set $21=0"
            )

    def _homing_axes(self) -> tuple[AxisIndex | None, ...]:
        return (None,) if self._stage.identify().homes_together else (0, 1)

    def _time_homing(self, axis: AxisIndex | None, distance_mm: float) -> AnswerTime:
        self._stage.move_to(*self._inward_point(distance_mm))
        return self._stage.home(axis).time

    def _time_homing_undelayed(self, axis: AxisIndex | None, distance_mm: float) -> float:
        for _ in range(_MAX_TIMINGS):
            time = self._time_homing(axis, distance_mm)
            if time.late_s == 0.0:
                return time.taken_s
        problem = f"the end of homing was read late {_MAX_TIMINGS} times in a row, the last time by {time.late_s:.3f} s"
        raise DriftUnknown(f"{problem}; give this computer less to do, or set check = false in [drift]")

    def _inward_point(self, distance_mm: float) -> Point:
        """Return the point that lies `distance_mm` from where homing ends, along both axes."""
        travel = self._stage.travel()
        axes = zip(self._home, (travel.x_mm, travel.y_mm), strict=True)
        return Point(*(end + (distance_mm if end - low < high - end else -distance_mm) for end, (low, high) in axes))

    def _require_open_switches(self) -> None:
        """Move to where a switch closes if its axis has drifted by the limit, and raise if one is closed."""
        self._stage.move_to(*self._inward_point(self._limit_mm - self._stage.identify().pull_off_mm))
        if closed := self._stage.switches():
            axes = " and ".join("xy"[axis] for axis in sorted(closed))
            raise self._drift_failure(f"the switch of {axes} is closed more than {self._limit_mm:g} mm early")

    def _homing_speed(self, difference_s: float) -> float:
        if difference_s <= 0.0:
            raise PlanRefused("homing takes no longer from farther away, which shows no drift; set drift.check = false")
        speed = 0.5 * _RUN_UP_MM / difference_s
        if speed * _JITTER_S > self._limit_mm:
            problem = f"homing at {speed:.0f} mm/s resolves {speed * _JITTER_S:.2f} mm"
            raise PlanRefused(f"{problem}, not the limit of {self._limit_mm:g} mm; home more slowly or raise the limit")
        return speed

    def _take_unchecked(self) -> tuple[object, ...]:
        suspect, self.unchecked = tuple(self.unchecked), []
        return suspect

    def _drift_failure(self, why: str) -> PositionDrifted:
        suspect = self._take_unchecked()
        return PositionDrifted(
            f"the stage has lost its scale: {why}; {len(suspect)} positions since the last passed check are suspect: "
            "look for an obstacle or too high an acceleration, home, and take them again",
            suspect=suspect,
        )


def recover(stage: Gantry, may_home: Callable[[str], bool], watch: DriftWatch | None = None) -> None:
    """Make the stage usable again after a `StageError`, or raise another one.

    Homing needs the answer True of `may_home`, which is called with a question; otherwise `NotHomed` is raised. The
    watch begins again if the stage is homed, or if it could not begin.
    """
    stage.recover()
    if stage.trusted and (watch is None or watch.begun):
        return
    if not may_home("The stage's position is lost. Home it now? It will move to its switches."):
        raise NotHomed("homing was declined and the stage's position is not known; home it before going on")
    if watch is None:
        stage.home()
    else:
        watch.begin()
