"""The `[[board]]` tables of rig.toml: printed ChArUco boards."""

import cv2
import numpy as np
from msgspec import Struct


class BoardSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """A `[[board]]` table: one printed ChArUco board.

    Parameters
    ----------
    name : str
        Name in results and messages.
    columns, rows : int
        Number of squares.
    square_mm, marker_mm : float
        Sides of a square and of a marker.
    dictionary : str
        OpenCV's name of the marker dictionary.
    first_marker_id : int
        Number of the first marker; boards with different markers can be told apart.
    """

    name: str
    columns: int
    rows: int
    square_mm: float
    marker_mm: float
    dictionary: str = "DICT_5X5_1000"
    first_marker_id: int = 0

    def __post_init__(self) -> None:
        if not hasattr(cv2.aruco, self.dictionary) or not self.dictionary.startswith("DICT_"):
            raise ValueError(f"board {self.name}: {self.dictionary!r} names no dictionary of OpenCV; try DICT_5X5_1000")
        available, markers = len(self._dictionary().bytesList), self.columns * self.rows // 2
        if not 0 <= self.first_marker_id <= available - markers:
            raise ValueError(
                f"board {self.name}: {self.dictionary} has {available} markers, too few for {markers} from "
                f"{self.first_marker_id} on; take a larger dictionary or a lower first_marker_id"
            )
        if min(self.columns, self.rows) < 3 or not 0.0 < self.marker_mm < self.square_mm:
            raise ValueError(
                f"board {self.name}: a board has at least 3 x 3 squares and markers smaller than these; "
                f"got {self.columns} x {self.rows}, {self.square_mm:g} mm and {self.marker_mm:g} mm"
            )

    def in_opencv(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's board; its dictionary holds only the board's own markers, which speeds up detection."""
        predefined = self._dictionary()
        count = self.columns * self.rows // 2
        own = predefined.bytesList[self.first_marker_id : self.first_marker_id + count]
        dictionary = cv2.aruco.Dictionary(own, predefined.markerSize, predefined.maxCorrectionBits)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm, self.marker_mm, dictionary, np.arange(count, dtype=np.int32)
        )

    def _dictionary(self) -> cv2.aruco.Dictionary:
        """Return the predefined dictionary that `dictionary` names."""
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
