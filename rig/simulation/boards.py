"""Simulated boards: their poses, their printed texture, and where a camera sees their corners."""

import math
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.rig.settings import BoardSettings
from faintfield.rig.simulation.optics import SimulatedOptics, distort
from faintfield.rig.simulation.scene import TexturedPlane

# Rotations about x and y (degrees), then x, y, z (mm): tilted in all directions, near and far, seen from every node.
_SIX_POSES = (
    (22.0, 4.0, -60.0, -50.0, 540.0),
    (-24.0, 6.0, 70.0, 40.0, 560.0),
    (5.0, 28.0, 40.0, -45.0, 560.0),
    (-4.0, -26.0, -50.0, 45.0, 900.0),
    (20.0, -20.0, 10.0, 10.0, 900.0),
    (0.0, 3.0, -10.0, 0.0, 950.0),
)


@dataclass(frozen=True)
class SimulatedBoard:
    """The inner corners of a chessboard in space.

    `rt_ref_board` leads from the board, whose origin is its first corner, to the reference camera: Rodrigues rad and
    mm.
    """

    corner_rows: int
    corner_columns: int
    square_mm: float
    rt_ref_board: NDArray[np.float64]

    def seen(self, optics: SimulatedOptics, rt_cam_ref: NDArray[np.float64]) -> NDArray[np.float64]:
        """Return the images (corner, 2) of the corners, row by row, in pixels; NaN outside the detector."""
        row, column = np.divmod(np.arange(self.corner_rows * self.corner_columns), self.corner_columns)
        flat = np.column_stack([column, row, np.zeros(len(row))]) * self.square_mm
        points = _transform(rt_cam_ref, _transform(self.rt_ref_board, flat))
        x, y = distort(points[:, 0] / points[:, 2], points[:, 1] / points[:, 2], optics.distortion)
        pixels = np.column_stack([x * optics.fx_px + optics.cx_px, y * optics.fy_px + optics.cy_px])
        inside = (pixels >= 0).all(axis=1) & (pixels <= np.array(optics.size_px) - 1).all(axis=1) & (points[:, 2] > 0)
        return np.where(inside[:, np.newaxis], pixels, np.nan)


def six_boards(corner_rows: int, corner_columns: int, square_mm: float) -> list[SimulatedBoard]:
    """Return a board in six poses around the scene, as a careful person would hold it."""
    centre_mm = np.array([(corner_columns - 1) * square_mm / 2, (corner_rows - 1) * square_mm / 2, 0.0])
    boards = []
    for about_x, about_y, *place_mm in _SIX_POSES:
        rotation = _rotation(np.radians([0, about_y, 0])) @ _rotation(np.radians([about_x, 0, 0]))
        pose = np.append(cv2.Rodrigues(rotation)[0].ravel(), place_mm - rotation @ centre_mm)
        boards.append(SimulatedBoard(corner_rows, corner_columns, square_mm, pose))
    return boards


def printed_board(
    name: str,
    picture: NDArray[np.floating],
    pitch_mm: float,
    board: SimulatedBoard,
    first_corner_mm: tuple[float, float],
) -> TexturedPlane:
    """Return a printed board, of reflectance `picture` (row, column), in the pose of `board`.

    `first_corner_mm` is the position x, y of the first inner corner from the outer edges of the picture's first sample.
    """
    height, width = picture.shape
    centre_mm = np.array([width * pitch_mm / 2 - first_corner_mm[0], height * pitch_mm / 2 - first_corner_mm[1], 0.0])
    pose = np.append(board.rt_ref_board[:3], _transform(board.rt_ref_board, centre_mm[np.newaxis])[0])
    opaque = np.ones(picture.shape, np.float32)
    rx, ry, rz, x, y, z = pose.tolist()
    return TexturedPlane(name, picture.astype(np.float32), opaque, pitch_mm, (rx, ry, rz, x, y, z))


def _rotation(rodrigues: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(rodrigues)[0], np.float64)


def _transform(rt: NDArray[np.float64], points: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(points @ _rotation(np.asarray(rt[:3], np.float64)).T + rt[3:], np.float64)


# White margin around a board.
_MARGIN_MM = 12.0

# Reflectance of black ink and white paper.
_BLACK, _WHITE = 0.04, 0.9

# Samples of the print per pixel of the detector, and the blur of the lens in pixels, which prevents aliasing.
_SAMPLES_PER_PX, _BLUR_PX = 2.0, 0.6

# Change of pose (rad, mm) from one board to the next, so that none hides another.
_BOARD_OFFSET = np.array([0.0, 0.0, 0.0, 180.0, 0.0, 40.0])


def standing_board(board: BoardSettings, sweep: int, place: int, optics: SimulatedOptics) -> TexturedPlane:
    """Return a board in the pose of a sweep; several boards stand side by side, each in its own `place`.

    The optics of the camera decide how finely the board is sampled.
    """
    poses = six_boards(board.rows - 1, board.columns - 1, board.square_mm)
    standing = poses[sweep % len(poses)]
    standing = replace(standing, rt_ref_board=standing.rt_ref_board + place * _BOARD_OFFSET)
    px_mm = float(standing.rt_ref_board[5]) / optics.fx_px
    drawn = board.in_opencv()
    # A whole number of samples per square keeps the print true to size; each bit of a marker needs at least one
    bits = drawn.getDictionary().markerSize + 2
    min_samples = math.ceil(bits * board.square_mm / board.marker_mm)
    samples = max(round(board.square_mm * _SAMPLES_PER_PX / px_mm), min_samples)
    pitch_mm = board.square_mm / samples
    margin = round(_MARGIN_MM / pitch_mm)
    printed = drawn.generateImage((board.columns * samples, board.rows * samples)) / np.float32(255)
    paper = _BLACK + (_WHITE - _BLACK) * np.pad(printed, margin, constant_values=1.0)
    picture = cv2.GaussianBlur(paper.astype(np.float32), (0, 0), _BLUR_PX * px_mm / pitch_mm)
    edge_mm = margin * pitch_mm + board.square_mm
    return printed_board(board.name, picture, pitch_mm, standing, (edge_mm, edge_mm))
