"""`import grid`: pictures on a regular grid become a set with nodes, nominal poses and disparities."""

import json
from collections.abc import Iterable
from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from tests.pipelines.conftest import Command, assert_refused


def _picture(value: int = 0, shape: tuple[int, ...] = (6, 8)) -> NDArray[np.uint16]:
    return np.full(shape, value, np.uint16)


def _pictures(folder: Path, names: Iterable[str]) -> Path:
    """Write pictures that hold the number of their place among the names."""
    folder.mkdir()
    for index, name in enumerate(names):
        if name.endswith(".tiff"):
            tifffile.imwrite(folder / name, _picture(index))
        else:
            assert cv2.imwrite(str(folder / name), _picture(index).astype(np.uint8))
    return folder


def _grid_names(rows: Iterable[int], columns: Iterable[int]) -> list[str]:
    return [f"view_r{row}_c{column}.tiff" for row in rows for column in columns]


def test_nodes_are_last_two_numbers_of_names(tmp_path: Path, done: Command) -> None:
    src = _pictures(tmp_path / "src", _grid_names((8, 10), (9, 12, 15)))
    result = json.loads(done("--json", "import", "grid", src, tmp_path / "out", "--pitch-mm", 50, "--linear").stdout)
    assert (result["rows"], result["columns"], result["size_px"]) == (2, 3, [8, 6])
    elemental_set = load_set(tmp_path / "out")
    assert [view.node for view in elemental_set.settings.view] == list(np.ndindex(2, 3))
    assert [int(read_frame(path).pixels_dn[0, 0]) for path in elemental_set.image_paths] == list(range(6))
    assert elemental_set.settings.view[elemental_set.reference_view].node == (1, 1)
    # A camera to the right of the reference moves points to the left
    expected = [(50.0 * (1 - column), 50.0 * (1 - row)) for row in range(2) for column in range(3)]
    np.testing.assert_array_equal(elemental_set.poses_rt_cam_ref[:, 3:5], expected)


@pytest.mark.parametrize(
    ("names", "options", "failure", "words"),
    [
        ([], (), "MissingFile", "holds nothing; convert pictures to PNG or TIFF"),
        (["r0_c0.tiff", "r1_c1.tiff"], (), "MissingFile", "the view in row 0 and column 1, counted from 0, is missing"),
        (["a1_1.tiff", "b1_1.tiff"], (), "BadValue", "is at node (1, 1) like a1_1.tiff"),
        (["a.tiff", "b.tiff"], ("--rows", 3), "MissingFile", "fewer than a grid of 3 x 1 has, and their names do not"),
        (["1.tiff", "2.tiff"], ("--rows", 3), "MissingFile", "their names do not tell which one is missing; add it"),
        (["1.tiff", "2.tiff", "3.tiff"], ("--rows", 2), "BadValue", "holds 3 pictures, 1 too many for a grid of 2 x 1"),
        (["1.tiff", "2.tiff", "all.tiff"], ("--rows", 2), "BadValue", "grid of 2 x 1: all.tiff, unlike the others by"),
        (["a.tiff"], ("--dark-current-e-per-s", 2), "BadValue", "states no exposure, without which 2 dark electrons"),
    ],
)
def test_incomplete_grids_and_options_are_refused(
    names: list[str], options: tuple[object, ...], failure: str, words: str, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("import", "grid", _pictures(tmp_path / "src", names), tmp_path / "out", *options)
    assert_refused(ended, failure, words)
    assert [path.name for path in tmp_path.iterdir()] == ["src"]


@pytest.mark.parametrize(
    "names",
    [_grid_names(range(2), range(3)), [f"IMG_{number}.tiff" for number in (98, 99, 100, 101, 102, 103)]],
)
def test_missing_pictures_are_named_and_done_without(names: list[str], tmp_path: Path, done: Command) -> None:
    src = _pictures(tmp_path / "src", names)
    (src / names[4]).unlink()
    words = done("import", "grid", src, tmp_path / "out", "--rows", 2, "--columns", 3, "--linear").stderr
    assert "1 of 6 pictures is missing, counted from 0: row 1, column 1; the set is made without it" in words
    elemental_set = load_set(tmp_path / "out")
    nodes = [view.node for view in elemental_set.settings.view]
    assert nodes == [(0, 0), (0, 1), (0, 2), (1, 0), (1, 2)]
    assert [int(read_frame(path).pixels_dn[0, 0]) for path in elemental_set.image_paths] == [0, 1, 2, 3, 5]


def test_lens_is_that_of_options(tmp_path: Path, done: Command, faintfield: Command) -> None:
    src, lens = _pictures(tmp_path / "src", _grid_names(range(2), range(3))), ("--distortion", -0.1, "--cx-px", 3)
    done("import", "grid", src, tmp_path / "out", "--pitch-mm", 50, "--fx-px", 9, "--linear", *lens)
    camera = load_set(tmp_path / "out").settings.camera
    assert (camera.fx_px, camera.fy_px, camera.cx_px, camera.cy_px) == (9, 9, 3, 2.5)
    assert camera.distortion == (-0.1,)
    for wrong, words in (
        (("--fx-px", 9), "give --pitch-mm, too"),
        (("--fx-px", 9, "--pitch-mm", 50, "--disparity-px", 2), "not of aligned ones; leave one out"),
        (("--fx-px", 9, "--pitch-mm", 50, "--distortion", "nan"), "the lens of the options cannot be"),
        (("--keep-order", "--flip-rows"), "--keep-order contradicts --flip-rows; leave one out"),
    ):
        ended = faintfield("import", "grid", src, tmp_path / "no", *wrong, *lens)
        assert (ended.returncode, words in ended.stderr) == (2, True)
    # The second folds the picture inside, not at its corners
    for folding in (("--distortion", -5), ("--distortion", -2.1, "--distortion", 1)):
        ended = faintfield("import", "grid", src, tmp_path / "no", "--pitch-mm", 50, "--fx-px", 9, *folding)
        assert_refused(ended, "LensNotInvertible", "correct signs and order (k1, k2, p1, p2, k3 …)")


def test_full_disk_is_found_before_pictures_are_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    monkeypatch.setattr("faintfield.pipelines.formats.exchange.picture_grid.arrange_grid", pytest.fail)
    monkeypatch.setattr("faintfield.pipelines.formats.files._free_bytes", lambda _: 6 * 96 - 1)
    src = _pictures(tmp_path / "src", _grid_names(range(2), range(3)))
    assert_refused(faintfield("import", "grid", src, tmp_path / "out"), "DiskFull", "MB are needed")


def test_unlike_pictures_are_refused(tmp_path: Path, faintfield: Command) -> None:
    src = _pictures(tmp_path / "src", _grid_names([0], [0, 1]))
    for second, failure, words in (
        (_picture(shape=(8, 6)), "WrongSize", "is 6 x 8 px, the first picture 8 x 6 px"),
        (_picture(shape=(6, 8, 3)), "WrongSize", "is (6, 8, 3), the first picture (6, 8)"),
        (_picture().astype(np.uint8), "WrongBitDepth", "has 8 bits per pixel, the first picture 16"),
    ):
        tifffile.imwrite(src / "view_r0_c1.tiff", second, photometric="rgb" if second.ndim == 3 else "minisblack")
        ended = faintfield("import", "grid", src, tmp_path / "out")
        assert_refused(ended, failure, f"{src / 'view_r0_c1.tiff'}: {words}")
        assert [path.name for path in tmp_path.iterdir()] == ["src"]


def test_stated_turn_moves_pictures(tmp_path: Path, done: Command) -> None:
    src = _pictures(tmp_path / "src", _grid_names(range(2), range(3)))
    done("import", "grid", src, tmp_path / "out", "--linear", "--transpose", "--flip-columns")
    elemental_set = load_set(tmp_path / "out")
    assert [view.node for view in elemental_set.settings.view] == list(np.ndindex(3, 2))
    assert [int(read_frame(path).pixels_dn[0, 0]) for path in elemental_set.image_paths] == [3, 0, 4, 1, 5, 2]


def test_noise_and_exposure_are_those_of_options(tmp_path: Path, done: Command) -> None:
    values = (0.25, 64.0, 3.0, 4.0, 0.5, 0.6)
    names = ("exposure-s", "offset-dn", "gain-dn-per-e", "read-noise-e", "dark-current-e-per-s", "quantum-efficiency")
    options = [word for name, value in zip(names, values, strict=True) for word in (f"--{name}", value)]
    ended = done("import", "grid", _pictures(tmp_path / "src", ["a.tiff"]), tmp_path / "out", *options)
    elemental_set = load_set(tmp_path / "out")
    noise = elemental_set.noise
    levels = (noise.offset_dn, noise.gain_dn_per_e, noise.read_noise_e)
    rates = (noise.dark_current_e_per_s, noise.quantum_efficiency)
    assert (elemental_set.settings.exposure_s, *levels, *rates) == values
    assert elemental_set.settings.units.light == "electrons"
    assert "estimated" not in (tmp_path / "out" / "elemental.toml").read_text()
    assert "assumed" not in ended.stderr
    assert json.loads((tmp_path / "out" / "provenance.json").read_text())["noise"] == {"how": "stated"}


def test_point_is_sharp_at_its_disparity(tmp_path: Path, done: Command) -> None:
    (tmp_path / "src").mkdir()
    for row, column in np.ndindex(3, 3):
        picture = _picture(0, (30, 40))
        picture[15 - 3 * (row - 1), 20 - 3 * (column - 1)] = 9000
        tifffile.imwrite(tmp_path / "src" / f"view_r{row}_c{column}.tiff", picture)
    done("import", "grid", tmp_path / "src", tmp_path / "set", "--disparity-px", 4)
    planes = []
    for disparity_px in (-3, 1):
        out = tmp_path / f"planes{disparity_px}"
        words = ("--out", out, f"--disparity-px={disparity_px}", "--method", "backprojection")
        done("reconstruct", tmp_path / "set", *words)
        planes.append(read_frame(next(out.glob("plane_*.tiff"))).pixels_dn)
    sharp, blurred = planes
    # All nine views agree on its place; at the other disparity each says another place
    assert sharp.shape == (30, 40)
    assert np.argwhere(sharp == sharp.max()).tolist() == [[15, 20]]
    assert sharp.max() == pytest.approx(9000.0, rel=1e-3)
    assert blurred.max() < 0.2 * 9000


def test_raw_file_is_kept_with_its_black_level(real_data: Path, tmp_path: Path, done: Command) -> None:
    src, imported = tmp_path / "src", tmp_path / "set"
    src.mkdir()
    (src / "colorchart.dng").symlink_to(real_data / "raw" / "colorchart.dng")
    done("import", "grid", src, imported, "--read-noise-e", 3)
    assert (imported / "colorchart.dng").read_bytes() == (src / "colorchart.dng").read_bytes()
    elemental_set = load_set(imported)
    assert elemental_set.settings.camera.mosaic is None
    assert elemental_set.settings.camera.size_px == (1734, 1156)
    assert "offset_dn" not in (imported / "elemental.toml").read_text()
    frame = read_frame(imported / "colorchart.dng")
    assert frame.black_dn is not None
    layouts = channel_layouts(elemental_set)
    assert [layout.name for layout in layouts] == ["red", "green", "blue"]
    for layout in layouts:
        images = load_channel(elemental_set, layout)
        for index, lattice in enumerate(layout.lattices):
            row, column = lattice.first
            expected = frame.pixels_dn[row::2, column::2] - frame.black_dn[row, column]
            np.testing.assert_allclose(images.electrons[index], expected, atol=1e-3)
