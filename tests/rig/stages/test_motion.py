"""Durations of motions, one-sided paths, and allowed positions."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from faintfield.rig.errors import KeepOutCrossed, OutsideTravel
from faintfield.rig.simulation.controller.kinematics import Profile
from faintfield.rig.stages.motion import (
    StageWorkspace,
    duration_s,
    one_sided_path,
    path_duration_s,
    segment_meets,
    timeout_s,
)
from faintfield.rig.stages.protocol import Box, MotionLimits, Point, Position

LIMITS = MotionLimits((100.0, 50.0), (500.0, 200.0))
coordinates = st.floats(-300.0, 300.0).map(lambda value: round(value, 3))
points = st.builds(Point, coordinates, coordinates)


def test_long_and_a_short_motion() -> None:
    start = Point(0.0, 0.0)
    assert duration_s(start, Point(50.0, 0.0), LIMITS) == pytest.approx(0.7)
    assert duration_s(start, Point(0.0, 2.0), LIMITS) == pytest.approx(0.2)
    assert duration_s(start, Point(50.0, 0.0), LIMITS, feed_mm_per_s=10.0) == pytest.approx(5.02)
    assert duration_s(start, start, LIMITS) == 0.0
    assert timeout_s(10.0) == 17.0


@settings(deadline=None, max_examples=25)
@given(st.floats(0.01, 500.0), st.floats(1.0, 200.0), st.floats(10.0, 2000.0))
def test_simulated_carriage_takes_as_long_as_predicted(length: float, speed: float, acceleration: float) -> None:
    profile = Profile.rest_to_rest(length, speed, acceleration)
    limits = MotionLimits((speed, speed), (acceleration, acceleration))
    assert duration_s(Point(0.0, 0.0), Point(length, 0.0), limits) == pytest.approx(profile.duration_s)
    times = np.linspace(0.0, profile.duration_s, 2001)
    gone_mm, speeds = np.array([profile.at(time)[:2] for time in times]).T
    assert gone_mm[-1] == pytest.approx(length)
    assert speeds.max() <= speed * (1.0 + 1e-9)
    assert np.abs(np.diff(speeds)).max() <= acceleration * times[1] * (1.0 + 1e-6)
    assert np.trapezoid(speeds, times) == pytest.approx(length, rel=1e-3)


@given(points, points, st.floats(0.1, 5.0))
def test_no_axis_arrives_downwards(start: Point, target: Point, approach_mm: float) -> None:
    path = (start, *one_sided_path(start, target, approach_mm))
    assert path[-1] == target
    assert len(path) <= 3
    before = path[-2]
    assert before.x_mm <= target.x_mm
    assert before.y_mm <= target.y_mm
    assert path_duration_s(path, LIMITS) >= duration_s(start, target, LIMITS) - 1e-9


@settings(deadline=None, max_examples=25)
@given(points, points, points, st.floats(1.0, 200.0), st.floats(1.0, 200.0))
def test_segment_meets_a_box_that_holds_its_sample(
    start: Point, end: Point, corner: Point, width: float, height: float
) -> None:
    box = Box((corner.x_mm, corner.x_mm + width), (corner.y_mm, corner.y_mm + height))
    shares = np.linspace(0.0, 1.0, 501)
    samples = [Point(*(a + share * (b - a) for a, b in zip(start, end, strict=True))) for share in shares]
    if any(box.holds(sample) for sample in samples):
        assert segment_meets(box, start, end)
    spacing = math.dist(start, end) / 500.0
    if not any(box.holds(sample, spacing) for sample in samples):
        assert not segment_meets(box, start, end)


def test_path_outside_travel_or_through_keep_out() -> None:
    workspace = StageWorkspace(Box((0.0, 400.0), (0.0, 400.0)), (Box((100.0, 120.0), (100.0, 120.0)),))
    workspace.check_path([Point(0.0, 0.0), Point(400.0, 0.0), Point(400.0 + 1e-9, 400.0)])
    with pytest.raises(OutsideTravel, match=r"\(401\.000, 0\.000\) mm is outside the travel \[0, 400\]"):
        workspace.check_path([Point(0.0, 0.0), Point(401.0, 0.0)])
    with pytest.raises(KeepOutCrossed, match=r"way from .* meets the keep-out"):
        workspace.check_path([Point(0.0, 0.0), Point(200.0, 200.0)])
    workspace.check_path([Point(0.0, 0.0), Point(0.0, 200.0), Point(200.0, 200.0)])


def test_only_axes_that_arrive_downwards_turn() -> None:
    start = Point(0.0, 0.0)
    assert one_sided_path(start, Point(-5.0, 3.0), 2.0) == (Point(-7.0, 3.0), Point(-5.0, 3.0))
    assert one_sided_path(start, Point(0.0, 3.0), 2.0) == (Point(0.0, 3.0),)


def test_segment_that_touches_a_box_meets_it() -> None:
    box = Box((5.0, 15.0), (10.0, 20.0))
    for start, end, beside in (
        (Point(0.0, 10.0), Point(5.0, 10.0), Point(-0.001, 0.0)),  # ends on an edge
        (Point(0.0, 20.0), Point(30.0, 20.0), Point(0.0, 0.001)),  # along an edge
        (Point(0.0, 15.0), Point(10.0, 5.0), Point(0.0, -0.001)),  # touches a corner
        (Point(7.0, 10.0), Point(7.0, 10.0), Point(0.0, -0.001)),  # stands on an edge
    ):
        moved = [Point(x + beside.x_mm, y + beside.y_mm) for x, y in (start, end)]
        assert segment_meets(box, start, end)
        assert segment_meets(box, end, start)
        assert not segment_meets(box, *moved)


def test_rounding_keeps_a_position_inside_the_travel() -> None:
    workspace = StageWorkspace(Box((0.0, 0.3), (0.0, 0.3)))
    workspace.check_path([Point(0.1 + 0.2, 3 * 0.1), Point(0.3 + 9e-7, -9e-7)])
    with pytest.raises(OutsideTravel):
        workspace.check_path([Point(0.3 + 2e-6, 0.0)])


def test_trusted_position_is_at_target_within_tolerance() -> None:
    target = Point(0.0, 0.0)
    assert Position(Point(0.25, -0.5), (0.25, 0.5), trusted=True).is_at(target)
    assert not Position(Point(0.25, -0.5), (0.25, 0.5), trusted=False).is_at(target)
    assert not Position(Point(0.26, 0.0), (0.25, 0.5), trusted=True).is_at(target)
    assert not Position(Point(0.0, -0.51), (0.25, 0.5), trusted=True).is_at(target)


def test_boxes() -> None:
    for ends in ((1.0, 0.0), (1.0, 1.0)):
        for box in ((ends, (0.0, 1.0)), ((0.0, 1.0), ends)):
            with pytest.raises(ValueError, match="swap its ends"):
                Box(*box)
    assert Box((0.0, 2.0), (0.0, 2.0)).intersection(Box((1.0, 3.0), (-1.0, 1.0))) == Box((1.0, 2.0), (0.0, 1.0))
