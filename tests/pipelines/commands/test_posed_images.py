"""Models of COLMAP and mrcal: what goes out comes back, and views see points where these programs put them."""

import json
import struct
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from scipy.spatial.transform import Rotation

from faintfield.pipelines.commands.exports import export_colmap
from faintfield.pipelines.commands.imports import import_colmap
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.exchange.colmap import read_model, write_model
from faintfield.pipelines.formats.exchange.imported_set import PosedImage, relative
from faintfield.pipelines.formats.exchange.options import ImportOptions
from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.sets.elemental_set import load_set
from tests.pipelines.conftest import Command, Edit, SetMaker, assert_refused

PROGRAMS = ["colmap", "mrcal"]
IMAGE = np.arange(192, dtype=np.uint16).reshape(12, 16)

CAMERAS = "1 PINHOLE 16 12 20 20 8 6\n"
IMAGES = "1 1 0 0 0 0 0 0 1 a.tiff\n\n"
CAMERA_MODEL = """{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [20, 20, 8, 6], 'imagersize': [16, 12],
'rt_cam_ref': [0, 0, 0, 0, 0, 0]}"""


def write_models(folder: Path) -> Path:
    """Write one image with a model of either program."""
    folder.mkdir()
    tifffile.imwrite(folder / "a.tiff", IMAGE)
    (folder / "cameras.txt").write_text(CAMERAS)
    (folder / "images.txt").write_text(IMAGES)
    (folder / "a.cameramodel").write_text(CAMERA_MODEL)
    return folder


@pytest.mark.parametrize("program", PROGRAMS)
def test_exported_principal_points_come_back(program: str, tmp_path: Path, done: Command) -> None:
    (tmp_path / "src").mkdir()
    for row, column in np.ndindex(2, 3):
        tifffile.imwrite(tmp_path / "src" / f"view_r{row}_c{column}.tiff", IMAGE + np.uint16(3 * row + column))
    options = ("--pitch-mm", 10, "--fx-px", 20, "--disparity-px", 2.3)
    done("import", "grid", tmp_path / "src", tmp_path / "set", *options)
    done("export", program, tmp_path / "set", tmp_path / "model")
    words = ("--images", tmp_path / "set", "--reference", "view_r1_c1.tiff")
    done("import", program, tmp_path / "model", tmp_path / "back", *words)
    first, back = load_set(tmp_path / "set"), load_set(tmp_path / "back")
    assert len(np.unique(first.principal_points_px, axis=0)) == 6
    np.testing.assert_allclose(back.principal_points_px, first.principal_points_px, atol=1e-9)
    np.testing.assert_allclose(back.poses_rt_cam_ref, first.poses_rt_cam_ref, atol=1e-6)
    assert [view.node for view in back.settings.view] == [view.node for view in first.settings.view]


@pytest.mark.parametrize(
    ("program", "depth", "models"),
    [("colmap", "relative", ("cameras.txt", "images.txt")), ("mrcal", "mm", ("a.cameramodel",))],
)
def test_import_states_no_unknown_units_and_all_inputs(
    program: str, depth: str, models: tuple[str, ...], tmp_path: Path, done: Command
) -> None:
    src, folder = write_models(tmp_path / "src"), tmp_path / "set"
    done("import", program, src, folder)
    settings = load_set(folder).settings
    assert (settings.units.depth, settings.units.light, settings.exposure_s) == (depth, "dn", None)
    inputs = json.loads((folder / "provenance.json").read_text())["inputs"]
    assert inputs == {name: sha256(src / name) for name in (*models, "a.tiff")}


@pytest.mark.parametrize(("depth", "units"), [("mm", ["mm", "m"]), ("relative", ["relative"] * 2)])
def test_export_states_unit_of_its_lengths(
    depth: str, units: list[str], make_set: SetMaker, edit: Edit, tmp_path: Path, done: Command, faintfield: Command
) -> None:
    folder = make_set([IMAGE, IMAGE])
    edit(folder, lambda settings: settings.update(units={"depth": depth}))
    for program, unit in zip(PROGRAMS, units, strict=True):
        ended = done("--json", "export", program, folder, tmp_path / program)
        assert json.loads(ended.stdout)["unit"] == unit
        assert ("has no scale" in ended.stderr) == (depth == "relative")
        assert f"{tmp_path / program}: 2 views" in ended.stderr
    ended = faintfield("export", "nerfstudio", folder, tmp_path / "transforms.json")
    assert ended.returncode == 2
    assert "transforms.json: is the name of a file" in ended.stderr
    assert not (tmp_path / "transforms.json").exists()
    for name, side in (("view_0.tiff", "a"), ("view_1.tiff", "b")):
        (folder / side).mkdir()
        (folder / name).rename(folder / side / "x.tiff")
    edit(folder, lambda settings: [view.update(image=f"{'ab'[i]}/x.tiff") for i, view in enumerate(settings["view"])])
    ended = faintfield("export", "mrcal", folder, tmp_path / "cameras")
    assert_refused(ended, "BadValue", "b/x.tiff would become x.cameramodel like another view")


FISHEYE = CAMERAS.replace("PINHOLE", "OPENCV_FISHEYE")


@pytest.mark.parametrize(
    ("program", "file", "content", "words"),
    [
        ("colmap", "images.txt", IMAGES.replace("1 a.tiff", "2 a.tiff"), "a.tiff was taken with camera 2, and cameras"),
        ("colmap", "images.txt", IMAGES.replace("1 a.tiff", "1 f.tiff"), "f.tiff: holds float32 pixels"),
        ("colmap", "cameras.txt", FISHEYE, "OPENCV_FISHEYE has no counterpart here"),
        ("mrcal", "a.cameramodel", CAMERA_MODEL.replace("[20, 20", "[-20, 20"), "a.cameramodel: focal lengths must be"),
        ("mrcal", "b.cameramodel", CAMERA_MODEL.replace("20,", "21,"), "have 2 lenses"),
    ],
)
def test_impossible_models_and_images_are_refused(
    program: str, file: str, content: str, words: str, tmp_path: Path, faintfield: Command
) -> None:
    src = write_models(tmp_path / "src")
    tifffile.imwrite(src / "b.tiff", IMAGE)
    tifffile.imwrite(src / "f.tiff", IMAGE.astype(np.float32))
    (src / file).write_text(content)
    assert_refused(faintfield("import", program, src, tmp_path / "set"), "BadValue", words)
    assert not (tmp_path / "set").exists()


STORED = Path(__file__).parents[1] / "colmap"


@pytest.mark.parametrize("kind", ["text", "binary"])
def test_stored_models_see_as_colmap_does(kind: str) -> None:
    """COLMAP's library sees the points of its model half a pixel apart from us."""
    truth, images = json.loads((STORED / "seen.json").read_text()), read_model(STORED / kind, Path())
    assert [str(image.path) for image in images] == list(truth["seen"])
    for image in images:
        turn, shift = Rotation.from_rotvec(image.rt_cam_world[:3]), image.rt_cam_world[3:]
        pixels = image.lens.project(turn.apply(truth["points"]) + shift)
        np.testing.assert_allclose(pixels + 0.5, truth["seen"][str(image.path)], atol=1e-9, err_msg=str(image.path))


def test_model_becomes_an_elemental_set(tmp_path: Path) -> None:
    """One camera of the stored model, its images in a folder below, its unit a metre."""
    chosen = [image for image in read_model(STORED / "text", Path()) if image.path.stem[-1] in "45"]
    lone = [replace(image, lens=chosen[0].lens) for image in chosen]
    (tmp_path / "model").mkdir()
    write_model(tmp_path / "model", lone, binary=True)
    for image in chosen:
        (tmp_path / image.path).parent.mkdir(exist_ok=True)
        cv2.imwrite(str(tmp_path / image.path), np.zeros((480, 640), np.uint16))
    options = ImportOptions(images=tmp_path, mm_per_unit=1000, reference="radial r4.png", exposure_s=1)
    import_colmap(tmp_path / "model", tmp_path / "set", options=options)
    elemental_set = load_set(tmp_path / "set")
    assert (elemental_set.lens.fx_px, elemental_set.lens.cx_px, elemental_set.lens.cy_px) == (800.0, 322.0, 237.75)
    expected = relative(*(image.rt_cam_world * [1, 1, 1, 1000, 1000, 1000] for image in reversed(chosen)))
    np.testing.assert_allclose(elemental_set.poses_rt_cam_ref, [np.zeros(6), expected], atol=1e-9)
    assert elemental_set.settings.units.depth == "mm"
    export_colmap(tmp_path / "set", tmp_path / "back", binary=True)
    back = read_model(tmp_path / "back")
    np.testing.assert_allclose([image.rt_cam_world for image in back], [np.zeros(6), expected], atol=1e-9)


def test_impossible_models_are_refused(tmp_path: Path) -> None:
    """Names with spaces in a text model, and a file that states more points than it can hold."""
    with pytest.raises(BadValue, match="has a space, where COLMAP ends a name in a text model; use --binary"):
        write_model(tmp_path, read_model(STORED / "binary"), binary=False)
    assert not list(tmp_path.iterdir())
    write_model(tmp_path, read_model(STORED / "binary"), binary=True)
    path = tmp_path / "images.bin"
    path.write_bytes(path.read_bytes()[:-8] + struct.pack("<Q", 2**62))
    with pytest.raises(BadValue, match="is not a COLMAP model that can be read"):
        read_model(tmp_path)


def test_equal_names_of_images_are_refused(tmp_path: Path) -> None:
    """They would be copied over one another."""
    lens = read_model(STORED / "text")[0].lens
    images = [PosedImage(Path(side, "0.png"), lens, np.zeros(6)) for side in ("left", "right")]
    (tmp_path / "model").mkdir()
    write_model(tmp_path / "model", images, binary=False)
    for image in images:
        (tmp_path / image.path).parent.mkdir()
        cv2.imwrite(str(tmp_path / image.path), np.zeros((480, 640), np.uint16))
    with pytest.raises(BadValue, match=r"right/0\.png: would become 0\.png"):
        import_colmap(tmp_path / "model", tmp_path / "set", options=ImportOptions(images=tmp_path))
