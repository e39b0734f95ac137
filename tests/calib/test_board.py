"""Boards against OpenCV's own drawing of them."""

from typing import Any

import numpy as np
import pytest

from faintfield.calib.board import Board, black_rectangles_mm


def drawn(board: Board, px_per_mm: int) -> np.ndarray[Any, Any]:
    picture = np.full(
        (round(board.rows * board.square_mm * px_per_mm), round(board.columns * board.square_mm * px_per_mm)), 255
    )
    for left, top, across, down in np.rint(black_rectangles_mm(board) * px_per_mm).astype(int):
        picture[top : top + down, left : left + across] = 0
    return picture


@pytest.mark.parametrize(("columns", "rows", "first"), [(5, 7, 0), (8, 6, 40)])
def test_the_rectangles_are_opencvs_drawing(columns: int, rows: int, first: int) -> None:
    board = Board("b", columns, rows, 10.0, 7.0, "DICT_5X5_250", first)
    ours = drawn(board, 14)
    opencvs = board.opencv_board().generateImage(ours.shape[::-1], marginSize=0, borderBits=1)
    assert (ours != opencvs).mean() < 0.01  # edges may be one pixel off
    inner = np.abs(np.diff(ours, axis=1))[:, 1:].max()
    assert inner == 255


def test_corners_are_numbered_along_the_rows_from_the_first_inner_corner() -> None:
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
def test_invalid_boards_are_refused(changed: dict[str, Any], words: str) -> None:
    good: dict[str, Any] = {"name": "b", "columns": 5, "rows": 7, "square_mm": 10.0, "marker_mm": 7.0}
    good |= {"dictionary": "DICT_5X5_250"}
    Board(**good)
    with pytest.raises(ValueError, match=words):
        Board(**(good | changed))
