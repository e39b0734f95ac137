"""Homings within a sweep: the shift of the switches is found and taken out of the poses, and no other is."""

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.geometry import Target
from faintfield.calib.homography import rotation_matrix
from faintfield.rig.plan import grid_nodes, nominal_poses_rt_cam_ref
from faintfield.rig.simulation.boards import six_boards
from tests.calib.geometry.simulated import BOARD_NAMES, LENIENT, Simulated, calibrated, centres_mm, observe

SIDE, PITCH_MM, NOISE_PX = 3, 100.0, 0.05
POSES = nominal_poses_rt_cam_ref(SIDE, SIDE, PITCH_MM) + np.random.default_rng(5).normal(size=(SIDE**2, 6)) * 1e-3
POSES[SIDE**2 // 2] = 0


def observed(shift_mm: NDArray[np.float64], seed: int = 1) -> Simulated:
    """Show three boards in each sweep; the stage homes after the first row of the first sweep, and is shifted then."""
    rng = np.random.default_rng(seed)
    observations = []
    for sweep in (0, 1):
        for index, board in list(enumerate(six_boards(6, 8, 40.0)))[3 * sweep : 3 * sweep + 3]:
            for node, pose in zip(grid_nodes(SIDE, SIDE), POSES, strict=True):
                homing = int(sweep > 0 or node[0] > 0)
                there = pose - np.append(np.zeros(3), rotation_matrix(pose) @ shift_mm * homing)
                target = Target(BOARD_NAMES[index], sweep, homing)
                observations.append(observe(board, there, node, target, rng, NOISE_PX))
    return Simulated(observations, POSES, SIDE)


def test_shift_is_measured_and_taken_out() -> None:
    true_mm = np.array([0.1, -0.03, 0.0])
    geometry = calibrated(observed(true_mm), LENIENT)
    (shift,) = geometry.homings
    assert (shift.before, shift.after) == (0, 1)
    sigma_mm = np.sqrt(np.diag(shift.covariance_mm2))
    assert sigma_mm[:2].max() < 0.02
    np.testing.assert_array_less(np.abs(shift.shift_mm - true_mm), 4 * sigma_mm)
    error_mm = np.sqrt(np.square(centres_mm(geometry.rt_cam_ref) - centres_mm(POSES)).mean())
    stated_mm = float(np.sqrt(np.square(geometry.sigma_mm()).mean() / 3))
    assert error_mm < 2 * stated_mm < 0.08
    assert not geometry.warnings


@pytest.mark.deep
def test_error_of_a_shift_is_as_stated() -> None:
    """Squared errors over their covariance have mean three; eight seeds put three standard errors at 2.6."""
    true_mm = np.array([0.1, -0.03, 0.02])
    ratios = []
    for seed in range(8):
        (shift,) = calibrated(observed(true_mm, seed=seed), LENIENT).homings
        error = shift.shift_mm - true_mm
        ratios.append(error @ np.linalg.solve(shift.covariance_mm2, error))
    assert np.mean(ratios) == pytest.approx(3.0, abs=2.6)


def test_homing_without_shift_leaves_one_rigid_group() -> None:
    geometry = calibrated(observed(np.zeros(3)), LENIENT)
    assert not geometry.homings
    assert [board.target.homing for board in geometry.boards] == [0] * 6


def test_homing_after_every_row_leaves_one_rigid_group() -> None:
    """No row shares a board and a homing with another, so that no shift can be found; the geometry can."""
    truth = observed(np.zeros(3))
    views = [replace(view, target=replace(view.target, homing=view.node[0])) for view in truth.observations]
    geometry = calibrated(replace(truth, observations=views), LENIENT)
    assert not geometry.homings
    assert geometry.undetermined_homings == [0, 1]
    assert len(geometry.nodes) == SIDE**2
