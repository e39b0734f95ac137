"""Doubts about boards: heard where a sweep or a node is lost, and not for a view or two."""

import pytest

from faintfield.rig.capture.sweeps import board_warnings
from faintfield.rig.plan import CapturePlan, CaptureStep, Grid
from faintfield.rig.session.frames import planned_frames
from faintfield.rig.stages.protocol import Point

_GRID = Grid(3, 3, 50.0, Point(0.0, 0.0))
_PLAN = CapturePlan.of(
    _GRID, [CaptureStep("charuco", (0.1,)), CaptureStep("charuco", (0.1,))], approach_mm=1.0, frame_bytes=1
)
FRAMES = planned_frames(_PLAN)


def _said(corners: list[int]) -> list[str]:
    """Return all that is said while frames with these corners are taken one after the other."""
    known = dict(enumerate(corners))
    said: list[str] = []
    for number in known:
        upto = {key: value for key, value in known.items() if key <= number}
        said += board_warnings(FRAMES[number], FRAMES, upto, 6)
    return said


def test_a_few_poor_views_are_no_matter() -> None:
    assert _said([5, 0, 6, 24, 24, 24, 24, 24, 0] + [24] * 8 + [24]) == []


def test_a_board_out_of_view_is_said_after_three_frames_and_once() -> None:
    (said,) = _said([0, 4, 5, 0, 3])
    assert said.startswith("board sweep 1: none of its first 3 frames shows 6 board corners, the most is 5; ")


@pytest.mark.parametrize(("poor", "heard"), [(4, False), (5, True)])
def test_a_sweep_of_which_half_is_lost_is_said_at_its_end(poor: int, heard: bool) -> None:
    second = [20] * (9 - poor) + [2] * poor
    said = _said([20] * 9 + second)
    assert (
        said
        == [
            f"board sweep 2: {poor} of 9 frames show fewer than 6 board corners, limit half of them; "
            "stand the board nearer to the middle and take the sweep again, or add one"
        ]
    ) == heard
    assert bool(said) == heard


def test_a_node_that_no_sweep_shows_is_named_when_all_are_taken() -> None:
    corners = [20] * 8 + [5]
    (said,) = _said([*corners, *corners])
    last = FRAMES[8].stop.node
    assert f"1 of 9 nodes see 6 board corners in no sweep ({list(last)})" in said
    assert _said([*corners, *[20] * 9]) == []
