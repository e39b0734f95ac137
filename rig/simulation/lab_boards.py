"""The boards of a simulated lab, as they come from the printer and stand before the camera."""

import math
from dataclasses import replace

import cv2
import numpy as np

from faintfield.rig.boards import BoardSettings
from faintfield.rig.simulation.boards import printed_board, six_boards
from faintfield.rig.simulation.optics import SimulatedOptics
from faintfield.rig.simulation.scene import TexturedPlane

_MARGIN_MM = 12.0

# White paper reflects most of the light and black ink a little.
_BLACK, _WHITE = 0.04, 0.9

# The print is finer than the detector sees it, and blurred as the lens does, which keeps its edges from aliasing.
_SAMPLES_PER_PX, _BLUR_PX = 2.0, 0.6

# Boards beside one another stand this far apart, so that none hides another.
_BESIDE_MM = np.array([0.0, 0.0, 0.0, 180.0, 0.0, 40.0])


def standing_board(board: BoardSettings, sweep: int, place: int, optics: SimulatedOptics) -> TexturedPlane:
    """Return a board as it stands in a sweep: turned and tilted differently in each, several beside one another.

    Parameters
    ----------
    board : BoardSettings
        What is printed.
    sweep : int
        Which sweep.
    place : int
        Which of the boards.
    optics : SimulatedOptics
        The camera that will look at it.
    """
    places = six_boards(board.rows - 1, board.columns - 1, board.square_mm)
    standing = places[sweep % len(places)]
    standing = replace(standing, rt_ref_board=standing.rt_ref_board + place * _BESIDE_MM)
    px_mm = float(standing.rt_ref_board[5]) / optics.fx_px
    drawn = board.in_opencv()
    # A whole number of samples per square, or the print would not be true to size, and one for each bit of a marker
    bits = drawn.getDictionary().markerSize + 2
    least = math.ceil(bits * board.square_mm / board.marker_mm)
    samples = max(round(board.square_mm * _SAMPLES_PER_PX / px_mm), least)
    pitch_mm = board.square_mm / samples
    margin = round(_MARGIN_MM / pitch_mm)
    printed = drawn.generateImage((board.columns * samples, board.rows * samples)) / np.float32(255)
    paper = _BLACK + (_WHITE - _BLACK) * np.pad(printed, margin, constant_values=1.0)
    picture = cv2.GaussianBlur(paper.astype(np.float32), (0, 0), _BLUR_PX * px_mm / pitch_mm)
    edge_mm = margin * pitch_mm + board.square_mm
    return printed_board(board.name, picture, pitch_mm, standing, (edge_mm, edge_mm))
