"""Every stage meets the contract, over every kind of connection."""

from collections.abc import Callable
from functools import partial

import pytest

from faintfield.rig.devices import open_stage
from faintfield.rig.plan import Grid
from faintfield.rig.simulation.controller.bench import Bench, Link, PtyLink
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.stages.conformance import check_conformance
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Point, StageSettings
from faintfield.testing import stage_contract
from tests.faults.stage_faults import filter_once, lose_steps
from tests.rig.stages.benches import CONTROLLERS, Controller, firmware, homed, on_homing
from tests.rig.stages.socket_link import SocketLink


@pytest.mark.parametrize("controller", CONTROLLERS)
@pytest.mark.parametrize("make_link", [Link, PtyLink, SocketLink])
def test_contract(controller: Controller, make_link: Callable[[], Link]) -> None:
    link = make_link()
    stage_contract(Bench(controller, link).stage())
    if isinstance(link, PtyLink | SocketLink):
        link.close()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_contract_with_board_that_keeps_running(controller: Controller) -> None:
    stage_contract(Bench(controller, resets_on_open=False).stage())


@pytest.mark.parametrize("port", ["simulated:grbl", "simulated:marlin"])
def test_contract_of_what_open_stage_returns(port: str) -> None:
    stage_contract(open_stage(StageSettings(protocol="simulated", port=port)))


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_grid_of_49_nodes_takes_a_minute(controller: Controller) -> None:
    bench = Bench(controller)
    stage = homed(bench)
    travel = stage.travel()
    first = Point(travel.x_mm[0] + 50.0, travel.y_mm[0] + 50.0)
    stage.move_to(*first)
    started_s = bench.clock.now_s()
    for stop in Grid(7, 7, 50.0, first).stops():
        assert stage.move_to(*stop.target).is_at(stop.target)
        assert bench.true_position() == pytest.approx(stop.target, abs=1.0 / 160.0)
    assert 33.0 < bench.clock.now_s() - started_s <= 60.0


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_conformance(controller: Controller) -> None:
    stage = Bench(controller).stage()
    stage.connect()
    checks = list(check_conformance(stage))
    assert len(checks) == 7
    assert all(check.passed for check in checks), checks


def test_wrong_setting_fails_the_first_check() -> None:
    bench = Bench(partial(SimulatedGrbl, settings={20: "0"}))
    stage = bench.stage()
    stage.connect()
    (failed,) = (check for check in check_conformance(stage) if not check.passed)
    assert failed.name == "settings"
    assert failed.measured.startswith("$20=0")


def test_slow_stage_fails_the_check_of_speed(bench: Bench, unhomed: Gantry) -> None:
    settings = firmware(bench, SimulatedGrbl).settings
    for number in (110, 111):
        settings[number] = f"{0.5 * float(settings[number]):.3f}"
    assert [check.name for check in check_conformance(unhomed) if not check.passed] == ["speed"]


def test_lost_steps_fail_the_check_of_repeatability(bench: Bench, unhomed: Gantry) -> None:
    checks = check_conformance(unhomed)
    earlier = [next(checks) for _ in range(6)]

    def slip(data: bytes) -> bytes:
        lose_steps(0, 1.0)(bench)
        return data

    def slip_at_next_jog(homing: int) -> None:
        if homing == 4:  # after the timing
            filter_once(bench.wire.filters_to_controller, slip, lambda data: b"$J" in data)

    on_homing(bench, slip_at_next_jog)
    last = next(checks)
    assert all(check.passed for check in earlier)
    assert (last.name, last.passed) == ("repeatability", False)
    assert "lost its scale" in last.measured
