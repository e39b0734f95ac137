"""Other people's light fields: one scene in many conventions becomes one set, or is refused by name."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, load_set
from tests.calib.light_fields import CARDS
from tests.end_to_end.light_field_files import HCI_FX_PX, HCI_PITCH_MM, Variant, views_of
from tests.end_to_end.light_field_variants import CORPUS, REFUSED

pytestmark = pytest.mark.deep  # tests/calib and tests/pipelines try a few quickly

# True disparities of the scene as rendered, and what the range that is found may be wider, which planes need not be.
LEAST_PX, LARGEST_PX, WIDER_PX, NARROWER_PX = -3.8, -1.0, 0.7, 0.1


def _import(variant: Variant, folder: Path) -> int:
    return run(["import", "grid", str(variant.source(folder / "src")), str(folder / "set"), *variant.options])


def _shown(elemental_set: ElementalSet) -> dict[tuple[int, int], NDArray[np.float64]]:
    """Return the grey pictures by node."""
    pictures = {}
    for view, path in zip(elemental_set.settings.view, elemental_set.image_paths, strict=True):
        assert view.node is not None
        pixels = read_frame(path).pixels_dn.astype(np.float64)
        pictures[view.node] = pixels.mean(axis=2) if pixels.ndim == 3 else pixels
    return pictures


def _assert_as_rendered(elemental_set: ElementalSet, variant: Variant) -> None:
    """Each node has the picture that was rendered for it, at its place among the cameras."""
    views = views_of(variant.aligned_px, variant.square)
    kept = sorted(node for node in views if variant.kept(*node))
    # Rows and columns count what is there: every second one is a grid of its own
    by_row, by_column = max(round(1 / variant.ratio), 1), max(round(variant.ratio), 1)
    names = {(row, column): (row // by_row, column // by_column) for row, column in kept}
    shown = _shown(elemental_set)
    assert sorted(shown) == sorted(names.values())
    for node in kept:
        picture = shown[names[node]].ravel()
        alike = [np.corrcoef(picture, view.ravel())[0, 1] for view in views.values()]
        assert list(views)[int(np.argmax(alike))] == node, f"{node} shows another view"
        assert max(alike) > 0.97
    # Cameras move right with columns and down with rows, in the ratio of pitches
    nodes = np.array([view.node for view in elemental_set.settings.view], float)
    away = nodes - nodes[elemental_set.reference_view]
    moved_mm = -elemental_set.poses_rt_cam_ref[:, 3:5]
    pitch_mm = np.abs(moved_mm[away[:, 0] != 0, 1] / away[away[:, 0] != 0, 0]).mean()
    np.testing.assert_allclose(moved_mm[:, 0], variant.ratio * pitch_mm * away[:, 1], atol=0.15 * pitch_mm, rtol=0.04)
    np.testing.assert_allclose(moved_mm[:, 1], pitch_mm * away[:, 0], atol=0.02 * pitch_mm)


def _assert_range(elemental_set: ElementalSet, variant: Variant) -> None:
    """The range of disparities holds the true one, and little more; all depths are in front of the cameras."""
    arrangement = elemental_set.settings.arrangement
    assert arrangement is not None
    assert arrangement.disparity_range_px is not None
    # From column to column; every second one sees points move twice as far
    by_column = max(variant.ratio, 1.0)
    least_px, largest_px = (limit_px / by_column - variant.aligned_px for limit_px in arrangement.disparity_range_px)
    assert LEAST_PX - WIDER_PX < least_px < LEAST_PX + NARROWER_PX
    assert LARGEST_PX - NARROWER_PX < largest_px < LARGEST_PX + WIDER_PX
    moved_px = (by_column * (disparity_px + variant.aligned_px) for disparity_px in (LEAST_PX, -2.0, LARGEST_PX))
    depths = [elemental_set.depth_of_disparity(disparity_px) for disparity_px in moved_px]
    assert 0 < depths[0] < depths[1] < depths[2]
    if elemental_set.settings.units.depth == "mm":
        assert variant.sidecars
        assert depths[1] == pytest.approx(HCI_FX_PX * HCI_PITCH_MM / 2.0, rel=1e-6)


@pytest.mark.parametrize("name", CORPUS)
def test_scene_is_imported_from_any_convention(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    variant = CORPUS[name]
    code = _import(variant, tmp_path)
    complaint = capfd.readouterr().err
    assert code == 0, complaint
    elemental_set = load_set(tmp_path / "set")
    assert elemental_set.settings.arrangement is not None
    assert elemental_set.settings.arrangement.told_by in ("pictures", "signs")
    assert variant.words in complaint
    _assert_as_rendered(elemental_set, variant)
    _assert_range(elemental_set, variant)


@pytest.mark.parametrize("name", REFUSED)
def test_pictures_without_order_are_refused(name: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    failure, variant = REFUSED[name]
    code = _import(variant, tmp_path)
    complaint = capfd.readouterr().err
    assert code == 1, complaint
    assert f"faintfield: {failure}: " in complaint
    assert not (tmp_path / "set").exists()


# Planes of these are looked for, too: orders and files with disparities of both signs.
WITH_PLANES = (
    "as documented",
    "aligned by 1 px, numbers turned: rows columns",
    "aligned by 4 px, numbers turned: transposed rows",
    "HCI, both reversed: True",
    "every second column",
    "exposures that differ",
)


def _in_focus_px(elemental_set: ElementalSet, best: dict[str, Any]) -> NDArray[np.float64]:
    """Return the disparities of planes of best focus, which are stated in the unit of the set."""
    if "disparity_px" in best:
        return np.array(best["disparity_px"])
    return np.array([elemental_set.disparity_of_depth(depth_mm) for depth_mm in best["depth_mm"]])


@pytest.mark.parametrize("name", WITH_PLANES)
def test_planes_of_best_focus_lie_at_cards(name: str, tmp_path: Path) -> None:
    """Each plane is at a card's disparity."""
    variant = CORPUS[name]
    assert _import(variant, tmp_path) == 0
    asked = ("--depth-mm", "auto", "--method", "backprojection")
    assert run(["reconstruct", str(tmp_path / "set"), "--out", str(tmp_path / "planes"), *asked]) == 0
    elemental_set = load_set(tmp_path / "set")
    record = json.loads((tmp_path / "planes" / "reconstruction.json").read_text())
    focus_px = _in_focus_px(elemental_set, record["best_focus"]) / max(variant.ratio, 1.0) - variant.aligned_px
    true_px = np.array([card.disparity_px for card in CARDS])
    away_px = np.abs(focus_px[:, np.newaxis] - true_px)
    assert away_px.min(axis=1).max() < 0.3
    # The wall, and the first two of the cards; others, close to one another, may share a plane
    assert away_px.min(axis=0)[:3].max() < 0.3
