"""Arrangement of imported pictures: an order is corrected, kept with a warning, or refused by name."""

import json
from collections.abc import Callable
from pathlib import Path

import cv2
import numpy as np
import pytest

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from tests.calib.light_fields import Layer, Views, light_field, with_noise
from tests.pipelines.conftest import Command

ROWS, COLUMNS, SIZE_PX, SMALL_PX = 3, 4, (128, 96), (96, 72)

# Disparities of the cards by `light_field`, once aligned.
LEAST_PX, LARGEST_PX = -1.4, 1.4


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


def _pictures(elemental_set: ElementalSet) -> Views:
    """Return the pictures by node."""
    nodes = [view.node for view in elemental_set.settings.view]
    return {
        node: read_frame(path).pixels_dn
        for node, path in zip(nodes, elemental_set.image_paths, strict=True)
        if node is not None
    }


def _assert_as_rendered(elemental_set: ElementalSet, views: Views) -> None:
    pictures = _pictures(elemental_set)
    assert sorted(pictures) == sorted(views)
    for node, view in views.items():
        np.testing.assert_array_equal(pictures[node], (view * 40_000).astype(np.uint16))


NAMES: dict[str, tuple[Callable[[int, int], str], tuple[object, ...]]] = {
    "rows reversed": (lambda r, c: _plain(ROWS - 1 - r, c), ("--pitch-mm", 10, "--fx-px", 100)),
    "transposed and reversed": (lambda r, c: _plain(COLUMNS - 1 - c, r), ()),
    "in order by row": (lambda r, c: f"v{5 + r * COLUMNS + c}.png", ("--rows", ROWS, "--columns", COLUMNS)),
}


@pytest.mark.parametrize("names", NAMES)
def test_pictures_under_any_names_become_one_set(names: str, views: Views, tmp_path: Path, done: Command) -> None:
    name, options = NAMES[names]
    ended = done("--json", "import", "grid", _write(tmp_path / "src", views, name), tmp_path / "set", *options)
    elemental_set = load_set(tmp_path / "set")
    _assert_as_rendered(elemental_set, views)
    record = json.loads(ended.stdout)["arrangement"]
    least_px, largest_px = record["disparity_range_px"]
    assert LEAST_PX - 0.6 < least_px < LEAST_PX + 0.05
    assert LARGEST_PX - 0.05 < largest_px < LARGEST_PX + 0.6
    assert record["aligned"] is True
    assert record["told_by"] == "pictures"
    assert "contradict" not in ended.stderr
    # No disparity was given: disparities only, all of them in front of the cameras
    assert elemental_set.settings.units.depth == "disparity_px"
    assert elemental_set.settings.arrangement is not None
    assert elemental_set.settings.arrangement.disparity_range_px == (least_px, largest_px)
    assert 0 < elemental_set.depth_of_disparity(LEAST_PX) < elemental_set.depth_of_disparity(LARGEST_PX)


def test_wrongly_stated_order_is_kept_and_contradicted(views: Views, tmp_path: Path, done: Command) -> None:
    ended = done("import", "grid", _write(tmp_path / "src", views), tmp_path / "set", "--flip-rows")
    assert "the pictures contradict the order that the options state" in ended.stderr
    _assert_as_rendered(load_set(tmp_path / "set"), {(ROWS - 1 - r, c): view for (r, c), view in views.items()})


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


def test_poses_follow_ratio_of_pitches(tmp_path: Path, done: Command) -> None:
    wide = light_field(grid=(3, 3), size_px=SIZE_PX, ratio=1.5)
    ended = done("import", "grid", _write(tmp_path / "src", wide), tmp_path / "set", "--pitch-mm", 10)
    elemental_set = load_set(tmp_path / "set")
    nodes = [view.node for view in elemental_set.settings.view]
    moved_mm = np.subtract(*(elemental_set.poses_rt_cam_ref[nodes.index(node), 3:5] for node in ((2, 2), (1, 1))))
    np.testing.assert_allclose(moved_mm, (-15.0, -10.0), rtol=0.04)
    assert "times as far apart as rows" in ended.stderr


def _assert_refused(faintfield: Command, src: Path, *words: str) -> None:
    ended = faintfield("import", "grid", src, src.parent / "set", "--rows", 3, "--columns", 3)
    assert ended.returncode == 1
    assert not (src.parent / "set").exists()
    assert all(word in ended.stderr for word in words), ended.stderr


def test_copies_and_shuffles_are_refused(nine_views: Views, tmp_path: Path, faintfield: Command) -> None:
    copies = {**nine_views, (1, 1): nine_views[2, 2]}
    _assert_refused(faintfield, _write(tmp_path / "copies", copies), "CopiedPicture", "2 of 9 pictures are copies")
    order = np.random.default_rng(2).permutation(9)
    shuffled = {divmod(place, 3): nine_views[divmod(int(source), 3)] for place, source in enumerate(order)}
    src = _write(tmp_path / "shuffle", shuffled, lambda r, c: f"{3 * r + c:04}.png")
    _assert_refused(faintfield, src, "ShuffledPictures")
    stated = faintfield("import", "grid", src, tmp_path / "set", "--flip-rows")
    assert "so the order may be wrong" in stated.stderr


def test_two_likely_orders_are_refused_with_both(tmp_path: Path, faintfield: Command) -> None:
    plane = light_field((Layer(1.5),), grid=(3, 3), size_px=SMALL_PX)
    src = _write(tmp_path / "src", plane)
    _assert_refused(faintfield, src, "AmbiguousOrder", "--flip-rows --flip-columns, or --disparity-px")
    assert faintfield("import", "grid", src, tmp_path / "set", "--disparity-px", 3).returncode == 0
    _assert_as_rendered(load_set(tmp_path / "set"), plane)


@pytest.mark.deep
@pytest.mark.parametrize("names", ["columns reversed", "aligned elsewhere"])
def test_photographs_of_archive_are_put_in_order(names: str, real_data: Path, tmp_path: Path, done: Command) -> None:
    """Only the inner 5 x 5 views."""
    (tmp_path / "src").mkdir()
    for row, column in np.ndindex(5, 5):
        picture = cv2.imread(str(real_data / "lightfield-chess" / f"view_r{row + 2}_c{column + 2}.jpg"))
        assert picture is not None
        if names == "aligned elsewhere":
            picture = np.roll(picture, (5 * (row - 2), 5 * (column - 2)), (0, 1))
        node = (row, 4 - column) if names == "columns reversed" else (row, column)
        assert cv2.imwrite(str(tmp_path / "src" / _plain(*node)), picture)
    result = json.loads(done("--json", "import", "grid", tmp_path / "src", tmp_path / "set").stdout)["arrangement"]
    turns = {key for key in ("columns_flipped", "rows_flipped", "transposed") if result.get(key)}
    assert turns == ({"columns_flipped"} if names == "columns reversed" else set())
    assert result.get("told_by") == "pictures"


@pytest.mark.deep
def test_pictures_of_different_scenes_are_refused(tmp_path: Path, faintfield: Command) -> None:
    nodes = np.ndindex(3, 3)
    scenes = {(r, c): light_field(grid=(1, 1), size_px=SMALL_PX, seed=50 + 9 * r + c)[0, 0] for r, c in nodes}
    _assert_refused(faintfield, _write(tmp_path / "src", scenes), "NotOneScene")


@pytest.mark.deep
def test_nine_pictures_of_a_line_are_no_square(tmp_path: Path, done: Command) -> None:
    line = light_field(grid=(1, 9), size_px=SMALL_PX, seed=32)
    src = _write(tmp_path / "src", line, lambda _, c: f"{c:04}.png")
    ended = done("--json", "import", "grid", src, tmp_path / "set")
    result = json.loads(ended.stdout)
    assert (result["rows"], result["columns"]) == (1, 9)
    assert [view.node for view in load_set(tmp_path / "set").settings.view] == sorted(line)
    assert "the pictures show one line of 9 views, not 3 x 3" in ended.stderr


def test_noisy_copies_and_darkness_are_warned_of(nine_views: Views, tmp_path: Path, done: Command) -> None:
    """SNR 0.16 with σ at a fifth of white: contrast as in pictures of different scenes, but no light above noise."""
    copies = with_noise(dict.fromkeys(nine_views, nine_views[1, 1]), 50)
    ended = done("import", "grid", _write(tmp_path / "copies", copies), tmp_path / "set")
    assert "all views show the same; no depth can be found" in ended.stderr
    dark = with_noise(nine_views, 0.16)
    src = _write(tmp_path / "dark", dark, white=int(13_000 / float(np.std(dark[0, 0]))))
    ended = done("import", "grid", src, tmp_path / "dark set")
    assert "too dark, or show nothing in common; the order of the names is kept" in ended.stderr
