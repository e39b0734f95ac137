"""Result of the geometry calibration: lens, poses, boards, and the covariance of lens and poses."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.estimate import Repeatability
from faintfield.calib.geometry.bundle import Bundle
from faintfield.calib.geometry.observations import Node, Target
from faintfield.calib.homography import rotation_matrix
from faintfield.calib.lens import Lens

# Probability of a shift that chance alone shows.
_CHANCE = 1e-3


@dataclass(frozen=True)
class BoardPose:
    """Pose of a board during a sweep; the board's origin is its first inner corner.

    Attributes
    ----------
    target : Target
        The board, with its sweep and homing.
    rt_ref_board : float array (6,)
        Rodrigues vector in rad and translation in mm, from the board's frame to the reference camera's.
    """

    target: Target
    rt_ref_board: NDArray[np.float64]


@dataclass(frozen=True)
class HomingShift:
    """Shift of all cameras from one homing of the stage to a later one, in the reference camera's frame.

    Attributes
    ----------
    before, after : int
        Numbers of the two homings.
    shift_mm, covariance_mm2 : float array (3,), float array (3, 3)
        The shift, and its covariance.
    """

    before: int
    after: int
    shift_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64]

    def is_significant(self) -> bool:
        """Return whether chance hardly makes such a shift."""
        distance2 = float(self.shift_mm @ np.linalg.solve(self.covariance_mm2, self.shift_mm))
        return bool(stats.chi2.sf(distance2, 3) < _CHANCE)


@dataclass(frozen=True)
class RigGeometry:
    """Lens of the camera and its pose at every node.

    Attributes
    ----------
    lens, lens_model : Lens, str
        Lens of the camera; its model is "pinhole", "opencv4", "opencv5" or "opencv8".
    nodes : list of (int, int)
        Row and column of the nodes, in raster order.
    reference : int
        Index of the node whose camera is the reference frame.
    rt_cam_ref : array (node, 6)
        Poses, Rodrigues rad and mm.
    covariance : array (state, state)
        Covariance of `lens.parameters` and of the nodes' poses in order; the reference's is zero.
    boards : list of BoardPose
        Poses of the boards in each sweep.
    warp_mm : array (2,)
        Height of the boards' bulge at their middle, along x and along y.
    sigma_px : float
        Standard deviation of a typical corner, per axis, estimated from the residuals.
    rms_inlier_px, rms_mrcal_px : float
        √(Σ residual² / 2N) over the N inliers; mrcal's rms_reproj_error__pixels, √(Σ residual² / N) over all corners,
        masked ones included.
    corners, outliers : int
        Numbers of inliers and of outliers.
    holdout_ratio : float, optional
        Ratio of the residual of boards left out of the fit to that of the fit; None with a single board pose.
    repeatability : Repeatability, optional
        None with a single sweep.
    warnings : list of str
        Views that disagree with the rest, and what to do about them.
    homings, undetermined_homings : list of HomingShift, list of int
        Shifts of the stage by homings within sweeps, if they show; sweeps within which the stage homed although no
        other sweep joins the nodes before and after.
    solution : Bundle, optional
        Solution of the bundle adjustment; None if poses and lens were stated.
    """

    lens: Lens
    lens_model: str
    nodes: list[Node]
    reference: int
    rt_cam_ref: NDArray[np.float64]
    covariance: NDArray[np.float64]
    boards: list[BoardPose]
    warp_mm: NDArray[np.float64]
    sigma_px: float
    rms_inlier_px: float
    rms_mrcal_px: float
    corners: int
    outliers: int
    holdout_ratio: float | None
    repeatability: Repeatability | None
    warnings: list[str] = field(default_factory=list)
    homings: list[HomingShift] = field(default_factory=list)
    undetermined_homings: list[int] = field(default_factory=list)
    solution: Bundle | None = None

    def pose_covariance(self, node: int) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of one node's pose, rad² and mm²."""
        here = self._pose_slice(node)
        return self.covariance[here, here]

    def lens_and_pose_covariance(self, node: int) -> NDArray[np.float64]:
        """Return the covariance (intrinsics + 6, square) of the lens together with one node's pose."""
        chosen = np.r_[: len(self.lens.parameters), self._pose_slice(node)]
        return np.asarray(self.covariance[np.ix_(chosen, chosen)])

    def centres_mm(self) -> NDArray[np.float64]:
        """Return the camera centres (node, 3) in the reference frame, `−Rᵀ t`."""
        return np.array([-rotation_matrix(rt).T @ rt[3:] for rt in self.rt_cam_ref])

    def centre_covariance_mm2(self) -> NDArray[np.float64]:
        """Return the covariance of all centres, (3·node, 3·node), by first-order propagation."""
        jacobian = np.zeros((3 * len(self.nodes), len(self.covariance)))
        for node, rt in enumerate(self.rt_cam_ref):
            columns = self._pose_slice(node)
            jacobian[3 * node : 3 * node + 3, columns] = _centre_jacobian(rt)
        return np.asarray(jacobian @ self.covariance @ jacobian.T)

    def sigma_mm(self) -> NDArray[np.float64]:
        """Return the total standard deviation of each centre over its three axes (node,): √ of the trace."""
        variances = np.diag(self.centre_covariance_mm2()).reshape(-1, 3)
        return np.asarray(np.sqrt(variances.sum(axis=1)))

    def sigma_rad(self) -> NDArray[np.float64]:
        """Return the total standard deviation of each orientation over its three axes (node,): √ of the trace."""
        return np.array([np.sqrt(np.trace(self.pose_covariance(node)[:3, :3])) for node in range(len(self.nodes))])

    def _pose_slice(self, node: int) -> slice:
        first = len(self.lens.parameters) + 6 * node
        return slice(first, first + 6)


def _centre_jacobian(rt: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ∂(−Rᵀ t) / ∂(r, t), (3, 6), from OpenCV's derivative of the rotation matrix."""
    rotation, derivative = cv2.Rodrigues(np.ascontiguousarray(rt[:3]))
    by_rotation = np.array([-row.reshape(3, 3).T @ rt[3:] for row in np.asarray(derivative)]).T
    return np.hstack([by_rotation, -np.asarray(rotation).T])
