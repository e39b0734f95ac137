"""Bundle adjustment with mrcal: one lens, the pose of every node, and the pose of every board in every sweep.

It begins with the focal length that fits best of many, and with poses along a tree of views.
"""

import heapq
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from itertools import zip_longest
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import MissingMrcal
from faintfield.calib.geometry.observations import Observations
from faintfield.calib.homography import rotation_matrix

LENS_MODELS = {"pinhole": "LENSMODEL_PINHOLE", **{f"opencv{n}": f"LENSMODEL_OPENCV{n}" for n in (4, 5, 8)}}

# Limits of the Gauss-Newton steps that follow mrcal, which stops about 1e-6 px short of the optimum: their number, and
# the largest entry of a step, in mrcal's scaled state, that ends them.
_MAX_POLISHING_STEPS = 5
_POLISHING_TOLERANCE = 1e-11


# Focal lengths tried, in widths of the detector: from a fisheye to a long telephoto.
_FOCAL_WIDTHS = np.geomspace(0.35, 12.0, 30)

# Views that are tried with each focal length; more take longer and hardly change the choice among 30.
_MAX_FOCAL_VIEWS = 24

type Transform = NDArray[np.float64]
"""Homogeneous matrix (4, 4) from the source to the destination frame."""


def load_mrcal() -> Any:
    """Return the module mrcal, which takes half a second to load and is not always installed (MissingMrcal)."""
    try:
        import mrcal
    except ImportError as failure:
        raise MissingMrcal(
            f"mrcal cannot be imported ({failure}), and geometry and camera models need it; "
            "run: pip install --no-deps mrcal numpysane"
        ) from failure
    return mrcal


@dataclass(frozen=True)
class BundleProblem:
    """Input of the bundle adjustment.

    Parameters
    ----------
    observations : Observations
        Corners of the boards.
    size_px, square_mm : (int, int), float
        Width and height of the detector; edge length of the squares of all boards.
    lens_model : str
        One of `LENS_MODELS`.
    with_warp : bool
        Fit one bend that all boards share, which requires boards of one shape.
    """

    observations: Observations
    size_px: tuple[int, int]
    square_mm: float
    lens_model: str
    with_warp: bool


@dataclass(frozen=True)
class Bundle:
    """Solution of a bundle adjustment.

    Attributes
    ----------
    inputs : dict
        Optimization inputs of mrcal at the optimum, where `mrcal.optimize(**inputs)` stays.
    """

    inputs: dict[str, Any]

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Parameters of the lens: fx, fy, cx, cy, and the distortion."""
        return np.asarray(self.inputs["intrinsics"][0])

    @property
    def rt_cam_ref(self) -> NDArray[np.float64]:
        """Poses (node, 6), the reference first."""
        return np.vstack([np.zeros(6), self.inputs["rt_cam_ref"]])

    @property
    def rt_ref_board(self) -> NDArray[np.float64]:
        """Poses (target, 6) of the boards."""
        return np.asarray(self.inputs["rt_ref_frame"])

    @property
    def warp_mm(self) -> NDArray[np.float64]:
        """Height in mm of the boards' bulge at their middle along x and y, (2,)."""
        warp = self.inputs["calobject_warp"]
        return np.zeros(2) if warp is None else np.asarray(warp)

    @property
    def inlier(self) -> NDArray[np.bool_]:
        """Corners that were seen and are no outliers, (view, row, column)."""
        return np.asarray(self.inputs["observations_board"][..., 2] > 0)

    def residuals(self) -> NDArray[np.float64]:
        """Return the weighted residuals in pixels (view, row, column, 2): model minus corner; zero where masked."""
        x = load_mrcal().optimizer_callback(**self.inputs, no_jacobian=True, no_factorization=True)[1]
        shape = (*self.inputs["observations_board"].shape[:3], 2)
        return np.asarray(x[: np.prod(shape)]).reshape(shape)

    def state_slices(self) -> dict[str, slice]:
        """Return the slices of mrcal's state that hold the intrinsics, the cameras and the boards."""
        mrcal = load_mrcal()
        counts = {
            "intrinsics": (mrcal.state_index_intrinsics(0, **self.inputs), len(self.intrinsics)),
            "cameras": (mrcal.state_index_extrinsics(0, **self.inputs), 6 * len(self.inputs["rt_cam_ref"])),
            "boards": (mrcal.state_index_frames(0, **self.inputs), 6 * len(self.rt_ref_board)),
        }
        return {name: slice(first, first + count) for name, (first, count) in counts.items()}


def solve(problem: BundleProblem) -> Bundle:
    """Return the solution, found in stages: poses, then the lens, then everything with outliers marked."""
    inputs = _inputs(problem)
    stages: list[dict[str, bool]] = [
        {"do_optimize_intrinsics_core": False, "do_optimize_intrinsics_distortions": False},
        {"do_optimize_intrinsics_distortions": False},
        {},
        {"do_optimize_calobject_warp": problem.with_warp, "do_apply_outlier_rejection": True},
    ]
    for stage in stages:
        inputs |= {
            "do_optimize_intrinsics_core": True,
            "do_optimize_intrinsics_distortions": True,
            "do_optimize_calobject_warp": False,
            "do_apply_outlier_rejection": False,
            **stage,
        }
        _optimize(inputs)
    inputs["do_apply_outlier_rejection"] = False
    _polish(inputs)
    return Bundle(inputs)


def solve_again(
    bundle: Bundle, observations: Observations, chosen: NDArray[np.bool_], fixed: Bundle | None = None
) -> Bundle:
    """Return the solution from the chosen views (view,) alone, starting from `bundle`; outliers stay marked.

    Lens and cameras are those of the solution `fixed`, if it is given, and only boards are fitted.
    """
    targets, frame_of = np.unique(observations.target_of[chosen], return_inverse=True)
    inputs = {name: copy(value) for name, value in bundle.inputs.items()}
    inputs["rt_ref_frame"] = np.ascontiguousarray(inputs["rt_ref_frame"][targets])
    inputs["observations_board"] = np.ascontiguousarray(inputs["observations_board"][chosen])
    indices = _indices(frame_of.astype(np.int32), observations.node_of[chosen])
    inputs["indices_frame_camintrinsics_camextrinsics"] = indices
    if fixed is not None:
        inputs |= {name: copy(fixed.inputs[name]) for name in ("intrinsics", "rt_cam_ref", "calobject_warp")}
        locked = ("intrinsics_core", "intrinsics_distortions", "extrinsics", "calobject_warp")
        inputs |= {f"do_optimize_{name}": False for name in locked}
    _optimize(inputs)
    return Bundle(inputs)


def _inputs(problem: BundleProblem) -> dict[str, Any]:
    observations = problem.observations
    focal_px = _focal_by_trial(problem)
    rt_cam_ref, rt_ref_board = _initial_poses(problem, focal_px)
    model = LENS_MODELS[problem.lens_model]
    width, height = problem.size_px
    intrinsics = np.zeros((1, load_mrcal().lensmodel_num_params(model)))
    intrinsics[0, :4] = focal_px, focal_px, (width - 1) / 2, (height - 1) / 2
    return {
        "lensmodel": model,
        "intrinsics": intrinsics,
        "imagersizes": np.array([problem.size_px], np.int32),
        "rt_cam_ref": rt_cam_ref[1:].copy(),
        "rt_ref_frame": rt_ref_board,
        "points": None,
        "observations_point": None,
        "indices_point_camintrinsics_camextrinsics": None,
        "observations_board": np.concatenate([observations.pixels, observations.weights[..., np.newaxis]], axis=-1),
        "indices_frame_camintrinsics_camextrinsics": _indices(observations.target_of, observations.node_of),
        "calibration_object_spacing": problem.square_mm,
        "calobject_warp": np.zeros(2) if problem.with_warp else None,
        "do_optimize_extrinsics": True,
        "do_optimize_frames": True,
        "do_apply_regularization": True,
        "verbose": False,
    }


def _indices(target_of: NDArray[np.int32], node_of: NDArray[np.int32]) -> NDArray[np.int32]:
    """Return mrcal's (frame, intrinsics, extrinsics) per view; the extrinsics of the reference camera are −1."""
    return np.ascontiguousarray(np.column_stack([target_of, np.zeros_like(target_of), node_of - 1]), np.int32)


def _optimize(inputs: dict[str, Any]) -> None:
    """Move the inputs to the optimum, in place."""
    optimize = load_mrcal().optimize
    with _c_library_silenced():
        optimize(**inputs)


@contextmanager
def _c_library_silenced() -> Iterator[None]:
    """Drop what mrcal's C code writes to standard error: it counts corners never seen as outliers."""
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _polish(inputs: dict[str, Any]) -> None:
    """Take Gauss-Newton steps, in place, until they vanish, so that the solution does not depend on its start."""
    mrcal = load_mrcal()
    for _ in range(_MAX_POLISHING_STEPS):
        state, x, jacobian, factor = mrcal.optimizer_callback(**inputs)
        if factor is None:
            break
        step = factor.solve_xt_JtJ_bt((jacobian.T @ x)[np.newaxis])[0]
        mrcal.ingest_packed_state(state - step, **inputs)
        if np.abs(step).max() < _POLISHING_TOLERANCE:
            break


def _initial_poses(problem: BundleProblem, focal_px: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return rt_cam_ref (node, 6) and rt_ref_board (target, 6) along the tree of the best-fitting views."""
    observations = problem.observations
    poses, errors = zip(*(view_pose(problem, view, focal_px) for view in range(len(observations.node_of))), strict=True)
    rt_cam_ref, rt_ref_board = (
        np.array([rt_of(transforms[index]) for index in range(len(transforms))])
        for transforms in _tree(observations, poses, errors)
    )
    return rt_cam_ref, rt_ref_board


def _focal_by_trial(problem: BundleProblem) -> float:
    """Return the focal length at which single views, each with a pose of its own, have the least reprojection error."""
    observations = problem.observations
    counts = (observations.weights > 0).sum(axis=(1, 2))
    views = np.argsort(-counts, kind="stable")
    # The best views of every target, since a board that faces the camera does not determine the focal length.
    per_target = [views[observations.target_of[views] == target] for target in range(len(observations.targets))]
    ranked = zip_longest(*(of_target.tolist() for of_target in per_target))
    chosen = [view for rank in ranked for view in rank if view is not None][:_MAX_FOCAL_VIEWS]
    focal_px = _FOCAL_WIDTHS * problem.size_px[0]
    errors = [sum(view_pose(problem, view, focal)[1] ** 2 for view in chosen) for focal in focal_px]
    return float(focal_px[int(np.argmin(errors))])


def view_pose(problem: BundleProblem, view: int, focal_px: float) -> tuple[Transform, float]:
    """Return the transform from board to camera that fits one view, and its rms reprojection error in pixels.

    The lens is a pinhole whose principal point is the middle of the detector.
    """
    observations, (width, height) = problem.observations, problem.size_px
    row, column = np.nonzero(observations.weights[view] > 0)
    points = np.column_stack([column, row, np.zeros(len(row))]) * problem.square_mm
    pixels = np.ascontiguousarray(observations.pixels[view, row, column])
    matrix = np.array([[focal_px, 0, (width - 1) / 2], [0, focal_px, (height - 1) / 2], [0, 0, 1]])
    solved, rotations, translations, errors = cv2.solvePnPGeneric(points, pixels, matrix, None, flags=cv2.SOLVEPNP_IPPE)
    if not solved:
        return np.eye(4), np.inf
    best = int(np.argmin(np.ravel(errors)))
    pose = np.eye(4)
    pose[:3, :3] = rotation_matrix(np.ravel(rotations[best]))
    pose[:3, 3] = np.ravel(translations[best])
    return pose, float(np.ravel(errors)[best])


def _tree(
    observations: Observations, poses: Sequence[Transform], errors: Sequence[float]
) -> tuple[dict[int, Transform], dict[int, Transform]]:
    """Return the transforms (camera from ref, ref from board), found from the reference along the best views."""
    camera_from_ref, ref_from_board = {0: np.eye(4)}, dict[int, Transform]()
    views_of: dict[tuple[str, int], list[int]] = {}
    for view, (node, target) in enumerate(zip(observations.node_of, observations.target_of, strict=True)):
        views_of.setdefault(("node", int(node)), []).append(view)
        views_of.setdefault(("target", int(target)), []).append(view)
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


def rt_of(transform: Transform) -> NDArray[np.float64]:
    """Return a transform as Rodrigues vector and translation (6,)."""
    return np.append(cv2.Rodrigues(transform[:3, :3])[0].ravel(), transform[:3, 3])


def transform_of(rt: NDArray[np.float64]) -> Transform:
    """Return the homogeneous matrix of a pose (6,)."""
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = rotation_matrix(rt), rt[3:]
    return transform
