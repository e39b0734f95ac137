"""The GRBL driver on a simulated controller: one test for each peculiarity of the protocol."""

from functools import partial
from itertools import pairwise

import pytest

from faintfield.rig.errors import OutsideTravel, StageAlarm, StageLost, StageRejected, WrongFirmware
from faintfield.rig.simulation.controller.bench import Bench
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Box, Point, StageSettings
from tests.rig.stages.benches import Traffic, grbl, homed


def test_positions_are_machine_positions_whatever_the_work_offset_and_report() -> None:
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


def test_status_is_asked_for_at_most_five_times_a_second() -> None:
    traffic = Traffic()
    stage = homed(Bench(SimulatedGrbl), traffic)
    stage.move_to(-200.0, -200.0)
    for _ in range(5):
        stage.position()
    polls = [at_s for at_s, _, data in traffic.entries if data == b"?"]
    assert len(polls) > 8
    assert min(b - a for a, b in pairwise(polls)) >= 0.2 - 1e-9


def test_motion_is_by_jogs_and_never_by_unlocking() -> None:
    traffic = Traffic()
    stage = homed(Bench(SimulatedGrbl), traffic)
    stage.move_to(-200.0, -200.0)
    moves = [data for data in traffic.chunks("sent") if b"X" in data]
    assert moves
    assert all(data.startswith(b"$J=G90 G21 G53 ") and len(data) < 80 for data in moves)
    assert b"$X\n" not in traffic.chunks("sent")


def test_one_idle_report_does_not_end_a_wait() -> None:
    bench = Bench(SimulatedGrbl)
    stage = homed(bench)
    told: list[bytes] = []

    def idle_while_it_moves(data: bytes) -> bytes:
        if b"<Jog" in data and not told:
            told.append(data)
            return data.replace(b"<Jog", b"<Idle")
        return data

    bench.wire.filters_to_host.append(idle_while_it_moves)
    grbl(bench).settings[110] = "3000.000"  # slower than the driver was told, so that it polls too soon
    assert stage.move_to(-350.0, -350.0).is_at(Point(-350.0, -350.0))
    assert told


def test_the_wrong_firmware_is_refused() -> None:
    bench = Bench(SimulatedGrbl)
    for version in (b"[VER:0.9j.20160316:]", b"[VER:3.7 FluidNC v3.7.8:]"):
        bench.wire.filters_to_host[:] = [partial(_replace, b"[VER:1.1h.20190830:]", version)]
        with pytest.raises(WrongFirmware, match=r"1\.1 or grblHAL is needed"):
            bench.stage().connect()
    bench.wire.filters_to_host.clear()
    marlin = bench.stage(StageSettings(protocol="marlin", port="simulated"))
    with pytest.raises(WrongFirmware, match="use protocol 'grbl'"):
        marlin.connect()


def test_configured_limits_narrow_the_travel() -> None:
    def stage_within(box: Box) -> Gantry:
        return Bench(SimulatedGrbl).stage(StageSettings(protocol="grbl", port="simulated", travel_mm=box))

    narrow = stage_within(Box((-300.0, 50.0), (-200.0, -100.0)))
    narrow.connect()
    assert narrow.travel() == Box((-300.0, 0.0), (-200.0, -100.0))
    with pytest.raises(OutsideTravel, match=r"correct stage\.travel_mm"):
        stage_within(Box((10.0, 20.0), (10.0, 20.0))).connect()


def test_a_keep_out_on_the_way_is_refused_before_motion() -> None:
    bench = Bench(SimulatedGrbl)
    box = Box((-120.0, -100.0), (-120.0, -100.0))
    stage = homed(bench, settings=StageSettings(protocol="grbl", port="simulated", keep_out=(box,)))
    before = bench.true_position()
    with pytest.raises(Exception, match="meets the keep-out box"):
        stage.move_to(-200.0, -200.0)
    assert bench.true_position() == before
    stage.move_to(-200.0, -50.0)
    stage.move_to(-200.0, -200.0)


def test_a_locked_stage_jogs_only_when_asked_to_unlock() -> None:
    bench = Bench(SimulatedGrbl)
    stage = bench.stage()
    stage.connect()
    with pytest.raises(StageAlarm, match="locked"):
        stage.jog(-1.0, 0.0)
    before = bench.true_position()
    assert not stage.jog(-1.0, -2.0, unlock=True).trusted
    moved = bench.true_position()
    assert (moved.x_mm - before.x_mm, moved.y_mm - before.y_mm) == pytest.approx((-1.0, -2.0), abs=0.01)
    with pytest.raises(OutsideTravel, match="longer than 10 mm"):
        stage.jog(-11.0, 0.0)
    with pytest.raises(StageRejected, match="error:15"):
        stage.jog(5.0, 5.0)
    stage.home()
    assert stage.jog(-50.0, -50.0).is_at(Point(-51.0, -51.0))
    with pytest.raises(OutsideTravel):
        stage.jog(60.0, 0.0)


def test_settings_that_change_while_read_are_not_believed() -> None:
    bench = Bench(SimulatedGrbl)
    seen: list[bytes] = []

    def double_a_digit_once(data: bytes) -> bytes:
        if data.startswith(b"$130=400") and not seen:
            seen.append(data)
            return b"$130=4400.000\r\n"
        return data

    bench.wire.filters_to_host.append(double_a_digit_once)
    with pytest.raises(StageLost, match=r"\$130 read differently"):
        bench.stage().connect()


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


def _replace(old: bytes, new: bytes, data: bytes) -> bytes:
    return data.replace(old, new)
