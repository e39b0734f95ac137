"""Warnings about boards: given where a sweep or a node is lost, not for single views."""

import pytest

from faintfield.rig.capture.checks import board_warnings
from faintfield.rig.plan import CapturePlan, CaptureStep, Grid, planned_frames
from faintfield.rig.stages.protocol import Point

_GRID = Grid(3, 3, 50.0, Point(0.0, 0.0))
_PLAN = CapturePlan.of(
    _GRID, [CaptureStep("charuco", (0.1,)), CaptureStep("charuco", (0.1,))], approach_mm=1.0, frame_bytes=1
)
FRAMES = planned_frames(_PLAN)


def _warnings(corners: list[int]) -> list[str]:
    """Return all warnings while frames with these numbers of corners are taken one after the other."""
    known = dict(enumerate(corners))
    warnings: list[str] = []
    for number in known:
        upto = {key: value for key, value in known.items() if key <= number}
        warnings += board_warnings(FRAMES[number], FRAMES, upto, 6)
    return warnings


def test_a_few_poor_views_give_no_warning() -> None:
    assert _warnings([5, 0, 6, 24, 24, 24, 24, 24, 0] + [24] * 8 + [24]) == []


def test_a_board_out_of_view_gives_one_warning_after_three_frames() -> None:
    (warning,) = _warnings([0, 4, 5, 0, 3])
    assert warning.startswith("board sweep 1: none of its first 3 frames shows 6 board corners, the most is 5; ")


@pytest.mark.parametrize(("poor", "expected"), [(4, False), (5, True)])
def test_a_half_lost_sweep_gives_a_warning_at_its_end(poor: int, expected: bool) -> None:
    second = [20] * (9 - poor) + [2] * poor
    warnings = _warnings([20] * 9 + second)
    assert (
        warnings
        == [
            f"board sweep 2: {poor} of 9 frames show fewer than 6 board corners, limit half of them; "
            "stand the board nearer to the middle and take the sweep again, or add one"
        ]
    ) == expected
    assert bool(warnings) == expected


def test_a_node_without_boards_is_named_after_all_sweeps() -> None:
    corners = [20] * 8 + [5]
    (warning,) = _warnings([*corners, *corners])
    last = FRAMES[8].stop.node
    assert f"1 of 9 nodes see 6 board corners in no sweep ({list(last)})" in warning
    assert _warnings([*corners, *[20] * 9]) == []
