"""What grblHAL does otherwise than GRBL, and how the driver copes with it."""

from functools import partial

import pytest

from faintfield.rig.errors import OutsideTravel, PlanRefused, StageAlarm, StageError
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Box
from tests.rig.stages.benches import Traffic, grbl, hal, homed


def assert_nothing_goes_on(bench: Bench) -> None:
    """Press resume, and see that nothing moves."""
    before = bench.true_position()
    bench.firmware.receive(b"~")
    bench.clock.sleep_s(10.0)
    assert bench.true_position() == before


@pytest.mark.parametrize("give_up", [Gantry.recover, Gantry.hold, Gantry.close])
def test_whoever_gives_up_leaves_nothing_that_could_go_on(give_up: object) -> None:
    bench = Bench(SimulatedGrblHal)
    stage = homed(bench)
    stage.move_to(-100.0, -100.0)
    bench.firmware.receive(b"$J=G90 G21 G53 X-300 F3000\n")
    bench.clock.sleep_s(0.5)
    hal(bench).open_door()
    bench.clock.sleep_s(2.0)
    with pytest.raises(StageAlarm, match="is moving without a command"):
        stage.position()
    assert callable(give_up)
    try:
        give_up(stage)
    except StageError:
        pass
    assert_nothing_goes_on(bench)
    assert not stage.trusted


@pytest.mark.parametrize("controller", [SimulatedGrbl, SimulatedGrblHal])
def test_a_motion_on_hold_is_forgotten_when_the_stage_is_closed(controller: type[SimulatedGrbl]) -> None:
    bench = Bench(controller)
    stage = homed(bench)
    bench.firmware.receive(b"G53 G1 X-300 F3000\n")
    bench.clock.sleep_s(0.5)
    grbl(bench).pause()
    bench.clock.sleep_s(1.0)
    with pytest.raises(StageAlarm, match="on hold"):
        stage.position()
    stage.close()
    assert_nothing_goes_on(bench)


def test_an_open_door_is_told_and_nothing_is_left_to_go_on() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    bench.firmware.receive(b"G53 G1 X-300 F3000\n")
    bench.clock.sleep_s(0.5)
    grbl(bench).door_is_open = True
    grbl(bench).open_door()
    with pytest.raises(StageAlarm, match="door is open; close the door"):
        stage.recover()
    grbl(bench).door_is_open = False
    stage.recover()
    assert_nothing_goes_on(bench)
    assert stage.trusted, "the motion slowed down and was reset at rest"


def test_a_frozen_jog_does_not_outlive_the_next_connection() -> None:
    bench = Bench(SimulatedGrblHal, resets_on_open=False)
    stage = homed(bench)
    bench.firmware.receive(b"$J=G90 G21 G53 X-300 F3000\n")
    bench.clock.sleep_s(0.5)
    hal(bench).open_door()
    bench.clock.sleep_s(2.0)
    stage.close()
    stage.connect()
    assert_nothing_goes_on(bench)
    stage.home()
    assert stage.trusted


@pytest.mark.parametrize("controller", [SimulatedGrbl, SimulatedGrblHal])
@pytest.mark.parametrize("code", [1, 2])
def test_a_board_that_an_alarm_has_silenced_is_revived_on_connecting(
    controller: type[SimulatedGrbl], code: int
) -> None:
    bench, traffic = Bench(controller, resets_on_open=False), Traffic()
    bench.clock.sleep_s(2.0)
    grbl(bench).alarm(code)
    bench.clock.sleep_s(1.0)
    stage = bench.stage(traffic=traffic)
    stage.connect()
    assert traffic.all("sent").count(b"\x18") == 1
    assert not stage.trusted
    stage.home()
    assert stage.move_to(-100.0, -100.0).trusted


def test_an_emergency_stop_has_to_be_released() -> None:
    bench = Bench(SimulatedGrblHal)
    stage = homed(bench)
    stage.move_to(-100.0, -100.0)
    bench.clock.after(0.5, hal(bench).press_emergency_stop)
    for act in (lambda: stage.move_to(-300.0, -300.0), stage.recover, stage.recover):
        with pytest.raises(StageAlarm, match=r"ALARM:10: .*release the emergency stop, then") as caught:
            act()
        assert caught.value.code == 10
        assert not stage.trusted
    hal(bench).release_emergency_stop()
    stage.recover()
    assert not stage.trusted
    stage.home()
    assert stage.trusted


def test_an_emergency_stop_whose_alarm_was_lost_is_not_overlooked() -> None:
    bench = Bench(SimulatedGrblHal)
    stage = homed(bench)
    bench.wire.filters_to_host.append(lambda data: b"" if b"ALARM" in data else data)
    hal(bench).press_emergency_stop()
    with pytest.raises(StageAlarm, match="release the emergency stop"):
        stage.move_to(-100.0, -100.0)
    assert not stage.trusted


def test_the_alarm_that_homing_is_required_is_no_failure_to_connect() -> None:
    bench = Bench(SimulatedGrblHal)
    stage = bench.stage()
    stage.connect()
    with pytest.raises(StageAlarm, match="ALARM:11: homing is required; home it"):
        stage.position()
    stage.home()
    assert stage.position().trusted


@pytest.mark.parametrize("code", [2, 17])
def test_a_critical_alarm_that_still_answers_is_reset(code: int) -> None:
    bench = Bench(SimulatedGrblHal)
    stage = homed(bench)
    stage.move_to(-100.0, -100.0)
    hal(bench).alarm(code)
    with pytest.raises(StageAlarm, match=f"ALARM:{code}:"):
        stage.position()
    stage.recover()
    assert stage.trusted == (code == 2)
    stage.home()
    assert stage.trusted


@pytest.mark.parametrize(
    ("settings", "travel"),
    [
        ({}, Box((-399.0, -1.0), (-399.0, -1.0))),
        ({27: "3.000"}, Box((-397.0, -3.0), (-397.0, -3.0))),
        ({21: "0"}, Box((-400.0, 0.0), (-400.0, 0.0))),
    ],
)
def test_the_travel_ends_where_the_firmware_refuses(settings: dict[int, str], travel: Box) -> None:
    bench = Bench(partial(SimulatedGrblHal, settings=settings))
    stage = homed(bench)
    assert stage.travel() == travel
    for x_mm, y_mm in ((travel.x_mm[0] + 3.0, travel.y_mm[1]), (travel.x_mm[1], travel.y_mm[0] + 3.0)):
        assert stage.move_to(x_mm, y_mm).trusted
    with pytest.raises(OutsideTravel):
        stage.move_to(travel.x_mm[1] + 0.1, -100.0)


def test_drift_that_the_shortened_travel_hides_is_refused_to_be_watched() -> None:
    together = partial(SimulatedGrblHal, settings={22: "5"})
    stage = Bench(together).stage()
    stage.connect()
    with pytest.raises(PlanRefused, match=r"travel .* ends there; .*add 2 to \$22"):
        DriftWatch(stage).begin()
