"""Arrangement of imported pictures: an order is corrected, kept with a warning, or refused by name."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from faintfield.calib.lens import Lens
from faintfield.pipelines.formats.exchange.image_grid import ImageGrid, measured_steps
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_file import Arrangement
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from tests.calib.light_fields import Layer, Views, light_field, with_noise
from tests.pipelines.conftest import Command, assert_refused

ROWS, COLUMNS, SIZE_PX, SMALL_PX = 3, 4, (128, 96), (96, 72)

# Least and largest disparities of the cards by `light_field`, once aligned.
CARDS_PX = (-1.4, 1.4)


@pytest.fixture(scope="module")
def views() -> Views:
    return light_field(grid=(ROWS, COLUMNS), size_px=SIZE_PX, aligned_px=2.4)


@pytest.fixture(scope="module")
def nine_views() -> Views:
    return light_field(grid=(3, 3), size_px=SMALL_PX, aligned_px=2.4, seed=31)


def _plain(row: int, column: int) -> str:
    return f"view_r{row}_c{column}.png"


def _write(folder: Path, views: Views, name: Callable[[int, int], str] = _plain, white: int = 40_000) -> Path:
    folder.mkdir()
    for (row, column), view in views.items():
        assert cv2.imwrite(str(folder / name(row, column)), np.clip(view * white, 0, 65535).astype(np.uint16))
    return folder


def _assert_as_rendered(elemental_set: ElementalSet, views: Views) -> None:
    nodes = [view.node for view in elemental_set.settings.view]
    assert sorted(node for node in nodes if node) == sorted(views)
    for node, path in zip(nodes, elemental_set.image_paths, strict=True):
        assert node is not None
        np.testing.assert_array_equal(read_frame(path).pixels_dn, (views[node] * 40_000).astype(np.uint16))


def test_four_views_named_back_and_forth_are_put_in_order(tmp_path: Path, done: Command) -> None:
    views = light_field(grid=(2, 2), size_px=SMALL_PX)
    src = _write(tmp_path / "src", views, lambda row, column: _plain(row, 1 - column if row else column))
    assert "names run back and forth" in done("import", "grid", src, tmp_path / "set").stderr
    _assert_as_rendered(load_set(tmp_path / "set"), views)


def test_cameras_keep_their_places_when_a_picture_is_left_out() -> None:
    positions = {(row, column): (50.0 * column + 3 * row % 4, 40.0 * row) for row, column in np.ndindex(3, 2)}
    paths = {node: Path(f"{index}.png") for index, node in enumerate(positions)}
    grid = ImageGrid(paths, measured_steps(positions))
    whole, part = grid.moved(list(paths)), grid.moved(list(paths), omit=[1, 3, 5])  # the second column
    assert whole.measured is not None
    assert part.measured == {node: whole.measured[node] for node in part.paths}
    assert list(part.paths) == [(0, 0), (1, 0), (2, 0)]


def test_pictures_turned_by_their_names_are_put_in_order(views: Views, tmp_path: Path, done: Command) -> None:
    src = _write(tmp_path / "src", views, lambda row, column: _plain(COLUMNS - 1 - column, row))
    ended = done("--json", "import", "grid", src, tmp_path / "set", "--pitch-mm", 10, "--fx-px", 100)
    elemental_set = load_set(tmp_path / "set")
    _assert_as_rendered(elemental_set, views)
    record = json.loads(ended.stdout)["arrangement"]
    least_px, largest_px = record["disparity_range_px"]
    assert -0.6 < least_px - CARDS_PX[0] < 0.05
    assert -0.05 < largest_px - CARDS_PX[1] < 0.6
    assert record["aligned"] is True
    assert record["told_by"] == "pictures"
    assert "contradict" not in ended.stderr
    # No disparity was given: disparities only, all of them in front of the cameras
    assert elemental_set.settings.units.depth == "disparity_px"
    assert elemental_set.settings.arrangement is not None
    assert elemental_set.settings.arrangement.disparity_range_px == (least_px, largest_px)
    assert 0 < elemental_set.depth_of_disparity(CARDS_PX[0]) < elemental_set.depth_of_disparity(CARDS_PX[1])
    # A wrong order is kept if it is stated
    ended = done("import", "grid", src, tmp_path / "stated", "--transpose")
    assert "the pictures contradict the order that the options state" in ended.stderr
    _assert_as_rendered(load_set(tmp_path / "stated"), {(r, COLUMNS - 1 - c): view for (r, c), view in views.items()})


def test_gaps_and_odd_views_are_named(views: Views, tmp_path: Path, done: Command) -> None:
    kept = {node: view for node, view in views.items() if node not in ((0, 1), (2, 3))}
    odd = np.ascontiguousarray(kept.pop((1, 2))[::-1, ::-1])
    ended = done("import", "grid", _write(tmp_path / "src", kept | {(1, 2): odd}), tmp_path / "set")
    assert "fit none of their neighbours, and are left out: view_r1_c2.png" in ended.stderr
    elemental_set = load_set(tmp_path / "set")
    _assert_as_rendered(elemental_set, kept)
    assert elemental_set.settings.arrangement is not None
    assert elemental_set.settings.arrangement.missing == ((0, 1), (1, 2), (2, 3))
    assert elemental_set.settings.arrangement.odd_views == ("view_r1_c2.png",)
    assert elemental_set.settings.view[elemental_set.reference_view].node in ((0, 2), (1, 1), (1, 3), (2, 2))


def _check_refused(faintfield: Command, src: Path, *words: str) -> None:
    assert_refused(faintfield("import", "grid", src, src.parent / "set", "--rows", 3, "--columns", 3), *words)
    assert not (src.parent / "set").exists()


def test_copies_and_shuffles_are_refused(nine_views: Views, tmp_path: Path, faintfield: Command) -> None:
    copies = {**nine_views, (1, 1): nine_views[2, 2]}
    _check_refused(faintfield, _write(tmp_path / "copies", copies), "CopiedPicture", "2 of 9 pictures are copies")
    order = np.random.default_rng(2).permutation(9)
    shuffled = {divmod(place, 3): nine_views[divmod(int(source), 3)] for place, source in enumerate(order)}
    src = _write(tmp_path / "shuffle", shuffled, lambda r, c: f"{3 * r + c:04}.png")
    _check_refused(faintfield, src, "ShuffledPictures")
    stated = faintfield("import", "grid", src, tmp_path / "set", "--flip-rows")
    assert "so the order may be wrong" in stated.stderr
    kept = faintfield("import", "grid", src, tmp_path / "kept", "--rows", 3, "--columns", 3, "--keep-order")
    assert kept.returncode == 0
    _assert_as_rendered(load_set(tmp_path / "kept"), shuffled)


def test_two_likely_orders_are_refused_with_both(tmp_path: Path, faintfield: Command) -> None:
    plane = light_field((Layer(1.5),), grid=(3, 3), size_px=SMALL_PX)
    src = _write(tmp_path / "src", plane)
    _check_refused(faintfield, src, "AmbiguousOrder", "--flip-rows --flip-columns, or --disparity-px")
    for stated in (("--disparity-px", 3), ("--keep-order",)):
        assert faintfield("import", "grid", src, tmp_path / "set", *stated, "--overwrite").returncode == 0
        _assert_as_rendered(load_set(tmp_path / "set"), plane)
    arrangement = load_set(tmp_path / "set").settings.arrangement
    assert (arrangement and arrangement.told_by) == "options"


def _arrangement(done: Command, src: Path, *options: object) -> Arrangement:
    done("import", "grid", src, src.parent / "set", "--no-align", *options)
    arrangement = load_set(src.parent / "set").settings.arrangement
    assert arrangement is not None
    return arrangement


def test_displaced_view_is_irregular(tmp_path: Path, done: Command) -> None:
    disparity_px, share = -14.0, 0.08  # 1.1 px
    regular, displaced = (
        light_field((Layer(disparity_px, (px, px)),), (3, 3), SMALL_PX) for px in (0, share * disparity_px)
    )
    assert not _arrangement(done, _write(tmp_path / "src", regular)).irregular
    src = _write(tmp_path / "displaced", {**regular, (0, 1): displaced[0, 1]})
    assert _arrangement(done, src, "--overwrite").irregular


def test_uncertain_magnification_is_not_irregular(tmp_path: Path, done: Command) -> None:
    """Few blocks of cards before black hold detail: the views seem to be magnified by up to 0.9 %."""
    cards = (Layer(-8.0, (-20, 5), (10, 24)), Layer(-12.0, (22, -8), (9, 12)))
    views = with_noise(light_field(cards, (2, 3), (112, 84), detail=3, seed=2), 7)
    assert not _arrangement(done, _write(tmp_path / "src", views)).irregular


def test_small_noisy_pictures_are_not_irregular(tmp_path: Path, done: Command) -> None:
    """A pair of 64 x 48 px has six blocks, which overlap by half."""
    layers = (Layer(-1.0), Layer(-3.0, (-8, -6), (12, 10)), Layer(-4.0, (15, 8), (9, 12)))
    views = with_noise(light_field(layers, (3, 3), (64, 48), seed=2), 7, seed=102)
    assert not _arrangement(done, _write(tmp_path / "src", views)).irregular


@pytest.mark.parametrize("distortion", [-0.3, 0.3])
def test_stated_distortion_is_undone_before_pictures_are_compared(
    distortion: float, tmp_path: Path, done: Command
) -> None:
    (width, height), focal_px = SMALL_PX, 96.0
    lens = Lens(SMALL_PX, focal_px, focal_px, (width - 1) / 2, (height - 1) / 2, (distortion,))
    places = (focal_px * lens.rays() + (lens.cx_px, lens.cy_px)).astype(np.float32)
    views = light_field((Layer(-6.0),), (3, 3), SMALL_PX)
    for node, view in views.items():
        views[node] = cv2.remap(view, places, None, cv2.INTER_LINEAR).astype(np.float32)
    options = ("--pitch-mm", 10, "--fx-px", focal_px, "--distortion", distortion)
    disparities_px = _arrangement(done, _write(tmp_path / "src", views), *options).disparity_range_px
    assert disparities_px == pytest.approx((-6.0, -6.0), abs=0.7)  # as they are, -6.5 to 0.7


@pytest.mark.deep
def test_photographs_of_archive_are_put_in_order(real_data: Path, tmp_path: Path, done: Command) -> None:
    """The inner 5 x 5 views, aligned elsewhere, and with their columns reversed."""
    (tmp_path / "src").mkdir()
    for row, column in np.ndindex(5, 5):
        picture = cv2.imread(str(real_data / "lightfield-chess" / f"view_r{row + 2}_c{column + 2}.jpg"))
        assert picture is not None
        picture = np.roll(picture, (5 * (row - 2), 5 * (column - 2)), (0, 1))
        assert cv2.imwrite(str(tmp_path / "src" / _plain(row, 4 - column)), picture)
    result = json.loads(done("--json", "import", "grid", tmp_path / "src", tmp_path / "set").stdout)["arrangement"]
    turns = {key for key in ("columns_flipped", "rows_flipped", "transposed") if result.get(key)}
    assert (turns, result["told_by"]) == ({"columns_flipped"}, "pictures")


def test_noisy_copies_and_darkness_are_warned_of(nine_views: Views, tmp_path: Path, done: Command) -> None:
    """SNR 0.16 with σ at a fifth of white: contrast as in pictures of different scenes, but no light above noise."""
    copies = with_noise(dict.fromkeys(nine_views, nine_views[1, 1]), 50)
    ended = done("import", "grid", _write(tmp_path / "copies", copies), tmp_path / "set")
    assert "all views show the same; no depth can be found" in ended.stderr
    dark = with_noise(nine_views, 0.16)
    src = _write(tmp_path / "dark", dark, white=int(13_000 / float(np.std(dark[0, 0]))))
    ended = done("import", "grid", src, tmp_path / "dark set")
    assert "too dark, or show nothing in common; the order of the names is kept" in ended.stderr


@pytest.mark.deep
def test_objects_before_black_keep_the_order_of_the_names(tmp_path: Path, done: Command) -> None:
    """Nothing is hidden behind an object before black, which the test of hidden parts may misread."""
    size = ("--rows", 5, "--columns", 5, "--pitch-mm", 20, "--size-px", 240, 180)
    exact = ("--lens", "ideal", "--position-error-mm", 0, "--rotation-error-mrad", 0)
    done("simulate", tmp_path / "scene", *size, *exact)
    pictures = tmp_path / "pictures"
    pictures.mkdir()
    for view in (tmp_path / "scene" / "noise_free").glob("view_*.tiff"):
        view.rename(pictures / view.name)
    record = json.loads(done("--json", "import", "grid", pictures, tmp_path / "set", "--no-align").stdout)[
        "arrangement"
    ]
    assert record["told_by"] == "signs"
    assert record["disparity_range_px"][1] < 0
