"""The Marlin driver on a simulated controller: one test for each peculiarity of the protocol."""

from functools import partial

import pytest

from faintfield.rig.errors import NotHomed, StageRejected, StageTimeout, WrongFirmware
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.marlin import MarlinController
from faintfield.rig.stages.protocol import Box, Point, StageSettings
from tests.faults.stage_faults import restart_unseen
from tests.rig.stages.benches import firmware, homed


@pytest.fixture
def bench() -> Bench:
    return Bench(SimulatedMarlin)


def test_motors_stay_on_at_rest(bench: Bench, stage: Gantry) -> None:
    stage.move_to(100.0, 100.0)
    bench.clock.sleep_s(3600.0)
    stage.verify_at(100.0, 100.0)
    assert bench.true_position() == pytest.approx((100.0, 100.0), abs=0.01)


def test_damaged_lines_are_sent_again_and_executed_once(bench: Bench, stage: Gantry) -> None:
    sent = 0

    def damage_every_third(data: bytes) -> bytes:
        nonlocal sent
        sent += 1
        return data.replace(b"1", b"7", 1) if sent % 3 == 0 else data

    bench.wire.filters_to_controller.append(damage_every_third)
    for target in (Point(100.0, 100.0), Point(50.0, 150.0), Point(11.0, 11.0)):
        assert stage.move_to(*target).is_at(target)
        assert bench.true_position() == pytest.approx(target, abs=0.01)


def test_recovery_notices_an_unheard_restart(bench: Bench, stage: Gantry) -> None:
    stage.recover()
    assert stage.trusted
    restart_unseen(bench)
    bench.clock.sleep_s(5.0)
    stage.recover()
    assert not stage.trusted


def test_end_of_motion_is_awaited_without_realtime_positions() -> None:
    bench = Bench(partial(SimulatedMarlin, realtime_position=False))
    stage = homed(bench)
    stage.move_to(200.0, 200.0)
    assert bench.true_position() == pytest.approx((200.0, 200.0), abs=0.01)


def test_late_answers_do_not_disturb_the_recovery(bench: Bench, stage: Gantry) -> None:
    for _ in range(3):
        bench.firmware.say("ok")
    bench.firmware.say("Resend: 99")
    bench.wire.hold_up(0.25)
    bench.firmware.say("ok")
    stage.recover()
    stage.home()
    assert stage.move_to(100.0, 100.0).is_at(Point(100.0, 100.0))
    assert bench.true_position() == pytest.approx((100.0, 100.0), abs=0.01)


def test_hold_stops_dead_and_so_loses_the_position(bench: Bench, stage: Gantry) -> None:
    bench.firmware.receive(b"G1 X300 F600\n")
    bench.clock.sleep_s(1.0)
    stage.hold()
    assert not bench.firmware.mechanics.moving
    assert bench.true_position().x_mm < 15.0
    assert not stage.trusted


def test_closed_switches_are_named_by_axis(stage: Gantry) -> None:
    stage.move_to(0.0, 100.0)
    assert stage.switches() == {0}
    stage.home()
    stage.move_to(100.0, 0.0)
    assert stage.switches() == {1}


def test_one_axis_can_be_homed_alone(unhomed: Gantry) -> None:
    unhomed.home(0)
    assert not unhomed.trusted, "the other axis is still unknown"
    unhomed.home()
    unhomed.move_to(50.0, 50.0)
    assert unhomed.home(1).position.point == Point(50.0, 0.0)
    assert unhomed.trusted


def test_travel_is_what_all_sources_allow(bench: Bench, unhomed: Gantry) -> None:
    assert unhomed.travel() == Box((0.0, 400.0), (0.0, 400.0))
    bench.wire.filters_to_host.append(lambda data: data.replace(b"Max:  X400.00", b"Max:  X350.00"))
    unhomed.connect()
    assert unhomed.travel() == Box((0.0, 350.0), (0.0, 400.0))


def test_motion_refused_until_homed_is_an_error(bench: Bench, stage: Gantry) -> None:
    bench.wire.filters_to_controller.append(
        lambda data: bench.firmware.say("echo:Home XY First") or data if b"G1" in data else data  # type: ignore[func-returns-value]
    )
    with pytest.raises(StageRejected, match=r"refused 'G1 .*Home XY First; home the stage first"):
        stage.move_to(100.0, 100.0)


@pytest.mark.parametrize("resets_on_open", [True, False])
def test_wrong_firmware_is_refused(resets_on_open: bool) -> None:
    bench = Bench(SimulatedMarlin, resets_on_open=resets_on_open)
    bench.clock.sleep_s(5.0)
    with pytest.raises(WrongFirmware, match="use protocol 'marlin'"):
        bench.stage(StageSettings(protocol="grbl", port="simulated")).connect()


def test_refusal_along_a_path_loses_the_position(bench: Bench, stage: Gantry, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse_the_second(controller: MarlinController, *path: object) -> Point:
        raise StageRejected("the controller refused the second motion; nothing moved by it; home the stage first")

    monkeypatch.setattr(MarlinController, "follow", refuse_the_second)
    with pytest.raises(StageRejected):
        stage.move_to(100.0, 100.0)
    assert not stage.trusted
    with pytest.raises(NotHomed):
        stage.verify_at(*bench.true_position())


def test_controller_waiting_for_its_button_is_awaited(bench: Bench, stage: Gantry) -> None:
    bench.clock.after(0.5, firmware(bench, SimulatedMarlin).wait_for_button)
    bench.clock.after(300.0, firmware(bench, SimulatedMarlin).press_button)
    assert stage.move_to(100.0, 100.0).is_at(Point(100.0, 100.0))
    assert bench.clock.now_s() > 300.0
    assert stage.trusted


def test_button_is_awaited_for_ten_minutes_at_most(bench: Bench, stage: Gantry) -> None:
    bench.clock.after(0.5, firmware(bench, SimulatedMarlin).wait_for_button)
    begun_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match=r"'M400' within 60\d\.\d s, it waits for its button to be pressed; "):
        stage.move_to(100.0, 100.0)
    assert 600.0 < bench.clock.now_s() - begun_s < 620.0
    assert not stage.trusted


def test_slow_motion_is_awaited_while_busy_within_bounds(bench: Bench, stage: Gantry) -> None:
    bound_s = 1.5 * 200.0 / 100.0 + 2.5
    firmware(bench, SimulatedMarlin).settings["M203"] = 20.0
    assert stage.move_to(200.0, 0.0).trusted, "10 s, where 2.2 s were predicted"
    bench.firmware.mechanics.endless = True
    begun_s = bench.clock.now_s()
    with pytest.raises(StageTimeout, match="it says that it is busy; "):
        stage.move_to(200.0, 200.0)
    assert bound_s + 10.0 < bench.clock.now_s() - begun_s < bound_s + 16.0
