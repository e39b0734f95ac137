"""Depths that auto finds, or refuses: views that mean nothing, and those in another order than stated."""

import contextlib
import re
import tomllib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import tomli_w
from numpy.typing import NDArray

from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.reconstruction.autofocus import best_focus, searched_range_mm
from faintfield.pipelines.reconstruction.comparison import BinnedViews, binned_views
from faintfield.pipelines.reconstruction.significance import _shuffles, check_places
from faintfield.recon.errors import NothingInFocus
from tests.calib.light_fields import Layer, light_field, with_noise
from tests.pipelines.conftest import Command

pytestmark = pytest.mark.usefixtures("undrawn")

type Node = tuple[int, int]

NODES, SIZE_PX = 5, (96, 72)
OFFSET_DN, GAIN_DN_PER_E, READ_NOISE_E = 100.0, 2.0, 3.0
CARDS = (Layer(0.0), Layer(-2.5, (-22, -15), (19, 15)), Layer(-4.0, (22, 8), (15, 19)))


def _write_grid(folder: Path, picture: Callable[[Node], NDArray[np.floating]]) -> Path:
    """Write a set of a square grid, 10 mm apart, of what each node sees, in electrons."""
    folder.mkdir()
    random, middle, views = np.random.default_rng(7), NODES // 2, []
    for row, column in np.ndindex(NODES, NODES):
        electrons = random.poisson(picture((row, column))) + random.normal(0, READ_NOISE_E, SIZE_PX[::-1])
        name = f"view_r{row}_c{column}.tiff"
        cv2.imwrite(str(folder / name), (OFFSET_DN + GAIN_DN_PER_E * electrons).round().astype(np.uint16))
        pose = [0.0, 0.0, 0.0, -10.0 * (column - middle), -10.0 * (row - middle), 0.0]
        views.append({"image": name, "rt_cam_ref": pose, "node": [row, column]})
    width, height = SIZE_PX
    lens = {"fx_px": 100.0, "fy_px": 100.0, "cx_px": (width - 1) / 2, "cy_px": (height - 1) / 2}
    settings = {
        "format": 1,
        "exposure_s": 0.5,
        "reference_view": len(views) // 2,
        "camera": {"size_px": [width, height], **lens},
        "noise": {"offset_dn": OFFSET_DN, "gain_dn_per_e": GAIN_DN_PER_E, "read_noise_e": READ_NOISE_E},
        "view": views,
    }
    (folder / "elemental.toml").write_text(tomli_w.dumps(settings))
    return folder


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


def _reordered(scene: Path, folder: Path, seen_by: Callable[[int, int], Node]) -> ElementalSet:
    """Return the scene with each node's picture replaced by that of another."""
    folder.mkdir()
    settings = tomllib.loads((scene / "elemental.toml").read_text())
    for view in settings["view"]:
        row, column = seen_by(*view["node"])
        view["image"] = f"view_r{row}_c{column}.tiff"
        (folder / view["image"]).write_bytes((scene / view["image"]).read_bytes())
    (folder / "elemental.toml").write_text(tomli_w.dumps(settings))
    return load_set(folder)


@pytest.mark.parametrize(
    ("seen_by", "remedy"),
    [
        pytest.param(lambda r, c: (r, NODES - 1 - c), "reversed columns (--flip-columns)", marks=pytest.mark.deep),
        (lambda r, c: (NODES - 1 - c, r), "rows and columns exchanged, and rows reversed (--transpose --flip-rows)"),
    ],
)
def test_another_order_is_refused_with_its_option(
    seen_by: Callable[[int, int], Node], remedy: str, scene: Path, tmp_path: Path
) -> None:
    elemental_set = _reordered(scene, tmp_path / "set", seen_by)
    with pytest.raises(NothingInFocus, match=re.escape(f"the views agree better with {remedy}: by ")):
        best_focus(elemental_set, tmp_path)


def test_views_that_show_no_depth_are_refused(tmp_path: Path, faintfield: Command) -> None:
    def other_scene(node: Node) -> NDArray[np.floating]:
        return 200 * light_field(CARDS, (1, 1), SIZE_PX, seed=2010 + NODES * node[0] + node[1])[0, 0]

    folder = _write_grid(tmp_path / "set", other_scene)
    ended = faintfield("reconstruct", folder, "--depth-mm", "auto", "--out", tmp_path / "out")
    assert ended.returncode == 1
    assert re.search(r"NothingInFocus: .* no better than shuffled ones \(p = [0-9.]+ of 499 shuffles", ended.stderr)
    assert not (tmp_path / "out" / "reconstruction.json").exists()


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
            electrons = 200 * 64 * np.stack([_small_scene(random, (width, height)) for _ in electrons])
        meaningless = BinnedViews(
            elemental_set, [(layout, replace(images, electrons=electrons.astype(np.float32)))], views.bins_px
        )
        with contextlib.suppress(NothingInFocus):
            accepted += check_places(meaningless, range_mm) is not None
    assert accepted <= 2  # 0.2 are expected; more than two in one of 900 such tests


def _small_scene(random: np.random.Generator, size_px: tuple[int, int]) -> NDArray[np.floating]:
    """Return a picture of an own wall and cards."""
    return light_field(CARDS, (1, 1), size_px, seed=int(random.integers(2**40)))[0, 0]


def test_shuffles_differ_and_are_complete() -> None:
    for count, shuffles in ((3, 4), (4, 22), (5, 118), (6, 499), (25, 499)):
        orders = {tuple(places.tolist()) for places in _shuffles(count)}
        assert len(orders) == len(_shuffles(count)) == shuffles
        assert not orders & {tuple(range(count)), tuple(range(count))[::-1]}
        assert all(sorted(places) == list(range(count)) for places in orders)


def test_blind_views_do_not_hide_others(scene: Path, tmp_path: Path) -> None:
    _reordered(scene, tmp_path / "set", lambda row, column: (row, column))
    settings = tomllib.loads((tmp_path / "set" / "elemental.toml").read_text())
    settings["noise"]["saturation_dn"] = 65535.0
    cv2.imwrite(str(tmp_path / "set" / settings["view"][3]["image"]), np.full(SIZE_PX[::-1], 65535, np.uint16))
    settings["view"][5]["rt_cam_ref"] = [0.0, 3.0, 0.0, 50.0, 50.0, 0.0]  # looks backwards
    (tmp_path / "set" / "elemental.toml").write_text(tomli_w.dumps(settings))
    assert best_focus(load_set(tmp_path / "set"), tmp_path).p_value == 0.002


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
