"""`faintfield geometry` from images to files, on a small rendered set; boards on paper; other people's formats."""

import json
import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import mrcal
import msgspec
import numpy as np
import pytest

from faintfield.calib.board import Board
from faintfield.calib.geometry import BoardObservation, GeometrySettings, Node, Target, calibrate_geometry
from faintfield.pipelines.commands.calibration import geometry
from faintfield.pipelines.commands.capture import board
from faintfield.pipelines.commands.imports import import_mrcal
from faintfield.pipelines.commands.simulation import simulate
from faintfield.pipelines.errors import BadValue, InputError, MissingFile
from faintfield.pipelines.formats.exchange.colmap import read_model
from faintfield.pipelines.formats.results.geometry import (
    CORNERS_FILE,
    COVARIANCE_FILE,
    GEOMETRY_FILE,
    MODEL_FILE,
    GeometryRecord,
    read_geometry,
)
from faintfield.pipelines.formats.sets.board_set import load_board_set
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import read_truth
from faintfield.pipelines.formats.sets.session_set import with_measured_geometry
from faintfield.pipelines.simulation.options import SyntheticOptions
from faintfield.pipelines.workflows.geometry import GeometrySummary
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from tests.pipelines.conftest import Command, assert_refused, drawing_nothing
from tests.pipelines.forms import check_layout
from tests.simulated_boards import simulate_board_set

BOARDS = [Board(f"b{index}", 9, 7, 40.0, 29.0, "DICT_4X4_250", 31 * index) for index in range(4)]


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("scene") / "set"
    simulate(
        out, options=SyntheticOptions(rows=3, columns=3, pitch_mm=100.0, poses="nominal", size_px=(320, 240), seed=3)
    )
    return out


@pytest.fixture(scope="module")
def measured(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, GeometrySummary]:
    folder = tmp_path_factory.mktemp("boards")
    paper = paper_experiment(320, 240)
    experiment = SimulatedExperiment(paper.planes, paper.optics, paper.sensor, 3, 3, 100.0)
    truth = read_truth(scene)
    assert truth is not None
    simulate_board_set(folder, experiment, np.array(truth.true_rt_cam_ref), BOARDS, np.random.default_rng(1))
    with drawing_nothing():
        return folder, geometry(folder)


def test_files_hold_true_poses(measured: tuple[Path, GeometrySummary], scene: Path) -> None:
    folder, result = measured
    truth = read_truth(scene)
    assert truth is not None
    record = read_geometry(folder, GeometryRecord)
    np.testing.assert_allclose([node.rt_cam_ref for node in record.nodes], truth.true_rt_cam_ref, atol=0.6)
    assert record.camera_lens().fx_px == pytest.approx(400.0, abs=1.0)
    assert result.rms_inlier_px < 0.1
    content = json.loads((folder / "geometry.json").read_text())
    assert set(content["transfer_sigma_px"]) == {"500", "700"}
    assert set(content["inputs"]) >= {"charuco.toml", "b0_r0_c0.tiff"}
    with np.load(folder / COVARIANCE_FILE, allow_pickle=False) as stored:
        assert stored["covariance"].shape == (9 + 6 * 9,) * 2
    check_layout(folder / GEOMETRY_FILE, "geometry.json", "sha256")
    page = (folder / "geometry.html").read_text()
    assert "<svg" in page
    assert "squareness" in page
    elemental_set = with_measured_geometry(load_set(scene), folder)
    assert elemental_set.settings.view[0].rt_cam_ref == record.nodes[0].rt_cam_ref
    assert elemental_set.lens.fx_px == record.lens.fx_px
    assert "geometry.json" in elemental_set.input_hashes()
    for node in record.nodes[::4]:
        model = mrcal.cameramodel(str(folder / "cameras" / "node_r{}_c{}.cameramodel".format(*node.node)))
        np.testing.assert_allclose(model.rt_cam_ref()[3:] * 1000, node.rt_cam_ref[3:], atol=1e-6)
        assert model.intrinsics()[0] == "LENSMODEL_OPENCV5"
        point = np.array([[0.1, -0.05, 1.0]])
        pixels = mrcal.project(point, *model.intrinsics())
        np.testing.assert_allclose(pixels, record.camera_lens().project(point), atol=1e-4)


def test_mrcal_finds_the_residuals_and_errors_of_the_lens(measured: tuple[Path, GeometrySummary]) -> None:
    """Sums of squares and covariance are mrcal's own, from the file alone."""
    folder, _ = measured
    record = read_geometry(folder, GeometryRecord)
    model = mrcal.cameramodel(str(folder / MODEL_FILE))
    inputs = model.optimization_inputs()
    state, x, _, factor = mrcal.optimizer_callback(**inputs)
    boards = x[: mrcal.num_measurements_boards(**inputs)]
    assert boards @ boards == pytest.approx(2 * record.corners * record.rms_inlier_px**2, rel=1e-9)
    assert mrcal.measurements_board(inputs, x=x, icam_intrinsics=1 - model.icam_intrinsics()).any() == 0
    scale = np.ones_like(state)
    mrcal.unpack_state(scale, **inputs)
    first = mrcal.state_index_intrinsics(model.icam_intrinsics(), **inputs)
    sigma = np.sqrt(np.diag(factor.solve_xt_JtJ_bt(np.eye(len(state))))) * scale * record.corner_sigma_px
    np.testing.assert_allclose(sigma[first : first + 4], record.lens.sigma[:4], rtol=0.01)
    # The regularization, weaker for two lenses, moves what the corners determine by little
    before = inputs["intrinsics"][model.icam_intrinsics()].copy()
    mrcal.optimize(**inputs)
    moved = inputs["intrinsics"][model.icam_intrinsics()] - before
    assert (np.abs(moved[:4]) < 0.1 * np.array(record.lens.sigma[:4])).all()


@pytest.mark.deep
def test_tools_of_mrcal_draw_the_model(measured: tuple[Path, GeometrySummary], tmp_path: Path) -> None:
    tools = Path(sys.executable).parent
    calls = [["projection-uncertainty", "--gridn", "12", "9", "--distance", "0.6"], ["projection-uncertainty"]]
    calls += [["residuals", f"--{kind}"] for kind in ("vectorfield", "magnitudes", "histogram")]
    for number, (tool, *words) in enumerate([*calls, ["valid-intrinsics-region"]]):
        drawing = tmp_path / f"{number}.svg"
        ended = subprocess.run(
            [tools / f"mrcal-show-{tool}", *words, "--hardcopy", drawing, measured[0] / MODEL_FILE],
            env={**os.environ, "PATH": f"{tools}:{os.environ['PATH']}"},  # mrcal brings its own gnuplot
            capture_output=True,
            text=True,
        )
        assert ended.returncode == 0, ended.stderr
        assert "</svg>" in drawing.read_text()


def test_stored_corners_give_the_same_geometry(measured: tuple[Path, GeometrySummary]) -> None:
    folder, _ = measured
    content = read_geometry(folder, GeometryRecord)
    with np.load(folder / CORNERS_FILE, allow_pickle=False) as stored:
        arrays = dict(stored)
    groups: dict[tuple[Node, Target], list[int]] = {}
    for row, (node, sweep, name) in enumerate(zip(arrays["node"], arrays["sweep"], arrays["board"], strict=True)):
        groups.setdefault(((int(node[0]), int(node[1])), Target(str(name), int(sweep))), []).append(row)
    per_row = (arrays["corner"], arrays["pixels"], arrays["sigma_px"])
    corners = [BoardObservation(*key, *(values[rows] for values in per_row)) for key, rows in groups.items()]
    boards = {board.name: board for board in BOARDS}
    again = calibrate_geometry(boards, corners, content.size_px, content.reference_node, GeometrySettings())
    pixels, here = np.array([[20.0, 30.0], [160.0, 100.0], [300.0, 200.0]]), content.camera_lens()
    points = np.column_stack([here.rays_at(pixels), np.ones(3)]) * 600.0
    for rt, node in zip(again.rt_cam_ref, content.nodes, strict=True):
        np.testing.assert_allclose(rt, node.rt_cam_ref, atol=1e-8)
    np.testing.assert_allclose(again.lens.project(points), here.project(points), atol=1e-6)


def test_hand_written_geometry_needs_lens_and_poses_only(scene: Path, tmp_path: Path) -> None:
    poses = [[0.0, 0.0, 0.0, -100.0 * (column - 1), -100.0 * (row - 1), 0.0] for row, column in np.ndindex(3, 3)]
    lens = {"model": "pinhole", "fx_px": 390.0, "fy_px": 390.0, "cx_px": 159.0, "cy_px": 119.0, "distortion": []}
    nodes = [
        {"node": node, "rt_cam_ref": pose, "sigma_mm": 0.1, "sigma_rad": 1e-4}
        for node, pose in zip(np.ndindex(3, 3), poses, strict=True)
    ]
    content = {"lens": lens, "size_px": [320, 240], "reference_node": [1, 1], "nodes": nodes}
    (tmp_path / "geometry.json").write_text(json.dumps(content))
    elemental_set = with_measured_geometry(load_set(scene), tmp_path)
    assert elemental_set.lens.fx_px == 390.0
    np.testing.assert_array_equal(elemental_set.poses_rt_cam_ref, poses)
    del content["reference_node"]
    (tmp_path / "geometry.json").write_text(json.dumps(content))
    with pytest.raises(BadValue, match="reference_node"):
        with_measured_geometry(load_set(scene), tmp_path)


def test_poses_of_another_camera_are_refused(
    measured: tuple[Path, GeometrySummary], scene: Path, tmp_path: Path
) -> None:
    elemental_set = load_set(scene)
    camera = msgspec.structs.replace(elemental_set.settings.camera, size_px=(160, 120))
    other = replace(elemental_set, settings=msgspec.structs.replace(elemental_set.settings, camera=camera))
    with pytest.raises(BadValue, match=r"is of .* px images"):
        with_measured_geometry(other, measured[0])
    beyond = [msgspec.structs.replace(view, node=(row, 7)) for row, view in enumerate(elemental_set.settings.view[:6])]
    views = [*beyond, *elemental_set.settings.view[6:]]
    larger = replace(elemental_set, settings=msgspec.structs.replace(elemental_set.settings, view=views))
    with pytest.raises(BadValue, match="has no pose for 6 of 9 views"):
        with_measured_geometry(larger, measured[0])
    with pytest.raises(MissingFile, match="run `faintfield geometry`"):
        with_measured_geometry(elemental_set, tmp_path)


BOARD = 'name = "a", columns = 9, rows = 7, square_mm = 40.0, marker_mm = 29.0, dictionary = "DICT_4X4_250"'
IMAGE = 'image = [{ file = "no.tiff", node = [0, 0], sweep = 0 }]'


@pytest.mark.parametrize(
    ("boards", "words"),
    [
        (f"{{ {BOARD} }}", "no.tiff is named but missing"),
        ("{ colums = 9 }", "did you mean 'columns'"),
        (f"{{ {BOARD.rpartition(',')[0]} }}", "missing required field `dictionary`"),
        (f"{{ {BOARD} }}, {{ {BOARD.replace('"a"', '"b"')} }}", "share markers 0 to 30"),
    ],
)
def test_bad_board_sets_are_refused(boards: str, words: str, tmp_path: Path) -> None:
    (tmp_path / "charuco.toml").write_text(f"format = 1\nboard = [{boards}]\n{IMAGE}\n")
    with pytest.raises(InputError, match=words):
        load_board_set(tmp_path)


def test_board_pdf_is_true_to_size(tmp_path: Path) -> None:
    result = board(tmp_path / "b.pdf", paper="A3", boards=2, square_mm=30.0)
    content = (tmp_path / "b.pdf").read_bytes().decode("ascii")
    assert "/MediaBox [0 0 1190.55118 841.88976]" in content  # 420 x 297 mm in points
    assert "/Count 2" in content
    first, second = result.board
    markers = first.columns * first.rows // 2
    assert second.first_marker_id == first.first_marker_id + markers
    squares = [line.split() for line in content.splitlines() if line.endswith(" re")]
    assert sum(line[2] == line[3] == "30.00000" for line in squares) == 2 * -(-first.columns * first.rows // 2)
    start = int(content.split("startxref\n")[1].split()[0])
    assert content[start:].startswith("xref")
    for number, line in enumerate(content[start:].splitlines()[3:], start=1):
        if not line.endswith(" n "):
            break
        assert content[int(line.split()[0]) :].startswith(f"{number} 0 obj")


def test_missing_and_damaged_models_are_named(tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match=r"cameras.bin or cameras.txt"):
        read_model(tmp_path)
    (tmp_path / "x.cameramodel").write_text("{ nonsense")
    with pytest.raises(BadValue, match="is not a camera model"):
        import_mrcal(tmp_path, tmp_path / "out")


def test_export_without_mrcal_is_a_named_failure(
    scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    monkeypatch.setitem(sys.modules, "mrcal", None)
    assert_refused(faintfield("export", "mrcal", scene, tmp_path / "out"), "MissingMrcal", "pip install")
    assert not (tmp_path / "out").exists()
