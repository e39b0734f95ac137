"""Every stage meets the contract, over every kind of connection."""

from collections.abc import Iterator
from functools import partial
from unittest import mock

import pytest

from faintfield.rig.devices import open_stage
from faintfield.rig.errors import StageLost
from faintfield.rig.simulation.controller.bench import Bench, DirectLink, Link, PtyLink
from faintfield.rig.simulation.controller.grbl import SimulatedGrbl
from faintfield.rig.stages.conformance import check_conformance
from faintfield.rig.stages.protocol import Point, StageSettings
from faintfield.testing import stage_contract
from tests.rig.stages.benches import CONTROLLERS, Controller, grbl
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
    stage_contract(Bench(controller, link).stage())


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_contract_with_a_board_that_keeps_running(
    controller: Controller,
) -> None:
    stage_contract(Bench(controller, resets_on_open=False).stage())


@pytest.mark.parametrize("port", ["simulated:grbl", "simulated:marlin"])
def test_contract_of_what_open_stage_returns(port: str) -> None:
    stage_contract(open_stage(StageSettings(protocol="simulated", port=port)))


@pytest.mark.parametrize("controller", CONTROLLERS)
def test_a_grid_of_7_by_7_within_a_minute_of_simulated_time(controller: Controller) -> None:
    bench = Bench(controller)
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


def test_a_setting_that_should_be_changed_fails_the_first_check() -> None:
    bench = Bench(partial(SimulatedGrbl, settings={20: "0"}))
    stage = bench.stage()
    stage.connect()
    (failed,) = (check for check in check_conformance(stage) if not check.passed)
    assert failed.name == "settings"
    assert failed.measured.startswith("$20=0")


def test_a_stage_slower_than_its_settings_say_fails_the_check_of_speed() -> None:
    bench = Bench(SimulatedGrbl)
    stage = bench.stage()
    stage.connect()
    for number in (110, 111):
        grbl(bench).settings[number] = f"{0.5 * float(grbl(bench).settings[number]):.3f}"
    assert [check.name for check in check_conformance(stage) if not check.passed] == ["speed"]


def test_lost_steps_fail_the_check_of_repeatability() -> None:
    bench = Bench(SimulatedGrbl)
    stage = bench.stage()
    stage.connect()
    checks = check_conformance(stage)
    done = [next(checks) for _ in range(6)]
    homings: list[bool] = []

    def slip_after_the_timing(data: bytes) -> bytes:
        homings.extend([True] * data.count(b"$H"))
        if len(homings) == 4 and b"$J" in data:
            bench.firmware.mechanics.axes[0].slip_mm += 1.0
            homings.append(True)
        return data

    bench.wire.filters_to_controller.append(slip_after_the_timing)
    last = next(checks)
    assert all(check.passed for check in done)
    assert (last.name, last.passed) == ("repeatability", False)
    assert "lost its scale" in last.measured


def test_the_port_is_closed_even_if_a_stage_cannot_be_told_to_stop() -> None:
    """A plug-in may raise what no controller should."""
    stage = Bench(SimulatedGrbl).stage()
    stage.connect()
    controller = stage._controller  # noqa: SLF001 - what a plug-in would be
    with (
        mock.patch.object(controller, "read_position", side_effect=StageLost("unplugged; plug it in")),
        pytest.raises(StageLost),
    ):
        stage.position()
    with (
        mock.patch.object(controller, "abort", side_effect=ZeroDivisionError),
        mock.patch.object(controller, "close", wraps=controller.close) as close,
        pytest.raises(ZeroDivisionError),
    ):
        stage.close()
    assert close.called
    stage.connect()
    stage.close()
