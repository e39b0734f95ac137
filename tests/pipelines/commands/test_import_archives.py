"""`import grid` of the files of archives: positions in names, HCI's parameters, stacks, mosaics, floats."""

import json
import tempfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.calib.arrangement.views import Orientation
from faintfield.pipelines.formats.exchange.image_grid import find_grid
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import read_true_depth_mm
from tests.pipelines.conftest import Command, assert_refused

SIZE = (6, 8)
NODES = [(row, column) for row in range(3) for column in range(3)]


def picture(value: float, dtype: str = "u2", shape: tuple[int, ...] = SIZE) -> NDArray[Any]:
    """A picture whose first pixel says which it is, on a gradient that would show a turned one."""
    pixels = np.zeros(shape, dtype)
    pixels.reshape(-1)[:] = np.arange(pixels.size) % 50
    pixels[0, 0] = value
    return pixels


def write(path: Path, pixels: NDArray[Any]) -> None:
    path.parent.mkdir(exist_ok=True)
    assert cv2.imwrite(str(path), pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, ::-1]))


def folder_of(folder: Path, names: Iterable[str], dtype: str = "u1") -> Path:
    for index, name in enumerate(names):
        write(folder / name, picture(100 + index, dtype))
    return folder


def first_pixels(folder: Path) -> list[int]:
    return [int(read_frame(path).pixels_dn[0, 0]) for path in load_set(folder).image_paths]


def test_positions_in_names_place_cameras(tmp_path: Path, done: Command) -> None:
    """An irregular grid: row 0 has the largest y, and columns run against x; the set knows neither, but the nodes."""
    shifts = np.random.default_rng(3).uniform(-4, 4, (9, 2))
    places = {node: (-60.0 * node[1] + dx, -60.0 * node[0] + dy) for node, (dx, dy) in zip(NODES, shifts, strict=True)}
    names = [f"out_{r:02}_{c:02}_{y:.3f}_{x:.3f}_.png" for (r, c), (x, y) in places.items()]
    src = folder_of(tmp_path / "src", names)
    words = done("import", "grid", src, tmp_path / "set", "--pitch-mm", 10, "--fx-px", 20, "--disparity-px", 2).stderr
    assert "names state positions" in words
    elemental_set = load_set(tmp_path / "set")
    assert [view.node for view in elemental_set.settings.view] == NODES
    x_0, y_0 = places[1, 1]
    # 60 by construction; the mean distance differs by the slope of the errors
    scale = np.polyfit([c for _, c in NODES], [places[node][0] for node in NODES], 1)[0] / -10.0
    expected = np.array([((x - x_0) / scale, (y - y_0) / scale) for x, y in places.values()])
    assert 5 < scale < 7
    np.testing.assert_allclose(elemental_set.poses_rt_cam_ref[:, 3:5], expected, atol=2e-3)
    # The plane on which pictures are aligned stays where it is in all of them, also with uneven steps
    assert elemental_set.depth_of_disparity(0.0) == pytest.approx(20 * 10 / 2, rel=1e-3)
    moved = 20 * elemental_set.poses_rt_cam_ref[:, 3:5] / elemental_set.depth_of_disparity(0.0)
    moved += elemental_set.principal_points_px
    np.testing.assert_allclose(moved, moved[[4] * 9], atol=1e-9)


@pytest.mark.parametrize("transpose", [True, False])
def test_turned_grid_takes_positions_along(transpose: bool, tmp_path: Path) -> None:
    places = {(r, c): (60.0 * c + r, 50.0 * r - 0.5 * c * c) for r in range(2) for c in range(3)}
    names = [f"out_{r:02}_{c:02}_{y:.3f}_{x:.3f}_.png" for (r, c), (x, y) in places.items()]
    grid = find_grid(folder_of(tmp_path / "src", names))
    orientation = Orientation(transpose, not transpose, transpose)
    turned = grid.moved(orientation.apply(list(grid.paths)), transposed=transpose)
    assert turned.size == ((3, 2) if transpose else (2, 3))
    nodes = {path.name: node for node, path in grid.paths.items()}
    assert grid.measured is not None
    assert turned.measured is not None
    scales = []
    first = np.array(grid.measured[nodes[turned.paths[0, 0].name]])
    for node, path in turned.paths.items():
        steps = (np.array(grid.measured[nodes[path.name]]) - first)[:: -1 if transpose else 1]
        for before, after, flipped in zip(steps, turned.measured[node], (transpose, not transpose), strict=True):
            if abs(before) > 0.5:
                scales.append(after / before * (-1 if flipped else 1))
    # One unit for all, and each axis runs its way
    np.testing.assert_allclose(scales, scales[0], atol=1e-9)
    assert scales[0] == pytest.approx(60 / 50 if transpose else 1, rel=0.1)


def test_pattern_orders_and_places(tmp_path: Path, done: Command, faintfield: Command) -> None:
    src = folder_of(tmp_path / "src", [f"s3-{c}+{r}.png" for r, c in NODES])
    done("import", "grid", src, tmp_path / "set", "--pattern", "s3-{column}+{row}.png")
    assert [view.node for view in load_set(tmp_path / "set").settings.view] == NODES
    options = json.loads((tmp_path / "set" / "provenance.json").read_text())["options"]
    assert options["pattern"] == "s3-{column}+{row}.png"
    words = ("--pattern", "s3-{column}+{row}.png", "--rows", 9)
    ended = faintfield("import", "grid", src, tmp_path / "other", *words)
    assert_refused(ended, "BadValue", "makes a grid of 3 x 3, --rows")


def test_foreign_files_are_left_out_and_named(tmp_path: Path, done: Command) -> None:
    src = folder_of(tmp_path / "src", [f"v_{r}_{c}.png" for r, c in NODES])
    for name in ("mask_0.png", "depth_1.png", "film.gif", "film2.gif", "notes.txt"):
        (src / name).write_bytes((src / "v_0_0.png").read_bytes())
    words = done("import", "grid", src, tmp_path / "set", "--linear").stderr
    assert "left out: 2 of 11 pictures, by their names no views (depth_1.png)" in words
    assert "left out: 2 .gif files, which are not read" in words
    assert first_pixels(tmp_path / "set") == [100 + index for index in range(9)]


@pytest.mark.parametrize("suffix", [".jfif", ".JPEG_original", "", ".tiff"])
def test_views_are_known_by_content(suffix: str, tmp_path: Path, done: Command) -> None:
    src = folder_of(tmp_path / "src", [f"v_{r}_{c}.jpg" for r, c in NODES])
    written = [path.rename(path.with_suffix(suffix)) for path in sorted(src.iterdir())]
    write(src / "depth.png", picture(7))
    words = done("import", "grid", src, tmp_path / "set", "--linear").stderr
    assert "left out: 1 of 10 pictures, by their names no views (depth.png)" in words
    assert [view.node for view in load_set(tmp_path / "set").settings.view] == NODES
    inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
    assert sorted(inputs) == [path.name for path in written]


def test_views_that_are_not_read_are_refused(tmp_path: Path, faintfield: Command) -> None:
    src = folder_of(tmp_path / "src", ["depth.png"])
    for r, c in NODES:
        (src / f"v_{r}_{c}.webp").write_bytes(b"RIFF\x10\0\0\0WEBPVP8 ")
    ended = faintfield("import", "grid", src, tmp_path / "set")
    words = "holds 9 .webp files, which are not read, and only 1 .png file of those that are (depth.png); convert the"
    assert_refused(ended, "MissingFile", words)
    assert not (tmp_path / "set").exists()


def test_copies_of_another_kind_are_refused(tmp_path: Path, faintfield: Command) -> None:
    src = folder_of(tmp_path / "src", [f"v_{n}_{m}.{kind}" for n in "01" for m in "01" for kind in ("png", "bmp")])
    ended = faintfield("import", "grid", src, tmp_path / "set")
    assert_refused(ended, "BadValue", "several kinds (4 .bmp files, 4 .png files), with v_0_0 in two of them")


class TestKinds:
    """Files of kinds that are read keep their values."""

    def test_white_of_12_bit_pgm_is_saturation(self, tmp_path: Path, done: Command) -> None:
        (tmp_path / "src").mkdir()
        pixels = picture(4095, ">u2")
        (tmp_path / "src" / "a.pgm").write_bytes(b"P5 # of 12 bits\n8 6\n# one more\n4095\n" + pixels.tobytes())
        done("import", "grid", tmp_path / "src", tmp_path / "set", "--linear")
        elemental_set = load_set(tmp_path / "set")
        assert elemental_set.noise.saturation_dn == 4095.0
        np.testing.assert_array_equal(read_frame(elemental_set.image_paths[0]).pixels_dn, pixels)

    def test_floats_become_16_bits_by_recorded_factor(self, tmp_path: Path, done: Command) -> None:
        src, generator = tmp_path / "src", np.random.default_rng(9)
        pictures = {node: generator.uniform(0, 0.1 + node[0], SIZE).astype(np.float32) for node in NODES}
        for (r, c), pixels in pictures.items():
            write(src / f"v_{r}_{c}.pfm", pixels)
        words = done("import", "grid", src, tmp_path / "set", "--linear").stderr
        factor = json.loads((tmp_path / "set" / "provenance.json").read_text())["options"]["dn_per_value"]
        assert factor == pytest.approx(65534 / max(pixels.max() for pixels in pictures.values()), rel=1e-9)
        assert f"linear, {factor:.6g} DN for 1" in words
        elemental_set = load_set(tmp_path / "set")
        for pixels, path in zip(pictures.values(), elemental_set.image_paths, strict=True):
            assert np.abs(read_frame(path).pixels_dn / factor - pixels).max() <= 0.501 / factor
        inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
        assert set(inputs) == {f"v_{r}_{c}.pfm" for r, c in NODES}

    def test_floats_that_are_no_light_are_refused(self, tmp_path: Path, faintfield: Command) -> None:
        write(tmp_path / "src" / "b_0_0.tiff", np.ones(SIZE, "f4"))
        for value, words in ((np.nan, "values that are not finite; replace"), (-0.1, "-0.1, and the largest value of")):
            write(tmp_path / "src" / "b_0_1.tiff", np.full(SIZE, value, "f4"))
            ended = faintfield("import", "grid", tmp_path / "src", tmp_path / "set", "--rows", 1, "--columns", 2)
            assert_refused(ended, "BadValue", f"b_0_1.tiff: holds {words}")
            assert [path.name for path in tmp_path.iterdir()] == ["src"]


class TestOneFile:
    """Views in one file: a stack of pictures, or a mosaic of equal tiles."""

    @pytest.mark.parametrize("dtype", ["u1", "f4"])
    def test_stack_is_a_grid(self, dtype: str, tmp_path: Path, done: Command) -> None:
        stack = np.stack([picture(100 + index, dtype) for index in range(9)])
        tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack")
        words = done("import", "grid", tmp_path / "stack.tif", tmp_path / "set", "--linear").stderr
        assert "holds 9 pictures; they are taken as 3 x 3, row by row" in words
        elemental_set = load_set(tmp_path / "set")
        assert [view.node for view in elemental_set.settings.view] == NODES
        values = np.array(first_pixels(tmp_path / "set"), float)
        np.testing.assert_allclose(values / values[0] * 100, np.arange(100, 109), rtol=1e-4)
        assert elemental_set.noise.saturation_dn == (255.0 if dtype == "u1" else 65535.0)
        inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
        assert set(inputs) == {"stack.tif"}

    def test_stack_compressed_by_opencv_is_read(self, tmp_path: Path, done: Command) -> None:
        pictures = [picture(100 + index, "u2", (*SIZE, 3)) for index in range(6)]
        lzw = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_LZW]
        bgr = [np.ascontiguousarray(pixels[:, :, ::-1]) for pixels in pictures]
        assert cv2.imwritemulti(str(tmp_path / "a.tif"), bgr, lzw)
        done("import", "grid", tmp_path / "a.tif", tmp_path / "set", "--linear", "--rows", 2, "--columns", 3)
        for path, pixels in zip(load_set(tmp_path / "set").image_paths, pictures, strict=True):
            np.testing.assert_array_equal(read_frame(path).pixels_dn, pixels)

    def test_mosaic_is_cut_into_its_tiles(self, tmp_path: Path, done: Command, faintfield: Command) -> None:
        tiles = {(r, c): picture(100 + 10 * r + c, "u1", (*SIZE, 3)) for r in range(2) for c in range(3)}
        rows = [np.concatenate([tiles[r, c] for c in range(3)], axis=1) for r in range(2)]
        write(tmp_path / "all.png", np.concatenate(rows))
        words = ("import", "grid", tmp_path / "all.png", tmp_path / "set", "--columns", 3, "--rows")
        assert_refused(faintfield(*words, 5), "BadValue", "is 24 x 12 px, which 3 columns and 5 rows do not divide")
        done(*words, 2, "--linear")
        elemental_set = load_set(tmp_path / "set")
        assert [view.node for view in elemental_set.settings.view] == list(tiles)
        for path, tile in zip(elemental_set.image_paths, tiles.values(), strict=True):
            np.testing.assert_array_equal(read_frame(path).pixels_dn, tile)


HCI = """[intrinsics]
focal_length_mm = 100.0
image_resolution_x_px = 8
image_resolution_y_px = 6
sensor_size_mm = 35.0
[extrinsics]
num_cams_x = 3
num_cams_y = 3
baseline_mm = 50.0
focus_distance_m = 6.0
[meta]
scene = 100 % mine
"""


class TestHci:
    """The HCI benchmark: scale from parameters.cfg, true depth from a .pfm."""

    @pytest.fixture
    def src(self, tmp_path: Path) -> Path:
        src = folder_of(tmp_path / "src", [f"input_Cam{number:03}.png" for number in range(9)])
        (src / "parameters.cfg").write_text(HCI)
        write(src / "objectids_highres.png", picture(1))
        write(src / "gt_disp_lowres.pfm", self.disparity().astype(np.float32))
        return src

    def disparity(self) -> NDArray[np.float64]:
        """Their disparity in px of a slanted wall whose depth is 6 m at the first pixel, and less to the right."""
        depth_mm = 6000.0 - 100.0 * np.indices(SIZE)[1]
        # A point at depth z moves by f b / z px from view to view; shearing takes off that of the focus
        return np.asarray(8 * 100.0 / 35.0 * 50.0 * (1 / depth_mm - 1 / 6000.0))

    def test_parameters_give_scale_and_true_depth(self, src: Path, tmp_path: Path, done: Command) -> None:
        ended = done("import", "grid", src, tmp_path / "set", "--linear")
        assert "cameras 50 mm apart, focal length 22.8571 px, focus at 6000 mm" in ended.stderr
        elemental_set = load_set(tmp_path / "set")
        assert elemental_set.settings.camera.fx_px == pytest.approx(8 * 100 / 35)
        np.testing.assert_allclose(elemental_set.poses_rt_cam_ref[0, 3:5], [50.0, 50.0])
        assert [view.node for view in elemental_set.settings.view] == NODES
        assert elemental_set.depth_of_disparity(0.0) == pytest.approx(6000.0)
        # Their disparity grows towards the camera, ours falls: the last column is at 5300 mm
        assert elemental_set.depth_of_disparity(-float(self.disparity()[0, 7])) == pytest.approx(5300.0)
        depth_mm = 6000.0 - 100.0 * np.indices(SIZE)[1]
        np.testing.assert_allclose(np.asarray(read_true_depth_mm(tmp_path / "set")), depth_mm, rtol=1e-5)
        (src / "gt_disp_lowres.pfm").unlink()
        write(src / "gt_depth_lowres.pfm", (depth_mm / 1000).astype(np.float32))
        done("import", "grid", src, tmp_path / "again")
        np.testing.assert_allclose(np.asarray(read_true_depth_mm(tmp_path / "again")), depth_mm, rtol=1e-5)

    def test_options_override_parameters(self, src: Path, tmp_path: Path, done: Command) -> None:
        done("import", "grid", src, tmp_path / "set", "--pitch-mm", 5, "--fx-px", 20)
        elemental_set = load_set(tmp_path / "set")
        assert read_true_depth_mm(tmp_path / "set") is None  # it is of another scale
        assert (elemental_set.settings.camera.fx_px, elemental_set.poses_rt_cam_ref[0, 3]) == (20.0, 5.0)
        assert elemental_set.depth_of_disparity(0.0) == pytest.approx(6000.0)

    def test_damaged_parameters_are_refused(self, src: Path, tmp_path: Path, faintfield: Command) -> None:
        for old, new, words in (
            ("baseline_mm = 50.0", "baseline_mm = -5", "[extrinsics] baseline_mm = -5; it must be a positive number"),
            ("[extrinsics]", "[extrinsics", "is no configuration that can be read"),
        ):
            (src / "parameters.cfg").write_text(HCI.replace(old, new))
            assert_refused(faintfield("import", "grid", src, tmp_path / "set"), "BadValue", words)


def test_unpacked_views_are_removed(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    path, stack = tmp_path / "stack.tif", np.stack([picture(index) for index in range(4)])
    tifffile.imwrite(path, stack, photometric="minisblack")
    assert faintfield("import", "grid", path, tmp_path / "set").returncode == 0
    path.write_bytes(path.read_bytes()[:-100])
    assert_refused(faintfield("import", "grid", path, tmp_path / "set", "--overwrite"), "UnreadableImage")
    assert list((tmp_path / "temporary").iterdir()) == []
