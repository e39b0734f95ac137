"""Homing again finds lost steps, and what was recorded before is suspect."""

from collections.abc import Callable
from functools import partial

import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from faintfield.rig.errors import DriftUnknown, NotHomed, PlanRefused, PositionDrifted, StageAlarm
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.drift import Drift, DriftWatch, recover
from faintfield.rig.stages.gantry import Gantry
from tests.rig.stages.benches import CONTROLLERS, Controller, diagonal, firmware, keep_host_busy, on_homing


def watched(bench: Bench, limit_mm: float = 0.5) -> tuple[Gantry, DriftWatch]:
    stage = bench.stage()
    stage.connect()
    watch = DriftWatch(stage, limit_mm=limit_mm)
    watch.begin()
    return stage, watch


@pytest.mark.parametrize("controller", CONTROLLERS)
@settings(deadline=None, max_examples=12)
@given(st.integers(0, 1), st.floats(-8.0, 8.0))
def test_only_drift_beyond_the_limit_is_noticed(controller: Controller, axis: int, by_mm: float) -> None:
    assume(not 0.45 < abs(by_mm) < 0.55)
    bench = Bench(controller)
    stage, watch = watched(bench)
    stage.move_to(*diagonal(stage, 200.0))
    watch.unchecked.append("frame")
    bench.firmware.mechanics.axes[axis].slip_mm += by_mm
    if abs(by_mm) < 0.5:
        watch.check()
        return
    with pytest.raises(PositionDrifted) as caught:
        watch.check()
    assert caught.value.suspect == ("frame",)
    assert watch.unchecked == []


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_only_frames_after_a_good_check_are_doubtful(controller: Controller) -> None:
    bench = Bench(controller)
    stage, watch = watched(bench)
    watch.unchecked.append("early")
    watch.check()
    watch.unchecked.append("late")
    bench.firmware.mechanics.axes[0].slip_mm += 2.0
    with pytest.raises(PositionDrifted) as caught:
        watch.check()
    assert caught.value.suspect == ("late",)
    stage.recover()
    stage.home()
    watch.begin()
    watch.unchecked.append("again")
    watch.check()
    assert watch.unchecked == []


def test_check_without_begin_is_refused(stage: Gantry) -> None:
    watch = DriftWatch(stage)
    watch.unchecked.append("frame")
    with pytest.raises(PlanRefused, match="begin the watch first"):
        watch.check()
    assert watch.unchecked == ["frame"]


def delay_line(bench: Bench, for_s: float = 3.0) -> None:
    """Hold back answers for a while, from soon on."""
    bench.clock.after(0.3, lambda: bench.wire.hold_up(for_s))


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("delay", [delay_line, keep_host_busy])
@pytest.mark.parametrize("number", [1, 4])
def test_delay_in_timed_homing_falsifies_no_check(
    controller: Controller, delay: Callable[[Bench], None], number: int
) -> None:
    bench = Bench(controller)
    on_homing(bench, lambda homing: delay(bench) if homing == number else None)
    stage, watch = watched(bench)
    for drift_mm in (0.3, -0.3):
        stage.move_to(*diagonal(stage, 200.0))
        bench.firmware.mechanics.axes[0].slip_mm += drift_mm
        watch.check()
    bench.firmware.mechanics.axes[0].slip_mm += 0.7
    with pytest.raises(PositionDrifted):
        watch.check()


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("delay", [delay_line, keep_host_busy])
def test_times_that_are_never_the_same_are_refused(
    controller: Controller, delay: Callable[[Bench, float], None]
) -> None:
    bench = Bench(controller)
    on_homing(bench, lambda homing: delay(bench, 3.0 + 0.5 * homing))
    with pytest.raises((PositionDrifted, DriftUnknown)):
        watched(bench)
    assert bench.clock.now_s() < 1000.0


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_busy_computer_is_no_drift(controller: Controller) -> None:
    bench = Bench(controller)
    stage, watch = watched(bench)
    watch.unchecked.append("frame")
    stage.move_to(*diagonal(stage, 200.0))
    on_homing(bench, lambda homing: keep_host_busy(bench) if homing == 1 else None)
    with pytest.raises(DriftUnknown, match=r"answers were delayed; 1 positions .* in doubt") as caught:
        watch.check()
    assert caught.value.suspect == ("frame",)
    assert stage.trusted
    watch.unchecked.append("again")
    stage.move_to(*diagonal(stage, 200.0))
    assert watch.check().passed


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("drift_mm", [0.7, -0.7])
@pytest.mark.parametrize("late_s", [0.03, 1.0])
def test_no_delay_hides_a_drift(controller: Controller, drift_mm: float, late_s: float) -> None:
    bench = Bench(controller)
    stage, watch = watched(bench)
    watch.unchecked.append("frame")
    stage.move_to(*diagonal(stage, 200.0))
    bench.firmware.mechanics.axes[0].slip_mm += drift_mm

    def read_late(data: bytes) -> bytes:
        if b"ok" in data:
            bench.host_busy_until_s = bench.clock.now_s() + late_s
        return data

    on_homing(bench, lambda homing: bench.wire.filters_to_host.append(read_late) if homing == 1 else None)
    with pytest.raises((DriftUnknown, PositionDrifted)) as caught:
        watch.check()
    assert caught.value.suspect == ("frame",)


def test_limits_that_cannot_be_kept_are_refused() -> None:
    with pytest.raises(PlanRefused, match=r"resolves 0\.40 mm"):
        watched(Bench(SimulatedMarlin), limit_mm=0.1)
    with pytest.raises(PlanRefused, match="pull off farther"):
        watched(Bench(SimulatedGrbl), limit_mm=1.0)
    with pytest.raises(PlanRefused, match="resolves"):
        watched(Bench(partial(SimulatedGrbl, settings={25: "6000.000"})))


@pytest.mark.parametrize(("drift_mm", "passed"), [(-0.5, True), (-0.51, False)])
def test_drift_as_large_as_the_limit_passes(drift_mm: float, passed: bool) -> None:
    assert Drift((0.0, drift_mm), 0.5).passed is passed


def test_homing_time_independent_of_distance_is_refused(bench: Bench, unhomed: Gantry) -> None:
    # After the first homing, each pair begins at the nearer distance
    on_homing(bench, lambda homing: setattr(bench.firmware, "homing_slowdown", 1.0 if homing % 2 else 5.0))
    with pytest.raises(PlanRefused, match="no longer from farther away"):
        DriftWatch(unhomed).begin()


def test_recovery_homes_only_when_agreed(bench: Bench) -> None:
    stage, watch = watched(bench)
    watch.unchecked.append("frame")
    firmware(bench, SimulatedGrbl).alarm(3)
    with pytest.raises(StageAlarm):
        stage.position()
    before = bench.true_position()
    with pytest.raises(NotHomed, match="declined"):
        recover(stage, lambda question: False, watch)
    assert bench.true_position() == before
    assert watch.unchecked == ["frame"]
    recover(stage, lambda question: "Home it now?" in question, watch)
    assert stage.trusted
    assert watch.unchecked == []


def test_recovery_that_keeps_the_position_asks_nothing(bench: Bench) -> None:
    stage, watch = watched(bench)
    watch.unchecked.append("frame")
    bench.firmware.receive(b"G53 G0 X10\n")
    with pytest.raises(StageAlarm, match="ALARM:2"):
        stage.position()
    recover(stage, lambda question: pytest.fail("asked"), watch)
    assert watch.unchecked == ["frame"]
