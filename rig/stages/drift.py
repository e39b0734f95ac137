"""Lost steps, which no report shows: found by homing again and timing it.

A motor that loses steps leaves the controller's count right and the carriage wrong. Homing again from a known place
tells: the way to the switch is longer or shorter than the count says, and so is the time that homing takes. The speed
of homing is measured at the beginning, from two distances, so no setting of the controller enters.

Controllers that home both axes at once (GRBL) end when the farther axis is at its switch, so their time shows only
the axis that drifted farthest away. For these the stage first goes so near the switches that one would close if its
axis had drifted towards it.
"""

import math

from msgspec import Struct

from faintfield.rig.errors import PlanRefused, PositionDrifted, StageError
from faintfield.rig.stages.protocol import AxisIndex, Point, Stage

# Serial adapters hold a short answer back for up to this long.
_JITTER_S = 0.016
_RUN_UP_MM = 10.0


class Drift(Struct, frozen=True):
    """How far the carriages were off their count when the stage was homed again.

    Parameters
    ----------
    away_mm : tuple of float
        Away from the switch is positive: per axis, or one number for both where they home together.
    limit_mm : float
        From where on it counts as drift.
    """

    away_mm: tuple[float, ...]
    limit_mm: float

    @property
    def passed(self) -> bool:
        """Whether no axis has drifted."""
        return all(abs(value) <= self.limit_mm for value in self.away_mm)


class DriftWatch:
    """Remembers what was visited since the stage was last known to be on its scale.

    Parameters
    ----------
    stage : Stage
        A connected stage.
    limit_mm : float
        How much drift to look for.
    """

    def __init__(self, stage: Stage, *, limit_mm: float = 0.5) -> None:
        self._stage = stage
        self._limit_mm = limit_mm
        self._unchecked: list[object] = []
        self._doubtful: list[object] = []
        self._home = Point(math.nan, math.nan)
        self._taken_s: dict[AxisIndex | None, float] = {}
        self._speed_mm_per_s: dict[AxisIndex | None, float] = {}

    @property
    def unchecked(self) -> tuple[object, ...]:
        """What was visited since the last good check, and will be vouched for or not by the next."""
        return tuple(self._unchecked)

    @property
    def doubtful(self) -> tuple[object, ...]:
        """What was visited before a check that failed, or was never checked before the scale was set anew."""
        return tuple(self._doubtful)

    def visited(self, what: object) -> None:
        """Note that `what` (a node, a frame) relies on the stage being on its scale."""
        self._unchecked.append(what)

    def begin(self) -> None:
        """Home, and learn how long homing takes from known distances; begin again whenever the stage was homed.

        Homing sets the scale anew: what was visited before and not checked can be checked no more, and is doubtful.

        Raises
        ------
        PlanRefused
            Drift of the limit cannot be told from the jitter of the clock, or not at all.
        PositionDrifted
            Homing does not take as long twice.
        """
        self._doubt()
        self._speed_mm_per_s.clear()
        self._home = self._stage.home().position.point
        if self._stage.identify().homes_together and self._stage.identify().pull_off_mm <= self._limit_mm:
            raise PlanRefused(
                f"drift limit {self._limit_mm:g} mm, but homing pulls off the switches by only "
                f"{self._stage.identify().pull_off_mm:g} mm; pull off farther ($27) or lower the limit"
            )
        for axis in self._homings():
            near_s = self._timed(axis, 0.5 * _RUN_UP_MM)
            far_s = self._timed(axis, _RUN_UP_MM)
            self._taken_s[axis] = far_s
            self._speed_mm_per_s[axis] = self._speed(far_s - near_s)
        self.check()  # a disturbance while homing was timed would mislead every later check

    def check(self) -> Drift:
        """Home again; what was visited is on its scale if this returns, and doubtful if it raises.

        Raises
        ------
        PositionDrifted
            With what is suspect. The stage may need `recover` and `home`.
        PlanRefused
            There is nothing to compare with, since `begin` did not end well.
        """
        if set(self._speed_mm_per_s) != set(self._homings()):
            raise PlanRefused("drift cannot be checked: homing was not timed at the beginning; begin the watch first")
        try:
            if self._stage.identify().homes_together:
                self._require_open_switches()
            drift = Drift(
                tuple(
                    (self._timed(axis, _RUN_UP_MM) - self._taken_s[axis]) * self._speed_mm_per_s[axis]
                    for axis in self._homings()
                ),
                self._limit_mm,
            )
        except PositionDrifted:
            raise
        except StageError as failure:
            raise self._drifted(f"the check ended in: {failure}") from failure
        if not drift.passed:
            worst = max(drift.away_mm, key=abs)
            raise self._drifted(f"{worst:+.2f} mm off its scale, more than {self._limit_mm:g} mm")
        self._unchecked.clear()
        return drift

    def _homings(self) -> tuple[AxisIndex | None, ...]:
        """Return the ways to home that have to be timed."""
        return (None,) if self._stage.identify().homes_together else (0, 1)

    def _timed(self, axis: AxisIndex | None, distance_mm: float) -> float:
        """Return how long homing takes from `distance_mm` away from where it ends."""
        self._stage.move_to(*self._inward(distance_mm))
        return self._stage.home(axis).duration_s

    def _inward(self, distance_mm: float) -> Point:
        """Return the point that lies `distance_mm` from where homing ends, along both axes."""
        travel = self._stage.travel()
        return Point(
            *(
                value + distance_mm * (1.0 if value - low < high - value else -1.0)
                for value, (low, high) in zip(self._home, (travel.x_mm, travel.y_mm), strict=True)
            )
        )

    def _require_open_switches(self) -> None:
        """Go as near the switches as the limit, and raise if one is closed there."""
        pull_off = self._stage.identify().pull_off_mm
        self._stage.move_to(*self._inward(self._limit_mm - pull_off))
        if closed := self._stage.switches():
            axes = " and ".join("xy"[axis] for axis in sorted(closed))
            raise self._drifted(f"the switch of {axes} is closed more than {self._limit_mm:g} mm early")

    def _speed(self, difference_s: float) -> float:
        """Return the homing speed from the time that the half run-up takes."""
        if difference_s <= 0.0:
            raise PlanRefused(
                "homing takes as long from near as from far: its time shows no drift; do without the check"
            )
        speed = 0.5 * _RUN_UP_MM / difference_s
        if speed * _JITTER_S > self._limit_mm:
            raise PlanRefused(
                f"homing at {speed:.0f} mm/s resolves {speed * _JITTER_S:.2f} mm and drift of {self._limit_mm:g} mm "
                "is to be found; home more slowly or raise the limit"
            )
        return speed

    def _doubt(self) -> tuple[object, ...]:
        """Count what is unchecked as doubtful, and return it."""
        doubtful, self._unchecked = self.unchecked, []
        self._doubtful.extend(doubtful)
        return doubtful

    def _drifted(self, why: str) -> PositionDrifted:
        """Return the failure that names what is suspect, and count it as doubtful."""
        suspect = self._doubt()
        return PositionDrifted(
            f"the stage has lost its scale: {why}; {len(suspect)} positions since the last good check are suspect: "
            "look for an obstacle or too high an acceleration, home, and take them again",
            suspect=suspect,
        )
