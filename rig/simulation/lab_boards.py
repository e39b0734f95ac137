"""The boards of a simulated lab, as they come from the printer and stand before the camera."""

import numpy as np

from rig.boards import Board
from rig.simulation.scene import TexturedPlane

_TEXTURE_PITCH_MM = 0.5
_MARGIN_SQUARES = 0.5


def standing_board(board: Board, sweep: int, place: int) -> TexturedPlane:
    """Return a board as it stands in a sweep: turned and tilted differently in each, several beside one another.

    Parameters
    ----------
    board : Board
        What is printed.
    sweep : int
        Which sweep.
    place : int
        Which of the boards.
    """
    size_px = (
        round(board.columns * board.square_mm / _TEXTURE_PITCH_MM),
        round(board.rows * board.square_mm / _TEXTURE_PITCH_MM),
    )
    margin_px = round(_MARGIN_SQUARES * board.square_mm / _TEXTURE_PITCH_MM)
    printed = board.in_opencv().generateImage(size_px).astype(np.float32) / 255.0
    paper = np.pad(printed, margin_px, constant_values=1.0)
    # White paper reflects most of the light and black ink a little
    reflectance = (0.04 + 0.86 * paper).astype(np.float32)
    tilt_rad = 0.25 if sweep % 2 else -0.2
    pose = (0.5 * tilt_rad, tilt_rad, 0.1 * sweep, 180.0 * place, 20.0 * sweep, 620.0 + 60.0 * sweep + 40.0 * place)
    return TexturedPlane(board.name, reflectance, np.ones_like(reflectance), _TEXTURE_PITCH_MM, pose)
