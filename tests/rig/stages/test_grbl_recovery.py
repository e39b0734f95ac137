"""GRBL after a fault: what keeps the position, what loses it, and how it is recovered."""

import pytest

from faintfield.rig.errors import NotHomed, StageAlarm, StageLost, StageRejected, StageTimeout
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.stages.protocol import Point
from tests.rig.stages.benches import Traffic, grbl, homed


def test_alarm_2_keeps_the_position() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    stage.move_to(-100.0, -100.0)
    bench.firmware.receive(b"G53 G0 X10\n")
    with pytest.raises(StageAlarm, match="ALARM:2") as caught:
        stage.position()
    assert caught.value.position_kept
    stage.recover()
    assert stage.trusted
    assert stage.verify_at(-100.0, -100.0).trusted


@pytest.mark.parametrize("code", [1, 9])
def test_other_alarms_lose_it_and_stay_locked_until_homed(code: int) -> None:
    bench = Bench(SimulatedGrbl)
    traffic = Traffic()
    stage = homed(bench, traffic)
    grbl(bench).alarm(code)
    with pytest.raises(StageAlarm, match=f"ALARM:{code}:") as caught:
        stage.move_to(-100.0, -100.0)
    assert caught.value.code == code
    stage.recover()
    assert not stage.trusted
    assert grbl(bench).state == "Alarm"
    assert b"$X\n" not in traffic.chunks("sent")
    with pytest.raises(NotHomed):
        stage.move_to(-100.0, -100.0)
    stage.home()
    assert stage.move_to(-100.0, -100.0).trusted


def test_a_hard_limit_stops_the_stage_and_the_reset_is_repeated_until_taken() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    stage.move_to(-50.0, -50.0)
    bench.firmware.mechanics.axes[0].slip_mm = 49.5  # the switch is nearer than the count says
    with pytest.raises(StageAlarm, match="ALARM:1"):
        stage.move_to(-10.0, -50.0)
    stage.recover()
    assert not stage.trusted


def test_failed_homing_is_an_alarm_although_it_answers_ok() -> None:
    bench = Bench(SimulatedGrbl)
    stage = bench.stage()
    stage.connect()
    bench.firmware.mechanics.axes[1].stuck = True
    with pytest.raises(StageAlarm, match="ALARM:9"):
        stage.home()
    assert not stage.trusted


def test_homing_is_given_four_minutes_and_no_more() -> None:
    bench = Bench(SimulatedGrbl)
    stage = bench.stage()
    stage.connect()
    bench.firmware.homing_slowdown = 20.0
    stage.home()
    bench.firmware.homing_slowdown = 2000.0
    started_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match="within 240 s"):
        stage.home()
    assert bench.clock.now_s() - started_s == pytest.approx(240.0, abs=2.0)
    assert not stage.trusted
    stage.recover()
    bench.firmware.homing_slowdown = 1.0
    stage.home()
    assert stage.trusted


def test_ctrl_c_stops_the_motion_and_the_trust() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)

    def interrupt() -> None:
        raise KeyboardInterrupt

    bench.clock.after(0.5, interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.move_to(-300.0, -300.0)
    bench.clock.sleep_s(1.0)
    stopped = bench.true_position()
    assert -200.0 < stopped.x_mm < -10.0
    assert not bench.firmware.mechanics.moving
    assert not stage.trusted
    stage.recover()
    stage.home()


def test_ctrl_c_breaks_off_homing() -> None:
    bench = Bench(SimulatedGrbl)
    stage = bench.stage()
    stage.connect()

    def interrupt() -> None:
        raise KeyboardInterrupt

    bench.clock.after(2.0, interrupt)
    with pytest.raises(KeyboardInterrupt):
        stage.home()
    bench.clock.sleep_s(0.1)
    assert grbl(bench).state == "Alarm"
    stage.recover()
    stage.home()
    assert stage.trusted


def test_hold_keeps_the_position() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    stage.move_to(-100.0, -100.0)
    bench.firmware.receive(b"$J=G91 G21 X-50 F600\n")
    bench.clock.sleep_s(1.0)
    stage.hold()
    assert stage.trusted
    assert not bench.firmware.mechanics.moving
    position = stage.position().point
    assert -115.0 < position.x_mm < -105.0
    assert bench.true_position() == pytest.approx(position, abs=0.01)


def test_a_held_stage_recovers_with_its_position() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    bench.clock.after(0.5, grbl(bench).pause)
    with pytest.raises(StageAlarm, match="on hold") as caught:
        stage.move_to(-200.0, -200.0)
    assert caught.value.position_kept
    stage.recover()
    assert stage.trusted
    target = Point(-200.0, -200.0)
    assert stage.move_to(*target).is_at(target)
    assert bench.true_position() == pytest.approx(target, abs=0.01)


def test_a_restart_during_an_exposure_is_noticed() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    stage.move_to(-100.0, -100.0)
    bench.clock.after(0.5, bench.firmware.restart)
    bench.clock.sleep_s(2.0)
    with pytest.raises(StageLost, match="restarted"):
        stage.verify_at(-100.0, -100.0)
    assert not stage.trusted


def test_settings_are_read_anew_on_recovery() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    grbl(bench).settings[130] = "200.000"
    bench.firmware.restart()
    bench.clock.sleep_s(2.0)
    with pytest.raises(StageLost):
        stage.position()
    stage.recover()
    assert stage.travel().x_mm == (-200.0, 0.0)


def test_an_alarm_that_somebody_else_cleared_still_loses_the_position() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    bench.firmware.receive(b"$J=G91 G21 X-100 F600\n")
    bench.clock.sleep_s(1.0)
    bench.firmware.receive(b"\x18")
    bench.firmware.receive(b"$X\n")
    stage.recover()
    assert not stage.trusted


@pytest.mark.parametrize("seen", [True, False])
def test_a_restart_after_alarm_2_loses_the_position_whether_it_was_seen_or_not(seen: bool) -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    stage.move_to(-100.0, -100.0)
    bench.firmware.receive(b"G53 G0 X10\n")
    with pytest.raises(StageAlarm, match="ALARM:2"):
        stage.position()
    assert stage.trusted
    if not seen:
        bench.wire.filters_to_host.append(lambda data: b"" if b"Grbl" in data else data)
    bench.firmware.restart()
    bench.clock.sleep_s(2.0)
    stage.recover()
    assert not stage.trusted


def test_a_path_whose_second_part_is_refused_is_not_followed() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    bench.wire.filters_to_controller.append(lambda data: data.replace(b"$J=G90 G21 G53 X-300.000", b"$Q"))
    with pytest.raises(StageRejected, match=r"refused .* nothing moved by it"):
        stage.move_to(-300.0, -300.0)
    bench.wire.filters_to_controller.clear()
    bench.clock.sleep_s(1.0)
    assert not bench.firmware.mechanics.moving
    assert bench.true_position().x_mm > -50.0
    assert stage.trusted
    target = Point(-50.0, -50.0)
    assert stage.move_to(*target).is_at(target)
    assert bench.true_position() == pytest.approx(target, abs=0.01)


def test_a_restart_that_somebody_else_unlocked_and_moved_on_from_loses_the_position() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    bench.firmware.restart()
    bench.clock.sleep_s(2.0)
    bench.firmware.receive(b"$X\n$J=G91 G21 X-10 F6000\n")
    bench.clock.sleep_s(2.0)
    stage.recover()
    assert not stage.trusted


def test_the_rest_of_a_damaged_line_does_not_disturb_the_recovery() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    bench.firmware.receive(b";")
    stage.recover()
    stage.home()
    assert stage.trusted
