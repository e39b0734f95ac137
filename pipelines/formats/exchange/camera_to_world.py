"""Poses as other programs state them, where each camera is and how it is turned, and as this project has them."""

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy.spatial.transform import Rotation

# By how much the columns of a rotation may be off unit length and right angles, as rounded numbers are.
_TOLERANCE = 1e-2


def rt_cam_world(turn: ArrayLike, centre: ArrayLike) -> NDArray[np.float64]:
    """Return a pose (6,), Rodrigues rad and the unit of the centre, from world to camera.

    Parameters
    ----------
    turn : array (3, 3)
        Rotation from camera to world: its columns are the camera's x (right), y (down) and z (forward) in the world.
    centre : array (3,)
        Place of the camera in the world.

    Raises
    ------
    ValueError
        `turn` is no rotation: it is not finite, stretches, or mirrors.
    """
    matrix = np.asarray(turn, np.float64)
    # Elements beyond 2 are refused before their squares, which may overflow
    if not (np.abs(matrix) <= 2).all() or not np.allclose(matrix.T @ matrix, np.eye(3), atol=_TOLERANCE):
        raise ValueError("its rotation is not finite, or has columns that are not of length 1 and at right angles")
    if np.linalg.det(matrix) < 0:
        raise ValueError("its rotation mirrors the world")
    to_camera = Rotation.from_matrix(matrix).inv()
    return np.append(to_camera.as_rotvec(), -to_camera.apply(np.asarray(centre, np.float64)))


def turn_and_centre(rt: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the rotation (3, 3) from camera to world and the camera's place (3,) of a pose; undoes `rt_cam_world`."""
    to_world = Rotation.from_rotvec(rt[:3]).inv()
    return to_world.as_matrix(), -to_world.apply(rt[3:])
