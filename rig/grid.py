"""The nominal grid: its nodes, and the camera poses that a perfect gantry gives them."""

import numpy as np
from numpy.typing import NDArray


def grid_nodes(rows: int, columns: int) -> list[tuple[int, int]]:
    """Return the nodes (row, column) in raster order; row 0 is the top, column 0 the left."""
    return [(row, column) for row in range(rows) for column in range(columns)]


def centre_node(rows: int, columns: int) -> tuple[int, int]:
    """Return the node of the reference camera; of two in the middle, the lower or right one."""
    return rows // 2, columns // 2


def nominal_poses_rt_cam_ref(rows: int, columns: int, pitch_mm: float) -> NDArray[np.float64]:
    """Return the poses (view, 6) of a perfect grid; a camera moved by c right and down shifts points by −c."""
    row_0, column_0 = centre_node(rows, columns)
    poses = np.zeros((rows * columns, 6))
    for view, (row, column) in enumerate(grid_nodes(rows, columns)):
        poses[view, 3:5] = (column_0 - column) * pitch_mm, (row_0 - row) * pitch_mm
    return poses
