"""Outputs of commands: replaced only by their own kind, only if asked, and never where inputs lie."""

import shutil
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from tests.calib.noise.darkroom import specimen
from tests.pipelines.conftest import Command, SetMaker, assert_refused
from tests.pipelines.forms import files_in
from tests.pipelines.noise_sets import take_set, write_frames


@pytest.fixture
def sources(
    make_set: SetMaker, grey_images: list[NDArray[np.uint16]], sweep: Path, tmp_path: Path, done: Command
) -> dict[str, Path]:
    """A set with a model and a set inside, a copy of it, frames of a camera, and pictures; all look like outputs."""
    folder, emva, pictures = make_set(grey_images), tmp_path / "emva", tmp_path / "pictures"
    done("export", "colmap", folder, folder / "model")
    copy = Path(shutil.copytree(folder, tmp_path / "copy"))
    shutil.copytree(copy, folder / "inner")
    frames = write_frames(tmp_path / "frames", take_set(*specimen(1, shape=(24, 32)), (1.0, 10.0), 2, (1000.0,)))
    done("export", "emva1288", frames, emva)
    (frames / "descriptor.txt").touch()
    pictures.mkdir()
    (pictures / "elemental.toml").touch()
    for column in range(2):
        cv2.imwrite(str(pictures / f"view_r0_c{column}.png"), np.full((6, 8), column, np.uint8))
    return {"set": folder, "copy": copy, "frames": frames, "emva": emva, "pictures": pictures, "sweep": sweep}


@pytest.mark.parametrize(
    ("words", "merged"),
    [
        ("export colmap {set} {out}", True),
        ("export mrcal {set} {out}", True),
        ("export zarr {sweep} {out}", True),
        ("export emva1288 {frames} {out}", False),
        ("import emva1288 {emva}/descriptor.txt {out}", False),
        ("import grid {pictures} {out}", False),
        ("simulate {out} --size-px 32 24 --rows 1 --columns 2", False),
    ],
)
def test_only_earlier_outputs_are_replaced(
    words: str, merged: bool, sources: dict[str, Path], tmp_path: Path, done: Command, faintfield: Command
) -> None:
    if "zarr" in words:
        pytest.importorskip("zarr")
    out, theirs = tmp_path / "out", tmp_path / "theirs"
    call, onto_theirs = ([word.format(out=folder, **sources) for word in words.split()] for folder in (out, theirs))
    done(*call)
    before = files_in(out)
    assert_refused(faintfield(*call), "OutputExists", "; give --overwrite to replace it, or ")
    (out / "notes.txt").touch()
    if merged:
        assert_refused(faintfield(*call, "--overwrite"), "OutputExists", "(notes.txt)")
        assert files_in(out) == before | {"notes.txt": b""}
        (out / "notes.txt").unlink()
    done(*call, "--overwrite")
    assert files_in(out) == before
    theirs.mkdir()
    name = "zarr.json" if "zarr" in words else "thesis.tex"  # arrays of other programs have a zarr.json, too
    (theirs / name).write_text('{"zarr_format": 3, "node_type": "group", "attributes": {}}')
    for options in ((), ("--overwrite",)):
        assert_refused(faintfield(*onto_theirs, *options), "OutputExists")
        assert list(files_in(theirs)) == [name]
    if "colmap" in words:
        done(*call, "--binary", "--overwrite")
        assert sorted(files_in(out)) == ["cameras.bin", "images.bin", "points3D.bin"]


@pytest.mark.parametrize(
    "words",
    [
        *(f"export {form} absent {{out}}" for form in ("colmap", "mrcal", "nerfstudio", "zarr", "emva1288")),
        *(f"import {form} absent {{out}}" for form in ("grid", "colmap", "mrcal", "nerfstudio", "emva1288")),
        "import poses absent {out} --fx-px 600",
        *("simulate {out}", "darken absent {out}", "demo {out}", "figures {out}"),
    ],
)
def test_output_is_checked_before_anything_else(words: str, tmp_path: Path, faintfield: Command) -> None:
    if "zarr" in words:
        pytest.importorskip("zarr")
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "thesis.tex").touch()
    ended = faintfield(*words.format(out=tmp_path / "out").split())
    assert_refused(ended, "OutputExists", "holds files already (thesis.tex)")


def test_results_folder_is_checked_before_depths_are_searched(
    simulated_scene: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    monkeypatch.setattr("faintfield.pipelines.reconstruction.request.best_focus", pytest.fail)
    monkeypatch.setattr("faintfield.pipelines.reconstruction.request.found_range_mm", pytest.fail)
    (tmp_path / "file").touch()
    ended = faintfield("reconstruct", simulated_scene, "--depth", "auto", "--out", tmp_path / "file")
    assert_refused(ended, "OutputExists", "file: is a file, and a folder")
    ended = faintfield("reconstruct", simulated_scene, "--depth", "auto", "--out", simulated_scene)
    assert_refused(ended, "OutputExists", "results would lie among")
    (tmp_path / "surface.json").touch()
    words = ("--sweep", "auto", "--depth-map", "--out", tmp_path)
    assert_refused(faintfield("reconstruct", simulated_scene, *words), "OutputExists", "holds a surface")


@pytest.mark.parametrize("words", ["simulate {out}", "darken {bright} {out}", "export zarr {planes} {out}"])
def test_room_for_all_that_is_written_is_needed(
    words: str,
    simulated_scene: Path,
    sweep: Path,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    faintfield: Command,
) -> None:
    places = {"bright": simulated_scene / "noise_free", "planes": sweep, "out": tmp_path / "out"}
    monkeypatch.setattr("faintfield.pipelines.formats.files._free_bytes", lambda _: 50_000)
    ended = faintfield(*(word.format(**places) for word in words.split()))
    assert_refused(ended, "DiskFull", "MB are needed", "0.1 MB are free")
    assert not (tmp_path / "out").exists()


@pytest.mark.parametrize(
    "words",
    [
        "export emva1288 {frames} {frames}",
        "import grid {pictures} {pictures}",
        "import colmap {set}/model {set} --images {copy}",
        "import colmap {copy}/model {set} --images {set}",
        "darken {set} {set}",
        "darken {set}/inner {set}",
    ],
)
def test_inputs_are_never_replaced(words: str, sources: dict[str, Path], tmp_path: Path, faintfield: Command) -> None:
    before = files_in(tmp_path)
    ended = faintfield(*(word.format(**sources) for word in words.split()), "--overwrite")
    assert_refused(ended, "OutputExists", "which is read")
    assert files_in(tmp_path) == before
