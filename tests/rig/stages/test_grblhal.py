"""Differences of grblHAL from GRBL, and the driver's handling of them."""

import contextlib
from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from faintfield.rig.errors import OutsideTravel, PlanRefused, StageAlarm, StageError
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.grblhal import SimulatedGrblHal
from faintfield.rig.stages.drift import DriftWatch
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Box
from tests.rig.stages.benches import Traffic, firmware, homed


@pytest.fixture
def bench() -> Bench:
    return Bench(SimulatedGrblHal)


def assert_nothing_goes_on(bench: Bench) -> None:
    """Press resume, and see that nothing moves."""
    before = bench.true_position()
    bench.firmware.receive(b"~")
    bench.clock.sleep_s(10.0)
    assert bench.true_position() == before


@pytest.mark.parametrize("give_up", [Gantry.recover, Gantry.hold, Gantry.close])
@pytest.mark.parametrize(
    ("controller", "motion", "freeze", "words"),
    [
        (SimulatedGrblHal, b"$J=G90 G21 G53 X-300 F3000\n", SimulatedGrblHal.open_door, "door was opened"),
        (SimulatedGrblHal, b"G53 G1 X-300 F3000\n", SimulatedGrblHal.pause, "on hold"),
        (SimulatedGrbl, b"G53 G1 X-300 F3000\n", SimulatedGrbl.pause, "on hold"),
    ],
)
def test_stopping_leaves_no_motion_to_resume(
    controller: type[SimulatedGrbl],
    motion: bytes,
    freeze: Callable[[Any], None],
    words: str,
    give_up: Callable[[Gantry], None],
) -> None:
    bench = Bench(controller, resets_on_open=False)
    stage = homed(bench)
    bench.firmware.receive(motion)
    bench.clock.sleep_s(0.5)
    freeze(bench.firmware)
    bench.clock.sleep_s(2.0)
    with pytest.raises(StageAlarm, match=words):
        stage.position()
    with contextlib.suppress(StageError):
        give_up(stage)
    assert_nothing_goes_on(bench)
    assert words == "on hold" or not stage.trusted
    stage.close()
    stage.connect()
    assert_nothing_goes_on(bench)
    stage.home()
    assert stage.trusted


def test_door_that_freezes_jog_is_named(bench: Bench, stage: Gantry) -> None:
    controller = firmware(bench, SimulatedGrblHal)

    def open_door() -> None:
        controller.door_is_open = True
        controller.open_door()

    bench.clock.after(0.5, open_door)
    with pytest.raises(StageAlarm, match="safety door was opened, and the jog is frozen; close the door"):
        stage.move_to(-300.0, -300.0)
    with pytest.raises(StageAlarm, match="door is open; close the door"):
        stage.recover()
    controller.door_is_open = False
    stage.recover()
    assert not stage.trusted
    stage.home()
    assert stage.move_to(-300.0, -300.0).trusted


def test_open_door_is_reported_and_discards_the_motion() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    bench.firmware.receive(b"G53 G1 X-300 F3000\n")
    bench.clock.sleep_s(0.5)
    firmware(bench, SimulatedGrbl).door_is_open = True
    firmware(bench, SimulatedGrbl).open_door()
    with pytest.raises(StageAlarm, match="door is open; close the door"):
        stage.recover()
    firmware(bench, SimulatedGrbl).door_is_open = False
    stage.recover()
    assert_nothing_goes_on(bench)
    assert stage.trusted, "the motion slowed down and was reset at rest"


@pytest.mark.parametrize("controller", [SimulatedGrbl, SimulatedGrblHal])
@pytest.mark.parametrize("code", [1, 2])
def test_connecting_revives_a_board_silenced_by_alarm(controller: type[SimulatedGrbl], code: int) -> None:
    bench, traffic = Bench(controller, resets_on_open=False), Traffic()
    bench.clock.sleep_s(2.0)
    firmware(bench, SimulatedGrbl).alarm(code)
    bench.clock.sleep_s(1.0)
    stage = bench.stage(traffic=traffic)
    stage.connect()
    assert traffic.all("sent").count(b"\x18") == 1
    assert not stage.trusted
    stage.home()
    assert stage.move_to(-100.0, -100.0).trusted


def test_emergency_stop_has_to_be_released(bench: Bench, stage: Gantry) -> None:
    stage.move_to(-100.0, -100.0)
    bench.clock.after(0.5, firmware(bench, SimulatedGrblHal).press_emergency_stop)
    for act in (lambda: stage.move_to(-300.0, -300.0), stage.recover, stage.recover):
        with pytest.raises(StageAlarm, match=r"^ALARM:10: .*release the emergency stop, then"):
            act()
        assert not stage.trusted
    firmware(bench, SimulatedGrblHal).release_emergency_stop()
    stage.recover()
    assert not stage.trusted
    stage.home()
    assert stage.trusted


def test_emergency_stop_is_noticed_without_its_alarm(bench: Bench, stage: Gantry) -> None:
    bench.wire.filters_to_host.append(lambda data: b"" if b"ALARM" in data else data)
    firmware(bench, SimulatedGrblHal).press_emergency_stop()
    with pytest.raises(StageAlarm, match="release the emergency stop"):
        stage.move_to(-100.0, -100.0)
    assert not stage.trusted


def test_homing_required_is_no_failure_to_connect(unhomed: Gantry) -> None:
    with pytest.raises(StageAlarm, match="ALARM:11: homing is required; home it"):
        unhomed.position()
    unhomed.home()
    assert unhomed.position().trusted


@pytest.mark.parametrize(
    ("settings", "travel"),
    [
        ({}, Box((-399.0, -1.0), (-399.0, -1.0))),
        ({27: "3.000"}, Box((-397.0, -3.0), (-397.0, -3.0))),
        ({21: "0"}, Box((-400.0, 0.0), (-400.0, 0.0))),
    ],
)
def test_travel_ends_where_the_firmware_refuses(settings: dict[int, str], travel: Box) -> None:
    bench = Bench(partial(SimulatedGrblHal, settings=settings))
    stage = homed(bench)
    assert stage.travel() == travel
    for x_mm, y_mm in ((travel.x_mm[0] + 3.0, travel.y_mm[1]), (travel.x_mm[1], travel.y_mm[0] + 3.0)):
        assert stage.move_to(x_mm, y_mm).trusted
    with pytest.raises(OutsideTravel):
        stage.move_to(travel.x_mm[1] + 0.1, -100.0)


def test_shortened_travel_prevents_the_drift_watch() -> None:
    together = partial(SimulatedGrblHal, settings={22: "5"})
    stage = Bench(together).stage()
    stage.connect()
    with pytest.raises(PlanRefused, match=r"travel .* ends there; .*add 2 to \$22"):
        DriftWatch(stage).begin()
