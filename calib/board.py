"""ChArUco boards: chessboards with a marker in every white square, which identifies each corner."""

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

# Smallest and largest edge of a marker over that of its square: detection needs bits of some size and a white margin.
_MARKER_SHARE = (0.3, 0.95)


@dataclass(frozen=True)
class Board:
    """A ChArUco board to print or to detect: a chessboard with a marker in every white square.

    The board's coordinates in mm have their origin at the first inner corner (top left), x along a row, y down, and z
    into the board. Corners are numbered along the rows.

    Parameters
    ----------
    name : str
        Name in messages and results.
    columns, rows : int
        Numbers of squares across and down.
    square_mm, marker_mm : float
        Edge lengths as measured on the print.
    dictionary : str
        One of OpenCV's predefined dictionaries of markers.
    first_marker_id : int
        Number of the first marker in the dictionary. Boards that are in view together must not share numbers.

    Raises
    ------
    ValueError
        There are fewer than 3 x 3 squares, markers do not fit their squares, or the dictionary is unknown or too small.

    Examples
    --------
    >>> from faintfield import Board
    >>> board = Board("wall", columns=9, rows=7, square_mm=30.0, marker_mm=22.0)
    >>> board.marker_count, board.corner_shape
    (31, (6, 8))
    >>> board.corners_mm()[:3]  # the first corners of the first row
    array([[ 0.,  0.,  0.],
           [30.,  0.,  0.],
           [60.,  0.,  0.]])
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
        smallest, largest = (share * self.square_mm for share in _MARKER_SHARE)
        if not smallest <= self.marker_mm <= largest:
            raise ValueError(
                f"board '{self.name}': marker_mm = {self.marker_mm} does not fit squares of {self.square_mm} mm; "
                f"give {smallest:.3g} to {largest:.3g}"
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
        """Number of markers: one in each white square."""
        return self.columns * self.rows // 2

    @property
    def marker_ids(self) -> range:
        """Numbers of the markers."""
        return range(self.first_marker_id, self.first_marker_id + self.marker_count)

    @property
    def corner_shape(self) -> tuple[int, int]:
        """Numbers of rows and columns of the inner corners."""
        return self.rows - 1, self.columns - 1

    def corners_mm(self) -> NDArray[np.float64]:
        """Return the inner corners (corner, 3) in the board's coordinates, ordered by number."""
        rows, columns = self.corner_shape
        row, column = np.divmod(np.arange(rows * columns), columns)
        return np.column_stack([column, row, np.zeros(len(row))]) * self.square_mm

    def opencv_board(self, *, legacy: bool = False) -> Any:
        """Return OpenCV's board; in the `legacy` layout, boards with an even number of rows begin with white."""
        size, ids = (self.columns, self.rows), np.array(self.marker_ids)
        lengths = (float(self.square_mm), float(self.marker_mm))
        board = cv2.aruco.CharucoBoard(size, *lengths, predefined_dictionary(self.dictionary), ids)
        board.setLegacyPattern(legacy)
        return board


def predefined_dictionary(name: str) -> Any:
    """Return OpenCV's dictionary of markers by name; ValueError if it is unknown."""
    number = getattr(cv2.aruco, name, None) if name.startswith("DICT_") else None
    if number is None:
        known = sorted(known for known in dir(cv2.aruco) if known.startswith("DICT_"))
        raise ValueError(f"dictionary '{name}' is not known; take one of {', '.join(known)}")
    return cv2.aruco.getPredefinedDictionary(number)


def black_rectangles_mm(board: Board) -> NDArray[np.float64]:
    """Return the black parts of a board as rectangles (rectangle, 4): left, top, width, height in mm from the top left.

    Adjacent bits in a row of a marker form one rectangle, so that a printer leaves no hairline between them. The first
    square is black, as OpenCV draws boards by default.
    """
    dictionary = predefined_dictionary(board.dictionary)
    side = dictionary.markerSize + 2
    bit_mm, margin_mm = board.marker_mm / side, (board.square_mm - board.marker_mm) / 2
    rectangles = []
    marker_of = iter(board.marker_ids)
    for row, column in np.ndindex(board.rows, board.columns):
        left, top = column * board.square_mm, row * board.square_mm
        if (row + column) % 2 == 0:
            rectangles.append((left, top, board.square_mm, board.square_mm))
            continue
        black = dictionary.generateImageMarker(next(marker_of), side, borderBits=1) == 0
        for line, bits in enumerate(black.astype(int)):
            edges = np.flatnonzero(np.diff(np.pad(bits, 1)))
            for start, end in edges.reshape(-1, 2):
                x, y = start * bit_mm, line * bit_mm
                rectangles.append((left + margin_mm + x, top + margin_mm + y, (end - start) * bit_mm, bit_mm))
    return np.array(rectangles)
