"""Other people's light fields: one scene in many conventions becomes one set, or is refused by name."""

import json
import os
from collections.abc import Collection, Iterable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from faintfield.pipelines.reconstruction.autofocus import best_focus
from tests.calib.light_fields import CARDS
from tests.end_to_end.light_field_files import HCI_FX_PX, HCI_PITCH_MM, Names, Scene, Variant, rendered
from tests.end_to_end.light_field_variants import CORPUS, REFUSED

# True disparities of the scene as rendered, and what the range that is found may be wider, which planes need not be.
LEAST_PX, LARGEST_PX, WIDER_PX, NARROWER_PX = -3.8, -1.0, 0.7, 0.1


@pytest.fixture(scope="session")
def scene() -> Scene:
    return rendered()


def _import(variant: Variant, scene: Scene, folder: Path) -> int:
    return run(["import", "grid", str(variant.source(scene, folder / "src")), str(folder / "set"), *variant.options])


def _shown(loaded: ElementalSet) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return the grey pictures by node."""
    found = {}
    for view, path in zip(loaded.settings.view, loaded.image_paths, strict=True):
        assert view.node is not None
        pixels = read_frame(path).pixels_dn.astype(np.float64)
        found[view.node] = pixels.mean(axis=2) if pixels.ndim == 3 else pixels
    return found


def _alike(one: Any, others: Any) -> NDArray[np.float64]:
    """Return the correlation of a picture with each of others."""
    return np.array([np.corrcoef(one.ravel(), other.ravel())[0, 1] for other in others])


def _assert_as_rendered(loaded: ElementalSet, variant: Variant, scene: Scene) -> None:
    """Each node has the picture that was rendered for it, at its place among the cameras."""
    views = scene.views(variant.aligned_px, variant.square)
    kept = sorted(node for node in views if variant.kept(*node))
    # Rows and columns count what is there: every second one is a grid of its own
    by_row, by_column = max(round(1 / variant.ratio), 1), max(round(variant.ratio), 1)
    names = {(row, column): (row // by_row, column // by_column) for row, column in kept}
    shown = _shown(loaded)
    assert sorted(shown) == sorted(names.values())
    for node in kept:
        alike = _alike(shown[names[node]], views.values())
        assert list(views)[int(np.argmax(alike))] == node, f"{node} shows another view"
        assert alike.max() > 0.97
    _assert_cameras(loaded, variant)


def _assert_cameras(loaded: ElementalSet, variant: Variant) -> None:
    """Cameras move right with columns and down with rows, in the ratio of pitches."""
    nodes = np.array([view.node for view in loaded.settings.view], float)
    away = nodes - nodes[loaded.reference_view]
    moved_mm = -loaded.poses_rt_cam_ref[:, 3:5]
    pitch_mm = np.abs(moved_mm[away[:, 0] != 0, 1] / away[away[:, 0] != 0, 0]).mean()
    np.testing.assert_allclose(moved_mm[:, 0], variant.ratio * pitch_mm * away[:, 1], atol=0.15 * pitch_mm, rtol=0.04)
    np.testing.assert_allclose(moved_mm[:, 1], pitch_mm * away[:, 0], atol=0.02 * pitch_mm)


def _assert_range(loaded: ElementalSet, variant: Variant) -> None:
    """The range of disparities holds the true one, and little more; all depths are in front of the cameras."""
    found = loaded.settings.arrangement
    assert found is not None
    assert found.disparity_range_px is not None
    # From column to column; every second one sees points move twice as far
    by_column = max(variant.ratio, 1.0)
    least_px, largest_px = (it / by_column - variant.aligned_px for it in found.disparity_range_px)
    assert LEAST_PX - WIDER_PX < least_px < LEAST_PX + NARROWER_PX
    assert LARGEST_PX - NARROWER_PX < largest_px < LARGEST_PX + WIDER_PX
    depths = [loaded.depth_of_disparity(by_column * (it + variant.aligned_px)) for it in (LEAST_PX, -2.0, LARGEST_PX)]
    assert 0 < depths[0] < depths[1] < depths[2]
    if loaded.settings.units.depth == "mm":
        assert variant.beside
        assert depths[1] == pytest.approx(HCI_FX_PX * HCI_PITCH_MM / 2.0, rel=1e-6)


# Run always; each stands for a kind of its own.
QUICK = (
    "aligned middle, numbers turned: transposed rows",
    "HCI, both reversed",
    "every second column",
)
QUICK_REFUSED = ("shuffled",)


def _each(names: Iterable[str], quick: Collection[str]) -> list[Any]:
    """Return names as parameters, marked as deep but for the quick ones."""
    return [name if name in quick else pytest.param(name, marks=pytest.mark.deep) for name in names]


@pytest.mark.parametrize("name", _each(CORPUS, QUICK))
def test_scene_is_imported_from_any_convention(
    name: str, scene: Scene, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    variant = CORPUS[name]
    code = _import(variant, scene, tmp_path)
    said = capfd.readouterr().err
    assert code == 0, said
    loaded = load_set(tmp_path / "set")
    assert loaded.settings.arrangement is not None
    assert loaded.settings.arrangement.told_by in ("pictures", "signs")
    assert variant.said in said
    _assert_as_rendered(loaded, variant, scene)
    _assert_range(loaded, variant)


@pytest.mark.parametrize("name", _each(REFUSED, QUICK_REFUSED))
def test_pictures_without_order_are_refused(
    name: str, scene: Scene, tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    failure, variant = REFUSED[name]
    code = _import(variant, scene, tmp_path)
    said = capfd.readouterr().err
    assert code == 1, said
    assert f"faintfield: {failure}: " in said
    assert not (tmp_path / "set").exists()


# Planes of these are looked for, too: orders and files with disparities of both signs.
WITH_PLANES = (
    "as documented",
    "aligned far, numbers turned: rows columns",
    "aligned near, numbers turned: transposed rows",
    "HCI, both reversed",
    "back and forth by row",
    "every second column",
    "exposures that differ",
)


def _in_focus_px(loaded: ElementalSet, best: dict[str, Any]) -> NDArray[np.float64]:
    """Return the disparities of planes of best focus, which are stated in the unit of the set."""
    if "disparity_px" in best:
        return np.array(best["disparity_px"])
    return np.array([loaded.disparity_of_depth(it) for it in best["depth_mm"]])


@pytest.mark.deep
@pytest.mark.parametrize("name", WITH_PLANES)
def test_planes_of_best_focus_lie_at_cards(name: str, scene: Scene, tmp_path: Path) -> None:
    """Each plane is at a card's disparity."""
    variant = CORPUS[name]
    assert _import(variant, scene, tmp_path) == 0
    asked = ("--depth-mm", "auto", "--method", "backprojection")
    assert run(["reconstruct", str(tmp_path / "set"), "--out", str(tmp_path / "planes"), *asked]) == 0
    loaded = load_set(tmp_path / "set")
    record = json.loads((tmp_path / "planes" / "reconstruction.json").read_text())
    found_px = _in_focus_px(loaded, record["best_focus"]) / max(variant.ratio, 1.0) - variant.aligned_px
    true_px = np.array([card.disparity_px for card in CARDS])
    away_px = np.abs(found_px[:, np.newaxis] - true_px)
    assert away_px.min(axis=1).max() < 0.3
    # The wall, and the first two of the cards; others, close to one another, may share a plane
    assert away_px.min(axis=0)[:3].max() < 0.3


# Names, and by how many px points move more from node to node than in the archive.
CHESS = {
    "as in the archive": (Names(), 0),
    "columns reversed": (Names(flip_columns=True), 0),
    "transposed": (Names(transpose=True), 0),
    "aligned elsewhere": (Names(), 3),
}


@pytest.mark.deep
def test_planes_are_independent_of_names_and_alignment(tmp_path: Path) -> None:
    """A part of the middle 5 x 5 of the chess photographs; another part of each view aligns them elsewhere."""
    place = os.environ.get("FAINTFIELD_DATA")
    if not place:
        pytest.skip("FAINTFIELD_DATA does not name the folder of real data")
    found_px = {}
    for number, (what, (names, moved_px)) in enumerate(CHESS.items()):
        folder = tmp_path / str(number)
        folder.mkdir()
        for row, column in np.ndindex(5, 5):
            picture = cv2.imread(str(Path(place) / "lightfield-chess" / f"view_r{row + 2}_c{column + 2}.jpg"))
            assert picture is not None
            top, left = (first - moved_px * (it - 2) for first, it in ((120, row), (240, column)))
            part = picture[top : top + 240, left : left + 360]
            assert cv2.imwrite(str(folder / f"{names.stem((row, column), (5, 5))}.png"), part)
        assert run(["import", "grid", str(folder), str(folder / "set")]) == 0
        loaded = load_set(folder / "set")
        assert loaded.settings.arrangement is not None
        assert loaded.settings.arrangement.told_by == "pictures"
        depths = best_focus(loaded, tmp_path).depth_mm
        found_px[what] = np.array([loaded.disparity_of_depth(it) for it in depths]) - moved_px
    archive_px = found_px.pop("as in the archive")
    assert len(archive_px) >= 2
    for what, others_px in found_px.items():
        apart_px = np.abs(archive_px[:, np.newaxis] - others_px)
        assert apart_px.min(axis=1).max() < 0.2, (what, archive_px, others_px)
