"""Information that corners hold about lens and poses, and the error of transfers by a plane that it predicts.

With J the derivative of the corners of a sweep by the lens, the poses and the bend of the boards, and X that by the
boards' own poses, which are eliminated, a sweep adds to the normal matrix

    N = Jᵀ P J,      P = I − X (XᵀX)⁻¹ Xᵀ.

The stage misses each node of a sweep by δ, of standard deviation τ, which moves the corners by G δ; so the estimate has
the covariance `σ² N⁻¹ + τ² N⁻¹ S N⁻¹` with S the sum of `H Hᵀ` over the sweeps and `H = Jᵀ P G`, as in
`calib.geometry.covariance`. Sums over sweeps predict what further ones would bring, before they are taken.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.geometry.acceptance import require_seen
from faintfield.calib.geometry.calibrate import Adjustment
from faintfield.calib.geometry.observations import Node
from faintfield.calib.homography import (
    fronto_parallel_rt_ref_plane,
    image_lattice,
    rotation_matrix,
    transfer_derivative,
)

# Standard deviations of what is known of lens and poses before any corner is: focal lengths relative, the principal
# point in widths, distortion coefficients, rad and mm. They matter only while boards leave some direction free.
_PRIOR_FOCAL, _PRIOR_CENTRE, _PRIOR_DISTORTION = 0.3, 0.1, 0.3
_PRIOR_RAD, _PRIOR_MM = 1.0, 1000.0

# The same of the boards' bend in mm: free, and where none is fitted.
_PRIOR_BEND_MM, _NO_BEND_MM = 5.0, 1e-6

# The repeatability of the stage that is assumed until two sweeps tell it: that of which `faintfield geometry` warns.
_ASSUMED_STAGE_MM = 0.020

# Fewer corners of a board determine no pose.
_MIN_CORNERS = 6


@dataclass(frozen=True)
class StandingBoard:
    """A board in a sweep: its pose, and the weight of each corner (corner,) by index of the node; 0 if it is unseen."""

    board: Board
    rt_ref_board: NDArray[np.float64]
    weights: Mapping[int, NDArray[np.float64]]

    @property
    def corner_count(self) -> int:
        """Number of corners in all views."""
        return int(sum((weights > 0).sum() for weights in self.weights.values()))


@dataclass(frozen=True)
class Information:
    """Normal matrix N of lens, poses and bend, and the sum S of the stage's share, both (state, state), of sweeps."""

    normal: NDArray[np.float64]
    stage: NDArray[np.float64]
    sweeps: int = 1

    def __add__(self, other: "Information") -> "Information":
        return Information(self.normal + other.normal, self.stage + other.stage, self.sweeps + other.sweeps)


class TransferPrediction:
    """Prediction of the error of transfers by planes, linear about a geometry.

    The state is the lens, the poses of all nodes but the reference in their order, and the bend of the boards. Raises
    `NotIdentifiable` if a plane is not seen from half of the nodes.
    """

    def __init__(self, adjustment: Adjustment, depths_mm: Sequence[float]) -> None:
        self.geometry = geometry = adjustment.geometry
        self._lens_size = len(geometry.lens.parameters)
        self._size = self._lens_size + 6 * (len(geometry.nodes) - 1) + 2
        self._prior = self._prior_normal(with_warp=adjustment.with_warp)
        self._wanted = {depth_mm: self._mean_square(depth_mm) for depth_mm in depths_mm}
        self._variance_px2 = geometry.sigma_px**2

    def error_px(self, information: Information) -> tuple[float, float]:
        """Return the predicted rms error over views and image, and the depth in mm where it is largest."""
        inverse = np.linalg.inv(information.normal + self._prior)
        covariance = self._variance_px2 * inverse
        repeatability = self.geometry.repeatability
        if repeatability is not None or information.sweeps > 1:
            stage_sd_mm = _ASSUMED_STAGE_MM if repeatability is None else repeatability.sd_mm
            covariance += stage_sd_mm**2 * inverse @ information.stage @ inverse
        squares = {depth_mm: float(np.sum(wanted * covariance)) for depth_mm, wanted in self._wanted.items()}
        worst_mm = max(squares, key=lambda depth_mm: squares[depth_mm])
        return float(np.sqrt(max(squares[worst_mm], 0.0))), worst_mm

    def nothing(self) -> Information:
        """Return the information before any corner is seen."""
        return Information(np.zeros((self._size, self._size)), np.zeros((self._size, self._size)), 0)

    def of_sweep(self, boards: Sequence[StandingBoard]) -> Information:
        """Return the information of boards that stand together in one sweep."""
        normal = np.zeros((self._size, self._size))
        moved = np.zeros((self._size, 3 * len(self.geometry.nodes)))
        for standing in boards:
            if standing.corner_count < _MIN_CORNERS:
                continue
            crossed, own = np.zeros((self._size, 6)), np.zeros((6, 6))
            moved_own = np.zeros((6, moved.shape[1]))
            for node, weights in standing.weights.items():
                if not (weights > 0).any():
                    continue
                columns, by_state, by_board, by_stage = self._derivatives(standing, node, weights)
                of_node = slice(3 * node, 3 * node + 3)
                normal[np.ix_(columns, columns)] += by_state.T @ by_state
                crossed[columns] += by_state.T @ by_board
                own += by_board.T @ by_board
                moved[columns, of_node] += by_state.T @ by_stage
                moved_own[:, of_node] += by_board.T @ by_stage
            solved = np.linalg.pinv(own, hermitian=True)
            normal -= crossed @ solved @ crossed.T
            moved -= crossed @ solved @ moved_own
        return Information(normal, moved @ moved.T)

    def seen(
        self, board: Board, rt_ref_board: NDArray[np.float64], nodes: Sequence[int] | None = None
    ) -> StandingBoard:
        """Return a board as the nodes would see it, by default all, each corner in the image with the usual noise."""
        geometry = self.geometry
        points = self._points(board) @ rotation_matrix(rt_ref_board).T + rt_ref_board[3:]
        weights = {}
        for node in range(len(geometry.nodes)) if nodes is None else nodes:
            rt = geometry.rt_cam_ref[node]
            pixels = geometry.lens.project(points @ rotation_matrix(rt).T + rt[3:])
            inside = (pixels >= 0).all(axis=1) & (pixels <= np.array(geometry.lens.size_px) - 1).all(axis=1)
            weights[node] = inside.astype(float)
        return StandingBoard(board, rt_ref_board, weights)

    def _points(self, board: Board) -> NDArray[np.float64]:
        """Return the corners (corner, 3) of a board as it is bent."""
        points = board.corners_mm()
        points[:, 2] += _bend_shape(board) @ self.geometry.warp_mm
        return points

    def _derivatives(
        self, standing: StandingBoard, node: int, weights: NDArray[np.float64]
    ) -> tuple[NDArray[np.intp], NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
        """Return the columns of the state, and derivatives of weighted corners by these, the board and the stage."""
        geometry, lens, count = self.geometry, self.geometry.lens, len(self.geometry.lens.distortion)
        used = weights > 0
        of_board, of_camera = standing.rt_ref_board, geometry.rt_cam_ref[node]
        r, t, *chain = cv2.composeRT(of_board[:3], of_board[3:], of_camera[:3], of_camera[3:])
        # ∂(r, t) by the board's pose and by the camera's
        rr1, rt1, rr2, rt2, tr1, tt1, tr2, tt2 = chain
        of_pose = {"board": np.block([[rr1, rt1], [tr1, tt1]]), "camera": np.block([[rr2, rt2], [tr2, tt2]])}
        distortion = np.array([*lens.distortion, *[0.0] * (max(4, count) - count)])
        points = self._points(standing.board)[used]
        jacobian = np.asarray(cv2.projectPoints(points, r, t, lens.camera_matrix(), distortion)[1])
        jacobian = jacobian * weights[used].repeat(2)[:, np.newaxis]
        by_pose, by_lens = jacobian[:, :6], jacobian[:, 6 : 10 + count]
        by_camera, by_board = by_pose @ of_pose["camera"], by_pose @ of_pose["board"]
        along = by_pose[:, 3:] @ rotation_matrix(np.append(np.ravel(r), np.zeros(3)))[:, 2]
        by_bend = along[:, np.newaxis] * _bend_shape(standing.board)[used].repeat(2, axis=0)
        columns = [np.arange(self._lens_size), self._size - 2 + np.arange(2)]
        by_state = [by_lens, by_bend]
        if node != geometry.reference:
            columns.append(self._first_column(node) + np.arange(6))
            by_state.append(by_camera)
        by_stage = (by_board if node == geometry.reference else by_camera)[:, 3:]
        return np.concatenate(columns), np.hstack(by_state), by_board, by_stage

    def _first_column(self, node: int) -> int:
        return self._lens_size + 6 * (node - (node > self.geometry.reference))

    def _prior_normal(self, *, with_warp: bool) -> NDArray[np.float64]:
        lens = self.geometry.lens
        sigmas = [_PRIOR_FOCAL * lens.fx_px] * 2 + [_PRIOR_CENTRE * lens.size_px[0]] * 2
        sigmas += [_PRIOR_DISTORTION] * len(lens.distortion)
        prior = np.empty(self._size)
        prior[: self._lens_size] = np.array(sigmas) ** -2.0
        prior[self._lens_size : -2].reshape(-1, 6)[:] = np.repeat([_PRIOR_RAD, _PRIOR_MM], 3) ** -2.0
        prior[-2:] = (_PRIOR_BEND_MM if with_warp else _NO_BEND_MM) ** -2.0
        return np.diag(prior) * self.geometry.sigma_px**2

    def _mean_square(self, depth_mm: float) -> NDArray[np.float64]:
        """Return W (state, state): the mean square error of the transfer is the sum of W times the covariance."""
        geometry = self.geometry
        plane, pixels = fronto_parallel_rt_ref_plane(depth_mm), image_lattice(geometry.lens.size_px)
        wanted, points, seen = np.zeros((self._size, self._size)), 0, 0
        for node, rt in enumerate(geometry.rt_cam_ref):
            if node == geometry.reference:
                continue
            slope = transfer_derivative(geometry.lens, rt, plane, pixels)
            slope = slope[np.isfinite(slope).all(axis=(1, 2))]
            columns = np.r_[: self._lens_size, self._first_column(node) + np.arange(6)]
            wanted[np.ix_(columns, columns)] += np.einsum("pai,paj->ij", slope, slope)
            points += len(slope)
            seen += bool(len(slope))
        require_seen(depth_mm, seen, len(geometry.nodes) - 1)
        return wanted / points


def _bend_shape(board: Board) -> NDArray[np.float64]:
    """Return the height (corner, 2) of a bulge of one along x and along y, which is zero at the edges."""
    rows, columns = board.corner_shape
    row, column = np.divmod(np.arange(rows * columns), columns)
    along = np.column_stack([column / (columns - 1), row / (rows - 1)])
    return np.asarray(4 * along * (1 - along))


def standing_boards(adjustment: Adjustment, boards: Mapping[str, Board]) -> dict[int, list[StandingBoard]]:
    """Return the boards of each sweep as they were seen so far."""
    geometry, observations = adjustment.geometry, adjustment.observations
    index: dict[Node, int] = {node: place for place, node in enumerate(geometry.nodes)}
    sweeps: dict[int, list[StandingBoard]] = {}
    for number, pose in enumerate(geometry.boards):
        board = boards[pose.target.board]
        rows, columns = board.corner_shape
        weights = {}
        for view in np.flatnonzero(observations.target_of == number):
            kept = np.where(adjustment.inlier[view], observations.weights[view], 0.0)[:rows, :columns]
            weights[index[observations.nodes[observations.node_of[view]]]] = np.maximum(kept.ravel(), 0.0)
        sweeps.setdefault(pose.target.sweep, []).append(StandingBoard(board, pose.rt_ref_board, weights))
    return sweeps
