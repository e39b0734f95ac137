"""`import grid`: pictures on a regular grid become a set with nodes, nominal poses and disparities."""

import json
from collections.abc import Callable, Iterable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel

type Command = Callable[..., CompletedProcess[str]]


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


def _grid_names(rows: Iterable[int], columns: Iterable[int], template: str = "view_r{}_c{}.tiff") -> list[str]:
    return [template.format(row, column) for row in rows for column in columns]


@pytest.mark.parametrize(
    "names",
    [
        _grid_names(range(2), range(3)),
        _grid_names(range(4, 6), range(10, 13)),
        _grid_names((8, 9), (9, 10, 11), "img{}x{}.tiff"),
    ],
    ids=["from zero", "from elsewhere", "across ten"],
)
def test_nodes_are_the_last_two_numbers_of_a_name_counted_from_the_first(
    names: list[str], tmp_path: Path, done: Command
) -> None:
    src = _pictures(tmp_path / "src", names)
    (src / "README.txt").write_text("not a picture")
    result = json.loads(done("--json", "import", "grid", src, tmp_path / "out", "--pitch-mm", 50, "--linear").stdout)
    assert (result["rows"], result["columns"], result["size_px"]) == (2, 3, [8, 6])
    loaded = load_set(tmp_path / "out")
    assert [view.node for view in loaded.settings.view] == [(row, column) for row in range(2) for column in range(3)]
    assert [int(read_frame(path).pixels_dn[0, 0]) for path in loaded.image_paths] == list(range(6))
    assert loaded.settings.view[loaded.reference_view].node == (1, 1)
    # A camera to the right of the reference moves points to the left
    expected = [(50.0 * (1 - column), 50.0 * (1 - row)) for row in range(2) for column in range(3)]
    np.testing.assert_array_equal(loaded.poses_rt_cam_ref[:, 3:5], expected)


@pytest.mark.parametrize(
    ("names", "options", "failure", "words"),
    [
        ([], (), "MissingFile", "is empty; name the folder that holds the pictures"),
        (
            ["view_r0_c0.tiff", "view_r1_c1.tiff"],
            (),
            "MissingFile",
            "the view in row 0 and column 1, counted from 0, is missing, 2 of 4",
        ),
        (["a1_1.tiff", "b1_1.tiff"], (), "BadValue", "is at node (1, 1) like a1_1.tiff"),
        (["a.tiff", "b.tiff"], ("--rows", 3), "MissingFile", "holds 2 pictures, a grid of 3 x 1 needs 3"),
    ],
)
def test_grids_with_gaps_and_doubles_are_refused(
    names: list[str], options: tuple[object, ...], failure: str, words: str, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("import", "grid", _pictures(tmp_path / "src", names), tmp_path / "out", *options)
    assert ended.returncode == 1
    assert f"faintfield: {failure}: " in ended.stderr
    assert words in ended.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["src"]


@pytest.mark.parametrize(
    ("second", "failure", "words"),
    [
        (_picture(shape=(8, 6)), "WrongSize", "is 6 x 8 px, the first picture 8 x 6 px"),
        (_picture(shape=(6, 8, 3)), "WrongSize", "is (6, 8, 3), the first picture (6, 8)"),
        (_picture().astype(np.uint8), "WrongBitDepth", "has 8 bits per pixel, the first picture 16"),
    ],
)
def test_pictures_that_are_not_alike_are_refused(
    second: NDArray[Any], failure: str, words: str, tmp_path: Path, faintfield: Command
) -> None:
    src = _pictures(tmp_path / "src", _grid_names([0], [0, 1]))
    tifffile.imwrite(src / "view_r0_c1.tiff", second, photometric="rgb" if second.ndim == 3 else "minisblack")
    ended = faintfield("import", "grid", src, tmp_path / "out")
    assert ended.returncode == 1
    assert f"faintfield: {failure}: {src / 'view_r0_c1.tiff'}: {words}" in ended.stderr
    assert [path.name for path in tmp_path.iterdir()] == ["src"]


@pytest.mark.parametrize("name", ["view_r0_c0.png"])
def test_16_bit_pictures_are_kept_byte_for_byte(name: str, tmp_path: Path, done: Command) -> None:
    (tmp_path / "src").mkdir()
    assert cv2.imwrite(str(tmp_path / "src" / name), _picture(40_000))
    done("import", "grid", tmp_path / "src", tmp_path / "out")
    assert (tmp_path / "out" / name).read_bytes() == (tmp_path / "src" / name).read_bytes()
    assert load_set(tmp_path / "out").settings.view[0].image == name
    assert load_set(tmp_path / "out").noise.saturation_dn == 65535.0


@pytest.mark.parametrize(
    ("suffix", "shape"), [("png", (24, 32, 3)), ("jpg", (24, 32)), ("tif", (24, 32, 3))], ids=["png", "jpg", "tif"]
)
def test_linear_8_bit_pictures_become_16_bit_ones_of_the_same_values(
    shape: tuple[int, ...], suffix: str, tmp_path: Path, done: Command
) -> None:
    (tmp_path / "src").mkdir()
    source = tmp_path / "src" / f"view_r0_c0.{suffix}"
    assert cv2.imwrite(str(source), np.random.default_rng(1).integers(0, 256, shape).astype(np.uint8))
    done("import", "grid", tmp_path / "src", tmp_path / "out", "--linear")
    loaded = load_set(tmp_path / "out")
    assert loaded.settings.view[0].image == "view_r0_c0.tiff"
    pixels = read_frame(loaded.image_paths[0]).pixels_dn
    assert pixels.dtype == np.uint16
    np.testing.assert_array_equal(pixels, read_frame(source).pixels_dn)
    assert loaded.noise.saturation_dn == 255.0


def test_noise_and_exposure_are_those_given(tmp_path: Path, done: Command) -> None:
    options = {
        "exposure-s": 0.25,
        "offset-dn": 64.0,
        "gain-dn-per-e": 3.0,
        "read-noise-e": 4.0,
        "dark-current-e-per-s": 0.5,
        "quantum-efficiency": 0.6,
    }
    words = [word for key, value in options.items() for word in (f"--{key}", value)]
    said = done("import", "grid", _pictures(tmp_path / "src", ["a.tiff"]), tmp_path / "out", *words).stderr
    loaded = load_set(tmp_path / "out")
    assert loaded.settings.exposure_s == 0.25
    assert (loaded.noise.offset_dn, loaded.noise.gain_dn_per_e, loaded.noise.read_noise_e) == (64.0, 3.0, 4.0)
    assert (loaded.noise.dark_current_e_per_s, loaded.noise.quantum_efficiency) == (0.5, 0.6)
    assert loaded.settings.units.light == "electrons"
    assert "estimated" not in (tmp_path / "out" / "elemental.toml").read_text()
    assert "assumed" not in said


def test_a_dark_current_needs_an_exposure(tmp_path: Path, faintfield: Command) -> None:
    src = _pictures(tmp_path / "src", ["a.tiff"])
    ended = faintfield("import", "grid", src, tmp_path / "out", "--dark-current-e-per-s", 2)
    assert ended.returncode == 1
    assert "states no exposure, without which 2 dark electrons per second mean nothing; give --exp" in ended.stderr


@pytest.mark.parametrize(("pitch_mm", "disparity_px", "depth_mm"), [(50.0, 2.5, 2000.0), (None, 2.5, 1000.0)])
def test_pictures_aligned_on_a_plane_see_it_at_focal_length_times_pitch_over_disparity(
    pitch_mm: float | None, disparity_px: float, depth_mm: float, tmp_path: Path, done: Command
) -> None:
    src = _pictures(tmp_path / "src", _grid_names(range(3), range(3)))
    pitch = () if pitch_mm is None else ("--pitch-mm", pitch_mm)
    done("import", "grid", src, tmp_path / "out", "--disparity-px", disparity_px, "--fx-px", 100, *pitch)
    loaded = load_set(tmp_path / "out")
    assert loaded.depth_of_disparity(0.0) == pytest.approx(depth_mm, rel=1e-12)
    # Where each view images a point of that plane: always at the same pixel
    x_mm, y_mm = 30.0, -20.0
    moved = loaded.poses_rt_cam_ref[:, 3:5] + [x_mm, y_mm]
    pixels = 100.0 * moved / depth_mm + loaded.principal_points_px()
    np.testing.assert_allclose(pixels, pixels[[4] * 9], atol=1e-9)


@pytest.mark.parametrize("moves_px", [-3, 1])
def test_a_point_that_moves_by_a_disparity_is_sharp_at_that_disparity(
    moves_px: int, tmp_path: Path, done: Command
) -> None:
    (tmp_path / "src").mkdir()
    for row, column in np.ndindex(3, 3):
        picture = _picture(0, (30, 40))
        picture[15 + moves_px * (row - 1), 20 + moves_px * (column - 1)] = 9000
        tifffile.imwrite(tmp_path / "src" / f"view_r{row}_c{column}.tiff", picture)
    done("import", "grid", tmp_path / "src", tmp_path / "set", "--disparity-px", 4)
    peaks = {}
    for disparity_px in (-3, 1):
        out = tmp_path / f"planes{disparity_px}"
        done(
            "reconstruct",
            tmp_path / "set",
            "--out",
            out,
            f"--disparity-px={disparity_px}",
            "--method",
            "backprojection",
        )
        plane = read_frame(next(out.glob("plane_*.tiff"))).pixels_dn
        assert plane.shape == (30, 40)
        peaks[disparity_px] = plane.max()
        if disparity_px == moves_px:
            assert np.argwhere(plane == plane.max()).tolist() == [[15, 20]]
    # All nine views agree there; elsewhere each says it of another place
    assert peaks[moves_px] == pytest.approx(9000.0, rel=1e-3)
    assert max(peak for disparity_px, peak in peaks.items() if disparity_px != moves_px) < 0.2 * 9000


def test_only_an_earlier_set_is_replaced_and_never_the_pictures_themselves(tmp_path: Path, faintfield: Command) -> None:
    src = _pictures(tmp_path / "src", _grid_names([0], [0, 1], "view_r{}_c{}.png"))
    assert faintfield("import", "grid", src, tmp_path / "out").returncode == 0
    assert faintfield("import", "grid", src, tmp_path / "out").returncode == 1
    assert faintfield("import", "grid", src, tmp_path / "out", "--overwrite").returncode == 0
    (src / "elemental.toml").touch()
    ended = faintfield("import", "grid", src, src, "--overwrite")
    assert ended.returncode == 1
    assert "OutputExists" in ended.stderr
    assert sorted(path.name for path in src.iterdir()) == ["elemental.toml", "view_r0_c0.png", "view_r0_c1.png"]


class TestRawFiles:
    """Raw files stay what they are, and bring their own black level."""

    @pytest.fixture
    def imported(self, real_data: Path, tmp_path: Path, done: Command) -> Path:
        src = tmp_path / "src"
        src.mkdir()
        (src / "colorchart.dng").symlink_to(real_data / "raw" / "colorchart.dng")
        done("import", "grid", src, tmp_path / "set", "--read-noise-e", 3)
        return tmp_path / "set"

    def test_a_raw_file_is_kept_byte_for_byte(self, imported: Path, real_data: Path) -> None:
        original = (real_data / "raw" / "colorchart.dng").read_bytes()
        assert (imported / "colorchart.dng").read_bytes() == original
        settings = load_set(imported).settings
        assert settings.camera.mosaic is None
        assert settings.camera.size_px == (1734, 1156)
        assert "offset_dn" not in (imported / "elemental.toml").read_text()

    def test_each_phase_has_its_own_masked_black_level_taken_off(self, imported: Path) -> None:
        loaded = load_set(imported)
        frame = read_frame(imported / "colorchart.dng")
        black_dn = frame.black_dn
        assert black_dn is not None
        layouts = channel_layouts(loaded)
        assert [layout.name for layout in layouts] == ["red", "green", "blue"]
        for layout in layouts:
            images = load_channel(loaded, layout)
            for index, lattice in enumerate(layout.lattices):
                row, column = lattice.first
                expected = frame.pixels_dn[row::2, column::2] - black_dn[row, column]
                np.testing.assert_allclose(images.electrons[index], expected, atol=1e-3)

    @pytest.mark.deep
    def test_it_reconstructs_into_three_finite_channels(self, imported: Path, tmp_path: Path, done: Command) -> None:
        done("reconstruct", imported, "--out", tmp_path / "planes", "--depth", 1, "--passes", 2)
        result = json.loads((tmp_path / "planes" / "reconstruction.json").read_text())
        assert [record["channel"] for record in result["planes"]] == ["red", "green", "blue"]
        plane = tifffile.imread(tmp_path / "planes" / result["planes"][0]["file"])
        assert plane.shape == (578, 867, 3)
        assert np.isfinite(plane).all()
        frame = read_frame(imported / "colorchart.dng")
        for channel, (row, column) in enumerate([(0, 0), (0, 1), (1, 1)]):
            light = frame.pixels_dn[row::2, column::2].mean() - 2048
            assert plane[:, :, channel].mean() == pytest.approx(light, rel=0.02)
