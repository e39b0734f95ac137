"""`import grid` looks at the pictures: their order is corrected, kept and said to be unknown, or refused by name."""

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import cv2
import numpy as np
import pytest

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from tests.calib.light_fields import Layer, Views, light_field, with_noise

type Command = Callable[..., CompletedProcess[str]]

ROWS, COLUMNS, SIZE_PX, ALIGNED_PX = 4, 5, (128, 96), 2.4

# Disparities of the cards by `light_field`, once aligned.
LEAST_PX, LARGEST_PX = -1.4, 1.4


@pytest.fixture(scope="module")
def views() -> Views:
    return light_field(grid=(ROWS, COLUMNS), size_px=SIZE_PX, aligned_px=ALIGNED_PX)


def _write(folder: Path, views: Views, name: Callable[[int, int], str], white: int = 40_000) -> Path:
    folder.mkdir()
    for (row, column), view in views.items():
        assert cv2.imwrite(str(folder / name(row, column)), np.clip(view * white, 0, 65535).astype(np.uint16))
    return folder


def _plain(row: int, column: int) -> str:
    return f"view_r{row}_c{column}.png"


def _shown(loaded: ElementalSet) -> Views:
    """Return the pictures by node."""
    nodes = [view.node for view in loaded.settings.view]
    return {
        node: read_frame(path).pixels_dn
        for node, path in zip(nodes, loaded.image_paths, strict=True)
        if node is not None
    }


def _assert_as_rendered(loaded: ElementalSet, views: Views) -> None:
    shown = _shown(loaded)
    assert sorted(shown) == sorted(views)
    for node, view in views.items():
        np.testing.assert_array_equal(shown[node], (view * 40_000).astype(np.uint16))


NAMES: dict[str, tuple[Callable[[int, int], str], tuple[object, ...]]] = {
    "as documented": (_plain, ()),
    "rows reversed": (lambda r, c: _plain(ROWS - 1 - r, c), ()),
    "transposed and reversed": (lambda r, c: _plain(COLUMNS - 1 - c, r), ()),
    "every second number": (lambda r, c: _plain(10 + 2 * r, 2 * c), ()),
    "in order by row": (lambda r, c: f"{chr(97 + r * COLUMNS + c)}.png", ("--rows", ROWS, "--columns", COLUMNS)),
    "columns reversed, as stated": (lambda r, c: _plain(r, COLUMNS - 1 - c), ("--flip-columns",)),
    "transposed, as stated": (lambda r, c: _plain(c, r), ("--transpose",)),
}


@pytest.mark.parametrize("names", NAMES)
def test_pictures_under_any_names_become_one_set(names: str, views: Views, tmp_path: Path, done: Command) -> None:
    name, options = NAMES[names]
    ended = done("--json", "import", "grid", _write(tmp_path / "src", views, name), tmp_path / "set", *options)
    loaded = load_set(tmp_path / "set")
    _assert_as_rendered(loaded, views)
    record = json.loads(ended.stdout)["arrangement"]
    least_px, largest_px = record["disparity_range_px"]
    assert LEAST_PX - 0.6 < least_px < LEAST_PX + 0.05
    assert LARGEST_PX - 0.05 < largest_px < LARGEST_PX + 0.6
    assert record["aligned"] is True
    assert record["told_by"] == ("options" if "stated" in names else "pictures")
    assert "on a plane in the scene" in ended.stderr
    assert "contradict" not in ended.stderr
    # No scale was given: disparities only, all of them in front of the cameras
    assert loaded.settings.units.depth == "disparity_px"
    assert loaded.settings.arrangement is not None
    assert loaded.settings.arrangement.disparity_range_px == (least_px, largest_px)
    assert 0 < loaded.depth_of_disparity(LEAST_PX) < loaded.depth_of_disparity(LARGEST_PX)


def test_an_order_that_is_stated_wrongly_is_kept_and_contradicted(views: Views, tmp_path: Path, done: Command) -> None:
    ended = done("import", "grid", _write(tmp_path / "src", views, _plain), tmp_path / "set", "--flip-rows")
    assert "the pictures contradict the order that the options state" in ended.stderr
    np.testing.assert_array_equal(
        _shown(load_set(tmp_path / "set"))[0, 0], (views[ROWS - 1, 0] * 40_000).astype(np.uint16)
    )


def test_gaps_and_a_view_that_does_not_fit_are_named(views: Views, tmp_path: Path, done: Command) -> None:
    some = {node: it for node, it in views.items() if node not in ((0, 1), (3, 4))}
    some[2, 2] = np.ascontiguousarray(views[2, 2][::-1, ::-1])
    ended = done("import", "grid", _write(tmp_path / "src", some, _plain), tmp_path / "set")
    assert "missing      (0, 1), (2, 2), (3, 4)" in ended.stderr
    assert "fit none of their neighbours, and are left out: view_r2_c2.png" in ended.stderr
    loaded = load_set(tmp_path / "set")
    del some[2, 2]
    _assert_as_rendered(loaded, some)
    assert loaded.settings.arrangement is not None
    assert loaded.settings.arrangement.missing == ((0, 1), (2, 2), (3, 4))
    assert loaded.settings.arrangement.odd_views == ("view_r2_c2.png",)
    assert loaded.settings.view[loaded.reference_view].node in ((1, 2), (2, 1), (2, 3), (3, 2))


def test_poses_follow_the_ratio_of_pitches(tmp_path: Path, done: Command) -> None:
    wide = light_field(grid=(4, 4), size_px=SIZE_PX, ratio=1.5)
    ended = done("import", "grid", _write(tmp_path / "src", wide, _plain), tmp_path / "set", "--pitch-mm", 10)
    loaded = load_set(tmp_path / "set")
    nodes = [view.node for view in loaded.settings.view]
    moved_mm = loaded.poses_rt_cam_ref[nodes.index((2, 3)), 3:5] - loaded.poses_rt_cam_ref[nodes.index((1, 2)), 3:5]
    np.testing.assert_allclose(moved_mm, (-15.0, -10.0), rtol=0.04)
    assert "times as far apart as rows" in ended.stderr


def test_depths_are_in_mm_only_with_all_that_they_follow_from(views: Views, tmp_path: Path, done: Command) -> None:
    src = _write(tmp_path / "src", views, _plain)
    units = {}
    scale = ("--pitch-mm", 10, "--fx-px", 100)
    for name, options in {"all": (*scale, "--disparity-px", 4), "no disparity": scale}.items():
        done("import", "grid", src, tmp_path / name, *options)
        units[name] = load_set(tmp_path / name).settings.units.depth
    assert units == {"all": "mm", "no disparity": "disparity_px"}
    assert load_set(tmp_path / "all").depth_of_disparity(0.0) == pytest.approx(250.0)


def _refused(faintfield: Command, src: Path, *options: object) -> str:
    ended = faintfield("import", "grid", src, src.parent / "set", *options)
    assert ended.returncode == 1
    assert not (src.parent / "set").exists()
    return ended.stderr


def test_copies_and_different_scenes_are_refused(views: Views, tmp_path: Path, faintfield: Command) -> None:
    scenes = {(r, c): light_field(grid=(1, 1), size_px=SIZE_PX, seed=50 + 9 * r + c)[0, 0] for r, c in views}
    assert "NotOneScene" in _refused(faintfield, _write(tmp_path / "scenes", scenes, _plain))
    copies = dict.fromkeys(views, views[0, 0])
    said = _refused(faintfield, _write(tmp_path / "copies", copies, _plain))
    assert "CopiedPicture" in said
    assert f"{ROWS * COLUMNS} of {ROWS * COLUMNS} pictures" in said
    one = {**views, (1, 1): views[3, 3]}
    assert "2 of 20 pictures are copies" in _refused(faintfield, _write(tmp_path / "one", one, _plain))


def test_two_orders_that_are_equally_likely_are_refused_with_both(tmp_path: Path, faintfield: Command) -> None:
    plane = light_field((Layer(1.5),), grid=(4, 4), size_px=SIZE_PX)
    src = _write(tmp_path / "src", plane, _plain)
    said = _refused(faintfield, src)
    assert "AmbiguousOrder" in said
    assert "--flip-rows --flip-columns, or --disparity-px" in said
    # Either of what it names decides
    for options, first in ((("--disparity-px", 3), (0, 0)), (("--flip-rows", "--flip-columns"), (3, 3))):
        out = tmp_path / f"set{first[0]}"
        assert faintfield("import", "grid", src, out, *options).returncode == 0
        np.testing.assert_array_equal(_shown(load_set(out))[first], (plane[0, 0] * 40_000).astype(np.uint16))


def test_a_dark_set_keeps_its_names(views: Views, tmp_path: Path, done: Command) -> None:
    dark = {node: it + 0.001 for node, it in with_noise(views, 0.05).items()}
    level = 20 / float(np.std(dark[0, 0]))  # σ of 20 DN about 100 DN
    src = _write(
        tmp_path / "src", {node: ((it * level + 100) / 40_000).astype(np.float32) for node, it in dark.items()}, _plain
    )
    ended = done("import", "grid", src, tmp_path / "set")
    assert "the order of the names is kept" in ended.stderr
    assert len(load_set(tmp_path / "set").settings.view) == ROWS * COLUMNS


@pytest.mark.deep
@pytest.mark.parametrize("names", ["columns reversed", "aligned elsewhere"])
def test_photographs_of_an_archive(names: str, real_data: Path, tmp_path: Path, done: Command) -> None:
    """Only the inner 5 x 5 views."""
    (tmp_path / "src").mkdir()
    for row, column in np.ndindex(5, 5):
        picture = cv2.imread(str(real_data / "lightfield-chess" / f"view_r{row + 2}_c{column + 2}.jpg"))
        assert picture is not None
        if names == "aligned elsewhere":
            picture = np.roll(picture, (5 * (row - 2), 5 * (column - 2)), (0, 1))
        node = {"columns reversed": (row, 4 - column), "transposed": (column, row)}.get(names, (row, column))
        assert cv2.imwrite(str(tmp_path / "src" / _plain(*node)), picture)
    result = json.loads(done("--json", "import", "grid", tmp_path / "src", tmp_path / "set").stdout)["arrangement"]
    found = {key for key in ("columns_flipped", "rows_flipped", "transposed") if result.get(key)}
    assert found == {"columns reversed": {"columns_flipped"}, "transposed": {"transposed"}}.get(names, set())
    assert result.get("told_by") == "pictures"


SMALL_PX = (96, 72)


@pytest.fixture(scope="module")
def nine_views() -> Views:
    return light_field(grid=(3, 3), size_px=SMALL_PX, aligned_px=2.4, seed=31)


def _written(folder: Path, nine_views: Views, white: int = 40_000) -> Path:
    """Write views by one running number, row by row."""
    folder.mkdir()
    for number, node in enumerate(sorted(nine_views)):
        pixels = np.clip(nine_views[node] * white, 0, 65535).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"{number:04}.png"), pixels)
    return folder


@pytest.mark.parametrize("size", [(1, 9), (3, 3)])
def test_nine_views_by_one_number_are_a_line_or_a_square(size: tuple[int, int], tmp_path: Path, done: Command) -> None:
    src = _written(tmp_path / "src", light_field(grid=size, size_px=SMALL_PX, seed=32))
    ended = done("--json", "import", "grid", src, tmp_path / "set")
    result = json.loads(ended.stdout)
    assert (result["rows"], result["columns"]) == size
    nodes = [view.node for view in load_set(tmp_path / "set").settings.view]
    assert nodes == [(row, column) for row in range(size[0]) for column in range(size[1])]
    assert ("the pictures show one line of 9 views, not 3 x 3" in ended.stderr) is (min(size) == 1)
    assert ("1 row x 9 columns, 9 views" in ended.stderr) is (size == (1, 9))


def test_pictures_in_random_order_are_refused_unless_an_order_is_stated(
    nine_views: Views, tmp_path: Path, faintfield: Command
) -> None:
    order = np.random.default_rng(2).permutation(9)
    src = _written(
        tmp_path / "src", {divmod(place, 3): nine_views[divmod(int(of), 3)] for place, of in enumerate(order)}
    )
    ended = faintfield("import", "grid", src, tmp_path / "set", "--rows", 3, "--columns", 3)
    assert ended.returncode == 1
    assert "ShuffledPictures" in ended.stderr
    assert not (tmp_path / "set").exists()
    stated = faintfield("import", "grid", src, tmp_path / "set", "--flip-rows")
    assert "so the order may be wrong" in stated.stderr


def _said(nine_views: Views, folder: Path, done: Command, white: int = 40_000) -> str:
    return done("import", "grid", _written(folder / "src", nine_views, white), folder / "set").stderr


def test_copies_with_noise_are_said_to_show_the_same(nine_views: Views, tmp_path: Path, done: Command) -> None:
    said = _said(with_noise(dict.fromkeys(nine_views, nine_views[1, 1]), 50), tmp_path, done)
    assert "all views show the same; no depth can be found" in said


def test_dark_pictures_are_never_refused_however_much_they_are_amplified(
    nine_views: Views, tmp_path: Path, done: Command
) -> None:
    """SNR 0.16 with σ at a fifth of white: contrast as in pictures of different scenes, but no light above noise."""
    dark = with_noise(nine_views, 0.16)
    level = 13_000 / float(np.std(dark[0, 0]))
    said = _said(dark, tmp_path, done, int(level))
    assert "too dark, or show nothing in common; the order of the names is kept" in said
