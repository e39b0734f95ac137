"""`faintfield demo`: the whole experiment on simulated light, ending with report.html."""

import shutil
from pathlib import Path
from typing import Any

import numpy as np

from calib.board import Board
from pipelines.arguments import Positive, Seed
from pipelines.console import say
from pipelines.elemental_set import FILE_NAME
from pipelines.files import building_folder, check_free, write_json
from pipelines.geometry import geometry
from pipelines.metrics import METRICS_FILE
from pipelines.reconstruct import reconstruct
from pipelines.report import write_report
from pipelines.simulate import NOISE_FREE, simulate
from pipelines.simulate_boards import simulate_board_set
from pipelines.truth import read_truth
from rig.simulation.experiment import paper_experiment

_DEPTHS_MM = [500.0, 700.0]
_DARK_SCENE = "dark-scene"
_BOARDS = "boards"


def demo(out: Path = Path("demo"), /, *, snr: Positive = 0.16, seed: Seed = 1, measure: bool = False) -> dict[str, Any]:
    """Run the paper's experiment: simulate it in the dark, reconstruct both objects, and draw the report.

    Parameters
    ----------
    out
        Folder to write; the results of an earlier demo are replaced.
    snr
        Of the dark views, eq. (4).
    seed
        Of all chance.
    measure
        Do not take the camera's poses for known: photograph boards from the same nodes, measure where it was, and
        compare with the nominal grid. Takes half a minute more.
    """
    check_free(out, replace_if=f"{_DARK_SCENE}/{FILE_NAME}")
    scene = out / _DARK_SCENE
    say("simulating 7 x 7 views of a toy truck at 500 mm and a toy airplane at 700 mm, almost dark")
    simulate(scene, snr=snr, seed=seed, poses="nominal" if measure else "true", overwrite=True)
    say("reconstructing both planes without noise, for comparison")
    reconstruct(scene / NOISE_FREE, out=out / "noise-free", depth_mm=_DEPTHS_MM, method=["backprojection"])
    planes = _with_nominal_poses(scene, out, seed) if measure else []
    say("reconstructing both planes from the dark")
    dark = reconstruct(
        scene,
        out=out / "dark",
        depth_mm=_DEPTHS_MM,
        method=["backprojection", "mlem", "pmlem-osl"],
        geometry=out / _BOARDS if measure else None,
    )
    metrics = {**dark["metrics"], "planes": [*dark["metrics"]["planes"], *planes]}
    write_json(out / METRICS_FILE, metrics)
    return {"out": str(out), "report": str(write_report(out)), "metrics": metrics}


def _with_nominal_poses(scene: Path, out: Path, seed: int) -> list[dict[str, Any]]:
    """Measure the camera from boards, and return the errors that a reconstruction has without that."""
    say("photographing boards from the same nodes, and measuring where the camera was")
    _photograph_boards(scene, out / _BOARDS, seed)
    geometry(out / _BOARDS, depth_mm=_DEPTHS_MM)
    say("reconstructing both planes from the dark, with nominal poses")
    nominal = reconstruct(scene, out=out / "nominal", depth_mm=_DEPTHS_MM, method=["pmlem-osl"])
    planes: list[dict[str, Any]] = nominal["metrics"]["planes"]
    return planes


def _photograph_boards(scene: Path, out: Path, seed: int) -> None:
    """Photograph three boards with the camera where it was for the dark scene."""
    truth = read_truth(scene)
    assert truth is not None
    boards = [Board(f"board-{letter}", 11, 8, 36.0, 26.0, "DICT_4X4_250", 44 * k) for k, letter in enumerate("abc")]
    generator = np.random.default_rng([seed, 1])
    if out.exists():
        shutil.rmtree(out)
    with building_folder(out) as folder:
        simulate_board_set(folder, paper_experiment(), np.array(truth.true_rt_cam_ref), boards, generator)
