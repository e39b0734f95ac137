"""Homing again finds lost steps, and what was recorded before stays doubtful."""

from functools import partial

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from faintfield.rig.errors import NotHomed, PlanRefused, PositionDrifted, StageAlarm
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.drift import Drift, DriftWatch, recover
from faintfield.rig.stages.gantry import Gantry
from tests.rig.stages.benches import CONTROLLERS, Controller


def watched(bench: Bench, limit_mm: float = 0.5) -> tuple[Gantry, DriftWatch]:
    stage = bench.stage()
    stage.connect()
    watch = DriftWatch(stage, limit_mm=limit_mm)
    watch.begin()
    return stage, watch


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_good_stage_passes_again_and_again(controller: Controller) -> None:
    stage, watch = watched(Bench(controller))
    for number in range(3):
        stage.move_to(*_middle(stage))
        watch.note(number)
        assert watch.check().passed
        assert watch.unchecked == ()
    assert watch.doubtful == ()


@pytest.mark.parametrize("controller", CONTROLLERS)
@settings(deadline=None, max_examples=60)
@given(st.integers(0, 1), st.floats(-8.0, 8.0))
def test_any_drift_beyond_the_limit_is_found_and_none_within(controller: Controller, axis: int, by_mm: float) -> None:
    assume(not 0.45 < abs(by_mm) < 0.55)
    bench = Bench(controller)
    stage, watch = watched(bench)
    stage.move_to(*_middle(stage))
    watch.note("frame")
    bench.firmware.mechanics.axes[axis].slip_mm += by_mm
    if abs(by_mm) < 0.5:
        watch.check()
        return
    with pytest.raises(PositionDrifted) as caught:
        watch.check()
    assert caught.value.suspect == ("frame",)
    assert watch.doubtful == ("frame",)
    assert watch.unchecked == ()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_only_what_came_after_the_last_good_check_is_doubtful(controller: Controller) -> None:
    bench = Bench(controller)
    stage, watch = watched(bench)
    watch.note("early")
    watch.check()
    watch.note("late")
    bench.firmware.mechanics.axes[0].slip_mm += 2.0
    with pytest.raises(PositionDrifted):
        watch.check()
    assert watch.doubtful == ("late",)
    stage.recover()
    stage.home()
    watch.begin()
    watch.note("again")
    watch.check()
    assert watch.doubtful == ("late",)


def test_a_check_without_begin_is_refused() -> None:
    stage = Bench(SimulatedGrbl).stage()
    stage.connect()
    stage.home()
    watch = DriftWatch(stage)
    watch.note("frame")
    with pytest.raises(PlanRefused, match="begin the watch first"):
        watch.check()
    assert watch.unchecked == ("frame",)


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_disturbance_while_homing_was_timed_is_found_at_once(controller: Controller) -> None:
    bench = Bench(controller)
    stage = bench.stage()
    stage.connect()
    stage.home()
    homings: list[bool] = []

    def late_on_the_third(data: bytes) -> bytes:
        if b"$H" in data or b"G28" in data:
            homings.append(True)
            if len(homings) == 3:
                bench.clock.after(1.0, lambda: bench.wire.hold_up(8.0))
        return data

    bench.wire.filters_to_controller.append(late_on_the_third)
    with pytest.raises(PositionDrifted):
        DriftWatch(stage).begin()


def test_limits_that_cannot_be_kept_are_refused() -> None:
    with pytest.raises(PlanRefused, match=r"resolves 0\.40 mm"):
        watched(Bench(SimulatedMarlin), limit_mm=0.1)
    with pytest.raises(PlanRefused, match="pull off farther"):
        watched(Bench(SimulatedGrbl), limit_mm=1.0)
    with pytest.raises(PlanRefused, match="resolves"):
        watched(Bench(partial(SimulatedGrbl, settings={25: "6000.000"})))


@pytest.mark.parametrize(("drift_mm", "passed"), [(0.5, True), (-0.5, True), (0.51, False), (-0.51, False)])
def test_a_drift_as_large_as_the_limit_passes(drift_mm: float, passed: bool) -> None:
    assert Drift((0.0, drift_mm), 0.5).passed is passed


def test_homing_that_takes_no_longer_from_farther_away_is_refused() -> None:
    bench = Bench(SimulatedGrbl)
    stage = bench.stage()
    stage.connect()
    homings: list[bool] = []

    def slow_on_the_second(data: bytes) -> bytes:
        homings.extend([True] * data.count(b"$H"))
        bench.firmware.homing_slowdown = 5.0 if len(homings) == 2 else 1.0
        return data

    bench.wire.filters_to_controller.append(slow_on_the_second)
    with pytest.raises(PlanRefused, match="no longer from farther away"):
        DriftWatch(stage).begin()


def test_recovery_homes_only_when_agreed_to_and_leaves_the_unchecked_doubtful() -> None:
    bench = Bench(SimulatedGrbl)
    stage, watch = watched(bench)
    watch.note("frame")
    assert isinstance(bench.firmware, SimulatedGrbl)
    bench.firmware.alarm(3)
    with pytest.raises(StageAlarm):
        stage.position()
    before = bench.true_position()
    with pytest.raises(NotHomed, match="declined"):
        recover(stage, lambda question: False, watch)
    assert bench.true_position() == before
    assert watch.unchecked == ("frame",)
    recover(stage, lambda question: "Home it now?" in question, watch)
    assert stage.trusted
    assert watch.doubtful == ("frame",)


def test_recovery_that_keeps_the_position_asks_nothing() -> None:
    bench = Bench(SimulatedGrbl)
    stage, watch = watched(bench)
    watch.note("frame")
    bench.firmware.receive(b"G53 G0 X10\n")
    with pytest.raises(StageAlarm, match="ALARM:2"):
        stage.position()
    recover(stage, lambda question: pytest.fail("asked"), watch)
    assert watch.unchecked == ("frame",)


def _middle(stage: Gantry) -> tuple[float, float]:
    travel = stage.travel()
    return 0.5 * sum(travel.x_mm), 0.5 * sum(travel.y_mm)
