"""Depth maps, all-in-focus pictures and planes of best focus, of simulated scenes whose truth is known."""

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import read_truth, texture_and_region
from faintfield.pipelines.reconstruction.autofocus import searched_range_mm
from faintfield.pipelines.reconstruction.comparison import binned_views
from faintfield.recon.depth.focus import SURE
from faintfield.recon.surface import confidence
from tests.pipelines.conftest import Command, Edit, drawing_nothing
from tests.pipelines.forms import read_record
from tests.pipelines.surfaces import FOUND_CONFIDENCE, Searches

pytestmark = pytest.mark.usefixtures("undrawn")

SWEEP = ("--sweep-mm", "400:900:11", "--method", "backprojection", "--depth-map")
SMALL = ("--size-px", 160, 120, "--rows", 5, "--columns", 5)
MAPS = ("depth_mm.tiff", "depth_confidence.tiff", "all_in_focus.tiff")


def _run(*words: object) -> None:
    with drawing_nothing():
        assert run([str(word) for word in words]) == 0


@pytest.fixture(scope="module")
def scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("depth") / "scene"
    _run("simulate", folder, "--snr", 2, *SMALL)
    return folder


@pytest.fixture(scope="module")
def swept(scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("swept")
    _run("reconstruct", scene, "--out", out, *SWEEP)
    return out


def test_sure_depths_are_right_within_two_percent(swept: Path, scene: Path) -> None:
    depth_mm, confidence, _ = (read_frame(swept / name).pixels_dn for name in MAPS)
    assert np.array_equal(np.isfinite(depth_mm), confidence >= 0.9)
    truth = read_truth(scene)
    assert truth is not None
    anywhere = np.zeros(depth_mm.shape, bool)
    for plane in truth.planes:
        _, region = texture_and_region(scene, plane)
        sure = np.isfinite(depth_mm) & region
        assert sure.sum() > 0.5 * region.sum()
        assert np.median(np.abs(depth_mm[sure] / plane.depth_mm - 1)) <= 0.02
        anywhere |= region
    away = cv2.dilate(anywhere.astype(np.uint8), np.ones((17, 17))) == 0
    assert np.isfinite(depth_mm[away]).mean() < 0.02


def test_all_in_focus_shows_each_objects_own_plane(swept: Path, scene: Path) -> None:
    picture = read_frame(swept / "all_in_focus.tiff").pixels_dn
    depth_mm = read_frame(swept / "depth_mm.tiff").pixels_dn
    for at_mm in (500, 700):
        plane = read_frame(swept / f"plane_{at_mm:07.1f}.tiff").pixels_dn
        there = np.abs(depth_mm - at_mm) < 3
        assert there.sum() > 300
        unlike = np.sqrt(np.mean((picture - plane)[there] ** 2))
        assert unlike < 0.25 * np.std(plane[there])


def test_focus_marks_depths_of_objects(swept: Path) -> None:
    focus = read_record(swept)["focus"]
    np.testing.assert_allclose(focus["depth_mm"], np.linspace(400, 900, 11))
    assert len(focus["detail_e2"]) == len(focus["sigma_e2"]) == 11
    assert min(focus["sigma_e2"]) > 0
    np.testing.assert_allclose(focus["sharp_mm"], [500, 700], atol=25)  # half a step


def test_surfaces_have_no_stairs_and_end_with_sweep(tmp_path: Path, done: Command) -> None:
    grid = ("--size-px", 96, 72, "--rows", 5, "--columns", 5)
    done("simulate", tmp_path / "set", "--objects", "surfaces", "--snr", 2, *grid)
    done("reconstruct", tmp_path / "set", "--out", tmp_path, "--sweep-mm", "400:700:5", *SWEEP[2:])
    depth_mm = read_frame(tmp_path / "depth_mm.tiff").pixels_dn
    true_mm = read_frame(tmp_path / "set" / "truth" / "true_depth_mm.tiff").pixels_dn
    sure = np.isfinite(depth_mm)
    assert sure[true_mm < 700].mean() > 0.05
    assert sure[true_mm > 770].mean() < 0.02
    # Neighbouring planes of the sweep are farther apart than 4 %: depths at the nearest plane would mostly be wrong
    assert (np.abs(depth_mm[sure] / true_mm[sure] - 1) < 0.02).mean() > 0.9


def test_maps_are_recorded_and_on_page(swept: Path) -> None:
    found = read_record(swept)["depth_map"]
    assert (found["unit"], found["file"]) == ("mm", "depth_mm.tiff")
    assert 0.02 < found["sure_share"] < 0.5
    assert 480 < found["median"] < 720
    page = (swept / "report.html").read_text()
    assert 'id="depth-map"' in page
    assert "Hatched where it is not known" in page


def test_only_damaged_maps_are_made_again(seen: Searches, simulated_scene: Path, tmp_path: Path, done: Command) -> None:
    call = ("reconstruct", simulated_scene, "--out", tmp_path, "--sweep-mm", "400:900:5", *SWEEP[2:])
    done(*call)
    before = {name: (tmp_path / name).stat().st_mtime_ns for name in MAPS}
    assert "5 of 5 planes are there" in done(*call).stderr
    assert {name: (tmp_path / name).stat().st_mtime_ns for name in MAPS} == before
    kept = (tmp_path / MAPS[0]).read_bytes()
    (tmp_path / MAPS[0]).write_bytes(b"not a map")
    done(*call)
    assert (tmp_path / MAPS[0]).read_bytes() == kept


def test_disparities_and_colours_are_kept(
    seen: Searches, tmp_path: Path, done: Command, small_options: tuple[object, ...], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(confidence, "SURE", 0.9 * FOUND_CONFIDENCE)
    done("simulate", tmp_path / "bayer", "--colour", "bayer", "--snr", 5, *small_options)
    out = tmp_path / "out"
    done("reconstruct", tmp_path / "bayer", "--out", out, "--sweep-px", "-14:-7:5", *SWEEP[2:])
    assert read_frame(out / "all_in_focus.tiff").pixels_dn.shape == (72, 96, 3)
    # 600 mm; nodes are 50 mm apart, and the focal length is 120 px
    np.testing.assert_allclose(read_frame(out / "disparity_px.tiff").pixels_dn, -10, rtol=0.03)
    assert read_record(out)["depth_map"]["unit"] == "px"


def test_range_that_is_searched_is_where_views_overlap(scene: Path) -> None:
    elemental_set = load_set(scene)
    near_mm, far_mm = searched_range_mm(elemental_set)
    camera = elemental_set.settings.camera
    width, height = camera.size_px
    moved_px = np.abs(elemental_set.poses_rt_cam_ref[:, 3:5]) * camera.fx_px / near_mm
    shared = np.prod(np.maximum(1 - moved_px / [width, height], 0), axis=1).mean()
    assert 0.2 < shared < 0.32  # a quarter, by the grid of points that is counted
    assert far_mm > 1000 * near_mm  # infinity is in view


def _copied(folder: Path) -> None:
    """Give each view the picture of the first."""
    first, *others = sorted(folder.glob("view_*.tiff"))
    for path in others:
        shutil.copyfile(first, path)


def _shuffled(folder: Path) -> None:
    """Give each view the picture of another."""
    paths = sorted(folder.glob("view_*.tiff"))
    pictures = [path.read_bytes() for path in paths]
    for path, index in zip(paths, np.random.default_rng(3).permutation(len(paths)), strict=True):
        path.write_bytes(pictures[index])


def _four(settings: dict[str, Any]) -> None:
    settings.update(view=[settings["view"][index] for index in (0, 1, 3, 4)], reference_view=3)


IN_RANGE = ("--surface", "--depth-range-mm", "400:900")
MAP = ("--sweep-mm", "400:900:5", "--depth-map")


@pytest.mark.parametrize(
    ("words", "change", "few"),
    [
        (IN_RANGE, _copied, True),
        (IN_RANGE, _shuffled, False),
        (MAP, _copied, False),
    ],
)
def test_views_that_show_no_depth_have_no_map(
    words: tuple[str, ...],
    change: Callable[[Path], None],
    few: bool,
    simulated_scene: Path,
    edit: Edit,
    tmp_path: Path,
    faintfield: Command,
) -> None:
    folder = Path(shutil.copytree(simulated_scene, tmp_path / "set"))
    change(folder)
    if few:
        edit(folder, _four)
    ended = faintfield("reconstruct", folder, "--out", tmp_path / "out", *words)
    assert ended.returncode == 1
    assert "faintfield: NothingInFocus: " in ended.stderr
    assert f"{folder}: the views agree no better than shuffled ones (p = " in ended.stderr
    assert not list((tmp_path / "out").glob("*.tiff"))


@pytest.mark.deep
def test_pieces_of_photographed_chess_board_stand_in_order(real_data: Path, tmp_path: Path, done: Command) -> None:
    for row, column in np.ndindex(3, 3):  # each third of the views, around the one in the middle
        name = f"view_r{3 * row + 1}_c{3 * column + 1}.jpg"
        shutil.copy(real_data / "lightfield-chess" / name, tmp_path / f"view_r{row}_c{column}.jpg")
    done("import", "grid", tmp_path, tmp_path / "chess", "--disparity-px", 12)
    elemental_set = load_set(tmp_path / "chess")
    disparities_px = np.linspace(-12, 3.6, 27)
    depths_mm = [elemental_set.depth_of_disparity(d) for d in disparities_px.tolist()]
    compared = binned_views(elemental_set, depths_mm[13], tmp_path).compared(depths_mm)
    found = compared.depth_map()
    disparity_px = np.interp(found.index, np.arange(27), disparities_px) / 3
    disparity_px[found.confidence < SURE] = np.nan
    silver = ((613, 320), (598, 240), (573, 135), (497, 65))
    black = ((222, 300), (238, 235), (388, 150), (328, 120), (288, 30))
    for pieces in (silver, black):
        places = [(row // compared.bins_px, column // compared.bins_px) for column, row in pieces]
        near_to_far = [np.nanmedian(disparity_px[r - 3 : r + 4, c - 3 : c + 4]) for r, c in places]
        assert np.diff(near_to_far).min() > 0.15
        # Of this set it is known that points move by −3.4 … +0.8 px
        assert near_to_far[0] == pytest.approx(-3.3, abs=0.2)
        assert -0.2 < near_to_far[-1] < 0.9


def test_planes_of_one_pitch_make_one_picture(
    seen: Searches, simulated_scene: Path, tmp_path: Path, done: Command
) -> None:
    call = ("reconstruct", simulated_scene, "--sweep-mm", "400:900:5", *SWEEP[2:], "--out")
    done(*call, tmp_path / "own", "--pitch-mm", 3)
    done(*call, tmp_path / "usual")
    own, usual = (read_frame(tmp_path / name / "all_in_focus.tiff").pixels_dn for name in ("own", "usual"))
    farthest = read_frame(tmp_path / "own" / "plane_00900.0.tiff").pixels_dn
    assert own.shape == farthest.shape != usual.shape
    same = cv2.resize(own, usual.shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.corrcoef(same.ravel(), usual.ravel())[0, 1] > 0.9
