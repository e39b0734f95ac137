"""Placement of the next board: candidates, and the one that lowers the predicted transfer error most."""

from dataclasses import dataclass
from itertools import product
from typing import Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board, predefined_dictionary
from faintfield.calib.geometry.bundle import rt_of, transform_of
from faintfield.calib.geometry.information import Information, StandingBoard, TransferPrediction
from faintfield.calib.geometry.observations import BoardObservation, determines_pose
from faintfield.calib.geometry.rig_geometry import RigGeometry
from faintfield.calib.homography import rotation_matrix

type Direction = Literal["left", "right", "up", "down", ""]
"""The edge of a board that is turned away from the camera, as the camera sees it; empty if the board faces it."""

# Tilt of the candidates, and the smallest that has a direction.
TILT_DEG, _MIN_TILT_DEG = 25.0, 5.0

# Share of the image's width or height that a near board fills; the ratio of the distances of a far and a near one.
_NEAR_FILL, _FAR_OVER_NEAR = 0.85, 1.6

# Share of its corners that every node sees at least, so that the board joins the nodes; steps of the distances tried.
_MIN_SEEN, _DISTANCE_STEP = 1 / 3, 1.08
_MAX_STEPS = 30

# Corners of a view from which the pose of a board is told: enough to tell which way it is tilted.
_MIN_CORNERS_OF_POSE = 12

# Smallest bit of a marker that the detector reads, in pixels.
_MIN_BIT_PX = 3.0

# Cells of the detector whose corners are counted: rows, columns.
CELLS = (6, 8)

# Where a board is put to reach cells without corners: this far from the middle towards the middle of their part.
_TOWARDS = 0.75

_PARTS = (("upper left", "top", "upper right"), ("left", "middle", "right"), ("lower left", "bottom", "lower right"))


@dataclass(frozen=True)
class Tilt:
    """Angle between a board and the detector, and its direction."""

    deg: float
    direction: Direction


@dataclass(frozen=True)
class Placement:
    """A pose in which a board could be shown next, in words too, and the transfer error that it would lead to.

    `width` is that of the board in the image, in widths of the image.
    """

    rt_ref_board: NDArray[np.float64]
    distance_mm: float
    width: float
    far: bool
    direction: Direction
    part: str
    error_px: float


def board_middle_mm(board: Board, rt_ref_board: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the middle of a board (3,) in the reference frame."""
    return np.asarray(rotation_matrix(rt_ref_board) @ _middle_mm(board) + rt_ref_board[3:])


def tilt_of(rt_ref_board: NDArray[np.float64]) -> Tilt:
    """Return the tilt of a board against the detector.

    >>> tilt_of(np.array([0.0, np.radians(25.0), 0.0, 0.0, 0.0, 500.0]))
    Tilt(deg=25.0, direction='left')
    """
    normal = rotation_matrix(rt_ref_board)[:, 2]
    normal = normal if normal[2] > 0 else -normal
    deg = round(float(np.degrees(np.arccos(min(normal[2], 1.0)))), 1)
    if deg < _MIN_TILT_DEG:
        return Tilt(deg, "")
    # A normal that points right means that the depth grows to the left
    if abs(normal[0]) >= abs(normal[1]):
        return Tilt(deg, "left" if normal[0] > 0 else "right")
    return Tilt(deg, "up" if normal[1] > 0 else "down")


def board_in_view(geometry: RigGeometry, board: Board, observation: BoardObservation) -> NDArray[np.float64] | None:
    """Return rt_ref_board (6,) of a board by one view of a node of known pose; None if it shows too little."""
    enough = len(observation.corners) >= _MIN_CORNERS_OF_POSE and determines_pose(
        observation, {board.name: board.corner_shape}
    )
    if observation.node not in geometry.nodes or not enough:
        return None
    rays = geometry.lens.rays_at(observation.pixels)[:, np.newaxis]
    points = board.corners_mm()[observation.corners]
    solved, rotations, translations, errors = cv2.solvePnPGeneric(
        points, rays, np.eye(3), None, flags=cv2.SOLVEPNP_IPPE
    )
    if not solved:
        return None
    best = int(np.argmin(np.ravel(errors)))
    cam_from_board = transform_of(np.append(np.ravel(rotations[best]), np.ravel(translations[best])))
    ref_from_cam = np.linalg.inv(transform_of(geometry.rt_cam_ref[geometry.nodes.index(observation.node)]))
    return rt_of(ref_from_cam @ cam_from_board)


def count_cells(pixels: NDArray[np.float64], size_px: tuple[int, int]) -> NDArray[np.int64]:
    """Return the number of corners (point, 2) in each cell of the detector, `CELLS`."""
    cell = np.clip((pixels / size_px * CELLS[::-1]).astype(int), 0, np.array(CELLS[::-1]) - 1)
    return np.bincount(cell[:, 1] * CELLS[1] + cell[:, 0], minlength=CELLS[0] * CELLS[1]).reshape(CELLS)


def emptiest_part(cells: NDArray[np.integer]) -> tuple[str, NDArray[np.float64]] | None:
    """Return the part of the image that has most cells without corners, of nine, and its middle as shares (x, y).

    None if every cell has corners.
    """
    empty = np.asarray(cells) == 0
    if not empty.any():
        return None
    row, column = ((np.arange(count) + 0.5) / count for count in CELLS)
    # Each cell counts for the parts that it lies near to
    near_row, near_column = (
        np.maximum(0, 1 - np.abs(shares[:, np.newaxis] - [0.1, 0.5, 0.9]) / 0.4) for shares in (row, column)
    )
    weight = near_row.T @ empty @ near_column
    down, across = np.unravel_index(int(np.argmax(weight)), weight.shape)
    return _PARTS[down][across], np.array([across, down]) / 2


def candidate_placements(
    prediction: TransferPrediction, so_far: Information, board: Board, cells: NDArray[np.integer]
) -> list[Placement]:
    """Return placements of a board that every node sees, the best first.

    They are near or far, face the camera or are tilted to one of four sides, and stand in the middle or towards the
    part of the detector that has fewest corners. Each gets the transfer error that one more sweep with it leads to.
    """
    geometry = prediction.geometry
    places = [("middle", np.full(2, 0.5))]
    if (part := emptiest_part(cells)) is not None and part[0] != "middle":
        places.append((part[0], 0.5 + _TOWARDS * (part[1] - 0.5)))
    directions: tuple[Direction, ...] = ("left", "right", "up", "down", "")
    found = []
    for (name, share), direction in product(places, directions):
        near = _nearest(prediction, board, direction, share)
        if near is None:
            continue
        far = _pose(geometry, board, direction, share, _FAR_OVER_NEAR * _distance(board, near.rt_ref_board))
        standing = {False: near, True: prediction.seen(board, far)}
        for is_far, seen in standing.items():
            distance_mm = _distance(board, seen.rt_ref_board)
            if is_far and _bit_px(geometry, board, distance_mm) < _MIN_BIT_PX:
                continue
            error_px = prediction.error_px(so_far + prediction.of_sweep([seen]))[0]
            width = geometry.lens.fx_px * board.columns * board.square_mm / distance_mm / geometry.lens.size_px[0]
            found.append(Placement(seen.rt_ref_board, distance_mm, width, is_far, direction, name, error_px))
    return sorted(found, key=lambda placement: placement.error_px)


def _nearest(
    prediction: TransferPrediction, board: Board, direction: Direction, share: NDArray[np.float64]
) -> StandingBoard | None:
    """Return the board as near as every node sees enough of it; None if none does at any distance."""
    lens, (rows, columns) = prediction.geometry.lens, board.corner_shape
    across, down = (columns + 1) * board.square_mm, (rows + 1) * board.square_mm
    (width, height) = lens.size_px
    distance_mm = max(lens.fx_px * across / width, lens.fy_px * down / height) / _NEAR_FILL
    for _ in range(_MAX_STEPS):
        seen = prediction.seen(board, _pose(prediction.geometry, board, direction, share, distance_mm))
        if min((weights > 0).sum() for weights in seen.weights.values()) >= _MIN_SEEN * rows * columns:
            return seen
        distance_mm *= _DISTANCE_STEP
    return None


def _pose(
    geometry: RigGeometry, board: Board, direction: Direction, share: NDArray[np.float64], distance_mm: float
) -> NDArray[np.float64]:
    """Return the pose of a board whose middle is seen at a share (x, y) of the reference image."""
    about = {"left": (0, 1), "right": (0, -1), "up": (-1, 0), "down": (1, 0), "": (0, 0)}[direction]
    rodrigues = np.radians(TILT_DEG) * np.array([*about, 0.0])
    lens = geometry.lens
    x, y = (share * lens.size_px - [lens.cx_px, lens.cy_px]) / [lens.fx_px, lens.fy_px]
    middle_mm = distance_mm * np.array([x, y, 1.0])
    return np.append(rodrigues, middle_mm - cv2.Rodrigues(rodrigues)[0] @ _middle_mm(board))


def _middle_mm(board: Board) -> NDArray[np.float64]:
    rows, columns = board.corner_shape
    return np.array([(columns - 1) / 2, (rows - 1) / 2, 0.0]) * board.square_mm


def _distance(board: Board, rt_ref_board: NDArray[np.float64]) -> float:
    return float(board_middle_mm(board, rt_ref_board)[2])


def _bit_px(geometry: RigGeometry, board: Board, distance_mm: float) -> float:
    bits = predefined_dictionary(board.dictionary).markerSize + 2
    return float(geometry.lens.fx_px * board.marker_mm / bits / distance_mm)


def describe_placement(placement: Placement, *, with_distance: bool = True) -> str:
    """Return a placement in plain words, with its width in the picture if no lens is known that tells its distance."""
    size = (
        f"about {round(placement.distance_mm, -1):.0f} mm"
        if with_distance
        else f"as wide as {placement.width:.0%} of the picture"
    )
    distance = f"{'far away' if placement.far else 'near'} ({size})"
    edges = {"left": "left", "right": "right", "up": "upper", "down": "lower"}
    tilt = "facing the camera"
    if placement.direction:
        towards = placement.direction if placement.direction in ("up", "down") else f"to the {placement.direction}"
        tilt = f"tilted by about {TILT_DEG:.0f}° {towards} ({edges[placement.direction]} edge away from the camera)"
    place = "in the middle" if placement.part == "middle" else f"towards the {placement.part} of the picture"
    return f"{distance}, {tilt}, {place}"
