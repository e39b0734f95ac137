"""Depths that auto finds, or refuses: views that mean nothing, and those in another order than stated."""

import contextlib
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.formats.sets.elemental_file import Arrangement
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.depth.autofocus import best_focus, searched_range_mm
from faintfield.pipelines.reconstruction.depth.comparison import BinnedViews, _shuffles, binned_views, check_places
from faintfield.recon.errors import NothingInFocus
from tests.calib.light_fields import Layer, light_field, with_noise
from tests.pipelines.by_hand import View, write_set
from tests.pipelines.conftest import Command, Edit, run_undrawn

type Node = tuple[int, int]

NODES, SIZE_PX = 5, (96, 72)
CARDS = (Layer(0.0), Layer(-2.5, (-22, -15), (19, 15)), Layer(-4.0, (22, 8), (15, 19)))


def _write_grid(folder: Path, picture: Callable[[Node], NDArray[np.floating]]) -> Path:
    """Write a set of a square grid, 10 mm apart, of what each node sees, in electrons."""
    random, views = np.random.default_rng(7), []
    for row, column in np.ndindex(NODES, NODES):
        electrons = random.poisson(picture((row, column))) + random.normal(0, 3.0, SIZE_PX[::-1])
        pose = (0, 0, 0, -10 * (column - NODES // 2), -10 * (row - NODES // 2), 0)
        views.append(View((100 + 2 * electrons).round().astype(np.uint16), (row, column), pose))
    return write_set(folder, views, camera={"fx_px": 100.0, "fy_px": 100.0}, reference_view=NODES**2 // 2)


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    views = light_field(CARDS, (NODES, NODES), SIZE_PX)
    return _write_grid(tmp_path_factory.mktemp("auto") / "scene", lambda node: 200 * views[node])


def _check_disparities(disparities_px: NDArray[np.floating], aligned_px: float = 0.0) -> None:
    expected = [layer.disparity_px + aligned_px for layer in CARDS]
    np.testing.assert_allclose(np.sort(disparities_px), np.sort(expected), atol=0.1)


def test_depths_up_to_infinity_are_found(scene: Path, tmp_path: Path) -> None:
    focus = best_focus(load_set(scene), tmp_path)
    assert (focus.p_value, focus.shuffles) == (0.002, 499)
    assert focus.z_shuffled is not None
    _check_disparities(-1000 / np.array(focus.depth_mm))  # 100 px of focal length, nodes 10 mm apart


def test_infinity_is_left_out_where_alignment_is_unknown(scene: Path, tmp_path: Path) -> None:
    """Disparities of zero are those of infinity or of the plane on which the pictures are aligned."""
    elemental_set = load_set(scene)
    arrangement = Arrangement(disparity_range_px=(-4.4, 0.1), aligned=None)
    settings = msgspec.structs.replace(elemental_set.settings, arrangement=arrangement)
    depths = best_focus(replace(elemental_set, settings=settings), tmp_path).depth_mm
    np.testing.assert_allclose(-1000 / np.array(depths), [-4.0, -2.5], atol=0.1)


@pytest.mark.deep
def test_depths_stand_apart_in_spite_of_misfit(tmp_path: Path) -> None:
    """With poses off by 15 mrad, two peaks of the same samples had depths of 1333 and 1382 mm."""
    words = ("--position-error-mm", 1, "--rotation-error-mrad", 15, "--snr", 20, "--seed", 2, "--size-px", 240, 180)
    run_undrawn("simulate", tmp_path / "set", "--poses", "nominal", *words)
    focus = best_focus(load_set(tmp_path / "set"), tmp_path)
    assert sum(focus.share_of_sure) <= 1
    assert len(focus.share_of_sure) == len(focus.depth_mm)
    assert min(np.diff(focus.depth_mm) / focus.depth_mm[:-1]) > 0.1


def test_another_order_is_refused_with_its_option(scene: Path, tmp_path: Path, edit: Edit) -> None:
    folder = Path(shutil.copytree(scene, tmp_path / "set"))

    def reorder(settings: dict[str, Any]) -> None:
        for view in settings["view"]:
            row, column = view["node"]
            view["image"] = f"view_{NODES * (NODES - 1 - column) + row}.tiff"

    edit(folder, reorder)
    remedy = "rows and columns exchanged, and rows reversed (--transpose --flip-rows)"
    with pytest.raises(NothingInFocus, match=re.escape(f"the views agree better with {remedy}: by ")):
        best_focus(load_set(folder), tmp_path)


@pytest.mark.deep
@pytest.mark.parametrize("kind", ["noise", "other scenes", "shuffled views"])
def test_meaningless_sets_are_accepted_as_rarely_as_stated(kind: str, scene: Path, tmp_path: Path) -> None:
    elemental_set = load_set(scene)
    range_mm = searched_range_mm(elemental_set)
    views = binned_views(elemental_set, range_mm[0], tmp_path, min_bins_px=8)
    height, width = views.colours[0][1].electrons.shape[1:]
    (layout, images), random, accepted = views.colours[0], np.random.default_rng(3), 0
    for _ in range(100):
        electrons = images.electrons[random.permutation(NODES**2)]
        if kind == "noise":
            electrons = random.poisson(200, images.electrons.shape).astype(np.float32)
        if kind == "other scenes":
            seeds = random.integers(2**40, size=NODES**2).tolist()
            electrons = 200 * 64 * np.stack([light_field(CARDS, (1, 1), (width, height), seed=s)[0, 0] for s in seeds])
        meaningless = BinnedViews(
            elemental_set, [(layout, replace(images, electrons=electrons.astype(np.float32)))], views.bins_px
        )
        with contextlib.suppress(NothingInFocus):
            accepted += check_places(meaningless, range_mm) is not None
    assert accepted <= 2  # 0.2 are expected; more than two in one of 900 such tests


def test_shuffles_differ_and_are_complete() -> None:
    for count, shuffles in ((3, 4), (4, 22), (5, 118), (6, 499), (25, 499)):
        orders = {tuple(places.tolist()) for places in _shuffles(count)}
        assert len(orders) == len(_shuffles(count)) == shuffles
        assert not orders & {tuple(range(count)), tuple(range(count))[::-1]}
        assert all(sorted(places) == list(range(count)) for places in orders)


@pytest.mark.deep
def test_blind_views_do_not_hide_others(scene: Path, tmp_path: Path, edit: Edit) -> None:
    folder = Path(shutil.copytree(scene, tmp_path / "set"))
    cv2.imwrite(str(folder / "view_3.tiff"), np.full(SIZE_PX[::-1], 65535, np.uint16))
    edit(folder, lambda settings: settings["noise"].update(saturation_dn=65535.0))
    # One view looks backwards
    edit(folder, lambda settings: settings["view"][5].update(rt_cam_ref=[0.0, 3.0, 0.0, 50.0, 50.0, 0.0]))
    assert best_focus(load_set(folder), tmp_path).p_value == 0.002


@pytest.mark.deep
def test_depth_of_alignment_does_not_matter(tmp_path: Path, done: Command) -> None:
    views = with_noise(light_field(CARDS, (NODES, NODES), SIZE_PX, aligned_px=2.2), 20)
    (tmp_path / "pictures").mkdir()
    for (row, column), view in views.items():
        picture = np.clip(view * 40_000, 0, 65535).astype(np.uint16)
        cv2.imwrite(str(tmp_path / "pictures" / f"view_r{row}_c{column}.png"), picture)
    done("import", "grid", tmp_path / "pictures", tmp_path / "set", "--disparity-px", 12)
    elemental_set = load_set(tmp_path / "set")
    at_zero, slope = elemental_set.inverse_depth_of_disparity()
    depth_mm = np.array(best_focus(elemental_set, tmp_path).depth_mm)
    _check_disparities((1 / depth_mm - at_zero) / slope, aligned_px=2.2)
