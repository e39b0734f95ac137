"""Test what a capture relies on, by moving the stage: limits, speed, arrival, repeatability."""

import math
from collections.abc import Iterator

from msgspec import Struct

from faintfield.rig.errors import DriftUnknown, OutsideTravel, PlanRefused, PositionDrifted
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.motion import path_duration_s
from faintfield.rig.stages.protocol import Point

# Lowest rate of position reports, per second: a capture waits for them; and how many are timed.
_MIN_REPORTS_PER_S, _REPORTS = 4.0, 10


class Check(Struct, frozen=True):
    """The result of one check: the measured value and its limit, with units."""

    name: str
    passed: bool
    measured: str
    limit: str


def check_conformance(stage: Gantry) -> Iterator[Check]:
    """Check a connected stage, and yield each result; the stage homes and moves within the middle 40 % of its travel.

    Raises `StageError` if the stage failed, so that no more checks are possible.
    """
    identity = stage.identify()
    warnings = "; ".join(identity.warnings)
    yield Check("settings", not warnings, warnings or "nothing to change", "nothing to change")
    bound_s, homing_s = identity.homing_bound_s / 1.5, stage.home().duration_s
    yield Check("homing", homing_s < bound_s, f"{homing_s:.1f} s", f"< {bound_s:.0f} s")
    yield _limits(stage)
    yield _speed(stage)
    yield _arrival(stage)
    yield _report_rate(stage)
    if identity.has_switches:
        yield _repeatability(stage)


def _limits(stage: Gantry) -> Check:
    """Check that a position outside the travel is refused, and nothing moves."""
    travel, before = stage.travel(), stage.position()
    try:
        stage.move_to(travel.x_mm[1] + 10.0, travel.y_mm[1] + 10.0)
    except OutsideTravel:
        stayed = stage.verify_at(*before.point) == before
        return Check("limits", stayed, "refused, nothing moved" if stayed else "refused, but moved", "refused")
    return Check("limits", False, "went outside the travel", "refused")


def _speed(stage: Gantry) -> Check:
    """Check that a long motion takes the time that the controller's settings predict."""
    low, high = _corners(stage)
    stage.move_to(*low)
    predicted_s = path_duration_s((low, high), stage.identify().motion, stage.feed_mm_per_s())
    started_s = stage.clock.now_s()
    stage.move_to(*high)
    taken_s = stage.clock.now_s() - started_s
    limit_s = 1.25 * predicted_s + 0.5
    measured = f"{math.dist(low, high):.0f} mm in {taken_s:.2f} s"
    return Check("speed", taken_s <= limit_s, measured, f"<= {limit_s:.2f} s")


def _arrival(stage: Gantry) -> Check:
    """Check that a position is reached equally from all sides."""
    low, high = _corners(stage)
    middle = Point(0.5 * (low.x_mm + high.x_mm), 0.5 * (low.y_mm + high.y_mm))
    reports = []
    for corner in (low, high, Point(low.x_mm, high.y_mm), Point(high.x_mm, low.y_mm)):
        stage.move_to(*corner)
        reports.append(stage.move_to(*middle).point)
    spread_mm = max(math.dist(a, b) for a in reports for b in reports)
    limit_mm = max(stage.identify().tolerance_mm)
    return Check("arrival", spread_mm <= limit_mm, f"{spread_mm:.4f} mm spread", f"<= {limit_mm:.4f} mm")


def _report_rate(stage: Gantry) -> Check:
    started_s = stage.clock.now_s()
    for _ in range(_REPORTS):
        stage.position()
    rate = _REPORTS / (stage.clock.now_s() - started_s)
    return Check("report rate", rate >= _MIN_REPORTS_PER_S, f"{rate:.1f} /s", f">= {_MIN_REPORTS_PER_S:.0f} /s")


def _repeatability(stage: Gantry) -> Check:
    """Check by homing again that moving away from the switches and back loses no steps."""
    watch = DriftWatch(stage)
    try:
        watch.begin()
        for corner in _corners(stage):
            watch.unchecked.append(stage.move_to(*corner))
        drift = watch.check()
    except (PositionDrifted, DriftUnknown, PlanRefused) as failure:
        return Check("repeatability", False, str(failure), "no drift")
    worst_mm = max(map(abs, drift.away_mm))
    return Check("repeatability", True, f"{worst_mm:.2f} mm", f"<= {drift.limit_mm:g} mm")


def _corners(stage: Gantry) -> tuple[Point, Point]:
    """Return the lower and the upper corner of the middle 40 % of the travel."""
    (x0, x1), (y0, y1) = stage.travel().x_mm, stage.travel().y_mm
    low, high = (Point(x0 + share * (x1 - x0), y0 + share * (y1 - y0)) for share in (0.3, 0.7))
    return low, high
