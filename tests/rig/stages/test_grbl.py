"""The GRBL driver on a simulated controller: one test for each peculiarity of the protocol."""

from functools import partial
from itertools import count, pairwise

import pytest

from faintfield.rig.errors import KeepOutCrossed, OutsideTravel, StageAlarm, StageLost, StageRejected, WrongFirmware
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.simulation.controller.marlin import SimulatedMarlin
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Box, Point, StageSettings
from tests.faults.stage_faults import filter_once, report_idle_early
from tests.rig.stages.benches import Controller, Traffic, firmware, homed


def test_positions_are_independent_of_offset_and_report() -> None:
    for report in ("0", "1", "3"):
        bench = Bench(partial(SimulatedGrbl, settings={10: report}))
        stage = homed(bench)
        stage.move_to(-100.0, -100.0)
        bench.firmware.receive(b"G92 X0 Y0\n")
        bench.clock.sleep_s(0.1)
        for _ in range(12):  # the new offset is told within ten idle reports
            bench.firmware.receive(b"?")
        stage.move_to(-150.0, -120.0)
        assert bench.true_position() == pytest.approx((-150.0, -120.0), abs=0.01)
        assert stage.position().is_at(Point(-150.0, -120.0))


def test_stage_jogs_and_never_unlocks(bench: Bench) -> None:
    traffic = Traffic()
    stage = homed(bench, traffic)
    stage.move_to(-200.0, -200.0)
    moves = [data for data in traffic.chunks("sent") if b"X" in data]
    assert moves
    assert all(data.startswith(b"$J=G90 G21 G53 ") and len(data) < 80 for data in moves)
    assert b"$X\n" not in traffic.chunks("sent")


def test_stage_polls_often_only_at_arrival(bench: Bench) -> None:
    traffic = Traffic()
    stage = homed(bench, traffic)
    # Slower than the driver was told, so that it waits for long
    firmware(bench, SimulatedGrbl).settings |= {110: "3000.000", 111: "3000.000"}
    begun_s = bench.clock.now_s()
    stage.move_to(-300.0, -300.0)
    for _ in range(5):
        stage.verify_at(-300.0, -300.0)
    polls_s = [at_s for at_s, _, data in traffic.entries if data == b"?" and at_s > begun_s]
    intervals_s = [later - sooner for sooner, later in pairwise(polls_s)]
    assert polls_s[0] - begun_s > 4.0, "a motion is not disturbed"
    assert min(intervals_s) >= 0.05 - 1e-9
    assert sum(interval_s < 0.2 - 1e-9 for interval_s in intervals_s) < 20
    assert sum(interval_s >= 0.2 - 1e-9 for interval_s in intervals_s) > 5


def test_one_idle_report_does_not_end_a_wait(bench: Bench, stage: Gantry) -> None:
    report_idle_early(bench)
    # Slower than the driver was told, so that it polls too soon
    firmware(bench, SimulatedGrbl).settings[110] = "3000.000"
    assert stage.move_to(-350.0, -350.0).is_at(Point(-350.0, -350.0))
    assert bench.wire.filters_to_host == [], "it was reported"


def with_version(version: bytes, data: bytes) -> bytes:
    return data.replace(b"[VER:1.1h.20190830:]", version)


def test_wrong_firmware_is_refused(bench: Bench) -> None:
    for version in (b"[VER:0.9j.20160316:]", b"[VER:3.7 FluidNC v3.7.8:]"):
        bench.wire.filters_to_host[:] = [partial(with_version, version)]
        with pytest.raises(WrongFirmware, match=r"flash 1\.1 or grblHAL"):
            bench.stage().connect()
    bench.wire.filters_to_host.clear()
    with pytest.raises(WrongFirmware, match="use protocol 'grbl'"):
        bench.stage(StageSettings(protocol="marlin", port="simulated")).connect()


@pytest.mark.parametrize(
    ("settings", "axes", "old", "new", "words"),
    [
        ({}, ("X", "Z"), b",0.000|F", b"|F", r"reports 2 axes, not .*set stage\.axes"),
        ({10: "0"}, ("X", "Y"), b"|WCO:0.000,0.000,0.000", b"", r"without their offset; set \$10=1"),
    ],
)
def test_incomplete_reports_are_refused(
    settings: dict[int, str], axes: tuple[str, str], old: bytes, new: bytes, words: str
) -> None:
    bench = Bench(partial(SimulatedGrbl, settings=settings))
    bench.wire.filters_to_host.append(lambda data: data.replace(old, new))
    with pytest.raises(WrongFirmware, match=words):
        homed(bench, settings=StageSettings(protocol="grbl", port="simulated", axes=axes))


def test_configured_limits_narrow_the_travel(bench: Bench) -> None:
    def stage_within(box: Box) -> Gantry:
        return bench.stage(StageSettings(protocol="grbl", port="simulated", travel_mm=box))

    narrow = stage_within(Box((-300.0, 50.0), (-200.0, -100.0)))
    narrow.connect()
    assert narrow.travel() == Box((-300.0, 0.0), (-200.0, -100.0))
    narrow.close()
    with pytest.raises(OutsideTravel, match=r"correct stage\.travel_mm"):
        stage_within(Box((10.0, 20.0), (10.0, 20.0))).connect()


def test_path_through_a_keep_out_moves_nothing(bench: Bench) -> None:
    box = Box((-120.0, -100.0), (-120.0, -100.0))
    stage = homed(bench, settings=StageSettings(protocol="grbl", port="simulated", keep_out=(box,)))
    before = bench.true_position()
    with pytest.raises(KeepOutCrossed, match="meets the keep-out box"):
        stage.move_to(-200.0, -200.0)
    assert bench.true_position() == before
    stage.move_to(-200.0, -50.0)
    stage.move_to(-200.0, -200.0)


def test_locked_stage_jogs_only_if_unlocked(bench: Bench) -> None:
    stage = bench.stage()
    stage.connect()
    with pytest.raises(StageAlarm, match="locked"):
        stage.jog(-1.0, 0.0)
    before = bench.true_position()
    assert not stage.jog(-1.0, -2.0, unlock=True).trusted
    after = bench.true_position()
    assert (after.x_mm - before.x_mm, after.y_mm - before.y_mm) == pytest.approx((-1.0, -2.0), abs=0.01)
    with pytest.raises(OutsideTravel, match="longer than 10 mm"):
        stage.jog(-11.0, 0.0)
    with pytest.raises(StageRejected, match="error:15"):
        stage.jog(5.0, 5.0)
    stage.home()
    assert stage.jog(-50.0, -50.0).is_at(Point(-51.0, -51.0))
    with pytest.raises(OutsideTravel):
        stage.jog(60.0, 0.0)


def test_play_in_the_drive_does_not_matter() -> None:
    bench = Bench(partial(SimulatedGrbl, play_mm=0.3))
    stage = homed(bench)
    target = Point(-150.0, -150.0)
    places = []
    for start in (Point(-200.0, -200.0), Point(-100.0, -100.0), Point(-200.0, -100.0), Point(-150.0, -140.0)):
        stage.move_to(*start)
        stage.move_to(*target)
        places.append(bench.true_position())
    assert all(place == pytest.approx(places[0], abs=1e-6) for place in places)
    bench.firmware.receive(b"$J=G53 G90 G21 X-100 Y-100 F6000\n$J=G53 G90 G21 X-150 Y-150 F6000\n")
    bench.clock.sleep_s(5.0)
    assert bench.true_position().x_mm == pytest.approx(places[0].x_mm + 0.3), "the play is really there"


CHANGES = [(SimulatedGrbl, b"$130=400", b"400"), (SimulatedMarlin, b"echo: M92", b"X80")]


@pytest.mark.parametrize(("controller", "start", "old"), CHANGES)
def test_settings_that_keep_changing_are_refused(controller: Controller, start: bytes, old: bytes) -> None:
    bench, digits = Bench(controller), count(1)

    def change(data: bytes) -> bytes:
        return data.replace(old, old + b"%d" % next(digits)) if data.startswith(start) else data

    bench.wire.filters_to_host.append(change)
    with pytest.raises(StageLost, match="read differently"):
        bench.stage().connect()


@pytest.mark.parametrize(("controller", "start", "old"), CHANGES)
def test_setting_damaged_once_is_read_again(controller: Controller, start: bytes, old: bytes) -> None:
    stage = homed(Bench(controller))
    expected = stage.identify()
    bench = Bench(controller)
    filter_once(bench.wire.filters_to_host, lambda data: data.replace(old, old + b"0"), lambda data: start in data)
    stage = homed(bench)
    assert stage.identify() == expected


def test_settings_without_motion_may_keep_changing() -> None:
    bench, digits = Bench(SimulatedGrbl), count(1)
    bench.wire.filters_to_host.append(lambda data: b"$30=%d\r\n" % next(digits) if data.startswith(b"$30=") else data)
    assert homed(bench).trusted
