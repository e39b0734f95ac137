"""Bundle adjustment with mrcal: one lens, the pose of every node, and the pose of every board in every sweep."""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from copy import copy
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import MissingMrcal
from faintfield.calib.geometry.initialization import initialize
from faintfield.calib.geometry.observations import Observations

LENS_MODELS = {"pinhole": "LENSMODEL_PINHOLE", **{f"opencv{n}": f"LENSMODEL_OPENCV{n}" for n in (4, 5, 8)}}

# Limits of the Gauss-Newton steps that follow mrcal, which stops about 1e-6 px short of the optimum: their number, and
# the largest entry of a step, in mrcal's scaled state, that ends them.
_MAX_POLISHING_STEPS = 5
_POLISHING_TOLERANCE = 1e-11


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
    size_px : (int, int)
        Width and height of the detector.
    square_mm : float
        Edge length of the squares of all boards.
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
        mrcal's optimization inputs at the optimum: `mrcal.optimize(**inputs)` stays there.
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
            "do_optimize_intrinsics_distortions": problem.lens_model != "pinhole",
            "do_optimize_calobject_warp": False,
            "do_apply_outlier_rejection": False,
            **stage,
        }
        _optimize(inputs)
    inputs["do_apply_outlier_rejection"] = False
    _polish(inputs)
    return Bundle(inputs)


def solve_again(bundle: Bundle, observations: Observations, chosen: NDArray[np.bool_]) -> Bundle:
    """Return the solution from the chosen views (view,) alone, starting from `bundle`; outliers stay marked."""
    inputs = _restricted(bundle, observations, chosen)
    _optimize(inputs)
    return Bundle(inputs)


def fit_boards(bundle: Bundle, other: Bundle, observations: Observations, chosen: NDArray[np.bool_]) -> Bundle:
    """Return the poses of the boards in the chosen views (view,), with lens and cameras fixed to those of `other`."""
    inputs = _restricted(bundle, observations, chosen)
    inputs |= {name: copy(other.inputs[name]) for name in ("intrinsics", "rt_cam_ref", "calobject_warp")}
    locked = ("intrinsics_core", "intrinsics_distortions", "extrinsics", "calobject_warp")
    inputs |= {f"do_optimize_{name}": False for name in locked}
    _optimize(inputs)
    return Bundle(inputs)


def _inputs(problem: BundleProblem) -> dict[str, Any]:
    """Return mrcal's optimization inputs at the initial values."""
    observations = problem.observations
    focal_px, rt_cam_ref, rt_ref_board = initialize(observations, problem.size_px, problem.square_mm)
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


def _restricted(bundle: Bundle, observations: Observations, chosen: NDArray[np.bool_]) -> dict[str, Any]:
    """Return a copy of a solution's inputs with the chosen views and the boards that they see."""
    targets, frame_of = np.unique(observations.target_of[chosen], return_inverse=True)
    inputs = {name: copy(value) for name, value in bundle.inputs.items()}
    inputs["rt_ref_frame"] = np.ascontiguousarray(inputs["rt_ref_frame"][targets])
    inputs["observations_board"] = np.ascontiguousarray(inputs["observations_board"][chosen])
    indices = _indices(frame_of.astype(np.int32), observations.node_of[chosen])
    inputs["indices_frame_camintrinsics_camextrinsics"] = indices
    return inputs


def _optimize(inputs: dict[str, Any]) -> None:
    """Move the inputs to the optimum, in place."""
    mrcal = load_mrcal()
    with _c_library_silenced():
        mrcal.optimize(**inputs)


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
