"""`import grid` of the files of archives: positions in names, HCI's parameters, stacks, mosaics, floats."""

import json
import tempfile
from collections.abc import Callable, Iterable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.calib.arrangement.orientation import Orientation
from faintfield.pipelines.formats.exchange.image_grid import find_grid
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import read_true_depth_mm

type Command = Callable[..., CompletedProcess[str]]

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


def refused(ended: CompletedProcess[str], failure: str, *words: str) -> None:
    assert ended.returncode == 1, ended.stderr
    assert f"faintfield: {failure}: " in ended.stderr
    assert all(word in ended.stderr for word in words), ended.stderr


def test_positions_in_the_names_place_the_cameras(tmp_path: Path, done: Command) -> None:
    """An irregular grid: row 0 has the largest y, and columns run against x; the set knows neither, but the nodes."""
    shifts = np.random.default_rng(3).uniform(-4, 4, (9, 2))
    places = {node: (-60.0 * node[1] + dx, -60.0 * node[0] + dy) for node, (dx, dy) in zip(NODES, shifts, strict=True)}
    names = [f"out_{r:02}_{c:02}_{y:.3f}_{x:.3f}_.png" for (r, c), (x, y) in places.items()]
    src = folder_of(tmp_path / "src", names)
    said = done("import", "grid", src, tmp_path / "set", "--pitch-mm", 10, "--fx-px", 20, "--disparity-px", 2).stderr
    assert "names state positions" in said
    loaded = load_set(tmp_path / "set")
    assert [view.node for view in loaded.settings.view] == NODES
    x_0, y_0 = places[1, 1]
    # 60 by construction; the mean distance differs by the slope of the errors
    scale = np.polyfit([c for _, c in NODES], [places[node][0] for node in NODES], 1)[0] / -10.0
    expected = np.array([((x - x_0) / scale, (y - y_0) / scale) for x, y in places.values()])
    assert 5 < scale < 7
    np.testing.assert_allclose(loaded.poses_rt_cam_ref[:, 3:5], expected, atol=2e-3)
    # The plane on which pictures are aligned stays where it is in all of them, also with uneven steps
    moved = 20 * loaded.poses_rt_cam_ref[:, 3:5] / loaded.depth_of_disparity(0.0) + loaded.principal_points_px()
    np.testing.assert_allclose(moved, moved[[4] * 9], atol=1e-9)


@pytest.mark.parametrize(
    ("transpose", "flip_rows", "flip_columns"), [(True, False, False), (False, True, False), (True, False, True)]
)
def test_a_turned_grid_takes_positions_along(
    transpose: bool, flip_rows: bool, flip_columns: bool, tmp_path: Path
) -> None:
    places = {(r, c): (60.0 * c + r, 50.0 * r - 0.5 * c * c) for r in range(2) for c in range(3)}
    names = [f"out_{r:02}_{c:02}_{y:.3f}_{x:.3f}_.png" for (r, c), (x, y) in places.items()]
    grid = find_grid(folder_of(tmp_path / "src", names))
    turned = grid.turned(Orientation(transpose, flip_rows, flip_columns))
    assert turned.size == ((3, 2) if transpose else (2, 3))
    where = {path.name: node for node, path in grid.paths.items()}
    assert grid.measured is not None
    assert turned.measured is not None
    stretch = set()
    for node, path in turned.paths.items():
        old = grid.measured[where[path.name]]
        right, down = old[::-1] if transpose else old
        new = turned.measured[node]
        first = grid.measured[where[turned.paths[0, 0].name]]
        right_0, down_0 = first[::-1] if transpose else first
        for was, now, flipped in ((right - right_0, new[0], flip_columns), (down - down_0, new[1], flip_rows)):
            if abs(was) > 0.5:
                stretch.add(round(now / was * (-1 if flipped else 1), 9))
    assert len(stretch) == 1  # one unit for all, and each axis runs its way
    assert stretch.pop() == pytest.approx(60 / 50 if transpose else 1, rel=0.1)


def test_files_taken_in_order_are_counted_as_people_count(tmp_path: Path, done: Command) -> None:
    src = tmp_path / "src"
    for number in range(1, 13):
        write(src / f"v{number}.png", picture(number))
    done("import", "grid", src, tmp_path / "set", "--linear", "--rows", 3, "--columns", 4)
    assert first_pixels(tmp_path / "set") == list(range(1, 13))


def test_a_pattern_orders_and_places(tmp_path: Path, done: Command, faintfield: Command) -> None:
    src = folder_of(tmp_path / "src", [f"s3-{c}+{r}.png" for r, c in NODES])
    done("import", "grid", src, tmp_path / "set", "--pattern", "s3-{column}+{row}.png")
    assert [view.node for view in load_set(tmp_path / "set").settings.view] == NODES
    assert (
        json.loads((tmp_path / "set" / "provenance.json").read_text())["options"]["pattern"] == "s3-{column}+{row}.png"
    )
    ended = faintfield("import", "grid", src, tmp_path / "other", "--pattern", "{row}x{column}.png")
    refused(ended, "BadValue", "s3-0+0.png does not match it, 0 of 9 pictures do")
    words = ("--pattern", "s3-{column}+{row}.png", "--rows", 9)
    refused(faintfield("import", "grid", src, tmp_path / "other", *words), "BadValue", "makes a grid of 3 x 3, --rows")


class TestFoldersOfMixedFiles:
    """What is no view is left out and named; what is not read is named with its kind."""

    @pytest.mark.parametrize(
        ("others", "words"),
        [
            (["mask_0.png", "depth_1.png"], "left out: 2 of 11 pictures, by their names no views (depth_1.png)"),
            (["film.gif", "film2.gif", "notes.txt"], "left out: 2 .gif files, which are not read"),
        ],
    )
    def test_files_beside_the_views_are_left_out_and_named(
        self, others: list[str], words: str, tmp_path: Path, done: Command
    ) -> None:
        src = folder_of(tmp_path / "src", [f"v_{r}_{c}.png" for r, c in NODES])
        for name in others:
            (src / name).write_bytes((src / "v_0_0.png").read_bytes())
        assert words in done("import", "grid", src, tmp_path / "set", "--linear").stderr
        assert first_pixels(tmp_path / "set") == [100 + index for index in range(9)]

    def test_copies_of_another_kind_are_refused(self, tmp_path: Path, faintfield: Command) -> None:
        src = folder_of(tmp_path / "src", [f"v_{n}_{m}.{kind}" for n in "01" for m in "01" for kind in ("png", "bmp")])
        ended = faintfield("import", "grid", src, tmp_path / "set")
        refused(ended, "BadValue", "several kinds (4 .bmp files, 4 .png files), with v_0_0 in two of them; leave")
        ended = faintfield("import", "grid", src, tmp_path / "set", "--pattern", "v_{row}_{column}.png")
        refused(ended, "BadValue", "v_0_0.bmp does not match it, 4 of 8 pictures do")


class TestKinds:
    """Files of kinds that are read keep their values."""

    @pytest.mark.parametrize(
        ("kind", "dtype", "white", "shape"), [("bmp", "u1", 255, (*SIZE, 3)), ("pnm", "u2", 65535, SIZE)]
    )
    def test_pixels_come_through(
        self, kind: str, dtype: str, white: int, shape: tuple[int, ...], tmp_path: Path, done: Command
    ) -> None:
        suffix = {"pnm": "pgm" if len(shape) == 2 else "ppm"}.get(kind, kind)
        for index, (r, c) in enumerate(NODES):
            write(tmp_path / "src" / f"v_{r}_{c}.{suffix}", picture(200 + index, dtype, shape))
        done("import", "grid", tmp_path / "src", tmp_path / "set", "--linear")
        loaded = load_set(tmp_path / "set")
        assert loaded.noise.saturation_dn == white
        for index, path in enumerate(loaded.image_paths):
            pixels = read_frame(path).pixels_dn
            assert pixels.dtype == np.uint16
            np.testing.assert_array_equal(pixels, picture(200 + index, "u2", shape))

    def test_white_of_a_12_bit_pgm_is_where_pixels_saturate(self, tmp_path: Path, done: Command) -> None:
        (tmp_path / "src").mkdir()
        pixels = picture(4095, ">u2")
        (tmp_path / "src" / "a.pgm").write_bytes(b"P5 # of 12 bits\n8 6\n# one more\n4095\n" + pixels.tobytes())
        done("import", "grid", tmp_path / "src", tmp_path / "set", "--linear")
        loaded = load_set(tmp_path / "set")
        assert loaded.noise.saturation_dn == 4095.0
        np.testing.assert_array_equal(read_frame(loaded.image_paths[0]).pixels_dn, pixels)

    @pytest.mark.parametrize("suffix", ["tiff", "pfm"])
    def test_floats_become_16_bits_by_one_factor_that_is_recorded(
        self, suffix: str, tmp_path: Path, done: Command
    ) -> None:
        src, generator = tmp_path / "src", np.random.default_rng(9)
        pictures = {node: generator.uniform(0, 0.1 + node[0], SIZE).astype(np.float32) for node in NODES}
        for (r, c), pixels in pictures.items():
            write(src / f"v_{r}_{c}.{suffix}", pixels)
        said = done("import", "grid", src, tmp_path / "set", "--linear").stderr
        factor = json.loads((tmp_path / "set" / "provenance.json").read_text())["options"]["dn_per_value"]
        assert factor == pytest.approx(65534 / max(pixels.max() for pixels in pictures.values()), rel=1e-9)
        assert f"linear, {factor:.6g} DN for 1" in said
        loaded = load_set(tmp_path / "set")
        for pixels, path in zip(pictures.values(), loaded.image_paths, strict=True):
            assert np.abs(read_frame(path).pixels_dn / factor - pixels).max() <= 0.501 / factor
        inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
        assert set(inputs) == {f"v_{r}_{c}.{suffix}" for r, c in NODES}

    @pytest.mark.parametrize(
        ("second", "failure", "words"),
        [
            (np.full(SIZE, np.nan, "f4"), "BadValue", "b_0_1.tiff: holds values that are not finite; replace them"),
            (
                np.full(SIZE, -0.1, "f4"),
                "BadValue",
                "b_0_1.tiff: holds -0.1, and the largest value of all pictures is 1",
            ),
        ],
    )
    def test_floats_that_are_no_light_are_refused(
        self, second: NDArray[Any], failure: str, words: str, tmp_path: Path, faintfield: Command
    ) -> None:
        write(tmp_path / "src" / "b_0_0.tiff", np.ones(SIZE, "f4"))
        write(tmp_path / "src" / "b_0_1.tiff", second)
        ended = faintfield("import", "grid", tmp_path / "src", tmp_path / "set", "--rows", 1, "--columns", 2)
        refused(ended, failure, words)
        assert [path.name for path in tmp_path.iterdir()] == ["src"]


class TestOneFile:
    """Views in one file: a stack of pictures, or a mosaic of equal tiles."""

    @pytest.mark.parametrize(("dtype", "compression"), [("u1", None), ("u2", "zlib"), ("f4", None)])
    def test_a_stack_is_a_grid(self, dtype: str, compression: str | None, tmp_path: Path, done: Command) -> None:
        stack = np.stack([picture(100 + index, dtype) for index in range(9)])
        tifffile.imwrite(tmp_path / "stack.tif", stack, compression=compression, photometric="minisblack")
        said = done("import", "grid", tmp_path / "stack.tif", tmp_path / "set", "--linear").stderr
        assert "holds 9 pictures; they are taken as 3 x 3, row by row" in said
        loaded = load_set(tmp_path / "set")
        assert [view.node for view in loaded.settings.view] == NODES
        values = np.array(first_pixels(tmp_path / "set"), float)
        np.testing.assert_allclose(values / values[0] * 100, np.arange(100, 109), rtol=1e-4)
        assert loaded.noise.saturation_dn == (255.0 if dtype == "u1" else 65535.0)
        inputs = json.loads((tmp_path / "set" / "provenance.json").read_text())["inputs"]
        assert set(inputs) == {"stack.tif"}

    def test_a_stack_in_a_compression_of_opencv_is_read(self, tmp_path: Path, done: Command) -> None:
        pictures = [picture(100 + index, "u2", (*SIZE, 3)) for index in range(6)]
        lzw = [cv2.IMWRITE_TIFF_COMPRESSION, cv2.IMWRITE_TIFF_COMPRESSION_LZW]
        assert cv2.imwritemulti(str(tmp_path / "a.tif"), [np.ascontiguousarray(it[:, :, ::-1]) for it in pictures], lzw)
        with tifffile.TiffFile(tmp_path / "a.tif") as tiff:
            assert tiff.pages.first.compression == 5
        done("import", "grid", tmp_path / "a.tif", tmp_path / "set", "--linear", "--rows", 2, "--columns", 3)
        for path, pixels in zip(load_set(tmp_path / "set").image_paths, pictures, strict=True):
            np.testing.assert_array_equal(read_frame(path).pixels_dn, pixels)

    def test_a_mosaic_is_cut_into_its_tiles(self, tmp_path: Path, done: Command) -> None:
        tiles = {(r, c): picture(100 + 10 * r + c, "u1", (*SIZE, 3)) for r in range(2) for c in range(3)}
        rows = [np.concatenate([tiles[r, c] for c in range(3)], axis=1) for r in range(2)]
        write(tmp_path / "all.png", np.concatenate(rows))
        done("import", "grid", tmp_path / "all.png", tmp_path / "set", "--linear", "--rows", 2, "--columns", 3)
        loaded = load_set(tmp_path / "set")
        assert [view.node for view in loaded.settings.view] == list(tiles)
        for path, tile in zip(loaded.image_paths, tiles.values(), strict=True):
            np.testing.assert_array_equal(read_frame(path).pixels_dn, tile)

    @pytest.mark.parametrize(
        ("options", "failure", "words"),
        [
            (("--rows", 4, "--columns", 2), "BadValue", "is 8 x 6 px, which 2 columns and 4 rows do not divide"),
        ],
    )
    def test_a_mosaic_that_does_not_divide_is_refused(
        self, options: tuple[object, ...], failure: str, words: str, tmp_path: Path, faintfield: Command
    ) -> None:
        write(tmp_path / "all.png", picture(1))
        refused(faintfield("import", "grid", tmp_path / "all.png", tmp_path / "set", *options), failure, words)
        assert [path.name for path in tmp_path.iterdir()] == ["all.png"]


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

    def test_the_file_gives_the_scale(self, src: Path, tmp_path: Path, done: Command) -> None:
        said = done("import", "grid", src, tmp_path / "set", "--linear").stderr
        assert "cameras 50 mm apart, focal length 22.8571 px, focus at 6000 mm" in said
        loaded = load_set(tmp_path / "set")
        assert loaded.settings.camera.fx_px == pytest.approx(8 * 100 / 35)
        np.testing.assert_allclose(loaded.poses_rt_cam_ref[0, 3:5], [50.0, 50.0])
        assert [view.node for view in loaded.settings.view] == NODES
        assert loaded.depth_of_disparity(0.0) == pytest.approx(6000.0)
        # Theirs grows towards the camera, ours falls: the last column is at 5300 mm
        assert loaded.depth_of_disparity(-float(self.disparity()[0, 7])) == pytest.approx(5300.0)

    def test_the_truth_is_kept_as_depth(self, src: Path, tmp_path: Path, done: Command) -> None:
        done("import", "grid", src, tmp_path / "set", "--linear")
        found = read_true_depth_mm(tmp_path / "set")
        assert found is not None
        np.testing.assert_allclose(found, 6000.0 - 100.0 * np.indices(SIZE)[1], rtol=1e-5)
        (src / "gt_disp_lowres.pfm").unlink()
        write(src / "gt_depth_lowres.pfm", (found / 1000).astype(np.float32))
        done("import", "grid", src, tmp_path / "again")
        np.testing.assert_allclose(np.asarray(read_true_depth_mm(tmp_path / "again")), found, rtol=1e-5)

    def test_options_take_the_place_of_the_file(self, src: Path, tmp_path: Path, done: Command) -> None:
        done("import", "grid", src, tmp_path / "set", "--pitch-mm", 5, "--fx-px", 20)
        loaded = load_set(tmp_path / "set")
        assert read_true_depth_mm(tmp_path / "set") is None  # it is of another scale
        assert (loaded.settings.camera.fx_px, loaded.poses_rt_cam_ref[0, 3]) == (20.0, 5.0)
        assert loaded.depth_of_disparity(0.0) == pytest.approx(6000.0)

    @pytest.mark.parametrize(
        ("old", "new", "words"),
        [
            ("baseline_mm = 50.0", "baseline_mm = -5", "[extrinsics] baseline_mm = -5; it must be a positive number"),
            ("[extrinsics]", "[extrinsics", "is no configuration that can be read"),
        ],
    )
    def test_a_damaged_file_is_refused(
        self, old: str, new: str, words: str, src: Path, tmp_path: Path, faintfield: Command
    ) -> None:
        (src / "parameters.cfg").write_text(HCI.replace(old, new))
        refused(faintfield("import", "grid", src, tmp_path / "set"), "BadValue", words)


@pytest.mark.deep
def test_a_rendered_light_field_of_hci_gives_depths_that_agree_with_its_truth(tmp_path: Path, done: Command) -> None:
    """The benchmark's conventions, written here from its own formulas: shear, focal length, sign of the disparity."""
    perfect = ("--position-error-mm", 0, "--rotation-error-mrad", 0, "--rows", 5, "--columns", 5)
    done("simulate", tmp_path / "scene", "--objects", "surfaces", "--snr", 4, "--size-px", 160, 120, *perfect)
    fx_px, pitch_mm, focus_mm, shift_px = 200.0, 50.0, 1000.0, 10  # focal length and pitch of the simulated rig
    valid = (slice(20, -20), slice(20, -20))
    for number, (row, column) in enumerate(np.ndindex(5, 5)):
        pixels = tifffile.imread(tmp_path / "scene" / "noise_free" / f"view_r{row}_c{column}.tiff")
        sheared = np.roll(pixels, (shift_px * (row - 2), shift_px * (column - 2)), (0, 1))
        write(tmp_path / "src" / f"input_Cam{number:03}.png", sheared[valid])
    depth_mm = tifffile.imread(tmp_path / "scene" / "truth" / "true_depth_mm.tiff")[valid].astype(float)
    assert shift_px == fx_px * pitch_mm / focus_mm
    disparity_px = fx_px * pitch_mm * (1 / depth_mm - 1 / focus_mm)
    write(tmp_path / "src" / "gt_disp_lowres.pfm", disparity_px.astype(np.float32))
    text = HCI.replace("num_cams_x = 3", "num_cams_x = 5").replace("num_cams_y = 3", "num_cams_y = 5")
    for old, new in {
        "x_px = 8": "x_px = 120",
        "y_px = 6": "y_px = 80",
        "6.0": "1.0",
        "100.0": "50",
        "35.0": "30",
    }.items():
        text = text.replace(old, new)
    (tmp_path / "src" / "parameters.cfg").write_text(text)
    done("import", "grid", tmp_path / "src", tmp_path / "set", "--gain-dn-per-e", 100, "--read-noise-e", 3)
    sweep = ("--sweep-mm", "400:1400:5", "--method", "backprojection", "--depth-map")
    done("reconstruct", tmp_path / "set", "--out", tmp_path / "out", *sweep)
    errors = json.loads((tmp_path / "out" / "depth_errors.json").read_text())
    assert errors["share"] > 0.4
    # The simulated lens distorts by up to 1 %, of which the benchmark's files know nothing
    assert errors["median_relative_error"] < 0.015
    assert errors["within_2_percent"] > 0.9


@pytest.mark.parametrize("src", ["stack.tif", "broken.tif"])
def test_unpacked_views_are_removed(
    src: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    (tmp_path / "temporary").mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(tmp_path / "temporary"))
    stack = np.stack([picture(index) for index in range(4)])
    tifffile.imwrite(tmp_path / "stack.tif", stack, photometric="minisblack")
    (tmp_path / "broken.tif").write_bytes((tmp_path / "stack.tif").read_bytes()[:-100])
    write(tmp_path / "floats" / "v_0_0.tiff", picture(1, "f4"))
    ended = faintfield("import", "grid", tmp_path / src, tmp_path / "set")
    assert ended.returncode == (1 if src == "broken.tif" else 0), ended.stderr
    assert list((tmp_path / "temporary").iterdir()) == []
