"""Covariance of the solution, repeatability of the gantry between sweeps, and shifts by homings within sweeps.

To first order the weighted residuals are `x = M (ε + G δ)` with M = I − J (JᵀJ)⁻¹ Jᵀ. Here J is the optimizer's
Jacobian, ε the noise of the corners (variance σ²), and δ the gantry's position error at each node in each sweep
(variance τ² per axis), which moves the corners by G δ. With K = GᵀMG = Q Λ Qᵀ the numbers `v = Λ^(−1/2) Qᵀ Gᵀ x` are
independent and have variances `σ² + τ² λ`; the rest of the residuals has variance σ². The restricted likelihood (REML)
of both gives σ and τ. The state's covariance is `σ² (JᵀJ)⁻¹ + τ² B Bᵀ` with B = (JᵀJ)⁻¹ Jᵀ G.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from itertools import chain, pairwise
from typing import Any

import cv2
import numpy as np
import scipy.sparse
from numpy.typing import NDArray
from scipy.optimize import minimize_scalar

from faintfield.calib.board import Board
from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.estimate import Repeatability
from faintfield.calib.geometry.bundle import Bundle, load_mrcal
from faintfield.calib.geometry.observations import Observations
from faintfield.calib.geometry.rig_geometry import HomingShift

# Eigenvalues of K below this multiple of the largest are left out: the fit absorbs those directions of the gantry's
# errors, so that the residuals contain nothing of them.
_MIN_RELATIVE_EIGENVALUE = 1e-6

# Range of ln(τ² λ / σ²) that is searched, λ being the mean eigenvalue; at its lower end τ is as good as zero.
_LOG_RATIO_RANGE = (-12.0, 8.0)


@dataclass(frozen=True)
class Uncertainty:
    """Uncertainty of a solution, from its residuals.

    Attributes
    ----------
    covariance : array (state, state)
        Covariance of mrcal's state, in rad, mm and pixels.
    sigma_px : float
        Standard deviation of a corner of weight one, per axis.
    repeatability : Repeatability, optional
        None with a single sweep.
    """

    covariance: NDArray[np.float64]
    sigma_px: float
    repeatability: Repeatability | None


def uncertainty(bundle: Bundle, observations: Observations) -> Uncertainty:
    """Return the covariance of a solution's state, which includes the gantry's repeatability if there are sweeps.

    Raises
    ------
    NotIdentifiable
        The corners leave some direction of the state undetermined.
    """
    mrcal = load_mrcal()
    state, x, jacobian, factor = mrcal.optimizer_callback(**bundle.inputs)
    if factor is None:
        raise NotIdentifiable(
            "the boards leave some pose or lens parameter free (the normal equations are singular); "
            "show more boards, tilted by 20 to 40 degrees, from more nodes"
        )
    scale = np.ones_like(state)
    mrcal.unpack_state(scale, **bundle.inputs)
    inverse = factor.solve_xt_JtJ_bt(np.eye(len(state)))
    freedom = 2 * int(bundle.inlier.sum()) - len(state)
    if freedom <= 0:
        raise NotIdentifiable(
            f"{bundle.inlier.sum()} corners cannot determine {len(state)} numbers; show boards with more corners"
        )
    boards = bundle.inlier.size * 2
    sweeps = {target.sweep for target in observations.targets}
    squares = float(x[:boards] @ x[:boards])
    if len(sweeps) == 1:
        sigma = float(np.sqrt(squares / freedom))
        return Uncertainty(inverse * np.outer(scale, scale) * sigma**2, sigma, None)
    motion = _corner_motion(bundle, observations, jacobian[:boards], scale)
    crossed = np.asarray((jacobian[:boards].T @ motion).todense())
    absorbed = inverse @ crossed
    spread = np.asarray((motion.T @ motion).todense()) - crossed.T @ absorbed
    sigma, repeatability = _variance_components(spread, motion.T @ x[:boards], squares, freedom)
    packed = inverse * sigma**2 + absorbed @ absorbed.T * repeatability.sd_mm**2
    return Uncertainty(packed * np.outer(scale, scale), sigma, repeatability)


def _corner_motion(bundle: Bundle, observations: Observations, jacobian: Any, scale: NDArray[np.float64]) -> Any:
    """Return G (measurement, 3·(node, sweep)): motion of the corners per mm of the camera at one node in one sweep.

    The translation is the last step of a camera's pose and, at the reference node, of a board's pose. So the columns
    of G are columns of the Jacobian, restricted to the rows of one sweep.
    """
    slices = bundle.state_slices()
    rows_per_view = 2 * int(np.prod(bundle.inlier.shape[1:]))
    groups: dict[tuple[int, int], int] = {}
    blocks, places = [], []
    by_row = jacobian.tocsr()
    for view, (node, target) in enumerate(zip(observations.node_of, observations.target_of, strict=True)):
        kind, index = ("cameras", node - 1) if node else ("boards", target)
        first = slices[kind].start + 6 * int(index) + 3
        columns = slice(first, first + 3)
        rows = by_row[view * rows_per_view : (view + 1) * rows_per_view]
        blocks.append(rows.toarray()[:, columns] / scale[columns])
        places.append(groups.setdefault((int(node), observations.targets[target].sweep), len(groups)))
    row = np.arange(len(blocks) * rows_per_view).repeat(3)
    column = np.repeat(places, rows_per_view)[:, np.newaxis] * 3 + np.arange(3)
    values = np.concatenate(blocks).ravel()
    return scipy.sparse.csr_array((values, (row, column.ravel())), shape=(len(row) // 3, 3 * len(groups)))


def _variance_components(
    spread: NDArray[np.float64], projected: NDArray[np.float64], squares: float, freedom: int
) -> tuple[float, Repeatability]:
    """Return σ and the gantry's repeatability by restricted maximum likelihood, as the module describes it."""
    eigenvalues, vectors = np.linalg.eigh(spread)
    kept = eigenvalues > _MIN_RELATIVE_EIGENVALUE * eigenvalues[-1]
    eigenvalues = eigenvalues[kept]
    v2 = (vectors[:, kept].T @ projected) ** 2 / eigenvalues
    rest = squares - v2.sum()

    def variance(ratio: float) -> float:
        return float((rest + (v2 / (1 + ratio * eigenvalues)).sum()) / freedom)

    def minus_log_likelihood(ratio: float) -> float:
        return float(freedom * np.log(variance(ratio)) + np.log1p(ratio * eigenvalues).sum()) / 2

    unit = float(eigenvalues.mean())
    best = minimize_scalar(
        lambda log_ratio: minus_log_likelihood(np.exp(log_ratio) / unit), bounds=_LOG_RATIO_RANGE, method="bounded"
    )
    ratio = float(np.exp(best.x) / unit)
    if minus_log_likelihood(0.0) <= best.fun:
        ratio = 0.0
    sigma2 = variance(ratio)
    tau2 = ratio * sigma2
    se_of_tau2 = np.sqrt(2 / ((eigenvalues / (sigma2 + tau2 * eigenvalues)) ** 2).sum())
    sd_mm = float(np.sqrt(tau2))
    # The root has no derivative at zero: near it, take the root of the standard error of τ².
    se_mm = float(se_of_tau2 / (2 * sd_mm)) if tau2 > se_of_tau2 else float(np.sqrt(se_of_tau2))
    return float(np.sqrt(sigma2)), Repeatability(sd_mm, se_mm)


def homing_shifts(
    bundle: Bundle, observations: Observations, covariance: NDArray[np.float64], boards: Sequence[Board]
) -> list[HomingShift]:
    """Return the shift between each two homings that follow one another in a sweep.

    Switches close within some hundredths of a millimetre, so all nodes that rely on one homing are shifted alike. A
    homing between sweeps shows nowhere, since the pose of a board is found anew in each. One within a sweep shows as
    boards that moved: in `bundle` every board has a pose after each homing, and their middles are compared.
    """
    middles_mm = {
        board.name: np.array([board.corner_shape[1] - 1, board.corner_shape[0] - 1, 0.0]) / 2 * board.square_mm
        for board in boards
    }
    targets = observations.targets
    by_board: dict[tuple[str, int], list[int]] = {}
    for index, target in enumerate(targets):  # in the order of sweeps and homings
        by_board.setdefault((target.board, target.sweep), []).append(index)
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for before, after in chain.from_iterable(map(pairwise, by_board.values())):
        pairs.setdefault((targets[before].homing, targets[after].homing), []).append((before, after))
    first = bundle.state_slices()["boards"].start
    shifts = []
    for (before, after), of_boards in sorted(pairs.items()):
        shift, jacobian = np.zeros(3), np.zeros((3, len(covariance)))
        for indices in of_boards:
            for index, sign in zip(indices, (1, -1), strict=True):
                point, slope = _point(bundle.rt_ref_board[index], middles_mm[targets[index].board])
                shift += sign * point / len(of_boards)
                jacobian[:, first + 6 * index : first + 6 * index + 6] += sign * slope / len(of_boards)
        shifts.append(HomingShift(before, after, shift, jacobian @ covariance @ jacobian.T))
    return shifts


def _point(rt: NDArray[np.float64], at_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a board's point in the reference frame, and its derivative (3, 6) by the board's pose."""
    rotation, derivative = cv2.Rodrigues(np.ascontiguousarray(rt[:3]))
    by_rotation = np.array([row.reshape(3, 3) @ at_mm for row in np.asarray(derivative)]).T
    return np.asarray(rotation) @ at_mm + rt[3:], np.hstack([by_rotation, np.eye(3)])
