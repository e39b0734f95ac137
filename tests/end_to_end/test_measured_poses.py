"""Reconstruction from measured, true and nominal poses of one dark scene."""

from pathlib import Path

import msgspec
import numpy as np
import pytest

from faintfield.calib.board import Board
from faintfield.pipelines.commands.geometry import geometry
from faintfield.pipelines.commands.reconstruct import reconstruct
from faintfield.pipelines.commands.simulate import simulate
from faintfield.pipelines.formats.sets.elemental_file import ElementalSetFile, write_set
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import read_truth
from faintfield.pipelines.reconstruction.options import Options
from faintfield.rig.simulation.experiment import paper_experiment
from tests.simulated_boards import simulate_board_set

BOARDS = [Board(f"b{index}", 9, 7, 40.0, 29.0, "DICT_4X4_250", 31 * index) for index in range(3)]


@pytest.mark.slow
def test_measured_poses_are_as_good_as_true_ones_and_nominal_ones_are_not(tmp_path: Path) -> None:
    scene, boards = tmp_path / "scene", tmp_path / "boards"
    simulate(scene, size_px=(320, 240), poses="nominal", seed=2)  # 7 x 7 nodes, SNR 0.16
    truth = read_truth(scene)
    assert truth is not None
    experiment = paper_experiment(320, 240)
    boards.mkdir()
    simulate_board_set(boards, experiment, np.array(truth.true_rt_cam_ref), BOARDS, np.random.default_rng(1))
    geometry(boards)
    measured = mean_square_error(scene, tmp_path / "measured", boards, "measured")
    nominal = mean_square_error(scene, tmp_path / "nominal", None, "nominal")
    write_set(scene, with_poses(load_set(scene).settings, truth.true_rt_cam_ref))
    exact = mean_square_error(scene, tmp_path / "true", None, "nominal")  # by what simulate stated
    assert abs(measured / exact - 1) < 0.01
    assert nominal > 1.2 * exact


def mean_square_error(scene: Path, out: Path, measured_in: Path | None, poses: str) -> float:
    result = reconstruct(scene, options=Options(depth_mm=[500.0], method=["pmlem-osl"]), out=out, geometry=measured_in)
    assert result.metrics is not None
    (row,) = result.metrics.planes
    assert row.poses == poses
    return row.mse_bright


def with_poses(
    settings: ElementalSetFile, poses: list[tuple[float, float, float, float, float, float]]
) -> ElementalSetFile:
    views = [msgspec.structs.replace(view, rt_cam_ref=pose) for view, pose in zip(settings.view, poses, strict=True)]
    return msgspec.structs.replace(settings, view=views)
