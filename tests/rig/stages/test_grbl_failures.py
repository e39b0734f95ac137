"""What GRBL's codes and states mean, by the lists in GRBL's repository, and whether the position is kept."""

import pytest

from faintfield.rig.errors import PositionLost, StageAlarm, StageTimeout, WrongFirmware
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.stages.grbl.failures import alarm_failure, error_failure, state_failure
from faintfield.rig.stages.grbl.messages import Report
from faintfield.rig.stages.protocol import StageSettings
from tests.rig.stages.benches import grbl, homed


@pytest.mark.parametrize(("code", "words"), [(1, "limit switch"), (2, "soft limits"), (99, "list of alarms")])
def test_only_soft_limits_keep_the_position(code: int, words: str) -> None:
    failure = alarm_failure(code)
    assert str(failure).startswith(f"ALARM:{code}: ")
    assert words in str(failure)
    assert failure.code == code
    assert failure.position_kept == (code == 2)


@pytest.mark.parametrize(("code", "words"), [(15, "target outside the travel"), (99, "list of errors")])
def test_refusal_names_command_and_reason(code: int, words: str) -> None:
    message = str(error_failure("$J=X1", code))
    assert "'$J=X1'" in message
    assert f"error:{code}, " in message
    assert words in message


@pytest.mark.parametrize(
    ("state", "kept"),
    [
        ("Hold", True), ("Jog", True), ("Home", False), ("Sleep", False), ("Tool", False),
    ],
)  # fmt: skip
def test_states_without_power_or_with_a_search_for_switches_lose_the_position(state: str, kept: bool) -> None:
    failure = state_failure(Report(state, None, (0.0, 0.0, 0.0), True, None, ""), alarm=3)
    assert failure.position_kept == kept
    assert "ALARM" not in str(failure)


def test_an_alarm_is_told_again_until_it_is_cleared() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    grbl(bench).alarm(3)
    for _ in range(2):
        with pytest.raises(StageAlarm, match="ALARM:3: reset while moving"):
            stage.position()
    stage.recover()
    stage.home()
    assert stage.position().trusted


@pytest.mark.parametrize("motion", [b"G53 G1 X-100 F6000\n", b"$J=G53 G90 X-100 F6000\n"])
def test_recovery_in_mid_motion_stops_it_and_keeps_the_position(motion: bytes) -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    stage.move_to(-300.0, -300.0)
    bench.firmware.receive(motion)
    bench.clock.sleep_s(0.5)
    stage.recover()
    assert stage.trusted
    bench.clock.sleep_s(1.0)
    here = stage.position().point
    assert -299.0 < here.x_mm < -200.0
    assert bench.true_position() == pytest.approx(here, abs=0.01)


def test_no_position_is_reported_while_the_stage_moves_or_is_held() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    stage.move_to(-300.0, -300.0)
    bench.firmware.receive(b"$J=G53 G90 X-100 F6000\n")
    bench.clock.sleep_s(0.3)
    with pytest.raises(StageAlarm, match="is moving without a command"):
        stage.position()
    grbl(bench).pause()
    bench.clock.sleep_s(1.0)
    with pytest.raises(StageAlarm, match="is on hold"):
        stage.verify_at(-300.0, -300.0)
    assert stage.trusted, "a hold slows down without losing steps"


def test_a_stage_that_moves_far_longer_than_predicted_is_stopped() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    grbl(bench).settings[110] = grbl(bench).settings[111] = "60.000"
    begun_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match="still moves after"):
        stage.move_to(-300.0, -300.0)
    assert bench.clock.now_s() - begun_s < 20.0
    bench.clock.sleep_s(1.0)
    assert not bench.firmware.mechanics.moving
    assert bench.true_position().x_mm > -50.0


def test_a_report_without_one_of_the_axes_is_refused() -> None:
    bench = Bench(SimulatedGrbl)
    bench.wire.filters_to_host.append(lambda data: data.replace(b",0.000|F", b"|F"))
    stage = bench.stage(StageSettings(protocol="grbl", port="simulated", axes=("X", "Z")))
    with pytest.raises(WrongFirmware, match=r"reports 2 axes, not .*set stage\.axes"):
        homed(bench, settings=stage.settings)


def test_work_positions_without_their_offset_are_refused() -> None:
    bench = Bench(SimulatedGrbl)
    grbl(bench).settings.update({10: "0"})
    bench.wire.filters_to_host.append(lambda data: data.replace(b"|WCO:0.000,0.000,0.000", b""))
    with pytest.raises(WrongFirmware, match=r"without their offset; set \$10=1"):
        bench.stage().connect()


def test_a_position_just_off_its_target_is_not_believed() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    tolerance_mm = stage.identify().tolerance_mm[0]
    stage.move_to(-100.0, -100.0)
    assert stage.verify_at(-100.0 + 0.9 * tolerance_mm, -100.0).trusted
    with pytest.raises(PositionLost):
        stage.verify_at(-100.0, -100.0 - 1.6 * tolerance_mm)
    assert not stage.trusted
