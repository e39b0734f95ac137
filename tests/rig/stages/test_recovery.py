"""Stages after a fault: what keeps the position, what loses it, and how it is recovered."""

from collections.abc import Callable

import pytest

from faintfield.rig.errors import NotHomed, PositionLost, StageAlarm, StageLost, StageRejected, StageTimeout
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.grbl_alarms import alarm_failure, error_failure, state_failure
from faintfield.rig.stages.grbl_lines import Report
from faintfield.rig.stages.protocol import Point
from tests.faults.stage_faults import lose_steps, restart_unseen, stick
from tests.rig.stages.benches import Controller, Traffic, diagonal, firmware, homed

type Fault = Callable[[Bench], object]


def test_unknown_codes_point_to_the_lists() -> None:
    assert "list of alarms" in str(alarm_failure(99))
    assert "'$J=X1'" in str(error_failure("$J=X1", 99))
    assert "list of errors" in str(error_failure("$J=X1", 99))
    assert "damaged on its way" in str(error_failure("$J=X1", 1))
    assert "damaged on its way" in str(error_failure("$J=X1", 36))


@pytest.mark.parametrize("state", ["Hold", "Jog", "Home", "Sleep", "Tool"])
def test_only_holds_and_jogs_keep_the_position(state: str) -> None:
    failure = state_failure(Report(state, None, (0.0, 0.0, 0.0), True, None, ""), alarm=3)
    assert failure.position_kept == (state in ("Hold", "Jog"))


def interrupt() -> None:
    raise KeyboardInterrupt


def alarm(code: int) -> Fault:
    return lambda bench: firmware(bench, SimulatedGrbl).alarm(code)


def restart(bench: Bench) -> None:
    bench.firmware.restart()
    bench.clock.sleep_s(5.0)


def unheard_restart(bench: Bench) -> None:
    restart_unseen(bench)
    bench.clock.sleep_s(5.0)


slip = lose_steps(0, 99.5)  # the switch is nearer than the count says


def sent(data: bytes) -> Fault:
    def send(bench: Bench) -> None:
        bench.firmware.receive(data)
        bench.clock.sleep_s(0.3)

    return send


def later(fault: Callable[[Bench], None]) -> Fault:
    return lambda bench: bench.clock.after(0.5, lambda: fault(bench))


def kill(bench: Bench) -> None:
    firmware(bench, SimulatedMarlin).kill("Heating failed")


def move(stage: Gantry) -> None:
    stage.move_to(*diagonal(stage, 10.0))


def ask_twice(stage: Gantry) -> None:
    with pytest.raises(StageAlarm):
        stage.position()
    stage.position()


FAULTS: list[tuple[Controller, Fault, Callable[[Gantry], object], type[BaseException], str | None, bool]] = [
    (SimulatedGrbl, sent(b"G53 G0 X10\n"), Gantry.position, StageAlarm, "ALARM:2", True),
    (SimulatedGrbl, alarm(1), move, StageAlarm, "ALARM:1: ", False),
    (SimulatedGrbl, alarm(3), ask_twice, StageAlarm, "ALARM:3: reset while moving", False),
    (SimulatedGrbl, alarm(9), move, StageAlarm, "ALARM:9: ", False),
    (SimulatedGrbl, slip, move, StageAlarm, "ALARM:1", False),
    (SimulatedGrbl, later(lambda bench: interrupt()), move, KeyboardInterrupt, None, False),
    (SimulatedGrbl, later(lambda bench: firmware(bench, SimulatedGrbl).pause()), move, StageAlarm, "on hold", True),
    (SimulatedGrbl, sent(b"$J=G53 G90 X-200 F6000\n"), Gantry.position, StageAlarm, "moving without a command", True),
    (SimulatedGrbl, restart, Gantry.position, StageLost, "restarted", False),
    (SimulatedGrbl, stick, Gantry.home, StageAlarm, "ALARM:9", False),
    (SimulatedGrblHal, alarm(2), Gantry.position, StageAlarm, "ALARM:2:", True),
    (SimulatedGrblHal, alarm(17), Gantry.position, StageAlarm, "ALARM:17:", False),
    (SimulatedMarlin, kill, move, StageAlarm, "Heating failed", False),
    (SimulatedMarlin, stick, Gantry.home, StageAlarm, "Homing Failed", False),
    (SimulatedMarlin, unheard_restart, Gantry.position, StageLost, "waits for line 1 ", False),
]


@pytest.mark.parametrize(("controller", "fault", "act", "failure", "words", "kept"), FAULTS)
def test_recovery_keeps_or_loses_the_position(
    controller: Controller,
    fault: Fault,
    act: Callable[[Gantry], object],
    failure: type[BaseException],
    words: str | None,
    kept: bool,
) -> None:
    bench, traffic = Bench(controller), Traffic()
    stage = homed(bench, traffic)
    start, target = diagonal(stage, 100.0), diagonal(stage, 200.0)
    stage.move_to(*start)
    fault(bench)
    with pytest.raises(failure, match=words):
        act(stage)
    if act is move:
        bench.clock.sleep_s(1.0)
        assert not bench.firmware.mechanics.moving
    bench.wire.filters_to_host.clear()
    bench.firmware.mechanics.axes[0].stuck = False
    stage.recover()
    assert stage.trusted == kept
    assert not bench.firmware.mechanics.moving
    if not kept:
        with pytest.raises(NotHomed):
            stage.move_to(*start)
        stage.home()
    assert stage.move_to(*target).is_at(target)
    assert bench.true_position() == pytest.approx(target, abs=0.01)
    assert kept or b"$X\n" not in traffic.chunks("sent")


def test_homing_may_take_four_minutes(bench: Bench, unhomed: Gantry) -> None:
    bench.firmware.homing_slowdown = 20.0
    unhomed.home()
    bench.firmware.homing_slowdown = 2000.0
    started_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match="within 240 s"):
        unhomed.home()
    assert bench.clock.now_s() - started_s == pytest.approx(240.0, abs=2.0)
    assert not unhomed.trusted
    unhomed.recover()
    bench.firmware.homing_slowdown = 1.0
    unhomed.home()
    assert unhomed.trusted


def test_ctrl_c_breaks_off_homing(bench: Bench, unhomed: Gantry) -> None:
    bench.clock.after(2.0, interrupt)
    with pytest.raises(KeyboardInterrupt):
        unhomed.home()
    bench.clock.sleep_s(0.1)
    assert firmware(bench, SimulatedGrbl).state == "Alarm"
    unhomed.recover()
    unhomed.home()
    assert unhomed.trusted


@pytest.mark.parametrize(
    ("motion", "stop"),
    [
        (b"$J=G91 G21 X-50 F600\n", Gantry.hold),
        (b"G53 G1 X-300 F600\n", Gantry.recover),
        (b"$J=G53 G90 X-300 F600\n", Gantry.recover),
    ],
)
def test_stop_in_motion_keeps_the_position(
    bench: Bench, stage: Gantry, motion: bytes, stop: Callable[[Gantry], None]
) -> None:
    stage.move_to(-100.0, -100.0)
    bench.firmware.receive(motion)
    bench.clock.sleep_s(1.0)
    stop(stage)
    assert stage.trusted
    bench.clock.sleep_s(1.0)
    assert not bench.firmware.mechanics.moving
    position = stage.position().point
    assert -115.0 < position.x_mm < -105.0
    assert bench.true_position() == pytest.approx(position, abs=0.01)


def test_motion_longer_than_predicted_is_stopped(bench: Bench, stage: Gantry) -> None:
    firmware(bench, SimulatedGrbl).settings.update({110: "60.000", 111: "60.000"})
    begun_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match="still moves after"):
        stage.move_to(-300.0, -300.0)
    assert bench.clock.now_s() - begun_s < 20.0
    bench.clock.sleep_s(1.0)
    assert not bench.firmware.mechanics.moving
    assert bench.true_position().x_mm > -50.0


def test_position_just_off_its_target_is_lost(stage: Gantry) -> None:
    tolerance_mm = stage.identify().tolerance_mm[0]
    stage.move_to(-100.0, -100.0)
    assert stage.verify_at(-100.0 + 0.9 * tolerance_mm, -100.0).trusted
    with pytest.raises(PositionLost):
        stage.verify_at(-100.0, -100.0 - 1.6 * tolerance_mm)
    assert not stage.trusted


def test_recovery_reads_the_settings_anew(bench: Bench, stage: Gantry) -> None:
    firmware(bench, SimulatedGrbl).settings[130] = "200.000"
    restart(bench)
    with pytest.raises(StageLost):
        stage.position()
    stage.recover()
    assert stage.travel().x_mm == (-200.0, 0.0)


def test_unlocking_after_reset_loses_the_position(bench: Bench, stage: Gantry) -> None:
    bench.firmware.receive(b"$J=G91 G21 X-100 F600\n")
    bench.clock.sleep_s(1.0)
    bench.firmware.receive(b"\x18")
    bench.firmware.receive(b"$X\n")
    stage.recover()
    assert not stage.trusted


def test_unlocking_after_restart_loses_the_position(bench: Bench, stage: Gantry) -> None:
    restart(bench)
    bench.firmware.receive(b"$X\n$J=G91 G21 X-10 F6000\n")
    bench.clock.sleep_s(2.0)
    stage.recover()
    assert not stage.trusted


@pytest.mark.parametrize("heard", [True, False])
def test_restart_after_alarm_2_loses_the_position(bench: Bench, stage: Gantry, heard: bool) -> None:
    bench.firmware.receive(b"G53 G0 X10\n")
    with pytest.raises(StageAlarm, match="ALARM:2"):
        stage.position()
    assert stage.trusted
    (restart if heard else unheard_restart)(bench)
    stage.recover()
    assert not stage.trusted


def test_refused_second_part_stops_the_path(bench: Bench, stage: Gantry) -> None:
    bench.wire.filters_to_controller.append(lambda data: data.replace(b"$J=G90 G21 G53 X-300.000", b"$Q"))
    with pytest.raises(StageRejected, match=r"refused .* nothing moved by it"):
        stage.move_to(-300.0, -300.0)
    bench.wire.filters_to_controller.clear()
    bench.clock.sleep_s(1.0)
    assert not bench.firmware.mechanics.moving
    assert bench.true_position().x_mm > -50.0
    assert stage.trusted
    assert stage.move_to(-50.0, -50.0).is_at(Point(-50.0, -50.0))
    assert bench.true_position() == pytest.approx((-50.0, -50.0), abs=0.01)


def test_rest_of_a_damaged_line_is_harmless(bench: Bench, stage: Gantry) -> None:
    bench.firmware.receive(b";")
    stage.recover()
    stage.home()
    assert stage.trusted
