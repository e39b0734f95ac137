"""Accuracy of the geometry and its stated uncertainty: `python -m benchmarks.calibration.geometry_accuracy`.

Per seed: 49 nodes with errors of 0.3 mm and 0.2 degrees, six boards, corners with noise of 0.2 px at 1600 x 1200 px.
"""

import argparse
import json
import resource
import sys
import time
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.geometry import (
    BoardObservation,
    GeometrySettings,
    RigGeometry,
    Target,
    calibrate_geometry,
    rms_over_views,
    transfer_sigma_at,
)
from faintfield.calib.homography import fronto_parallel_rt_ref_plane, image_lattice, transfer
from faintfield.calib.lens import Lens
from faintfield.rig.plan import grid_nodes
from faintfield.rig.simulation.boards import six_boards
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment

_CORNER_ROWS, _CORNER_COLUMNS, _SQUARE_MM = 9, 14, 27.0
_NOISE_PX = 0.2
_REFERENCE = (3, 3)


def boards() -> dict[str, Board]:
    """Return six A3 boards, each with its own markers."""
    columns, rows = _CORNER_COLUMNS + 1, _CORNER_ROWS + 1
    named = [Board(f"b{k}", columns, rows, _SQUARE_MM, 20.0, "DICT_5X5_1000", 75 * k) for k in range(6)]
    return {board.name: board for board in named}


def observe(
    experiment: SimulatedExperiment, poses: NDArray[np.float64], generator: np.random.Generator, miss_mm: float
) -> list[BoardObservation]:
    """Return noisy corners; with `miss_mm` boards are shown one after another and the stage misses nodes by that."""
    seen = []
    for index, board in enumerate(six_boards(_CORNER_ROWS, _CORNER_COLUMNS, _SQUARE_MM)):
        for node, pose in zip(grid_nodes(7, 7), poses, strict=True):
            there = pose + np.append(np.zeros(3), generator.normal(size=3) * miss_mm)
            pixels = board.seen(experiment.optics, there)
            ids = np.flatnonzero(np.isfinite(pixels[:, 0]))
            noisy = pixels[ids] + generator.normal(size=(len(ids), 2)) * _NOISE_PX
            target = Target(f"b{index}", index if miss_mm else 0)
            seen.append(BoardObservation(node, target, ids, noisy, np.full(len(ids), _NOISE_PX)))
    return seen


def centres_mm(rt_cam_ref: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return camera centres (node, 3)."""
    return np.array([-cv2.Rodrigues(rt[:3])[0].T @ rt[3:] for rt in rt_cam_ref])


def errors_of(geometry: RigGeometry, truth: NDArray[np.float64], experiment: SimulatedExperiment) -> dict[str, float]:
    """Return the errors of a geometry, and how they compare with what it states."""
    others = [index for index in range(len(truth)) if index != geometry.reference]
    missed = centres_mm(geometry.rt_cam_ref) - centres_mm(truth)
    turned = geometry.rt_cam_ref[:, :3] - truth[:, :3]
    pose_errors = geometry.rt_cam_ref - truth
    per_pose = [pose_errors[i] @ np.linalg.solve(geometry.pose_covariance(i), pose_errors[i]) / 6 for i in others]
    rows = np.concatenate([len(geometry.lens.parameters) + 6 * i + np.arange(6) for i in others])
    covariance = geometry.covariance[np.ix_(rows, rows)]
    joint = pose_errors[others].ravel()
    optics = experiment.optics
    true_lens = Lens(optics.size_px, optics.fx_px, optics.fy_px, optics.cx_px, optics.cy_px, optics.distortion)
    result = {
        "centre_um": 1e3 * _rms(missed[others]),
        "rotation_mdeg": 1e3 * np.degrees(_rms(turned[others])),
        "nees_joint": float(joint @ np.linalg.solve(covariance, joint) / len(joint)),
        "nees_per_pose": float(np.mean(per_pose)),
    }
    for depth in (500.0, 700.0):
        plane, pixels, square = fronto_parallel_rt_ref_plane(depth), image_lattice(optics.size_px), []
        for rt, rt_true in zip(geometry.rt_cam_ref[others], truth[others], strict=True):
            there = transfer(true_lens, rt_true, plane, pixels)
            inside = ((there >= -0.5) & (there <= np.array(optics.size_px) - 0.5)).all(axis=1)
            square.append(np.square(transfer(geometry.lens, rt, plane, pixels) - there)[inside].sum(axis=1))
        result[f"transfer_{depth:g}_px"] = float(np.sqrt(np.concatenate(square).mean()))
        result[f"stated_{depth:g}_px"] = rms_over_views(transfer_sigma_at(geometry, depth))
    return result


def per_view_pnp_um(
    observations: Sequence[BoardObservation], truth: NDArray[np.float64], experiment: SimulatedExperiment
) -> float:
    """Return the error of the centres when each view is solved alone, with the true lens, from its best board.

    The board's pose comes from the reference view alone.
    """
    optics = experiment.optics
    lens = Lens(optics.size_px, optics.fx_px, optics.fy_px, optics.cx_px, optics.cy_px, optics.distortion)
    matrix, distortion = lens.camera_matrix(), np.array(lens.distortion)
    points = {name: board.corners_mm() for name, board in boards().items()}
    solved = {}
    for board in observations:
        _, r, t = cv2.solvePnP(points[board.target.board][board.corners], board.pixels, matrix, distortion)
        pose = np.eye(4)
        pose[:3, :3], pose[:3, 3] = cv2.Rodrigues(r)[0], t.ravel()
        solved[board.node, board.target] = pose
    misses = []
    for node, rt in zip(grid_nodes(7, 7), truth, strict=True):
        if node == _REFERENCE:
            continue
        best = max((board for board in observations if board.node == node), key=lambda board: len(board.corners)).target
        camera_from_ref = solved[node, best] @ np.linalg.inv(solved[_REFERENCE, best])
        centre = -camera_from_ref[:3, :3].T @ camera_from_ref[:3, 3]
        misses.append(centre - centres_mm(rt[np.newaxis])[0])
    return 1e3 * _rms(np.array(misses))


def one_seed(seed: int, miss_mm: float) -> dict[str, float]:
    """Return the errors of one simulated calibration."""
    generator = np.random.default_rng(seed)
    experiment = paper_experiment(1600, 1200)
    truth = experiment.poses_rt_cam_ref(0.3, float(np.radians(0.2)), generator)
    seen = observe(experiment, truth, generator, miss_mm)
    settings = GeometrySettings(max_transfer_sigma_px=5.0)
    started = time.perf_counter()
    geometry = calibrate_geometry(boards(), seen, experiment.optics.size_px, _REFERENCE, settings)
    result = {"seconds": time.perf_counter() - started, **errors_of(geometry, truth, experiment)}
    result["pnp_centre_um"] = per_view_pnp_um(seen, truth, experiment)
    result["holdout_ratio"] = geometry.holdout_ratio or np.nan
    if geometry.repeatability is not None:
        result["repeatability_um"] = 1e3 * geometry.repeatability.sd_mm
    return result


def _rms(vectors: NDArray[np.float64]) -> float:
    """Return the root mean square length of vectors (vector, 3)."""
    return float(np.sqrt(np.square(vectors).sum(axis=-1).mean()))


def main() -> None:
    """Print rms (errors) and means (the rest) over the seeds."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.calibration.geometry_accuracy", description=__doc__)
    parser.add_argument("--seeds", type=int, default=20)
    parser.add_argument("--miss-mm", type=float, default=0.0, help="boards one after another, nodes missed by this")
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    arguments = parser.parse_args()
    runs = [one_seed(seed, arguments.miss_mm) for seed in range(arguments.seeds)]
    figures = {}
    for name in runs[0]:
        values = np.array([run[name] for run in runs])
        squared = name.endswith(("_um", "_mdeg", "_px"))
        figures[name] = float(np.sqrt(np.mean(values**2)) if squared else values.mean())
        figures[f"{name}_worst"] = float(values.max())
    figures["peak_mb"] = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1e3
    if arguments.json:
        sys.stdout.write(json.dumps(figures) + "\n")
        return
    for name, value in figures.items():
        print(f"{name:28} {value:10.4g}")


if __name__ == "__main__":
    main()
