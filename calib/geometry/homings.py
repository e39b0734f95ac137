"""Positions before and after a homing: switches close within some hundredths of a millimetre, not at one place.

All nodes that rely on one homing are shifted alike. A homing between two sweeps shows nowhere, since the pose of a
board is found anew in each sweep. One within a sweep shows as boards that moved against the nodes.
"""

import itertools
from collections.abc import Sequence
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.board import Board
from faintfield.calib.geometry.bundle import Bundle
from faintfield.calib.geometry.observations import BoardObservation, Observations, Target

# Probability of a shift that chance alone shows.
_CHANCE = 1e-3


@dataclass(frozen=True)
class HomingShift:
    """Shift of the stage from one homing to a later one, in the reference camera's frame.

    Attributes
    ----------
    before, after : int
        Numbers of the homings.
    shift_mm : array (3,)
        By how much all cameras after the later homing are shifted.
    covariance_mm2 : array (3, 3)
        Covariance of its error.
    """

    before: int
    after: int
    shift_mm: NDArray[np.float64]
    covariance_mm2: NDArray[np.float64]

    def is_significant(self) -> bool:
        """Return whether chance hardly makes such a shift."""
        distance2 = float(self.shift_mm @ np.linalg.solve(self.covariance_mm2, self.shift_mm))
        return bool(stats.chi2.sf(distance2, 3) < _CHANCE)


def as_one_homing(observations: Sequence[BoardObservation]) -> list[BoardObservation]:
    """Return the observations as if no homing had interrupted a sweep."""
    return [replace(seen, target=replace(seen.target, homing=0)) for seen in observations]


def interrupted_sweeps(observations: Sequence[BoardObservation]) -> list[int]:
    """Return the sweeps within which the stage homed."""
    homings: dict[int, set[int]] = {}
    for seen in observations:
        homings.setdefault(seen.target.sweep, set()).add(seen.target.homing)
    return sorted(sweep for sweep, of_sweep in homings.items() if len(of_sweep) > 1)


def homing_shifts(
    bundle: Bundle, observations: Observations, covariance: NDArray[np.float64], boards: Sequence[Board]
) -> list[HomingShift]:
    """Return the shift between each two homings that follow one another in a sweep.

    Parameters
    ----------
    bundle : Bundle
        Solution in which every board has a pose of its own after each homing.
    observations : Observations
        The corners that it was found from.
    covariance : array (state, state)
        Covariance of its state.
    boards : sequence of Board
        The boards, whose middles are compared.
    """
    middles = {board.name: _middle_mm(board) for board in boards}
    targets = observations.targets
    pairs: dict[tuple[int, int], list[tuple[int, int]]] = {}
    for before, after in _neighbours(targets):
        pairs.setdefault((targets[before].homing, targets[after].homing), []).append((before, after))
    first = bundle.state_slices()["boards"].start
    found = []
    for (one, other), of_boards in sorted(pairs.items()):
        shift, jacobian = np.zeros(3), np.zeros((3, len(covariance)))
        for indices in of_boards:
            for index, sign in zip(indices, (1, -1), strict=True):
                point, slope = _point(bundle.rt_ref_board[index], middles[targets[index].board])
                shift += sign * point / len(of_boards)
                jacobian[:, first + 6 * index : first + 6 * index + 6] += sign * slope / len(of_boards)
        found.append(HomingShift(one, other, shift, jacobian @ covariance @ jacobian.T))
    return found


def _neighbours(targets: Sequence[Target]) -> list[tuple[int, int]]:
    """Return the indices of each board before and after a homing within a sweep."""
    by_board: dict[tuple[str, int], list[int]] = {}
    for index, target in enumerate(targets):
        by_board.setdefault((target.board, target.sweep), []).append(index)
    ordered = [sorted(indices, key=lambda index: targets[index].homing) for indices in by_board.values()]
    return [pair for indices in ordered for pair in itertools.pairwise(indices)]


def _middle_mm(board: Board) -> NDArray[np.float64]:
    """Return the middle of a board's corners in its own frame."""
    rows, columns = board.corner_shape
    return np.array([(columns - 1) / 2, (rows - 1) / 2, 0.0]) * board.square_mm


def _point(rt: NDArray[np.float64], at_mm: NDArray[np.float64]) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return a board's point in the reference frame, and its derivative (3, 6) by the board's pose."""
    rotation, derivative = cv2.Rodrigues(np.ascontiguousarray(rt[:3]))
    by_rotation = np.array([row.reshape(3, 3) @ at_mm for row in np.asarray(derivative)]).T
    return np.asarray(rotation) @ at_mm + rt[3:], np.hstack([by_rotation, np.eye(3)])
