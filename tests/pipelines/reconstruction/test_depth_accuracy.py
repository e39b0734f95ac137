"""Depth maps and surfaces of a set that brings its true depth: errors by hand, and written wherever there is a map."""

import json
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.image_files import ONE_PIXEL, write_plane
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import TRUE_DEPTH_FILE, TrueDepth, read_true_depth_mm
from faintfield.pipelines.reconstruction.depth_accuracy import write_depth_errors
from faintfield.recon.surface import confidence
from tests.pipelines.conftest import Command, SetMaker
from tests.pipelines.surfaces import FOUND_CONFIDENCE, FOUND_MM, Searches

pytestmark = pytest.mark.usefixtures("undrawn")


SHAPE = (12, 16)


def bring_truth(folder: Path, depth_mm: NDArray[np.floating]) -> None:
    write_plane(folder / "true_depth_mm.tiff", depth_mm, ONE_PIXEL)
    write_json(folder / TRUE_DEPTH_FILE, TrueDepth(1, "true_depth_mm.tiff", "truth.pfm", "0" * 64))


@pytest.fixture
def a_set(make_set: SetMaker, grey_images: list[NDArray[np.uint16]]) -> Path:
    folder = make_set(grey_images)
    true_mm = 1000.0 + 10.0 * np.indices(SHAPE)[0]
    true_mm[0] = np.nan  # nobody knows the first row
    bring_truth(folder, true_mm)
    return folder


def test_errors_are_those_of_what_is_known(a_set: Path, tmp_path: Path) -> None:
    found = 1000.0 + 10.0 * np.indices(SHAPE)[0]
    found[:, :2] *= 1.5  # an eighth of the known ones, once the columns from 8 on are not known
    found[:, 2:] *= 0.99
    found[:, 8:] = np.nan
    write_plane(tmp_path / "depth_mm.tiff", found, ONE_PIXEL)
    errors = write_depth_errors(load_set(a_set), tmp_path, "depth_mm.tiff", "mm")
    assert errors is not None
    assert errors.samples == 11 * 8
    assert errors.share == 0.5
    assert errors.median_relative_error == pytest.approx(0.01, rel=1e-4)
    # Rows 1 to 11 have 6 samples each at 1 % and 2 at 50 %: the median of 88 lies 44th to 45th of the 66 at 1 %
    assert errors.median_error_mm == pytest.approx(
        np.median(np.repeat(10.0 + 0.1 * np.arange(1, 12), 6)[43:45]), rel=1e-3
    )
    assert errors.within_2_percent == 0.75
    written = json.loads((tmp_path / "depth_errors.json").read_text())
    assert written["samples"] == 88


def test_disparities_are_compared_as_depths(a_set: Path, tmp_path: Path) -> None:
    """Nodes are 10 mm apart and the focal length is 50 px: a point at z mm moves by -500/z px from node to node."""
    write_plane(tmp_path / "disparity_px.tiff", -500.0 / (1.02 * (1000.0 + 10.0 * np.indices(SHAPE)[0])), ONE_PIXEL)
    errors = write_depth_errors(load_set(a_set), tmp_path, "disparity_px.tiff", "px")
    assert errors is not None
    assert errors.median_relative_error == pytest.approx(0.02, rel=1e-4)


@pytest.mark.parametrize("shape", [SHAPE, (6, 8)], ids=["nothing known", "another size"])
def test_what_cannot_be_compared_leaves_no_file(shape: tuple[int, int], a_set: Path, tmp_path: Path) -> None:
    (tmp_path / "depth_errors.json").write_text("of an earlier map")
    write_plane(tmp_path / "depth_mm.tiff", np.full(shape, np.nan), ONE_PIXEL)
    assert write_depth_errors(load_set(a_set), tmp_path, "depth_mm.tiff", "mm") is None
    assert not (tmp_path / "depth_errors.json").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"{", "is not the true depth of a set"),
        (b'{"format":1,"depth_mm":"../x.tiff","source":"","sha256":""}', "leaves the folder"),
        (b'{"format":1,"depth_mm":"a.tiff","source":"","sha256":"","more":1}', "import the set again"),
    ],
)
def test_damaged_truth_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / TRUE_DEPTH_FILE).write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_true_depth_mm(tmp_path)


@pytest.mark.parametrize(
    "options",
    [
        ("--sweep-mm", "400:900:5", "--method", "backprojection", "--depth-map"),
        ("--surface", "--depth-range-mm", "400:900", "--penalty-weight", 0.5, "--passes", 2),
    ],
    ids=["depth map", "surface"],
)
def test_reconstruction_with_depth_writes_its_errors(
    options: tuple[object, ...],
    scene: Path,
    tmp_path: Path,
    done: Command,
    seen: Searches,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    out = tmp_path / "out"
    bring_truth(scene, np.full((72, 96), FOUND_MM * 1.25))
    monkeypatch.setattr(confidence, "SURE", 0.9 * FOUND_CONFIDENCE)
    message = done("reconstruct", scene, "--out", out, *options).stderr
    assert seen
    written = json.loads((out / "depth_errors.json").read_text())
    assert written["median_relative_error"] == pytest.approx(0.2, rel=1e-4)
    assert "median error 150 mm (20.00%)" in message
