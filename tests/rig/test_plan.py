"""The plan of a capture: order, times, room on disk, and what is refused before anything moves."""

import math
from itertools import pairwise
from typing import Any

import msgspec
import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.errors import KeepOutCrossed, OutsideTravel
from faintfield.rig.plan import MAX_FRAMES, CapturePlan, CaptureStep, Grid, Until, centre_node, planned_frames
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.motion import StageWorkspace
from faintfield.rig.stages.protocol import Box, MotionLimits, Point

GRID = Grid(7, 7, 50.0, Point(10.0, 10.0))
STEPS = (
    CaptureStep("charuco", (0.1,)),
    CaptureStep("dark_scene", (0.1,)),
    CaptureStep("dark", (0.1, 0.2), frames_per_node=20, at="centre"),
)
TRAVEL = Box((0.0, 400.0), (0.0, 400.0))
MOTION = MotionLimits((100.0, 100.0), (500.0, 500.0))


def plan_of(grid: Grid = GRID, steps: tuple[CaptureStep, ...] = STEPS) -> CapturePlan:
    return CapturePlan.of(grid, steps, approach_mm=2.0, frame_bytes=24_000_000, settle_s=0.5, readout_s=0.4)


@given(st.integers(1, 9), st.integers(1, 9), st.sampled_from(["serpentine", "raster"]))
def test_every_node_is_visited_once(rows: int, columns: int, order: str) -> None:
    grid = Grid(rows, columns, 10.0, Point(0.0, 0.0), msgspec.convert(order, type(GRID).__annotations__["order"]))
    stops = grid.stops()
    assert sorted(stop.node for stop in stops) == [(r, c) for r in range(rows) for c in range(columns)]
    assert all(stop.target == (10.0 * stop.node[1], 10.0 * stop.node[0]) for stop in stops)


def test_serpentine_turns_and_raster_does_not() -> None:
    serpentine = [stop.node for stop in Grid(2, 3, 1.0, Point(0.0, 0.0)).stops()]
    raster = [stop.node for stop in Grid(2, 3, 1.0, Point(0.0, 0.0), "raster").stops()]
    assert serpentine == [(0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 0)]
    assert raster == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 1), (1, 2)]
    assert Grid(7, 7, 50.0, Point(0.0, 0.0)).centre().node == (3, 3)
    assert Grid(2, 4, 50.0, Point(0.0, 0.0)).centre().node == (1, 2) == centre_node(2, 4)


def test_too_many_frames_are_refused_unlisted() -> None:
    with pytest.raises(ValueError, match="10000000000 nodes, at most 100000 are possible; take fewer"):
        Grid(100_000, 100_000, 1.0, Point(0.0, 0.0))
    grid = Grid(100, 100, 1.0, Point(0.0, 0.0))
    assert plan_of(grid, (CaptureStep("flat", (0.1,), 10),)).frame_count() == MAX_FRAMES
    for frames_per_node in (11, 10**12):
        with pytest.raises(ValueError, match=f"the plan has {frames_per_node}0000 frames, at most 100000 are possible"):
            plan_of(grid, (CaptureStep("flat", (0.1,), frames_per_node),))


@pytest.mark.parametrize("exposures_s", [(0.1, -1.0), (0.1, math.nan), (0.1, 1e6), ()])
def test_impossible_exposure_times_are_refused(exposures_s: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="exposure"):
        CaptureStep("flat", exposures_s)


@pytest.mark.parametrize("impossible", [{"size_px": (200_000, 200_000)}, {"saturation_dn": 2**16}])
def test_impossible_simulated_cameras_are_refused(impossible: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"camera.*; "):
        SimulatedSettings(**impossible)


def test_frames_follow_the_plan() -> None:
    plan = plan_of(Grid(2, 3, 50.0, Point(0.0, 0.0)), (STEPS[1], CaptureStep("dark", (0.1, 1.0), 2, at="centre")))
    frames = planned_frames(plan)
    assert [frame.number for frame in frames] == list(range(plan.frame_count()))
    assert [(frame.kind, frame.stop.node) for frame in frames[:6]] == [
        ("dark_scene", node) for node in [(0, 0), (0, 1), (0, 2), (1, 2), (1, 1), (1, 0)]
    ]
    assert [(frame.exposure_s, frame.repeat) for frame in frames[-4:]] == [(0.1, 0), (0.1, 1), (1.0, 0), (1.0, 1)]
    assert len({frame.name for frame in frames}) == len(frames)


def test_rounds_repeat_grid_after_grid() -> None:
    until = CaptureStep("dark_scene", (0.1,), 2, until=Until(0.1, 3))
    grid = Grid(1, 2, 50.0, Point(0.0, 0.0))
    once, plan = plan_of(grid, (replace(until, until=None),)), plan_of(grid, (until,))
    frames = planned_frames(plan)
    assert plan.frame_count() == len(frames) == 3 * once.frame_count() == 12
    assert [(frame.round, frame.stop.node[1], frame.repeat) for frame in frames] == [
        (number, column, 2 * number + repeat) for number in range(3) for column in range(2) for repeat in range(2)
    ]
    assert len({frame.name for frame in frames}) == len(frames)
    assert [point for point in plan.path() if point in {stop.target for stop in grid.stops()}] == 3 * [
        stop.target for stop in grid.stops()
    ]


@pytest.mark.parametrize(
    ("kind", "at", "sigma_e", "rounds", "message"),
    [
        ("bright", "grid", 0.1, 2, "until in a bright step"),
        ("dark_scene", "centre", 0.1, 2, "until in a dark_scene step at the centre"),
        ("dark_scene", "grid", 0.0, 2, r"until\.sigma_e = 0; a noise"),
        ("dark_scene", "grid", 0.1, 0, r"until\.at_most_rounds = 0; give 1 to"),
    ],
)
def test_impossible_rounds_are_refused(kind: Any, at: Any, sigma_e: float, rounds: int, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        CaptureStep(kind, (0.1,), at=at, until=Until(sigma_e, rounds))


def test_frames_and_disk_space() -> None:
    plan = plan_of()
    assert plan.frame_count() == 49 + 49 + 40
    assert plan.disk_bytes() == plan.frame_count() * 24_000_000


def test_path_reaches_every_stop_from_below() -> None:
    path = plan_of().path()
    targets = [stop.target for stop in (*GRID.stops(), *GRID.stops(), GRID.centre())]
    remaining = iter(path)
    assert all(target in remaining for target in targets), "in order"
    for before, after in pairwise(path):
        if after in targets:
            assert before.x_mm <= after.x_mm
            assert before.y_mm <= after.y_mm


def test_plan_outside_or_through_keep_out_is_refused() -> None:
    StageWorkspace(TRAVEL).check_path(plan_of().path())
    with pytest.raises(OutsideTravel):
        StageWorkspace(Box((0.0, 300.0), (0.0, 400.0))).check_path(plan_of().path())
    with pytest.raises(OutsideTravel):  # a node at the edge leaves no room to come from below
        StageWorkspace(TRAVEL).check_path(plan_of(Grid(7, 7, 50.0, Point(0.0, 0.0))).path())
    with pytest.raises(KeepOutCrossed):
        StageWorkspace(TRAVEL, (Box((30.0, 35.0), (5.0, 15.0)),)).check_path(plan_of().path())


@pytest.mark.parametrize(("controller", "origin"), [(SimulatedGrbl, -350.0), (SimulatedMarlin, 10.0)])
def test_predicted_time_is_the_time_taken(
    controller: type[SimulatedGrbl] | type[SimulatedMarlin], origin: float
) -> None:
    bench = Bench(controller)
    stage = bench.stage()
    stage.connect()
    stage.home()
    plan = plan_of(Grid(7, 7, 50.0, Point(origin, origin)), (CaptureStep("dark_scene", (0.1,)),))
    stage.workspace().check_path(plan.path())
    stage.move_to(*plan.stops[0].target)
    predicted_s = plan.duration_s(stage.identify().motion, stage.feed_mm_per_s())
    started_s = bench.clock.now_s()
    for stop in plan.stops:
        stage.move_to(*stop.target)
        bench.clock.sleep_s(plan.settle_s + 0.1 + plan.readout_s)
    assert bench.clock.now_s() - started_s == pytest.approx(predicted_s, rel=0.15)


def test_plan_survives_a_file() -> None:
    plan = plan_of()
    assert msgspec.json.decode(msgspec.json.encode(plan), type=CapturePlan) == plan
    with pytest.raises(msgspec.ValidationError, match="unknown field"):
        msgspec.json.decode(b'{"rows":1,"columns":1,"pitch_mm":1,"origin_mm":[0,0],"pich":2}', type=Grid)
    with pytest.raises(ValueError, match="at least one row"):
        Grid(0, 7, 50.0, Point(0.0, 0.0))


def test_empty_plan_goes_nowhere() -> None:
    plan = plan_of(steps=())
    assert plan.path() == ()
    assert plan.duration_s(MOTION, 100.0) == 0.0
