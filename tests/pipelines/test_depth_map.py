"""Depth maps, all-in-focus pictures and planes of best focus, of simulated scenes whose truth is known."""

import json
import shutil
import subprocess
import sys
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
from faintfield.pipelines.reconstruction import surface_depths
from faintfield.pipelines.reconstruction.autofocus import searched_range_mm
from faintfield.pipelines.reconstruction.comparison import binned_views
from faintfield.recon.depth.focus import SURE
from tests.pipelines.conftest import Command, Edit, SetMaker

SWEEP = ("--sweep-mm", "400:900:26", "--method", "backprojection", "--depth-map")
SMALL = ("--size-px", 160, 120, "--rows", 5, "--columns", 5)
MAPS = ("depth_mm.tiff", "depth_confidence.tiff", "all_in_focus.tiff")


def _run(*words: object) -> None:
    assert run([str(word) for word in words]) == 0


def _record(folder: Path) -> dict[str, Any]:
    content: dict[str, Any] = json.loads((folder / "reconstruction.json").read_text())
    return content


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


def test_all_in_focus_is_of_each_objects_own_plane(swept: Path, scene: Path) -> None:
    picture = read_frame(swept / "all_in_focus.tiff").pixels_dn
    depth_mm = read_frame(swept / "depth_mm.tiff").pixels_dn
    for at_mm in (500, 700):
        plane = read_frame(swept / f"plane_{at_mm:07.1f}.tiff").pixels_dn
        there = np.abs(depth_mm - at_mm) < 3
        assert there.sum() > 300
        unlike = np.sqrt(np.mean((picture - plane)[there] ** 2))
        assert unlike < 0.25 * np.std(plane[there])


def test_what_lies_beyond_the_sweep_is_not_known(scene: Path, tmp_path: Path, done: Command) -> None:
    done("reconstruct", scene, "--out", tmp_path, "--sweep-mm", "600:900:5", *SWEEP[2:])
    depth_mm = read_frame(tmp_path / "depth_mm.tiff").pixels_dn
    truth = read_truth(scene)
    assert truth is not None
    shares = {
        plane.depth_mm: np.isfinite(depth_mm[texture_and_region(scene, plane)[1]]).mean() for plane in truth.planes
    }
    assert shares[500.0] < 0.02
    assert shares[700.0] > 0.5


def test_slanted_and_curved_surfaces_have_no_stairs(tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "set", "--objects", "surfaces", "--snr", 2, *SMALL)
    done("reconstruct", tmp_path / "set", "--out", tmp_path, "--sweep-mm", "400:1400:8", *SWEEP[2:])
    depth_mm = read_frame(tmp_path / "depth_mm.tiff").pixels_dn
    true_mm = read_frame(tmp_path / "set" / "truth" / "true_depth_mm.tiff").pixels_dn
    sure = np.isfinite(depth_mm)
    assert sure.mean() > 0.05
    # Neighbouring planes of the sweep are farther apart than 4 %: depths at the nearest plane would mostly be wrong
    assert (np.abs(depth_mm[sure] / true_mm[sure] - 1) < 0.02).mean() > 0.9


def test_the_maps_are_recorded_and_on_the_page(swept: Path) -> None:
    found = _record(swept)["depth_map"]
    assert (found["unit"], found["file"]) == ("mm", "depth_mm.tiff")
    assert 0.02 < found["sure_share"] < 0.5
    assert 480 < found["median"] < 720
    page = (swept / "report.html").read_text()
    assert 'id="depth-map"' in page
    assert "Hatched where it is not known" in page


def test_maps_that_are_there_stay_and_others_are_made_anew(scene: Path, swept: Path, done: Command) -> None:
    before = {name: (swept / name).stat().st_mtime_ns for name in MAPS}
    ended = done("reconstruct", scene, "--out", swept, *SWEEP)
    assert "26 of 26 planes are there" in ended.stderr
    assert {name: (swept / name).stat().st_mtime_ns for name in MAPS} == before
    kept = (swept / MAPS[0]).read_bytes()
    (swept / MAPS[0]).write_bytes(b"not a map")
    done("reconstruct", scene, "--out", swept, *SWEEP)
    assert (swept / MAPS[0]).read_bytes() == kept


def test_a_map_does_not_make_the_planes_of_a_sweep_anew(scene: Path, tmp_path: Path, done: Command) -> None:
    few = ("--sweep-mm", "450:750:5", "--method", "backprojection")
    done("reconstruct", scene, "--out", tmp_path, *few)
    ended = done("reconstruct", scene, "--out", tmp_path, *few, "--depth-map")
    assert "5 of 5 planes are there" in ended.stderr


def test_disparities_and_colours_are_kept(tmp_path: Path, done: Command) -> None:
    done("simulate", tmp_path / "bayer", "--colour", "bayer", "--snr", 5, *SMALL)
    out = tmp_path / "out"
    # 50 mm from node to node, 200 px of focal length
    options = ("--sweep-px", "-23:-12:6", "--method", "backprojection", "--depth-map")
    done("reconstruct", tmp_path / "bayer", "--out", out, *options)
    assert read_frame(out / "all_in_focus.tiff").pixels_dn.shape == (120, 160, 3)
    disparity_px = read_frame(out / "disparity_px.tiff").pixels_dn
    known = np.isfinite(disparity_px)
    assert known.any()
    assert -23 <= disparity_px[known].min() < disparity_px[known].max() <= -12
    assert _record(out)["depth_map"]["unit"] == "px"


def test_the_objects_depths_are_found(scene: Path, tmp_path: Path, done: Command) -> None:
    done("reconstruct", scene, "--out", tmp_path, "--depth-mm", "auto", "--method", "backprojection")
    found = _record(tmp_path)
    np.testing.assert_allclose([plane["depth_mm"] for plane in found["planes"]], [500, 700], rtol=0.01)
    assert found["options"]["depth_mm"] == found["best_focus"]["depth_mm"]


def test_a_sweep_says_between_which_depths_to_look(scene: Path, tmp_path: Path, done: Command) -> None:
    options = ("--depth-mm", "auto", "--sweep-mm", "600:900:5", "--method", "backprojection")
    done("reconstruct", scene, "--out", tmp_path, *options)
    found = _record(tmp_path)
    np.testing.assert_allclose(found["best_focus"]["searched_mm"][0], [600, 900])
    depths = [plane["depth_mm"] for plane in found["planes"]]
    assert min(abs(depth / 700 - 1) for depth in depths) < 0.01
    assert found["focus"] is None


def test_the_range_that_is_searched_is_where_the_views_overlap(scene: Path) -> None:
    loaded = load_set(scene)
    near_mm, far_mm = searched_range_mm(loaded)
    camera = loaded.settings.camera
    width, height = camera.size_px
    moved_px = np.abs(loaded.poses_rt_cam_ref[:, 3:5]) * camera.fx_px / near_mm
    shared = np.prod(np.maximum(1 - moved_px / [width, height], 0), axis=1).mean()
    assert 0.2 < shared < 0.32  # a quarter, by the grid of points that is counted
    assert far_mm > 1000 * near_mm  # infinity is in view


def test_noise_has_no_planes_and_that_is_said(make_set: SetMaker, tmp_path: Path, faintfield: Command) -> None:
    generator = np.random.default_rng(5)
    dark = [generator.normal(100, 6, (48, 64)).round().astype(np.uint16) for _ in range(6)]
    ended = faintfield("reconstruct", make_set(dark), "--out", tmp_path / "out", "--depth-mm", "auto")
    assert ended.returncode == 1
    assert "the views agree no better than shuffled ones (p = " in ended.stderr
    assert "or make planes at depths given by --depth" in ended.stderr
    assert not (tmp_path / "out" / "reconstruction.json").exists()


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--depth-mm", 500, "--depth-map"), "--depth-map compares depths, and 1 are given"),
        (("--depth-mm", "auto", "--depth-mm", 500), "--depth-mm auto finds all depths"),
        (("--depth-mm", "auto", "--disparity-px", -3), "--depth-mm auto finds all depths"),
        (("--sweep-px", "1:1:5"), "--sweep-px 1:1:5: is no sweep; give two different ends"),
    ],
)
def test_what_does_not_fit_together_is_refused(
    words: tuple[object, ...], said: str, scene: Path, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("reconstruct", scene, "--out", tmp_path / "out", *words)
    assert ended.returncode == 2
    assert said in ended.stderr
    assert not (tmp_path / "out").exists()


def _middle_row(settings: dict[str, Any]) -> None:
    settings["view"] = settings["view"][3:6]
    settings["reference_view"] = 1


def _all_at_once(settings: dict[str, Any]) -> None:
    for view in settings["view"]:
        view["rt_cam_ref"] = [0.0] * 6


@pytest.mark.parametrize(
    ("change", "sweep_mm", "said"),
    [
        (_middle_row, "400:900:5", "has 3 views, and a depth map needs at least 4; capture more nodes"),
        (_all_at_once, "400:900:5", "NothingInFocus: {set}: all views were taken from one place"),
        (None, "5:20:5", "GeometryMismatch: between 5 and 20 mm the other views see 0%"),
    ],
)
def test_sets_and_sweeps_that_tell_no_depths_are_refused_before_their_planes_are_made(
    change: Callable[[dict[str, Any]], None] | None,
    sweep_mm: str,
    said: str,
    simulated_scene: Path,
    edit: Edit,
    tmp_path: Path,
    faintfield: Command,
) -> None:
    folder = Path(shutil.copytree(simulated_scene, tmp_path / "set"))
    if change is not None:
        edit(folder, change)
    options = ("--sweep-mm", sweep_mm, "--method", "backprojection")
    ended = faintfield("reconstruct", folder, "--out", tmp_path / "out", *options, "--depth-map")
    assert ended.returncode == 1
    assert said.format(set=folder) in ended.stderr
    assert not (tmp_path / "out").exists()


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


SURFACE, IN_RANGE = ("--surface",), ("--surface", "--depth-range-mm", "400:900")
MAP = ("--sweep-mm", "400:900:5", "--depth-map")


@pytest.mark.parametrize(
    ("words", "change", "few"),
    [
        pytest.param(SURFACE, _copied, False, marks=pytest.mark.slow),
        (IN_RANGE, _copied, False),
        (IN_RANGE, _copied, True),
        (IN_RANGE, _shuffled, False),
        (MAP, _copied, False),
        (MAP, _shuffled, False),
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
    if len(words) > 1:  # else the search for the range may find nothing before
        assert f"{folder}: the views agree no better than shuffled ones (p = " in ended.stderr
    assert not list((tmp_path / "out").glob("*.tiff"))


def test_a_depth_map_that_is_there_is_not_tested_again(
    scene: Path, swept: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def tested(*_: object) -> None:
        raise AssertionError

    monkeypatch.setattr(surface_depths, "check_agreement", tested)
    _run("reconstruct", scene, "--out", swept, *SWEEP)


def test_planes_load_nothing_of_surfaces(simulated_scene: Path, tmp_path: Path) -> None:
    words = ["reconstruct", simulated_scene, "--out", tmp_path, "--sweep-mm", "400:900:5", "--method", "backprojection"]
    loaded = (
        f"import sys; from faintfield.pipelines.cli import run; assert run({[str(word) for word in words]!r}) == 0; "
        "print(*(name for name in sys.modules if name.startswith('faintfield.recon.surface')))"
    )
    said = subprocess.run([sys.executable, "-c", loaded], capture_output=True, text=True, check=True).stdout
    assert said.splitlines()[-1] == ""


def test_the_pieces_of_a_photographed_chess_board_stand_in_their_order(
    real_data: Path, tmp_path: Path, done: Command
) -> None:
    for row, column in np.ndindex(3, 3):  # each third of the views, around the one in the middle
        name = f"view_r{3 * row + 1}_c{3 * column + 1}.jpg"
        shutil.copy(real_data / "lightfield-chess" / name, tmp_path / f"view_r{row}_c{column}.jpg")
    done("import", "grid", tmp_path, tmp_path / "chess", "--disparity-px", 12)
    loaded = load_set(tmp_path / "chess")
    disparities_px = np.linspace(-12, 3.6, 27)
    depths_mm = [loaded.depth_of_disparity(d) for d in disparities_px.tolist()]
    compared = binned_views(loaded, depths_mm[13], tmp_path).compared(depths_mm)
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


def test_planes_of_one_pitch_make_one_picture(scene: Path, swept: Path, tmp_path: Path) -> None:
    _run("reconstruct", scene, "--out", tmp_path, *SWEEP, "--pitch-mm", 2)
    own, usual = (read_frame(folder / "all_in_focus.tiff").pixels_dn for folder in (tmp_path, swept))
    farthest = read_frame(tmp_path / "plane_00900.0.tiff").pixels_dn
    assert own.shape == farthest.shape != usual.shape
    same = cv2.resize(own, usual.shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.corrcoef(same.ravel(), usual.ravel())[0, 1] > 0.9


def test_bins_are_as_large_as_asked(scene: Path, tmp_path: Path) -> None:
    loaded = load_set(scene)
    larger_px = 2 * binned_views(loaded, 700.0, tmp_path).bins_px
    views = binned_views(loaded, 700.0, tmp_path, min_bins_px=larger_px)
    assert views.bins_px == larger_px
    compared = views.compared([500.0, 700.0])
    assert [plane.light.shape for plane in compared.planes] == [tuple(side // larger_px for side in (120, 160))] * 2


def test_depths_that_are_the_same_count_once(scene: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    words = [word for _ in range(6) for word in ("--depth-mm", "500")]
    assert run(["reconstruct", str(scene), "--out", str(tmp_path), *words, "--depth-map"]) == 2
    assert "1 are given; give at least 5" in " ".join(capsys.readouterr().err.split())
