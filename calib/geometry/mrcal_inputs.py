"""Optimization inputs as mrcal's own tools take them: lengths in metres, and no moving camera at the reference.

mrcal keeps the frame of reference by a camera that does not move. Its projection uncertainty refuses a solution in
which that is one pose of a moving camera, and ours is that of the reference node. In these inputs every node has a pose
of its own, and an auxiliary camera with a lens of its own stands at the reference. It sees four corners of one board
where the solution puts them. These eight numbers determine eight others: the auxiliary focal lengths and the frame of
reference. The rest of the auxiliary lens is held by mrcal's regularization. So the auxiliary camera has no residuals,
and adds no knowledge of lens, poses or boards.
"""

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.geometry.bundle import Bundle
from faintfield.calib.homography import rotation_matrix

AUXILIARY_LENS, LENS = 0, 1
"""Indices of the lenses, mrcal's `icam_intrinsics`."""

REFERENCE_POSE = 0
"""Index of the pose of the reference node, mrcal's `icam_extrinsics`."""

_METRES = np.repeat([1.0, 1e-3], 3)


def tool_inputs(bundle: Bundle) -> dict[str, Any]:
    """Return the arguments of `mrcal.optimizer_callback` with the residuals of a solution.

    mrcal's regularization, weighted by the number of lenses, pulls the lens a little less than in the solution.
    """
    inputs, warp = bundle.inputs, bundle.inputs["calobject_warp"]
    poses, boards = bundle.rt_cam_ref * _METRES, bundle.rt_ref_board * _METRES
    target, _, node = inputs["indices_frame_camintrinsics_camextrinsics"].T
    views = np.column_stack([target, np.full_like(target, LENS), node + 1])
    board = _most_tilted_board(boards, np.unique(target[node < 0]))
    place = int(np.flatnonzero(target == board)[0])  # mrcal requires the views of a board in the order of the lenses
    observed = inputs["observations_board"]
    made = {
        **inputs,
        "intrinsics": np.vstack([_auxiliary_lens(bundle), inputs["intrinsics"]]),
        "imagersizes": np.repeat(inputs["imagersizes"], 2, axis=0),
        "rt_cam_ref": poses,
        "rt_ref_frame": boards,
        "calibration_object_spacing": inputs["calibration_object_spacing"] * 1e-3,
        "calobject_warp": None if warp is None else warp * 1e-3,
        "observations_board": np.insert(observed, place, _outer_corners(observed.shape[1:]), axis=0),
        "indices_frame_camintrinsics_camextrinsics": np.insert(views, place, [board, AUXILIARY_LENS, -1], axis=0),
    }
    # With the corners at zero, the residuals are where the auxiliary camera sees them
    corners = made["observations_board"][place]
    corners[..., :2] = np.where(corners[..., 2:] > 0, Bundle(made).residuals()[place], 0.0)
    return made


def seen_region_px(bundle: Bundle) -> NDArray[np.float64]:
    """Return the convex hull (point, 2) of the inlying corners of all views, a closed contour."""
    pixels = bundle.inputs["observations_board"][bundle.inlier][:, :2]
    hull = cv2.convexHull(pixels.astype(np.float32))[:, 0].astype(np.float64)
    return np.vstack([hull, hull[:1]])


def _auxiliary_lens(bundle: Bundle) -> NDArray[np.float64]:
    """Return a lens of the same focal lengths without what mrcal's regularization would change."""
    lens = np.zeros_like(bundle.intrinsics)
    lens[:4] = *bundle.intrinsics[:2], *(bundle.inputs["imagersizes"][0] - 1) / 2
    return lens


def _most_tilted_board(boards: NDArray[np.float64], candidates: NDArray[np.int32]) -> int:
    """Return the board that faces the reference least: one that faces it has no focal length of its own."""
    facing = [abs(rotation_matrix(boards[board])[2, 2]) for board in candidates]
    return int(candidates[np.argmin(facing)])


def _outer_corners(shape: tuple[int, int, int]) -> NDArray[np.float64]:
    """Return an observation (row, column, 3) of the four outer corners of the lattice, at zero, all others masked."""
    observation = np.zeros(shape)
    observation[..., 2] = -1.0
    observation[:: shape[0] - 1, :: shape[1] - 1, 2] = 1.0
    return observation
