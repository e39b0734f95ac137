"""The Marlin driver on a simulated controller: one test for each peculiarity of the protocol."""

from collections.abc import Callable
from functools import partial

import pytest

from faintfield.rig.errors import NotHomed, StageAlarm, StageLost, StageRejected, StageTimeout, WrongFirmware
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.marlin.controller import MarlinController
from faintfield.rig.stages.protocol import Box, Point, StageSettings
from tests.rig.stages.benches import homed


def without(*starts: bytes) -> Callable[[bytes], bytes]:
    """Return a filter that removes lines with these beginnings."""
    return lambda data: b"" if data.startswith(starts) else data


def test_motors_stay_on_however_long_nothing_moves() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    stage.move_to(100.0, 100.0)
    bench.clock.sleep_s(3600.0)
    stage.verify_at(100.0, 100.0)
    assert bench.true_position() == pytest.approx((100.0, 100.0), abs=0.01)


def test_damaged_lines_are_sent_again_and_executed_once() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    sent = 0

    def damage_every_third(data: bytes) -> bytes:
        nonlocal sent
        sent += 1
        return data.replace(b"1", b"7", 1) if sent % 3 == 0 else data

    bench.wire.filters_to_controller.append(damage_every_third)
    for target in (Point(100.0, 100.0), Point(50.0, 150.0), Point(11.0, 11.0)):
        assert stage.move_to(*target).is_at(target)
        assert bench.true_position() == pytest.approx(target, abs=0.01)


def test_an_unseen_restart_shows_at_the_next_command() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    bench.wire.filters_to_host.append(without(b"start"))
    bench.firmware.restart()
    bench.clock.sleep_s(5.0)
    with pytest.raises(StageLost, match="waits for line 1 "):
        stage.position()
    assert not stage.trusted
    stage.recover()
    with pytest.raises(NotHomed):
        stage.move_to(10.0, 10.0)
    stage.home()
    assert stage.trusted


def test_recovery_notices_an_unseen_restart() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    stage.recover()
    assert stage.trusted
    bench.wire.filters_to_host.append(without(b"start"))
    bench.firmware.restart()
    bench.clock.sleep_s(5.0)
    stage.recover()
    assert not stage.trusted


def test_the_end_of_a_motion_is_awaited_without_real_time_positions() -> None:
    bench = Bench(partial(SimulatedMarlin, realtime_position=False))
    stage = homed(bench)
    stage.move_to(200.0, 200.0)
    assert bench.true_position() == pytest.approx((200.0, 200.0), abs=0.01)


def test_answers_that_come_late_do_not_put_the_recovery_out_of_step() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    for _ in range(3):
        bench.firmware.say("ok")
    bench.firmware.say("Resend: 99")
    bench.wire.hold_up(0.25)
    bench.firmware.say("ok")
    stage.recover()
    stage.home()
    target = Point(100.0, 100.0)
    assert stage.move_to(*target).is_at(target)
    assert bench.true_position() == pytest.approx(target, abs=0.01)


def test_a_killed_controller_is_restarted_and_has_to_be_homed() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    assert isinstance(bench.firmware, SimulatedMarlin)
    bench.firmware.kill("Heating failed")
    with pytest.raises(StageAlarm, match="Heating failed"):
        stage.move_to(10.0, 10.0)
    stage.recover()
    assert not stage.trusted
    stage.home()
    assert stage.trusted


def test_failed_homing_is_an_alarm() -> None:
    bench = Bench(SimulatedMarlin)
    stage = bench.stage()
    stage.connect()
    bench.firmware.mechanics.axes[0].stuck = True
    with pytest.raises(StageAlarm, match="Homing Failed"):
        stage.home()


def test_hold_stops_dead_and_so_loses_the_position() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    bench.firmware.receive(b"G1 X300 F600\n")
    bench.clock.sleep_s(1.0)
    stage.hold()
    assert not bench.firmware.mechanics.moving
    assert bench.true_position().x_mm < 15.0
    assert not stage.trusted


def test_closed_switches_are_told_by_axis() -> None:
    stage = homed(Bench(SimulatedMarlin))
    stage.move_to(0.0, 100.0)
    assert stage.switches() == {0}
    stage.home()
    stage.move_to(100.0, 0.0)
    assert stage.switches() == {1}


def test_one_axis_can_be_homed_alone() -> None:
    bench = Bench(SimulatedMarlin)
    stage = bench.stage()
    stage.connect()
    stage.home(0)
    assert not stage.trusted, "the other axis is still unknown"
    stage.home()
    stage.move_to(50.0, 50.0)
    assert stage.home(1).position.point == Point(50.0, 0.0)
    assert stage.trusted


def test_travel_is_what_all_sources_allow() -> None:
    bench = Bench(SimulatedMarlin)
    stage = bench.stage()
    stage.connect()
    assert stage.travel() == Box((0.0, 400.0), (0.0, 400.0))
    bench.wire.filters_to_host.append(lambda data: data.replace(b"Max:  X400.00", b"Max:  X350.00"))
    stage.connect()
    assert stage.travel() == Box((0.0, 350.0), (0.0, 400.0))


def test_settings_that_change_while_read_are_not_believed() -> None:
    bench = Bench(SimulatedMarlin)
    seen: list[bytes] = []

    def lose_a_digit_once(data: bytes) -> bytes:
        if data.startswith(b"echo: M92") and not seen:
            seen.append(data)
            return data.replace(b"X80", b"X8")
        return data

    bench.wire.filters_to_host.append(lose_a_digit_once)
    with pytest.raises(StageLost, match="read differently"):
        bench.stage().connect()


def test_a_motion_that_is_refused_until_the_stage_is_homed_is_an_error() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    bench.wire.filters_to_controller.append(
        lambda data: bench.firmware.say("echo:Home XY First") or data if b"G1" in data else data  # type: ignore[func-returns-value]
    )
    with pytest.raises(StageRejected, match=r"refused 'G1 .*Home XY First; home the stage first"):
        stage.move_to(100.0, 100.0)


def test_the_wrong_firmware_is_refused() -> None:
    grbl = Bench(SimulatedMarlin).stage(StageSettings(protocol="grbl", port="simulated"))
    with pytest.raises(WrongFirmware, match="use protocol 'marlin'"):
        grbl.connect()
    kept_running = Bench(SimulatedMarlin, resets_on_open=False)
    kept_running.clock.sleep_s(5.0)
    with pytest.raises(WrongFirmware, match="use protocol 'marlin'"):
        kept_running.stage(StageSettings(protocol="grbl", port="simulated")).connect()


def test_a_refusal_half_way_along_a_path_loses_the_position_because_stopping_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """The refused line moves nothing, but the one before it did, and Marlin stops dead."""
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)

    def refuse_the_second(controller: MarlinController, *path: object) -> Point:
        raise StageRejected("the controller refused the second motion; nothing moved by it; home the stage first")

    monkeypatch.setattr(MarlinController, "follow", refuse_the_second)
    with pytest.raises(StageRejected):
        stage.move_to(100.0, 100.0)
    assert not stage.trusted
    with pytest.raises(NotHomed):
        stage.verify_at(*bench.true_position())


def paused(bench: Bench) -> SimulatedMarlin:
    """Let a controller wait for its button from half a second on."""
    assert isinstance(bench.firmware, SimulatedMarlin)
    bench.clock.after(0.5, bench.firmware.wait_for_button)
    return bench.firmware


def test_a_controller_that_waits_for_its_button_is_waited_for() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    bench.clock.after(300.0, paused(bench).press_button)
    target = Point(100.0, 100.0)
    assert stage.move_to(*target).is_at(target)
    assert bench.clock.now_s() > 300.0
    assert stage.trusted


def test_a_button_that_nobody_presses_is_not_waited_for_longer_than_ten_minutes() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    paused(bench)
    begun_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match=r"'M400' within 60\d\.\d s, it waits for its button to be pressed; "):
        stage.move_to(100.0, 100.0)
    assert 600.0 < bench.clock.now_s() - begun_s < 620.0
    assert not stage.trusted


def test_a_motion_slower_than_predicted_is_waited_for_while_busy_is_told_but_not_for_ever() -> None:
    bench = Bench(SimulatedMarlin)
    stage = homed(bench)
    bound_s = 1.5 * 200.0 / 100.0 + 2.5
    assert isinstance(bench.firmware, SimulatedMarlin)
    bench.firmware.settings["M203"] = 20.0
    assert stage.move_to(200.0, 0.0).trusted, "10 s, where 2.2 s were predicted"
    bench.firmware.mechanics.endless = True
    begun_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match="it says that it is busy; "):
        stage.move_to(200.0, 200.0)
    assert bound_s + 10.0 < bench.clock.now_s() - begun_s < bound_s + 16.0
