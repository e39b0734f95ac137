"""`align`: poses of a simulated set by its views, and nothing where the views tell none."""

import shutil
from json import loads
from pathlib import Path

import msgspec
import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray

from faintfield.pipelines.errors import CannotWrite
from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.results.alignment import AlignmentRecord
from faintfield.pipelines.formats.results.geometry import (
    COVARIANCE_FILE,
    GEOMETRY_FILE,
    CameraPoses,
    LensRecord,
    NodeRecord,
    read_geometry,
    write_geometry,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.formats.sets.ground_truth import read_truth
from faintfield.pipelines.formats.sets.session_set import with_measured_geometry
from tests.pipelines.conftest import Command
from tests.pipelines.forms import read_record

GRID = ("--rows", 5, "--columns", 5, "--size-px", 160, 120, "--snr", 2, "--objects", "surfaces")


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from faintfield.pipelines.commands.simulation import simulate
    from faintfield.pipelines.simulation.options import SyntheticOptions

    out = tmp_path_factory.mktemp("aligned") / "set"
    simulate(
        out,
        options=SyntheticOptions(
            rows=5,
            columns=5,
            size_px=(160, 120),
            snr=2.0,
            objects="surfaces",
            poses="nominal",
            rotation_error_mrad=8.0,
            seed=2,
        ),
    )
    return out


def test_poses_by_the_views_are_nearer_to_the_truth_by_what_they_state(
    scene: Path, tmp_path: Path, done: Command
) -> None:
    printed = loads(done("align", scene, "--out", tmp_path / "aligned", "--json").stdout)
    assert printed["accepted"]
    record = read_geometry(tmp_path / "aligned", AlignmentRecord)
    assert record.source == "views"

    stated, truth = load_set(scene), read_truth(scene)
    assert truth is not None
    aligned = with_measured_geometry(stated, tmp_path / "aligned")
    assert aligned.poses == "aligned"
    assert aligned.settings.camera == stated.settings.camera
    true = np.array(truth.true_rt_cam_ref)
    others = np.delete(np.arange(25), stated.reference_view)
    np.testing.assert_array_equal(aligned.poses_rt_cam_ref[stated.reference_view], true[stated.reference_view])

    # Shifts of the picture at 700 mm, where a rotation and a translation take each other's place
    def moved_px(poses: NDArray[np.float64]) -> NDArray[np.float64]:
        a, b, _, x, y, _ = (poses - true)[others].T
        return stated.settings.camera.fx_px * np.column_stack([b + x / 700, y / 700 - a])

    before, after = (np.sqrt(np.mean(moved_px(posed.poses_rt_cam_ref) ** 2)) for posed in (stated, aligned))
    assert after < 0.35 * before

    # The least-squares change of 1/depth by these shifts, common to all points
    along = true[others, 3:5]
    common = np.sum(along * moved_px(aligned.poses_rt_cam_ref)) / stated.settings.camera.fx_px / np.sum(along**2)
    assert abs(common) < 3 * aligned.inverse_depth_sigma
    assert aligned.inverse_depth_sigma < 0.02 / 700

    with np.load(tmp_path / "aligned" / COVARIANCE_FILE) as arrays:
        covariance, lens = arrays["covariance"], len(arrays["intrinsics"])
    rows = (lens + 6 * others[:, np.newaxis] + np.arange(6)).ravel()
    errors = (aligned.poses_rt_cam_ref - true)[others].ravel()
    assert 0.5 < errors @ np.linalg.solve(covariance[np.ix_(rows, rows)], errors) / len(errors) < 1.5

    done("verify", tmp_path / "aligned", "--inputs", scene)
    (tmp_path / "aligned").rename(tmp_path / "alignment")
    planes = ("--geometry", tmp_path / "alignment", "--depth-mm", 700, "--prior", "tv", "--out", tmp_path / "planes")
    done("reconstruct", scene, *planes)
    assert read_record(tmp_path / "planes")["options"]["poses"] == "aligned"
    assert "Poses, by the views" in (tmp_path / "planes" / "report.html").read_text()

    # A second result that cannot be written leaves the first
    before = {path.name: path.read_bytes() for path in (tmp_path / "alignment").iterdir()}
    with pytest.raises(CannotWrite):
        write_geometry(tmp_path / "alignment", record, {COVARIANCE_FILE: b"new", "a" * 300: b"no such name"})
    assert {path.name: path.read_bytes() for path in (tmp_path / "alignment").iterdir()} == before


def test_noise_alone_gives_no_poses_and_removes_earlier_ones(scene: Path, tmp_path: Path, faintfield: Command) -> None:
    dark = tmp_path / "dark"
    shutil.copytree(scene, dark)
    generator = np.random.default_rng(1)
    for view in dark.glob("view_*.tiff"):
        shape = read_frame(view).pixels_dn.shape
        write_frame(view, np.rint(100 + generator.normal(0, 7, shape)).astype(np.uint16))
    (tmp_path / "out").mkdir()
    for name in ("geometry.json", "alignment.html"):
        (tmp_path / "out" / name).write_text("{}")
    ended = faintfield("align", dark, "--out", tmp_path / "out", "--json")
    assert ended.returncode == 0
    assert not loads(ended.stdout)["accepted"]
    assert "the views tell no poses" in ended.stderr
    assert "give the range by `faintfield align --depth-range NEAR:FAR`" in ended.stderr
    assert not (tmp_path / "out").exists() or not list((tmp_path / "out").glob("[ag]*"))


@pytest.mark.deep
def test_true_poses_stay(tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "set", *GRID, "--seed", 3)
    printed = loads(done("align", tmp_path / "set", "--depth-range", "500:1050", "--json").stdout)
    assert not printed["accepted"]
    assert "the poses stay as they are" in printed["reason"]
    assert not (tmp_path / "set" / "alignment" / "geometry.json").exists()


@pytest.mark.deep
def test_wrong_depths_and_poses_by_the_same_views_are_refused(tmp_path: Path, faintfield: Command) -> None:
    folder = tmp_path / "set"
    faintfield("simulate", folder, "--rows", 5, "--columns", 5, "--size-px", 320, 240, "--poses", "nominal", "--snr", 1)
    ended = faintfield("align", folder, "--depth", 600, "--json")
    printed = loads(ended.stdout)
    assert (ended.returncode, printed["accepted"]) == (0, False)
    assert "times what is plausible; the depths may be wrong" in printed["reason"]

    assert loads(faintfield("align", folder, "--depth", 500, "--depth", 700, "--json").stdout)["accepted"]
    ended = faintfield("align", folder, "--geometry", folder / "alignment", "--out", tmp_path / "out")
    assert (ended.returncode, "was found by these views already" in ended.stderr) == (1, True)


def test_few_views_and_depths_that_are_none_are_refused(
    simulated_scene: Path, scene: Path, tmp_path: Path, faintfield: Command
) -> None:
    few = tmp_path / "few"
    shutil.copytree(simulated_scene, few)
    text = (few / "elemental.toml").read_text()
    head, *views = text.split("[[view]]")
    (few / "elemental.toml").write_text("[[view]]".join([head, *views[:6]]))
    ended = faintfield("align", few)
    assert (ended.returncode, "6 views" in ended.stderr, "at least 8" in ended.stderr) == (1, True, True)
    ended = faintfield("align", scene, "--depth", -5)
    assert (ended.returncode, "a plane at -5.0 mm is not in front of the camera" in ended.stderr) == (1, True)
    ended = faintfield("align", scene, "--scene", "bright")
    assert (ended.returncode, "--scene bright names a set of a session" in ended.stderr) == (2, True)
    ended = faintfield("align", scene, "--out", "")
    assert (ended.returncode, "an argument is empty; give it a value" in ended.stderr) == (2, True)
    ended = faintfield("align", scene, "--depth-range", "800:800")
    assert (ended.returncode, "--depth-range 800:800: is no range" in ended.stderr) == (2, True)


def write_geometry_of_boards(out: Path, elemental_set: ElementalSet, poses: NDArray[np.float64]) -> None:
    camera = elemental_set.settings.camera
    nodes = [
        NodeRecord(node, (*pose,), 0.01, 1e-5) for node, pose in zip(elemental_set.nodes, poses.tolist(), strict=True)
    ]
    lens = LensRecord("opencv5", camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px, camera.distortion)
    geometry = CameraPoses(lens=lens, size_px=camera.size_px, reference_node=(2, 2), nodes=nodes)
    out.mkdir(exist_ok=True)
    write_json(out / GEOMETRY_FILE, geometry)


@pytest.mark.deep
def test_shift_of_a_homing_since_the_boards_is_taken_out(tmp_path: Path, done: Command) -> None:
    grid = ("--rows", 5, "--columns", 5, "--size-px", 320, 240)
    done("simulate", tmp_path / "set", *grid, "--snr", 4, "--seed", 4)
    elemental_set = load_set(tmp_path / "set")
    poses, later = (
        elemental_set.poses_rt_cam_ref,
        np.array([node is not None and node[0] > 2 for node in elemental_set.nodes]),
    )
    views = [
        msgspec.structs.replace(view, homing=int(homing))
        for view, homing in zip(elemental_set.settings.view, later, strict=True)
    ]
    settings = msgspec.structs.replace(elemental_set.settings, view=views)
    (tmp_path / "set" / "elemental.toml").write_bytes(tomli_w.dumps(msgspec.to_builtins(settings)).encode())
    measured = poses.copy()
    measured[later, 3] += 0.6
    write_geometry_of_boards(tmp_path / "boards", elemental_set, measured)
    lens = len(elemental_set.lens.parameters)
    covariance = np.zeros((lens + 150,) * 2)
    covariance[lens:, lens:] = np.diag(np.tile(np.repeat([1e-5, 0.003], 3) ** 2, 25))
    nodes, intrinsics = np.array(elemental_set.nodes), elemental_set.lens.parameters
    np.savez(tmp_path / "boards" / COVARIANCE_FILE, covariance=covariance, nodes=nodes, intrinsics=intrinsics)

    planes = ("--depth", 500, "--depth", 700)
    done("align", tmp_path / "set", "--geometry", tmp_path / "boards", *planes, "--out", tmp_path / "out")
    assert read_geometry(tmp_path / "out", AlignmentRecord).gain.by_gradient
    aligned = with_measured_geometry(elemental_set, tmp_path / "out").poses_rt_cam_ref
    right_mm = (aligned - poses)[:, 3]
    assert right_mm[later].mean() == pytest.approx(right_mm[~later].mean(), abs=0.15)


@pytest.mark.deep
def test_lens_is_found_beside_the_poses(scene: Path, tmp_path: Path, done: Command) -> None:
    wrong = tmp_path / "wrong"
    shutil.copytree(scene, wrong)
    settings = load_set(scene).settings
    first, *rest = settings.camera.distortion
    camera = msgspec.structs.replace(settings.camera, distortion=(first + 0.15, *rest))
    changed = msgspec.structs.replace(settings, camera=camera)
    (wrong / "elemental.toml").write_bytes(tomli_w.dumps(msgspec.to_builtins(changed)).encode())
    done("align", wrong, "--with-lens")
    record = read_geometry(wrong / "alignment", AlignmentRecord)
    assert record.lens_change
    assert record.lens.distortion[0] == pytest.approx(first, abs=3 * record.lens_change.distortion_sigma)
    assert record.lens_change.distortion_sigma < 0.06
    # Depths are free, so that a longer focal length would only make them larger
    assert abs(record.lens_change.focal_length) < 3e-3
    assert load_set(wrong).settings.camera.distortion == record.lens.distortion


def test_damaged_covariance_of_boards_is_refused(scene: Path, tmp_path: Path, faintfield: Command) -> None:
    elemental_set = load_set(scene)
    write_geometry_of_boards(tmp_path, elemental_set, elemental_set.poses_rt_cam_ref)
    np.savez(tmp_path / COVARIANCE_FILE, covariance=np.zeros((6, 6)), nodes=np.zeros((1, 2)), intrinsics=np.zeros(4))
    ended = faintfield("align", scene, "--geometry", tmp_path, "--depth", 700, "--out", tmp_path / "out")
    assert ended.returncode == 1
    assert f"{COVARIANCE_FILE}: cannot be read (covariance has shape (6, 6)" in ended.stderr

    size = len(elemental_set.lens.parameters) + 150
    np.savez(tmp_path / COVARIANCE_FILE, covariance=-np.eye(size))
    ended = faintfield("align", scene, "--geometry", tmp_path, "--depth", 700, "--out", tmp_path / "out")
    assert (ended.returncode, "a covariance that is not positive" in ended.stderr) == (1, True)

    geometry = loads((tmp_path / GEOMETRY_FILE).read_text())
    write_json(tmp_path / GEOMETRY_FILE, geometry | {"sha256": {COVARIANCE_FILE: "0" * 64}})
    ended = faintfield("align", scene, "--geometry", tmp_path, "--depth", 700, "--out", tmp_path / "out")
    assert (ended.returncode, f"{COVARIANCE_FILE}: was altered; run" in ended.stderr) == (1, True)

    ended = faintfield("align", scene, "--out", tmp_path)
    assert (ended.returncode, "that was not found by the views; name another --out" in ended.stderr) == (1, True)
    assert (tmp_path / GEOMETRY_FILE).exists()
