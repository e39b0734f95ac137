"""A simulated calibration, small and fast: 3 x 3 or 5 x 5 nodes, boards of 6 x 8 corners."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from faintfield.calib.board import Board
from faintfield.calib.geometry import BoardObservation, GeometrySettings, RigGeometry, Target, calibrate_geometry
from faintfield.rig.plan import centre_node, grid_nodes, nominal_poses_rt_cam_ref
from faintfield.rig.simulation.boards import SimulatedBoard, six_boards
from faintfield.rig.simulation.experiment import paper_experiment
from faintfield.rig.simulation.optics import SimulatedOptics

NOISE_PX = 0.2
LENIENT = GeometrySettings(max_transfer_sigma_px=20.0, max_holdout_ratio=10.0)
OPTICS = paper_experiment(1600, 1200).optics
BOARD_NAMES = [f"board-{index}" for index in range(6)]
BOARDS = {name: Board(name, 9, 7, 40.0, 30.0, "DICT_5X5_1000", 31 * k) for k, name in enumerate(BOARD_NAMES)}


@dataclass(frozen=True)
class Simulated:
    """Input of the calibration, and the truth."""

    observations: list[BoardObservation]
    poses: NDArray[np.float64]
    side: int

    @property
    def reference(self) -> tuple[int, int]:
        return centre_node(self.side, self.side)


def simulated(
    seed: int,
    side: int = 3,
    standing: list[SimulatedBoard] | None = None,
    miss_mm: float = 0.0,
    noise_px: float = NOISE_PX,
    optics: SimulatedOptics = OPTICS,
) -> Simulated:
    """Return corners of boards; with `miss_mm` boards are shown in turn and the stage misses each node by that."""
    generator = np.random.default_rng(seed)
    poses = nominal_poses_rt_cam_ref(side, side, 100.0)
    errors = generator.normal(size=poses.shape) * np.repeat([np.radians(0.2), 0.3], 3)
    errors[side * side // 2] = 0
    poses = poses + errors
    observations = []
    for index, board in enumerate(standing or six_boards(6, 8, 40.0)):
        for node, pose in zip(grid_nodes(side, side), poses, strict=True):
            there = pose + np.append(np.zeros(3), generator.normal(size=3) * miss_mm)
            target = Target(BOARD_NAMES[index], index if miss_mm else 0)
            observations.append(observe(board, there, node, target, generator, noise_px, optics))
    return Simulated(observations, poses, side)


def observe(
    board: SimulatedBoard,
    pose: NDArray[np.float64],
    node: tuple[int, int],
    target: Target,
    generator: np.random.Generator,
    noise_px: float,
    optics: SimulatedOptics = OPTICS,
) -> BoardObservation:
    """Return the corners that a camera sees, with noise."""
    pixels = board.seen(optics, pose)
    ids = np.flatnonzero(np.isfinite(pixels[:, 0]))
    noisy = pixels[ids] + generator.normal(size=(len(ids), 2)) * noise_px
    return BoardObservation(node, target, ids, noisy, np.full(len(ids), NOISE_PX))


def calibrated(truth: Simulated, settings: GeometrySettings | None = None) -> RigGeometry:
    return calibrate_geometry(BOARDS, truth.observations, OPTICS.size_px, truth.reference, settings)


def centres_mm(rt_cam_ref: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return camera centres (node, 3), by scipy's rotations."""
    return -Rotation.from_rotvec(rt_cam_ref[:, :3]).inv().apply(rt_cam_ref[:, 3:])
