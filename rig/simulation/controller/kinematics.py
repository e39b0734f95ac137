"""Motors, carriages and switches: where the controller believes the stage is, and where it truly is.

The controller counts the steps that it sends (the commanded position). The carriage follows, except for play in the
drive, steps that the motor lost, an axis that is stuck, and the ends of the travel.
"""

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

from faintfield.rig.simulation.controller.clock import ScheduledEvent, SimulatedClock

type Vector = tuple[float, ...]


@dataclass(frozen=True)
class Profile:
    """Speed along a straight line over time: pieces of constant acceleration.

    Parameters
    ----------
    pieces : tuple of (duration_s, initial speed mm/s, acceleration mm/s^2)
        In order.
    """

    pieces: tuple[tuple[float, float, float], ...]

    @classmethod
    def rest_to_rest(cls, length_mm: float, speed: float, acceleration: float) -> "Profile":
        """Speed up, cruise if there is room, slow down."""
        peak = min(speed, math.sqrt(length_mm * acceleration))
        ramp_s = peak / acceleration
        cruise_s = (length_mm - peak * ramp_s) / peak if peak else 0.0
        return cls(((ramp_s, 0.0, acceleration), (cruise_s, peak, 0.0), (ramp_s, peak, -acceleration)))

    @property
    def duration_s(self) -> float:
        """Time from beginning to end."""
        return sum(duration for duration, _, _ in self.pieces)

    def at(self, elapsed_s: float) -> tuple[float, float]:
        """Return the distance gone in mm and the speed in mm/s, `elapsed_s` after the beginning."""
        gone, speed = 0.0, 0.0
        for duration, initial, acceleration in self.pieces:
            spent = min(max(elapsed_s, 0.0), duration)
            gone += initial * spent + 0.5 * acceleration * spent**2
            speed = initial + acceleration * spent
            elapsed_s -= duration
            if elapsed_s < 0.0:
                break
        return gone, speed


@dataclass(frozen=True)
class Motion:
    """One straight motion, begun at a time."""

    start: Vector
    end: Vector
    profile: Profile
    acceleration: float
    begun_s: float

    def at(self, now_s: float) -> tuple[Vector, float]:
        """Return the commanded position and the speed at `now_s`."""
        length = math.dist(self.start, self.end)
        gone, speed = self.profile.at(now_s - self.begun_s)
        share = min(1.0, gone / length) if length else 1.0
        return tuple(a + share * (b - a) for a, b in zip(self.start, self.end, strict=True)), speed


@dataclass
class Axis:
    """One drive and its carriage, in the coordinates of its switch.

    Parameters
    ----------
    low_mm, high_mm : float
        Ends of the mechanical travel.
    carriage_mm : float
        Where the carriage is.
    play_mm : float
        How far the motor turns before the carriage follows in the other direction.

    Attributes
    ----------
    slip_mm : float
        Carriage less count, play aside: what the controller does not know.
    stuck : bool
        Whether the carriage stays where it is whatever the motor does.
    """

    low_mm: float
    high_mm: float
    carriage_mm: float
    play_mm: float = 0.0
    slip_mm: float = field(init=False)
    stuck: bool = False

    def __post_init__(self) -> None:
        self.slip_mm = self.carriage_mm  # the count begins at zero wherever the carriage was left

    def follow(self, commanded_mm: float) -> float:
        """Let the carriage follow the motor, and return where it comes to stand."""
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
    """The mechanics of a stage with two axes that can be moved and a third that stands.

    Motions are queued and run one after the other, each from rest to rest.

    Parameters
    ----------
    clock : SimulatedClock
        The world's time.
    axes : sequence of Axis
        x and y.
    step_mm : float
        Distance of one motor step.
    switch_mm : (float, float)
        Where the homing switches close; they are at the end of the travel that is nearer.
    """

    clock: SimulatedClock
    axes: tuple[Axis, Axis]
    step_mm: float
    switch_mm: tuple[float, float]
    switch_at_high_end: bool
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
        """Whether motors turn or will without being asked again."""
        return self._motion is not None

    def commanded_mm(self) -> Vector:
        """Return where the controller has counted the stage to."""
        if self._motion is not None:
            self._commanded = self._motion.at(self.clock.now_s())[0]
        return self._commanded

    def true_mm(self) -> Vector:
        """Return where the carriages are."""
        return tuple(axis.follow(value) for axis, value in zip(self.axes, self.commanded_mm(), strict=True))

    def switches(self) -> tuple[bool, ...]:
        """Return whether each axis's homing switch is closed."""
        sign = 1.0 if self.switch_at_high_end else -1.0
        return tuple(sign * (t - s) >= -1e-9 for t, s in zip(self.true_mm(), self.switch_mm, strict=True))

    def set_count(self, position: Sequence[float]) -> None:
        """Let the controller call its present place `position`; the carriage stays."""
        for axis, old, new in zip(self.axes, self.commanded_mm(), position, strict=True):
            axis.slip_mm += old - new
        self._commanded = tuple(position)

    def queue(self, target: Sequence[float], speed: float, acceleration: float) -> None:
        """Go to `target`, rounded to steps, after what is queued already."""
        rounded = tuple(round(value / self.step_mm) * self.step_mm for value in target)
        self._queue.append((rounded, speed, acceleration))
        if self._motion is None:
            self._start_next()

    def planned_mm(self) -> Vector:
        """Return where the stage will be when all that is queued is done."""
        if self._queue:
            return self._queue[-1][0]
        return self._motion.end if self._motion is not None else self._commanded

    def queued(self) -> int:
        """Return how many motions are under way or waiting."""
        return len(self._queue) + (self._motion is not None)

    def brake(self) -> None:
        """Drop what is queued and slow down at the motion's own acceleration; then `on_idle`."""
        self._queue.clear()
        if self._motion is None:
            return
        motion, (here, speed) = self._motion, self._motion.at(self.clock.now_s())
        remaining = math.dist(here, motion.end)
        if speed == 0.0 or remaining == 0.0:
            return
        stopping_s = speed / motion.acceleration
        share = min(1.0, 0.5 * speed * stopping_s / remaining)
        end = tuple(
            round((a + share * (b - a)) / self.step_mm) * self.step_mm for a, b in zip(here, motion.end, strict=True)
        )
        profile = Profile(((stopping_s, speed, -motion.acceleration),))
        self._begin(Motion(here, end, profile, motion.acceleration, self.clock.now_s()))

    def stop_dead(self) -> None:
        """Cut the motion off, as a reset does."""
        self.true_mm()
        self._queue.clear()
        self._end_motion()

    def homing_distances_mm(self) -> Vector:
        """Return how far each carriage is from its switch."""
        return tuple(abs(s - t) for s, t in zip(self.switch_mm, self.true_mm(), strict=True))

    def set_homed(self, axis: int, position_mm: float, carriage_mm: float) -> None:
        """Let one axis stand at `carriage_mm` and be counted as `position_mm`, as homing leaves it."""
        self.axes[axis].carriage_mm = carriage_mm
        self.axes[axis].slip_mm = carriage_mm - position_mm
        values = list(self._commanded)
        values[axis] = position_mm
        self._commanded = tuple(values)

    def _start_next(self) -> None:
        """Begin the next motion that is queued."""
        target, speed, acceleration = self._queue.pop(0)
        length = math.dist(self._commanded, target)
        profile = Profile.rest_to_rest(length, speed, acceleration) if length else Profile(())
        self._begin(Motion(self._commanded, target, profile, acceleration, self.clock.now_s()))

    def _begin(self, motion: Motion) -> None:
        """Put the end of `motion`, and the moment it runs into a switch, on the agenda."""
        self._end_motion()
        self._motion = motion
        duration_s = motion.profile.duration_s
        self._events = [] if self.endless else [self.clock.after(duration_s, self._finish)]
        open_now = not any(self.switches())
        hit_s = self._first_contact_s(motion) if open_now else None
        if hit_s is not None:
            self._events.append(self.clock.after(hit_s, self.on_switch))

    def _first_contact_s(self, motion: Motion) -> float | None:
        """Return after how long a switch closes in `motion`, None when none does."""
        duration_s = motion.profile.duration_s
        if not self._contact_at(motion.end):
            return None
        low, high = 0.0, duration_s
        for _ in range(40):
            middle = 0.5 * (low + high)
            here = motion.at(motion.begun_s + middle)[0]
            low, high = (low, middle) if self._contact_at(here) else (middle, high)
        return high

    def _contact_at(self, commanded: Vector) -> bool:
        """Return whether a switch would be closed with the motors at `commanded`."""
        sign = 1.0 if self.switch_at_high_end else -1.0
        return any(
            not axis.stuck and sign * (value + axis.slip_mm - switch) >= -1e-9
            for axis, value, switch in zip(self.axes, commanded, self.switch_mm, strict=True)
        )

    def _finish(self) -> None:
        """End the motion that is due, and begin the next or fall idle."""
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
        """Leave the present motion where it is."""
        self._commanded = self.commanded_mm()
        self._motion = None
        for event in self._events:
            event.cancel()
        self._events = []


def along(limits: Sequence[float], start: Sequence[float], target: Sequence[float]) -> float:
    """Return the largest rate on the way from `start` to `target` that keeps each axis within its limit."""
    length = math.dist(start, target)
    ways = zip(limits, start, target, strict=True)
    return min((limit * length / abs(b - a) for limit, a, b in ways if a != b), default=limits[0])
