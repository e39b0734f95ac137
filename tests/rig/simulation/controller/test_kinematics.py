"""The simulated mechanics obey the physics of motors, play and switches."""

import pytest

from faintfield.rig.simulation.controller.kinematics import Axis, Mechanics, SimulatedClock


def mechanics(play_mm: float = 0.0) -> tuple[SimulatedClock, Mechanics]:
    clock = SimulatedClock()
    axes = (Axis(-2.0, 405.0, 0.0, play_mm), Axis(-2.0, 405.0, 0.0, play_mm))
    return clock, Mechanics(clock, axes, 0.0125, -1.0)


def test_clock_jumps_from_event_to_event() -> None:
    clock = SimulatedClock()
    events: list[tuple[str, float]] = []
    clock.after(2.0, lambda: events.append(("late", clock.now_s())))
    clock.after(1.0, lambda: events.append(("early", clock.now_s())))
    clock.after(1.5, lambda: events.append(("never", clock.now_s()))).cancel()
    assert clock.next_event_s() == 1.0
    clock.sleep_s(1.2)
    assert clock.now_s() == 1.2
    clock.sleep_s(5.0)
    assert events == [("early", 1.0), ("late", 2.0)]
    assert clock.next_event_s() is None


def test_braking_distance_is_that_of_constant_deceleration() -> None:
    clock, stage = mechanics()
    stage.queue((300.0, 0.0), 100.0, 500.0)
    clock.sleep_s(1.0)
    here = stage.commanded_mm()[0]
    stage.brake()
    clock.sleep_s(0.19)
    assert stage.moving
    clock.sleep_s(0.02)
    assert not stage.moving
    assert stage.true_mm()[0] == pytest.approx(here + 100.0**2 / (2 * 500.0), abs=0.0125)


def test_positions_are_whole_steps() -> None:
    clock, stage = mechanics()
    stage.queue((33.3333, 7.77), 100.0, 500.0)
    clock.sleep_s(5.0)
    x, y = stage.true_mm()
    assert (x / 0.0125, y / 0.0125) == pytest.approx((round(x / 0.0125), round(y / 0.0125)))
    assert (x, y) == pytest.approx((33.3333, 7.77), abs=0.00626)


def test_play_holds_the_carriage_back_downwards() -> None:
    clock, stage = mechanics(play_mm=0.3)
    for target, true in ((50.0, 50.0), (30.0, 30.3), (30.2, 30.3), (31.0, 31.0)):
        stage.queue((target, 0.0), 100.0, 500.0)
        clock.sleep_s(5.0)
        assert stage.true_mm()[0] == pytest.approx(true, abs=0.0126)


def test_carriage_at_the_end_loses_steps() -> None:
    clock, stage = mechanics()
    stage.queue((410.0, 0.0), 100.0, 500.0)
    clock.sleep_s(10.0)
    assert stage.true_mm()[0] == 405.0
    stage.queue((400.0, 0.0), 100.0, 500.0)
    clock.sleep_s(10.0)
    assert stage.true_mm()[0] == pytest.approx(395.0)
