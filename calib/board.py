"""The ChArUco board: a chessboard with a marker in every white square, so that each corner is known by number."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

# A marker must leave some white around it, and its bits some size, for the detector to find it.
_MARKER_SHARE = (0.3, 0.95)


@dataclass(frozen=True)
class Board:
    """A board to print or to look for.

    The board's coordinates have their origin at its first inner corner (top left), x along a row, y down, z into the
    board, in mm. Corners are numbered along the rows.

    Parameters
    ----------
    name : str
        By which messages and results know it.
    columns, rows : int
        Squares across and down.
    square_mm, marker_mm : float
        Edge lengths, as measured on the print.
    dictionary : str
        Of OpenCV's predefined ones, such as "DICT_5X5_1000".
    first_marker_id : int
        Its markers are numbered from here; boards that are in view together share no number.

    Raises
    ------
    ValueError
        Fewer than 3 x 3 squares, markers that do not fit their squares, an unknown dictionary or too small a one.
    """

    name: str
    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_5X5_1000"
    first_marker_id: int = 0

    def __post_init__(self) -> None:
        if min(self.columns, self.rows) < 3:
            raise ValueError(f"board '{self.name}' has {self.columns} x {self.rows} squares; at least 3 x 3 are needed")
        if not (np.isfinite(self.square_mm) and self.square_mm > 0):
            raise ValueError(f"board '{self.name}': square_mm must be positive, got {self.square_mm}")
        least, most = (share * self.square_mm for share in _MARKER_SHARE)
        if not least <= self.marker_mm <= most:
            raise ValueError(
                f"board '{self.name}': marker_mm = {self.marker_mm} does not fit squares of {self.square_mm} mm; "
                f"give {least:.3g} to {most:.3g}"
            )
        known = len(predefined_dictionary(self.dictionary).bytesList)
        if self.first_marker_id < 0 or self.first_marker_id + self.marker_count > known:
            raise ValueError(
                f"board '{self.name}' needs markers {self.first_marker_id} to "
                f"{self.first_marker_id + self.marker_count - 1}, {self.dictionary} has 0 to {known - 1}; "
                "take a larger dictionary or a smaller first_marker_id"
            )

    @property
    def marker_count(self) -> int:
        """How many markers it carries: one in each white square."""
        return self.columns * self.rows // 2

    @property
    def marker_ids(self) -> range:
        """Numbers of its markers."""
        return range(self.first_marker_id, self.first_marker_id + self.marker_count)

    @property
    def corner_shape(self) -> tuple[int, int]:
        """Rows and columns of its inner corners."""
        return self.rows - 1, self.columns - 1

    def corners_mm(self) -> NDArray[np.float64]:
        """Return the inner corners (corner, 3) in the board's coordinates, by number."""
        rows, columns = self.corner_shape
        row, column = np.divmod(np.arange(rows * columns), columns)
        return np.column_stack([column, row, np.zeros(len(row))]) * self.square_mm

    def opencv_board(self, *, legacy: bool = False) -> Any:
        """Return the board as OpenCV knows it; `legacy`: an even number of rows begins with a white square."""
        size, ids = (self.columns, self.rows), np.array(self.marker_ids)
        lengths = (float(self.square_mm), float(self.marker_mm))
        board = cv2.aruco.CharucoBoard(size, *lengths, predefined_dictionary(self.dictionary), ids)
        board.setLegacyPattern(legacy)
        return board


def predefined_dictionary(name: str) -> Any:
    """Return OpenCV's dictionary of markers.

    Raises
    ------
    ValueError
        There is none of that name.
    """
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        known = sorted(known for known in dir(cv2.aruco) if known.startswith("DICT_"))
        raise ValueError(f"dictionary '{name}' is not known; take one of {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(number)


def black_rectangles_mm(board: Board) -> NDArray[np.float64]:
    """Return what is black on a board as rectangles (rectangle, 4): left, top, width, height in mm from its top left.

    Rectangles of one row of a marker that touch are one, so that a printer leaves no hairline between them. The first
    square is black, as OpenCV draws boards by default.
    """
    rectangles = []
    marker_of = iter(board.marker_ids)
    for row in range(board.rows):
        for column in range(board.columns):
            left, top = column * board.square_mm, row * board.square_mm
            if (row + column) % 2 == 0:
                rectangles.append((left, top, board.square_mm, board.square_mm))
                continue
            margin = (board.square_mm - board.marker_mm) / 2
            for x, y, width, height in _marker_runs(board, next(marker_of)):
                rectangles.append((left + margin + x, top + margin + y, width, height))
    return np.array(rectangles)


def _marker_runs(board: Board, marker_id: int) -> list[tuple[float, float, float, float]]:
    """Return the black runs of one marker, row by row, in mm from the marker's top left."""
    dictionary = predefined_dictionary(board.dictionary)
    side = dictionary.markerSize + 2
    black = dictionary.generateImageMarker(marker_id, side, borderBits=1) == 0
    bit_mm = board.marker_mm / side
    runs = []
    for row in range(side):
        edges = np.flatnonzero(np.diff(np.pad(black[row].astype(int), 1)))
        for start, end in edges.reshape(-1, 2):
            runs.append((start * bit_mm, row * bit_mm, (end - start) * bit_mm, bit_mm))
    return runs
