"""Initial values of the bundle adjustment: the focal length by trial, the poses along a tree of views."""

import heapq
from itertools import zip_longest

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.geometry.observations import Observations
from faintfield.calib.homography import rotation_matrix

# Focal lengths tried, in widths of the detector: from a fisheye to a long telephoto.
_FOCAL_WIDTHS = np.geomspace(0.35, 12.0, 30)

# Views that are tried with each focal length; more take longer and hardly change the choice among 30.
_MAX_FOCAL_VIEWS = 24

type Transform = NDArray[np.float64]
"""Homogeneous matrix (4, 4) from the source to the destination frame."""


def initialize(
    observations: Observations, size_px: tuple[int, int], square_mm: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return the focal length that fits single views best, and poses along the tree of the best-fitting views.

    Returns
    -------
    focal_px : float
        Focal length of a pinhole whose principal point is the middle of the detector.
    rt_cam_ref : array (node, 6)
        Poses of the nodes, Rodrigues rad and mm; zero for the reference, which is the first.
    rt_ref_board : array (target, 6)
        Poses of the boards.
    """
    focal_px = _focal_by_trial(observations, size_px, square_mm)
    matrix = _matrix(focal_px, size_px)
    poses = [_pose(observations, view, matrix, square_mm) for view in range(len(observations.node_of))]
    camera_from_ref, ref_from_board = _tree(observations, [pose for pose, _ in poses], [error for _, error in poses])
    rt_cam_ref = [_rt(camera_from_ref[node]) for node in range(len(observations.nodes))]
    rt_ref_board = [_rt(ref_from_board[target]) for target in range(len(observations.targets))]
    return focal_px, np.array(rt_cam_ref), np.array(rt_ref_board)


def _focal_by_trial(observations: Observations, size_px: tuple[int, int], square_mm: float) -> float:
    """Return the focal length at which single views, each with a pose of its own, have the least reprojection error."""
    counts = (observations.weights > 0).sum(axis=(1, 2))
    views = np.argsort(-counts, kind="stable")
    # The best views of every target, since a board that faces the camera does not determine the focal length.
    per_target = [views[observations.target_of[views] == target] for target in range(len(observations.targets))]
    ranked = zip_longest(*(of_target.tolist() for of_target in per_target))
    chosen = [view for rank in ranked for view in rank if view is not None][:_MAX_FOCAL_VIEWS]
    errors = [
        sum(_pose(observations, view, _matrix(focal, size_px), square_mm)[1] ** 2 for view in chosen)
        for focal in _FOCAL_WIDTHS * size_px[0]
    ]
    return float(_FOCAL_WIDTHS[int(np.argmin(errors))] * size_px[0])


def _pose(
    observations: Observations, view: int, matrix: NDArray[np.float64], square_mm: float
) -> tuple[Transform, float]:
    """Return the transform from board to camera that fits one view, and its rms reprojection error in pixels."""
    row, column = np.nonzero(observations.weights[view] > 0)
    points = np.column_stack([column, row, np.zeros(len(row))]) * square_mm
    pixels = np.ascontiguousarray(observations.pixels[view, row, column])
    found, rotations, translations, errors = cv2.solvePnPGeneric(points, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return np.eye(4), np.inf
    best = int(np.argmin(np.ravel(errors)))
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.ravel(rotations[best]))
    pose[:3, 3] = np.ravel(translations[best])
    return pose, float(np.ravel(errors)[best])


def _tree(
    observations: Observations, poses: list[Transform], errors: list[float]
) -> tuple[dict[int, Transform], dict[int, Transform]]:
    """Return the transforms (camera from ref, ref from board), found from the reference along the best views."""
    camera_from_ref, ref_from_board = {0: np.eye(4)}, dict[int, Transform]()
    views_of = _views_of(observations)
    waiting = [(errors[view], view) for view in views_of["node", 0]]
    heapq.heapify(waiting)
    while waiting:
        _, view = heapq.heappop(waiting)
        node, target = int(observations.node_of[view]), int(observations.target_of[view])
        reached = []
        if target not in ref_from_board:
            ref_from_board[target] = np.linalg.inv(camera_from_ref[node]) @ poses[view]
            reached = views_of["target", target]
        elif node not in camera_from_ref:
            camera_from_ref[node] = poses[view] @ np.linalg.inv(ref_from_board[target])
            reached = views_of["node", node]
        for other in reached:
            heapq.heappush(waiting, (errors[other], other))
    return camera_from_ref, ref_from_board


def _views_of(observations: Observations) -> dict[tuple[str, int], list[int]]:
    """Return the views of each node and of each target."""
    views: dict[tuple[str, int], list[int]] = {}
    for view, (node, target) in enumerate(zip(observations.node_of, observations.target_of, strict=True)):
        views.setdefault(("node", int(node)), []).append(view)
        views.setdefault(("target", int(target)), []).append(view)
    return views


def _matrix(focal_px: float, size_px: tuple[int, int]) -> NDArray[np.float64]:
    width, height = size_px
    return np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])


def _rt(transform: Transform) -> NDArray[np.float64]:
    return np.append(cv2.Rodrigues(transform[:3, :3])[0].ravel(), transform[:3, 3])
