"""Printed ChArUco boards, as rig.toml describes them."""

import cv2
import numpy as np
from msgspec import Struct


class BoardSettings(Struct, frozen=True, forbid_unknown_fields=True):
    """A `[[board]]` table: one printed ChArUco board.

    Parameters
    ----------
    name : str
        What to call it.
    columns, rows : int
        Squares.
    square_mm, marker_mm : float
        Sides.
    dictionary : str
        OpenCV's name of the marker dictionary.
    first_marker_id : int
        Markers are numbered from here, so that several boards can be told apart.
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
            raise ValueError(f"board {self.name}: {self.dictionary!r} is no dictionary of OpenCV; try DICT_5X5_1000")
        known, own = len(self._dictionary().bytesList), self.columns * self.rows // 2
        if not 0 <= self.first_marker_id <= known - own:
            raise ValueError(
                f"board {self.name}: {self.dictionary} has {known} markers, too few for {own} from "
                f"{self.first_marker_id} on; take a larger dictionary or a lower first_marker_id"
            )
        if min(self.columns, self.rows) < 3 or not 0.0 < self.marker_mm < self.square_mm:
            raise ValueError(
                f"board {self.name}: a board has at least 3 x 3 squares and markers smaller than these; "
                f"got {self.columns} x {self.rows}, {self.square_mm:g} mm and {self.marker_mm:g} mm"
            )

    def in_opencv(self) -> cv2.aruco.CharucoBoard:
        """Return OpenCV's idea of the board; its dictionary holds its own markers only: that is quicker."""
        whole = self._dictionary()
        count = self.columns * self.rows // 2
        own = whole.bytesList[self.first_marker_id : self.first_marker_id + count]
        dictionary = cv2.aruco.Dictionary(own, whole.markerSize, whole.maxCorrectionBits)
        return cv2.aruco.CharucoBoard(
            (self.columns, self.rows), self.square_mm, self.marker_mm, dictionary, np.arange(count, dtype=np.int32)
        )

    def _dictionary(self) -> cv2.aruco.Dictionary:
        return cv2.aruco.getPredefinedDictionary(getattr(cv2.aruco, self.dictionary))
