"""The result: the lens, the poses, the boards, and the covariance of all that a reconstruction uses."""

from dataclasses import dataclass, field

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.geometry.observations import Node, Target
from faintfield.calib.lens import Lens


@dataclass(frozen=True)
class BoardPose:
    """Where a board stood during a sweep; its origin is its first inner corner."""

    target: Target
    rt_ref_board: NDArray[np.float64]


@dataclass(frozen=True)
class Repeatability:
    """How far the gantry comes back to a node in another sweep: the standard deviation of each axis.

    Attributes
    ----------
    sd_mm : float
        Zero where the corners alone explain all differences between sweeps.
    se_mm : float
        Standard error of it.
    """

    sd_mm: float
    se_mm: float


@dataclass(frozen=True)
class RigGeometry:
    """Where the camera was at every node.

    Attributes
    ----------
    lens : Lens
        Of the camera.
    lens_model : str
        "pinhole", "opencv4", "opencv5" or "opencv8".
    nodes : list of (int, int)
        In raster order.
    reference : int
        Index of the node whose camera is the reference frame.
    rt_cam_ref : array (node, 6)
        Rodrigues rad and mm.
    covariance : array (state, state)
        Of `intrinsics` (fx, fy, cx, cy, distortion), then of every node's pose in order; the reference's is zero.
    boards : list of BoardPose
        As they stood.
    warp_mm : array (2,)
        How far the boards bulge at their middle, along x and along y.
    sigma_px : float
        Standard deviation of a typical corner, per axis, estimated from the residuals.
    rms_inlier_px : float
        √(Σ residual² / 2N) over the corners that were believed.
    rms_mrcal_px : float
        What mrcal calls rms_reproj_error__pixels: √(Σ residual² / N) over all corners, masked ones included.
    corners, outliers : int
        How many corners were used, and how many seen but not believed.
    holdout_ratio : float, optional
        Residual of boards that had no part in the fit over that of the fit; None with a single board pose.
    repeatability : Repeatability, optional
        Of the gantry between sweeps; None with a single sweep.
    doubts : list of str
        Views that disagree with the rest, and what to do about them.
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
    doubts: list[str] = field(default_factory=list)

    @property
    def intrinsics(self) -> NDArray[np.float64]:
        """Fx, fy, cx, cy and the distortion, as the covariance has them."""
        lens = self.lens
        return np.array([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion])

    def pose_covariance(self, node: int) -> NDArray[np.float64]:
        """Return the covariance (6, 6) of one node's pose, rad² and mm²."""
        here = self._pose_slice(node)
        return self.covariance[here, here]

    def lens_and_pose_covariance(self, node: int) -> NDArray[np.float64]:
        """Return the covariance (intrinsics + 6, square) of the lens together with one node's pose."""
        count = len(self.intrinsics)
        chosen = np.r_[np.arange(count), np.arange(*self._pose_slice(node).indices(len(self.covariance)))]
        return np.asarray(self.covariance[np.ix_(chosen, chosen)])

    def centres_mm(self) -> NDArray[np.float64]:
        """Return the camera centres (node, 3) in the reference frame, `−Rᵀ t`."""
        return np.array([-_rotation(rt).T @ rt[3:] for rt in self.rt_cam_ref])

    def centre_covariance_mm2(self) -> NDArray[np.float64]:
        """Return the covariance of all centres, (3·node, 3·node), by first-order propagation."""
        jacobian = np.zeros((3 * len(self.nodes), len(self.covariance)))
        for node, rt in enumerate(self.rt_cam_ref):
            columns = self._pose_slice(node)
            jacobian[3 * node : 3 * node + 3, columns] = _centre_jacobian(rt)
        return np.asarray(jacobian @ self.covariance @ jacobian.T)

    def sigma_mm(self) -> NDArray[np.float64]:
        """Return how well each centre is known, √ of its covariance's trace (node,)."""
        variances = np.diag(self.centre_covariance_mm2()).reshape(-1, 3)
        return np.asarray(np.sqrt(variances.sum(axis=1)))

    def sigma_rad(self) -> NDArray[np.float64]:
        """Return how well each orientation is known, √ of the trace of its rotation vector's covariance (node,)."""
        return np.array([np.sqrt(np.trace(self.pose_covariance(node)[:3, :3])) for node in range(len(self.nodes))])

    def _pose_slice(self, node: int) -> slice:
        first = len(self.intrinsics) + 6 * node
        return slice(first, first + 6)


def _rotation(rt: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(cv2.Rodrigues(rt[:3])[0], np.float64)


def _centre_jacobian(rt: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return ∂(−Rᵀ t) / ∂(r, t), (3, 6), from OpenCV's derivative of the rotation matrix."""
    rotation, derivative = cv2.Rodrigues(np.ascontiguousarray(rt[:3]))
    by_rotation = np.array([-row.reshape(3, 3).T @ rt[3:] for row in np.asarray(derivative)]).T
    return np.hstack([by_rotation, -np.asarray(rotation).T])
