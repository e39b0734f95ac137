"""Models of other programs, COLMAP and mrcal alike: what goes out comes back, and nothing is lost or taken silently."""

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.files import sha256
from faintfield.pipelines.formats.sets.elemental_set import load_set

type Command = Callable[..., CompletedProcess[str]]
type SetMaker = Callable[..., Path]
type Edit = Callable[[Path, Callable[[dict[str, Any]], object]], Path]

PROGRAMS = ["colmap", "mrcal"]
IMAGE = np.arange(192, dtype=np.uint16).reshape(12, 16)

CAMERAS = "1 PINHOLE 16 12 20 20 8 6\n"
IMAGES = "1 1 0 0 0 0 0 0 1 a.tiff\n\n"
CAMERA_MODEL = """{'lensmodel': 'LENSMODEL_PINHOLE', 'intrinsics': [20, 20, 8, 6], 'imagersize': [16, 12],
'rt_cam_ref': [0, 0, 0, 0, 0, 0]}"""


def write_models(folder: Path, image: NDArray[Any] = IMAGE) -> Path:
    """Write one image with a model of either program."""
    folder.mkdir()
    tifffile.imwrite(folder / "a.tiff", image)
    (folder / "cameras.txt").write_text(CAMERAS)
    (folder / "images.txt").write_text(IMAGES)
    (folder / "a.cameramodel").write_text(CAMERA_MODEL)
    return folder


def names_in(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def refused(ended: CompletedProcess[str], failure: str, *words: str) -> None:
    assert ended.returncode == 1, ended.stderr
    assert f"faintfield: {failure}: " in ended.stderr
    assert all(word in ended.stderr for word in words), ended.stderr


@pytest.mark.parametrize("program", PROGRAMS)
def test_principal_points_of_views_go_out_and_come_back(program: str, tmp_path: Path, done: Command) -> None:
    (tmp_path / "src").mkdir()
    for row, column in np.ndindex(2, 3):
        tifffile.imwrite(tmp_path / "src" / f"view_r{row}_c{column}.tiff", IMAGE + np.uint16(3 * row + column))
    options = ("--pitch-mm", 10, "--fx-px", 20, "--disparity-px", 2.3)
    done("import", "grid", tmp_path / "src", tmp_path / "set", *options)
    done("export", program, tmp_path / "set", tmp_path / "model")
    words = ("--images", tmp_path / "set", "--reference", "view_r1_c1.tiff")
    done("import", program, tmp_path / "model", tmp_path / "back", *words)
    given, back = load_set(tmp_path / "set"), load_set(tmp_path / "back")
    assert len(np.unique(given.principal_points_px(), axis=0)) == 6
    np.testing.assert_allclose(back.principal_points_px(), given.principal_points_px(), atol=1e-9)
    np.testing.assert_allclose(back.poses_rt_cam_ref, given.poses_rt_cam_ref, atol=1e-6)
    assert [view.node for view in back.settings.view] == [view.node for view in given.settings.view]


def test_views_in_folders_of_their_own_are_not_one_camera_model(
    make_set: SetMaker, edit: Edit, tmp_path: Path, faintfield: Command
) -> None:
    folder = make_set([IMAGE, IMAGE])
    for name, side in (("view_0.tiff", "a"), ("view_1.tiff", "b")):
        (folder / side).mkdir()
        (folder / name).rename(folder / side / "x.tiff")
    edit(folder, lambda settings: [view.update(image=f"{'ab'[i]}/x.tiff") for i, view in enumerate(settings["view"])])
    ended = faintfield("export", "mrcal", folder, tmp_path / "cameras")
    refused(ended, "BadValue", "b/x.tiff would become x.cameramodel like another view")
    assert not (tmp_path / "cameras").exists()


@pytest.mark.parametrize("program", PROGRAMS)
def test_an_export_replaces_an_earlier_one_and_nothing_else(
    program: str, make_set: SetMaker, tmp_path: Path, done: Command, faintfield: Command
) -> None:
    folder, out = make_set([IMAGE, IMAGE]), tmp_path / "model"
    done("export", program, folder, out)
    refused(faintfield("export", program, folder, out), "OutputExists", "holds files already")
    done("export", program, folder, out, "--overwrite")
    (out / "notes.txt").touch()
    before = names_in(out)
    refused(faintfield("export", program, folder, out, "--overwrite"), "OutputExists", "(notes.txt)")
    assert names_in(out) == before


@pytest.mark.parametrize("program", PROGRAMS)
def test_what_is_read_is_never_replaced(program: str, tmp_path: Path, done: Command, faintfield: Command) -> None:
    src, out = write_models(tmp_path / "src"), tmp_path / "set"
    done("import", program, src, out)
    done("export", program, out, out / "model")
    before = names_in(out)
    for models, images in ((out / "model", src), (src, out)):
        refused(
            faintfield("import", program, models, out, "--images", images, "--overwrite"),
            "OutputExists",
            "which is read",
        )
        assert names_in(out) == before
    done("import", program, src, out, "--overwrite")


@pytest.mark.parametrize("program", PROGRAMS)
def test_models_and_images_are_recorded(program: str, tmp_path: Path, done: Command) -> None:
    src = write_models(tmp_path / "src")
    done("import", program, src, tmp_path / "set")
    inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
    models = {"colmap": ("cameras.txt", "images.txt"), "mrcal": ("a.cameramodel",)}[program]
    assert inputs == {name: sha256(src / name) for name in (*models, "a.tiff")}


@pytest.mark.parametrize(
    ("program", "options", "depth"),
    [
        ("colmap", (), "relative"),
        ("colmap", ("--mm-per-unit", 25.4), "mm"),
        ("mrcal", (), "mm"),  # whose unit is the metre
    ],
)
def test_what_is_imported_states_no_scale_gain_or_exposure_that_nobody_gave(
    program: str, options: tuple[object, ...], depth: str, tmp_path: Path, done: Command
) -> None:
    src = write_models(tmp_path / "src", IMAGE)
    done("import", program, src, tmp_path / "set", *options)
    settings = load_set(tmp_path / "set").settings
    assert (settings.units.depth, settings.units.light, settings.exposure_s) == (depth, "dn", None)


@pytest.mark.parametrize(("depth", "units"), [("mm", ["mm", "m"]), ("relative", ["relative"] * 2)])
def test_an_export_says_the_unit_of_its_lengths(
    depth: str, units: list[str], make_set: SetMaker, edit: Edit, tmp_path: Path, done: Command
) -> None:
    folder = make_set([IMAGE])
    edit(folder, lambda settings: settings.update(units={"depth": depth}))
    for program, unit in zip(PROGRAMS, units, strict=True):
        ended = done("--json", "export", program, folder, tmp_path / program)
        assert json.loads(ended.stdout)["unit"] == unit
        assert ("has no scale" in ended.stderr) == (depth == "relative")


@pytest.mark.parametrize("program", ["colmap"])
@pytest.mark.parametrize(
    ("image", "failure", "words"),
    [
        (IMAGE.astype(np.float32), "BadValue", "a.tiff: holds float32 pixels"),
        (IMAGE[:, :14], "WrongSize", "a.tiff: is 14 x 12 px, its lens 16 x 12 px"),
    ],
)
def test_images_that_are_no_frames_of_the_lens_are_refused(
    program: str, image: NDArray[Any], failure: str, words: str, tmp_path: Path, faintfield: Command
) -> None:
    src = write_models(tmp_path / "src", image)
    refused(faintfield("import", program, src, tmp_path / "set"), failure, words)
    assert names_in(tmp_path) == ["src"]


@pytest.mark.parametrize(
    ("program", "file", "content", "words"),
    [
        ("colmap", "images.txt", IMAGES.replace("1 a.tiff", "2 a.tiff"), "a.tiff was taken with camera 2, and cameras"),
        ("mrcal", "a.cameramodel", CAMERA_MODEL.replace("[20, 20", "[-20, 20"), "a.cameramodel: focal lengths must be"),
        ("mrcal", "b.cameramodel", CAMERA_MODEL.replace("20,", "21,"), "have 2 lenses"),
    ],
)
def test_numbers_that_cannot_be_are_refused(
    program: str, file: str, content: str, words: str, tmp_path: Path, faintfield: Command
) -> None:
    src = write_models(tmp_path / "src")
    tifffile.imwrite(src / "b.tiff", IMAGE)
    (src / file).write_text(content)
    refused(faintfield("import", program, src, tmp_path / "set"), "BadValue", words)
    assert names_in(tmp_path) == ["src"]


def test_a_binary_model_replaces_a_text_model(make_set: SetMaker, tmp_path: Path, done: Command) -> None:
    folder = make_set([IMAGE, IMAGE])
    done("export", "colmap", folder, tmp_path / "model")
    done("export", "colmap", folder, tmp_path / "model", "--binary", "--overwrite")
    assert names_in(tmp_path / "model") == ["cameras.bin", "images.bin", "points3D.bin"]
