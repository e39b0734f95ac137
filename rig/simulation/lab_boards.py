"""The printed boards of the simulated lab, in a different pose for each sweep."""

import math
from dataclasses import replace

import cv2
import numpy as np

from faintfield.rig.boards import BoardSettings
from faintfield.rig.simulation.boards import printed_board, six_boards
from faintfield.rig.simulation.optics import SimulatedOptics
from faintfield.rig.simulation.scene import TexturedPlane

# White margin around a board.
_MARGIN_MM = 12.0

# Reflectance of black ink and white paper.
_BLACK, _WHITE = 0.04, 0.9

# Samples of the print per pixel of the detector, and the blur of the lens in pixels, which prevents aliasing.
_SAMPLES_PER_PX, _BLUR_PX = 2.0, 0.6

# Change of pose (rad, mm) from one board to the next, so that none hides another.
_BOARD_OFFSET = np.array([0.0, 0.0, 0.0, 180.0, 0.0, 40.0])


def standing_board(board: BoardSettings, sweep: int, place: int, optics: SimulatedOptics) -> TexturedPlane:
    """Return a board in the pose of a sweep; several boards stand side by side.

    Parameters
    ----------
    board : BoardSettings
        The printed board.
    sweep : int
        Index of the sweep, which decides the pose.
    place : int
        Index of the board.
    optics : SimulatedOptics
        The camera, which decides how finely the board is sampled.
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
