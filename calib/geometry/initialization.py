"""A first guess: the focal length by trial, the poses by a tree of boards seen from two nodes."""

import heapq
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.geometry.observations import Observations

# Focal lengths tried, in widths of the detector: from a fisheye to a long telephoto.
_FOCAL_WIDTHS = np.geomspace(0.35, 12.0, 30)
_FOCAL_VIEWS = 24

type Transform = NDArray[np.float64]
"""4 x 4, destination from source."""


@dataclass(frozen=True)
class Seed:
    """Where the solver starts.

    Attributes
    ----------
    focal_px : float
        Of a pinhole whose principal point is the middle of the detector.
    rt_cam_ref : array (node, 6)
        Zero for the reference, which is the first.
    rt_ref_board : array (target, 6)
        Rodrigues rad and mm.
    """

    focal_px: float
    rt_cam_ref: NDArray[np.float64]
    rt_ref_board: NDArray[np.float64]


def seed_from(observations: Observations, size_px: tuple[int, int], square_mm: float) -> Seed:
    """Return the focal length that fits single views best, and poses along the tree of the best-determined views."""
    focal_px = _focal_by_trial(observations, size_px, square_mm)
    poses = [
        _pose(observations, view, _matrix(focal_px, size_px), square_mm) for view in range(len(observations.node_of))
    ]
    camera_from_ref, ref_from_board = _tree(observations, [pose for pose, _ in poses], [error for _, error in poses])
    return Seed(
        focal_px,
        np.array([_rt(camera_from_ref[node]) for node in range(len(observations.nodes))]),
        np.array([_rt(ref_from_board[target]) for target in range(len(observations.targets))]),
    )


def _focal_by_trial(observations: Observations, size_px: tuple[int, int], square_mm: float) -> float:
    """Return the focal length at which boards alone, each seen in perspective, are reprojected best."""
    counts = (observations.weights > 0).sum(axis=(1, 2))
    views = np.argsort(-counts, kind="stable")
    # the best views of every target, since one board alone may face the camera and say nothing
    first_of_each = [view for rank in range(_FOCAL_VIEWS) for view in _nth_view_of_targets(observations, views, rank)]
    chosen = first_of_each[:_FOCAL_VIEWS]
    errors = [
        sum(_pose(observations, view, _matrix(focal, size_px), square_mm)[1] ** 2 for view in chosen)
        for focal in _FOCAL_WIDTHS * size_px[0]
    ]
    return float(_FOCAL_WIDTHS[int(np.argmin(errors))] * size_px[0])


def _nth_view_of_targets(observations: Observations, ordered: NDArray[np.intp], rank: int) -> list[int]:
    """Return for every target its view of a rank among the ordered views."""
    per_target = [ordered[observations.target_of[ordered] == target] for target in range(len(observations.targets))]
    return [int(views[rank]) for views in per_target if len(views) > rank]


def _pose(
    observations: Observations, view: int, matrix: NDArray[np.float64], square_mm: float
) -> tuple[Transform, float]:
    """Return camera from board of one view alone, and the rms of its reprojection in pixels."""
    row, column = np.nonzero(observations.weights[view] > 0)
    points = np.column_stack([column, row, np.zeros(len(row))]) * square_mm
    pixels = np.ascontiguousarray(observations.pixels[view, row, column])
    found, rotations, translations, errors = cv2.solvePnPGeneric(points, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    if not found:
        return np.eye(4), np.inf
    best = int(np.argmin(np.ravel(errors)))
    pose = np.eye(4)
    pose[:3, :3] = cv2.Rodrigues(rotations[best])[0]
    pose[:3, 3] = np.ravel(translations[best])
    return pose, float(np.ravel(errors)[best])


def _tree(
    observations: Observations, poses: list[Transform], errors: list[float]
) -> tuple[dict[int, Transform], dict[int, Transform]]:
    """Walk from the reference node along the views with the least error, (camera from ref, ref from board)."""
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
