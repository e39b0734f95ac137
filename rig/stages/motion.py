"""Paths of the stage: how long they take, arrival from one side, and checks against travel and keep-out boxes."""

import math
from collections.abc import Sequence
from functools import lru_cache
from itertools import pairwise

from msgspec import Struct

from faintfield.rig.errors import KeepOutCrossed, OutsideTravel
from faintfield.rig.stages.protocol import Box, MotionLimits, Point


def duration_s(start: Point, end: Point, motion: MotionLimits, feed_mm_per_s: float = math.inf) -> float:
    """Return the duration of a straight motion from rest to rest; `feed_mm_per_s` is the requested speed.

    The speed along the line is the highest that keeps every axis within its own rate, likewise the acceleration. A
    motion of length d at speed v and acceleration a takes d/v + v/a, or 2 sqrt(d/a) when it is too short to reach v.
    """
    length_mm = math.dist(start, end)
    if length_mm == 0.0:
        return 0.0
    direction = [abs(b - a) / length_mm for a, b in zip(start, end, strict=True)]
    speed = min(feed_mm_per_s, _along(direction, motion.rate_mm_per_s))
    acceleration = _along(direction, motion.acceleration_mm_per_s2)
    if length_mm < speed**2 / acceleration:
        return 2.0 * math.sqrt(length_mm / acceleration)
    return length_mm / speed + speed / acceleration


def path_duration_s(path: Sequence[Point], motion: MotionLimits, feed_mm_per_s: float = math.inf) -> float:
    """Return the duration of `path` with a stop at each of its points."""
    return sum(duration_s(start, end, motion, feed_mm_per_s) for start, end in pairwise(path))


def one_sided_path(start: Point, target: Point, approach_mm: float) -> tuple[Point, ...]:
    """Return a path to `target` on which every axis arrives upwards: `target`, perhaps after a turning point.

    Screws and belts have play: the carriage stops at a different place when it arrives from the other side. An axis
    that would arrive from above first goes `approach_mm` past its target and then back up.
    """
    turn = Point(*(b - approach_mm if b < a else b for a, b in zip(start, target, strict=True)))
    return (target,) if turn == target else (turn, target)


@lru_cache(maxsize=4096)  # the time to go is predicted before every frame, over all that are left
def one_sided_duration_s(
    start: Point, target: Point, approach_mm: float, motion: MotionLimits, feed_mm_per_s: float = math.inf
) -> float:
    """Return the duration of the path of `one_sided_path`."""
    return path_duration_s((start, *one_sided_path(start, target, approach_mm)), motion, feed_mm_per_s)


def timeout_s(predicted_s: float) -> float:
    """Return how long to wait for what should take `predicted_s` until it counts as failed."""
    return 1.5 * predicted_s + 2.0


def _along(direction: Sequence[float], limits: tuple[float, float]) -> float:
    """Return the largest rate along `direction` that keeps each axis within its limit."""
    return min(limit / share for limit, share in zip(limits, direction, strict=True) if share > 0.0)


# Tolerance in mm: positions computed from a pitch miss the edge that they should touch by rounding errors.
_ROUNDING_MM = 1e-6


class StageWorkspace(Struct, frozen=True):
    """Positions that the stage may take.

    Attributes
    ----------
    travel_mm : Box
        Travel of the stage.
    keep_out : tuple of Box
        Boxes that the stage must neither enter nor cross.
    """

    travel_mm: Box
    keep_out: tuple[Box, ...] = ()

    def check_path(self, path: Sequence[Point]) -> None:
        """Raise `OutsideTravel` or `KeepOutCrossed` for the first bad position or straight segment of a path."""
        for point in path:
            if not self.travel_mm.holds(point, _ROUNDING_MM):
                raise OutsideTravel(
                    f"position {point} is outside the travel {self.travel_mm}; choose one inside, or move the grid"
                )
        for start, end in pairwise(path):
            for box in self.keep_out:
                if segment_meets(box, start, end):
                    raise KeepOutCrossed(
                        f"the way from {start} to {end} meets the keep-out box {box}; change path or box"
                    )


def segment_meets(box: Box, start: Point, end: Point) -> bool:
    """Return whether the straight line from `start` to `end` touches `box`.

    The parameter of the segment is clipped against each pair of edges in turn (Liang and Barsky, 1984).
    """
    enter, leave = 0.0, 1.0
    for a, b, (low, high) in zip(start, end, (box.x_mm, box.y_mm), strict=True):
        if a == b:
            if not low <= a <= high:
                return False
            continue
        first, last = sorted(((low - a) / (b - a), (high - a) / (b - a)))
        enter, leave = max(enter, first), min(leave, last)
    return enter <= leave
