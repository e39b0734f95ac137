"""The contract of a stage, which every implementation must meet."""

import math

import pytest

from faintfield.rig.errors import NotHomed, OutsideTravel, PositionLost, StageError, StageLost
from faintfield.rig.stages.gantry import Gantry
from faintfield.rig.stages.protocol import Point


def stage_contract(stage: Gantry) -> None:
    """Check an unconnected stage, from connecting to closing; it homes five times and moves in a half of its travel.

    Parameters
    ----------
    stage : Gantry
        The stage; around a `Controller` of your own, `Gantry(controller, settings, clock)`.

    Raises
    ------
    AssertionError
        The stage does not meet the contract.
    """
    _check_unconnected(stage)
    stage.connect()
    _check_identity(stage)
    _check_unhomed(stage)
    _check_homed(stage)
    _check_moves(stage)
    _check_refusals(stage)
    _check_distrust(stage)
    _check_hold_and_recover(stage)
    _check_close(stage)


def _inside(stage: Gantry, share_x: float, share_y: float) -> Point:
    """Return the point at these fractions of the travel, rounded to 0.01 mm."""
    (x0, x1), (y0, y1) = stage.travel().x_mm, stage.travel().y_mm
    return Point(round(x0 + share_x * (x1 - x0), 2), round(y0 + share_y * (y1 - y0), 2))


def _check_unconnected(stage: Gantry) -> None:
    for act in (stage.identify, stage.travel, stage.home, stage.position, stage.switches):
        with pytest.raises(StageLost):
            act()
    with pytest.raises(NotHomed):
        stage.move_to(0.0, 0.0)
    assert not stage.trusted


def _check_identity(stage: Gantry) -> None:
    identity = stage.identify()
    assert identity.firmware
    assert all(0.0 < tolerance < 0.1 for tolerance in identity.tolerance_mm)
    assert min(identity.motion.rate_mm_per_s) > 0.0
    assert min(identity.motion.acceleration_mm_per_s2) > 0.0
    assert identity.homing_bound_s >= 240.0


def _check_unhomed(stage: Gantry) -> None:
    assert not stage.trusted
    target = _inside(stage, 0.5, 0.5)
    with pytest.raises(NotHomed):
        stage.move_to(*target)
    with pytest.raises(NotHomed):
        stage.verify_at(*target)


def _check_homed(stage: Gantry) -> None:
    homing = stage.home()
    assert stage.trusted
    assert homing.position.trusted
    assert homing.duration_s >= 0.0
    assert stage.position() == homing.position
    assert stage.travel().holds(homing.position.point)
    assert stage.switches() <= {0, 1}


def _check_moves(stage: Gantry) -> None:
    for shares in ((0.25, 0.25), (0.5, 0.25), (0.25, 0.5), (0.26, 0.26)):
        target = _inside(stage, *shares)
        assert stage.move_to(*target).is_at(target)
        assert stage.verify_at(*target).is_at(target)
        assert stage.position().is_at(target)
        assert stage.switches() == frozenset()


def _check_refusals(stage: Gantry) -> None:
    before = stage.position()
    (x0, x1), (y0, y1) = stage.travel().x_mm, stage.travel().y_mm
    for outside in ((x1 + 0.01, y0 + 5.0), (x0 + 5.0, y0 - 0.01), (math.nan, y0 + 5.0), (math.inf, y1)):
        with pytest.raises(OutsideTravel):
            stage.move_to(*outside)
    assert stage.trusted
    assert stage.position() == before


def _check_distrust(stage: Gantry) -> None:
    x_mm, y_mm = stage.position().point
    with pytest.raises(PositionLost):
        stage.verify_at(x_mm + 2.0 * max(stage.identify().tolerance_mm), y_mm)
    assert not stage.trusted
    assert not stage.position().is_at(Point(x_mm, y_mm))
    with pytest.raises(NotHomed):
        stage.move_to(x_mm, y_mm)
    stage.recover()
    assert not stage.trusted
    stage.home()
    assert stage.trusted


def _check_hold_and_recover(stage: Gantry) -> None:
    stage.recover()
    assert stage.trusted
    stage.hold()
    if not stage.trusted:
        stage.home()
    assert stage.move_to(*_inside(stage, 0.3, 0.3)).trusted


def _check_close(stage: Gantry) -> None:
    stage.close()
    stage.close()
    assert not stage.trusted
    with pytest.raises(StageError):
        stage.position()
    stage.connect()
    assert not stage.trusted
    stage.home()
    assert stage.trusted
    stage.close()
