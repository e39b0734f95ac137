"""Every stage meets the contract, over every kind of connection."""

from collections.abc import Iterator

import pytest

from faintfield.rig.devices import open_stage
from faintfield.rig.simulation.controller.bench import Bench, DirectLink, Link, PtyLink
from faintfield.rig.stages.conformance import check_conformance
from faintfield.rig.stages.protocol import Point, StageSettings
from tests.rig.stages.benches import CONTROLLERS, Controller
from tests.rig.stages.contract import check_stage
from tests.rig.stages.socket_link import SocketLink

LINKS = [DirectLink, PtyLink, SocketLink]


@pytest.fixture(params=LINKS)
def link(request: pytest.FixtureRequest) -> Iterator[Link]:
    made: Link = request.param()
    yield made
    if isinstance(made, PtyLink | SocketLink):
        made.close()


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_contract(controller: Controller, link: Link) -> None:
    check_stage(Bench(controller, link).stage())


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_contract_with_a_board_that_keeps_running(
    controller: Controller,
) -> None:
    check_stage(Bench(controller, resets_on_open=False).stage())


@pytest.mark.parametrize("port", ["simulated:grbl", "simulated:marlin"])
def test_contract_of_what_open_stage_returns(port: str) -> None:
    check_stage(open_stage(StageSettings(protocol="grbl", port=port)))


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_grid_of_7_by_7_within_a_minute_of_simulated_time(controller: Controller, link: Link) -> None:
    bench = Bench(controller, link)
    stage = bench.stage()
    stage.connect()
    stage.home()
    travel = stage.travel()
    first = Point(travel.x_mm[0] + 50.0, travel.y_mm[0] + 50.0)
    stage.move_to(*first)
    started_s = bench.clock.now_s()
    for row in range(7):
        for column in range(7) if row % 2 == 0 else reversed(range(7)):
            target = Point(first.x_mm + 50.0 * column, first.y_mm + 50.0 * row)
            assert stage.move_to(*target).is_at(target)
            assert bench.true_position() == pytest.approx(target, abs=1.0 / 160.0)
    assert 33.0 < bench.clock.now_s() - started_s <= 60.0


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_conformance(controller: Controller) -> None:
    stage = Bench(controller).stage()
    stage.connect()
    checks = list(check_conformance(stage))
    assert len(checks) == 7
    assert all(check.passed for check in checks), checks
