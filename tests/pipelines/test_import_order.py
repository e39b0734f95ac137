"""`import grid` checks that neighbours by the names are neighbours: it refuses, or says what it cannot know."""

import json
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import cv2
import numpy as np
import pytest

from faintfield.pipelines.formats.sets.elemental_set import load_set
from tests.calib.light_fields import Views, light_field, with_noise

type Command = Callable[..., CompletedProcess[str]]

SIZE_PX = (96, 72)


@pytest.fixture(scope="module")
def views() -> Views:
    return light_field(grid=(3, 3), size_px=SIZE_PX, aligned_px=2.4, seed=31)


def _written(folder: Path, views: Views, white: int = 40_000) -> Path:
    """Write views by one running number, row by row."""
    folder.mkdir()
    for number, node in enumerate(sorted(views)):
        pixels = np.clip(views[node] * white, 0, 65535).astype(np.uint16)
        assert cv2.imwrite(str(folder / f"{number:04}.png"), pixels)
    return folder


@pytest.mark.parametrize("size", [(1, 9), (9, 1), (3, 3)])
def test_nine_views_by_one_number_are_a_line_or_a_square(size: tuple[int, int], tmp_path: Path, done: Command) -> None:
    src = _written(tmp_path / "src", light_field(grid=size, size_px=SIZE_PX, seed=32))
    ended = done("--json", "import", "grid", src, tmp_path / "set")
    result = json.loads(ended.stdout)
    assert (result["rows"], result["columns"]) == size
    nodes = [view.node for view in load_set(tmp_path / "set").settings.view]
    assert nodes == [(row, column) for row in range(size[0]) for column in range(size[1])]
    assert ("the pictures show one line of 9 views, not 3 x 3" in ended.stderr) is (min(size) == 1)
    assert ("1 row x 9 columns, 9 views" in ended.stderr) is (size == (1, 9))


def test_pictures_in_random_order_are_refused_unless_an_order_is_stated(
    views: Views, tmp_path: Path, faintfield: Command
) -> None:
    order = np.random.default_rng(2).permutation(9)
    src = _written(tmp_path / "src", {divmod(place, 3): views[divmod(int(of), 3)] for place, of in enumerate(order)})
    ended = faintfield("import", "grid", src, tmp_path / "set", "--rows", 3, "--columns", 3)
    assert ended.returncode == 1
    assert "ShuffledPictures" in ended.stderr
    assert not (tmp_path / "set").exists()
    stated = faintfield("import", "grid", src, tmp_path / "set", "--flip-rows")
    assert "so the order may be wrong" in stated.stderr


def _said(views: Views, folder: Path, done: Command, white: int = 40_000) -> str:
    return done("import", "grid", _written(folder / "src", views, white), folder / "set").stderr


def test_copies_with_noise_are_said_to_show_the_same(views: Views, tmp_path: Path, done: Command) -> None:
    said = _said(with_noise(dict.fromkeys(views, views[1, 1]), 50), tmp_path, done)
    assert "all views show the same; no depth can be found" in said


def test_black_small_and_few_pictures_are_each_said(views: Views, tmp_path: Path, done: Command) -> None:
    cases = {
        "all pixels of each picture are alike": dict.fromkeys(views, np.zeros((72, 96), np.float32)),
        "smaller than 32 px": {node: view[:24, :24] for node, view in views.items()},
        "2 pictures are too few": {(0, column): views[0, column] for column in (0, 1)},
    }
    for number, (words, pictures) in enumerate(cases.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        options = () if len(pictures) > 2 else ("--columns", 2)
        src = _written(folder / "src", pictures)
        assert words in done("import", "grid", src, folder / "set", *options).stderr


def test_dark_pictures_are_never_refused_however_much_they_are_amplified(
    views: Views, tmp_path: Path, done: Command
) -> None:
    """SNR 0.16 with σ at a fifth of white: contrast as in pictures of different scenes, but no light above noise."""
    dark = with_noise(views, 0.16)
    level = 13_000 / float(np.std(dark[0, 0]))
    said = _said(dark, tmp_path, done, int(level))
    assert "too dark, or show nothing in common; the order of the names is kept" in said
