"""Boards against OpenCV's own drawing of them."""

from typing import Any

import numpy as np
import pytest

from faintfield.calib.board import Board, black_rectangles_mm


@pytest.mark.parametrize(("columns", "rows", "first"), [(5, 7, 0), (8, 6, 40)])
def test_rectangles_are_those_opencv_draws(columns: int, rows: int, first: int) -> None:
    board = Board("b", columns, rows, 10.0, 7.0, "DICT_5X5_250", first)
    drawing = board.opencv_board().generateImage((140 * columns, 140 * rows), marginSize=0, borderBits=1)
    picture = np.full(drawing.shape, 255)
    for left, top, across, down in np.rint(black_rectangles_mm(board) * 14).astype(int):
        picture[top : top + down, left : left + across] = 0
    assert (picture != drawing).mean() < 0.01  # edges may be one pixel off


def test_corners_are_numbered_along_the_rows() -> None:
    board = Board("b", 5, 7, 10.0, 7.0)
    opencvs = board.opencv_board().getChessboardCorners()
    np.testing.assert_allclose(board.corners_mm(), opencvs - opencvs[0], atol=1e-6)


@pytest.mark.parametrize(
    ("changed", "words"),
    [
        ({"marker_mm": 10.0}, "does not fit squares"),
        ({"dictionary": "DICT_9X9"}, "is not known"),
        ({"first_marker_id": 240}, "has 0 to 249"),
    ],
)
def test_invalid_board_is_refused(changed: dict[str, Any], words: str) -> None:
    good: dict[str, Any] = {"name": "b", "columns": 5, "rows": 7, "square_mm": 10.0, "marker_mm": 7.0}
    good |= {"dictionary": "DICT_5X5_250"}
    Board(**good)
    with pytest.raises(ValueError, match=words):
        Board(**(good | changed))
