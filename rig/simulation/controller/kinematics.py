"""Simulates time, motors, carriages and switches: the commanded and the true position of the stage.

The controller counts the steps that it sends (the commanded position). The carriage follows, except for play in the
drive, lost steps, an axis that is stuck, and the ends of the travel.
"""

import heapq
import itertools
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

type Vector = tuple[float, ...]


@dataclass(order=True)
class ScheduledEvent:
    """An action at a future time, unless it is cancelled."""

    at_s: float
    order: int
    action: Callable[[], None] = field(compare=False)
    cancelled: bool = field(default=False, compare=False)

    def cancel(self) -> None:
        """Prevent the action."""
        self.cancelled = True


class SimulatedClock:
    """A `Clock` that runs scheduled events; waiting runs those that are due, in order and each at its own time.

    Time does not pass otherwise, so a simulation gives the same result on any computer, however busy.
    """

    def __init__(self) -> None:
        self._now_s = 0.0
        self._events: list[ScheduledEvent] = []
        self._order = itertools.count()

    def now_s(self) -> float:
        """Return the simulated time in seconds since the clock was made."""
        return self._now_s

    def sleep_s(self, duration_s: float) -> None:
        """Advance by `duration_s` simulated seconds."""
        deadline_s = self._now_s + duration_s
        while self.step(deadline_s):
            pass

    def after(self, delay_s: float, action: Callable[[], None]) -> ScheduledEvent:
        """Schedule `action` after `delay_s`."""
        event = ScheduledEvent(self._now_s + max(0.0, delay_s), next(self._order), action)
        heapq.heappush(self._events, event)
        return event

    def step(self, until_s: float) -> bool:
        """Run the next event up to `until_s`; if there is none, advance to `until_s` and return False."""
        next_s = self.next_event_s()
        if next_s is None or next_s > until_s:
            self._now_s = max(self._now_s, until_s)
            return False
        self._now_s = max(self._now_s, next_s)
        heapq.heappop(self._events).action()
        return True

    def next_event_s(self) -> float | None:
        """Return the time of the next event, None if there is none."""
        while self._events and self._events[0].cancelled:
            heapq.heappop(self._events)
        return self._events[0].at_s if self._events else None


@dataclass(frozen=True)
class Profile:
    """Speed along a straight line over time: pieces of duration (s), initial speed (mm/s) and acceleration (mm/s²)."""

    pieces: tuple[tuple[float, float, float], ...]

    @classmethod
    def rest_to_rest(cls, length_mm: float, speed: float, acceleration: float) -> "Profile":
        """Return the profile that accelerates, cruises if the line is long enough, and decelerates."""
        peak = min(speed, math.sqrt(length_mm * acceleration))
        ramp_s = peak / acceleration
        cruise_s = (length_mm - peak * ramp_s) / peak if peak else 0.0
        return cls(((ramp_s, 0.0, acceleration), (cruise_s, peak, 0.0), (ramp_s, peak, -acceleration)))

    @property
    def duration_s(self) -> float:
        """Time from start to end."""
        return sum(duration for duration, _, _ in self.pieces)

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Return the distance covered in mm and the speed in mm/s, `elapsed_s` after the start."""
        covered, speed = 0.0, 0.0
        for duration, initial, acceleration in self.pieces:
            spent = min(max(elapsed_s, 0.0), duration)
            covered += initial * spent + 0.5 * acceleration * spent**2
            speed = initial + acceleration * spent
            elapsed_s -= duration
            if elapsed_s < 0.0:
                break
        return covered, speed


@dataclass(frozen=True)
class Motion:
    """A straight motion that began at `begun_s`."""

    start: Vector
    end: Vector
    profile: Profile
    acceleration: float
    begun_s: float

    def at(self, now_s: float) -> tuple[Vector, float]:
        """Return the commanded position and the speed at `now_s`."""
        length = math.dist(self.start, self.end)
        covered, speed = self.profile.at(now_s - self.begun_s)
        return interpolate(self.start, self.end, min(1.0, covered / length) if length else 1.0), speed


def interpolate(start: Vector, end: Vector, share: float) -> Vector:
    """Return the point at a share of the way from `start` to `end`."""
    return tuple(a + share * (b - a) for a, b in zip(start, end, strict=True))


@dataclass
class Axis:
    """One drive and its carriage, between two ends of the travel, in coordinates whose origin is at the switch.

    The motor turns by `play_mm` after a reversal before the carriage follows; if the axis is stuck, it does not.
    `slip_mm` is the position of the carriage minus the count, without play, which the controller does not know.
    """

    low_mm: float
    high_mm: float
    carriage_mm: float
    play_mm: float = 0.0
    slip_mm: float = field(init=False)
    stuck: bool = False

    def __post_init__(self) -> None:
        self.slip_mm = self.carriage_mm  # the count starts at zero, wherever the carriage is

    def follow(self, commanded_mm: float) -> float:
        """Move the carriage after the motor, and return its position."""
        if self.stuck:
            self.slip_mm = self.carriage_mm - commanded_mm
            return self.carriage_mm
        driven = commanded_mm + self.slip_mm
        position = min(max(self.carriage_mm, driven), driven + self.play_mm)
        self.carriage_mm = min(max(position, self.low_mm), self.high_mm)
        self.slip_mm += self.carriage_mm - position
        return self.carriage_mm


@dataclass
class Mechanics:
    """The mechanics of a stage with two axes, whose motions are queued and run one by one, each from rest to rest.

    `switch_sign` is 1 if the homing switches, which close at 0 mm, are at the upper ends of the travel, −1 if at the
    lower ends. `on_idle` is called when the last motion ends, `on_switch` when a motion closes a switch. With the fault
    `endless`, motions never end.
    """

    clock: SimulatedClock
    axes: tuple[Axis, Axis]
    step_mm: float
    switch_sign: float
    on_idle: Callable[[], None] = lambda: None
    on_switch: Callable[[], None] = lambda: None
    endless: bool = False
    still_since_s: float = -math.inf
    _commanded: Vector = (0.0, 0.0)
    _queue: list[tuple[Vector, float, float]] = field(default_factory=list)
    _motion: Motion | None = None
    _events: list[ScheduledEvent] = field(default_factory=list)

    @property
    def moving(self) -> bool:
        """Return whether a motion is under way or queued."""
        return self._motion is not None

    def commanded_mm(self) -> Vector:
        """Return the position that the controller has counted."""
        if self._motion is not None:
            self._commanded = self._motion.at(self.clock.now_s())[0]
        return self._commanded

    def true_mm(self) -> Vector:
        """Return the true position of the carriages."""
        return tuple(axis.follow(value) for axis, value in zip(self.axes, self.commanded_mm(), strict=True))

    def switches(self) -> tuple[bool, ...]:
        """Return whether each axis's homing switch is closed."""
        return tuple(self.switch_sign * position >= -1e-9 for position in self.true_mm())

    def set_count(self, position: Sequence[float]) -> None:
        """Set the controller's count to `position` without moving."""
        for axis, old, new in zip(self.axes, self.commanded_mm(), position, strict=True):
            axis.slip_mm += old - new
        self._commanded = tuple(position)

    def queue(self, target: Sequence[float], speed: float, acceleration: float) -> None:
        """Queue a motion to `target`, rounded to steps."""
        self._queue.append((self._whole_steps(target), speed, acceleration))
        if self._motion is None:
            self._start_next()

    def planned_mm(self) -> Vector:
        """Return the commanded position after all queued motions."""
        if self._queue:
            return self._queue[-1][0]
        return self._motion.end if self._motion is not None else self._commanded

    def queued(self) -> int:
        """Return the number of motions under way or waiting."""
        return len(self._queue) + (self._motion is not None)

    def brake(self) -> list[Vector]:
        """Drop the queue, decelerate at the motion's own acceleration, and return the targets ahead."""
        waiting = [target for target, _, _ in self._queue]
        self._queue.clear()
        if self._motion is None:
            return []
        ahead = [self._motion.end, *waiting]
        motion, (here, speed) = self._motion, self._motion.at(self.clock.now_s())
        remaining = math.dist(here, motion.end)
        if speed == 0.0 or remaining == 0.0:
            return ahead
        stopping_s = speed / motion.acceleration
        end = self._whole_steps(interpolate(here, motion.end, min(1.0, 0.5 * speed * stopping_s / remaining)))
        profile = Profile(((stopping_s, speed, -motion.acceleration),))
        self._begin(Motion(here, end, profile, motion.acceleration, self.clock.now_s()))
        return ahead

    def stop_dead(self) -> None:
        """End all motion at once, as a reset does."""
        self.true_mm()
        self._queue.clear()
        self._end_motion()

    def set_homed(self, axis: int, position_mm: float) -> None:
        """Put one carriage at `position_mm`, which its count agrees with, as homing leaves it."""
        self.axes[axis].carriage_mm = position_mm
        self.axes[axis].slip_mm = 0.0
        values = list(self._commanded)
        values[axis] = position_mm
        self._commanded = tuple(values)

    def _whole_steps(self, position: Sequence[float]) -> Vector:
        return tuple(round(value / self.step_mm) * self.step_mm for value in position)

    def _start_next(self) -> None:
        target, speed, acceleration = self._queue.pop(0)
        length = math.dist(self._commanded, target)
        profile = Profile.rest_to_rest(length, speed, acceleration) if length else Profile(())
        self._begin(Motion(self._commanded, target, profile, acceleration, self.clock.now_s()))

    def _begin(self, motion: Motion) -> None:
        self._end_motion()
        self._motion = motion
        self._events = [] if self.endless else [self.clock.after(motion.profile.duration_s, self._finish)]
        if not any(self.switches()) and self._contact_at(motion.end):
            self._events.append(self.clock.after(self._first_contact_s(motion), self.on_switch))

    def _first_contact_s(self, motion: Motion) -> float:
        """Return the time from the start of `motion`, at whose end a switch is closed, until it closes one."""
        low, high = 0.0, motion.profile.duration_s
        for _ in range(40):
            middle = 0.5 * (low + high)
            here = motion.at(motion.begun_s + middle)[0]
            low, high = (low, middle) if self._contact_at(here) else (middle, high)
        return high

    def _contact_at(self, commanded: Vector) -> bool:
        return any(
            not axis.stuck and self.switch_sign * (value + axis.slip_mm) >= -1e-9
            for axis, value in zip(self.axes, commanded, strict=True)
        )

    def _finish(self) -> None:
        assert self._motion is not None
        self._commanded = self._motion.end
        self._motion, self._events = None, []
        self.true_mm()
        if self._queue:
            self._start_next()
        else:
            self.still_since_s = self.clock.now_s()
            self.on_idle()

    def _end_motion(self) -> None:
        self._commanded = self.commanded_mm()
        self._motion = None
        for event in self._events:
            event.cancel()
        self._events = []


def along(limits: Sequence[float], start: Sequence[float], target: Sequence[float]) -> float:
    """Return the highest rate along the line from `start` to `target` that keeps each axis within its limit."""
    length = math.dist(start, target)
    ways = zip(limits, start, target, strict=True)
    return min((limit * length / abs(b - a) for limit, a, b in ways if a != b), default=limits[0])
