"""Depth maps, their errors, all-in-focus pictures and planes of best focus, of scenes whose truth is known."""

import json
import shutil
from collections.abc import Callable, Sequence
from pathlib import Path

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.pipelines.errors import InputError
from faintfield.pipelines.formats.files import write_json
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import ONE_PIXEL, write_plane
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.ground_truth import (
    TRUE_DEPTH_FILE,
    TrueDepth,
    read_true_depth_mm,
    read_truth,
    texture_and_region,
)
from faintfield.pipelines.reconstruction.accuracy import write_depth_errors
from faintfield.pipelines.reconstruction.depth.autofocus import searched_range_mm
from faintfield.pipelines.reconstruction.depth.comparison import binned_views
from faintfield.pipelines.reconstruction.depth.depth_map import map_picture
from faintfield.recon.depth.agreement import depth_map
from faintfield.recon.depth.focus import SURE
from tests.pipelines.conftest import Command, Edit, SetMaker, assert_refused, run_undrawn
from tests.pipelines.forms import read_record
from tests.pipelines.surfaces import FOUND_CONFIDENCE, FOUND_MM, Searches

SWEEP = ("--sweep-mm", "400:900:11", "--method", "backprojection", "--depth-map")
MAPS = ("depth_mm.tiff", "depth_confidence.tiff", "all_in_focus.tiff")


@pytest.fixture(scope="module")
def large_scene(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("depth") / "scene"
    run_undrawn("simulate", folder, "--snr", 2, "--size-px", 128, 96, "--rows", 5, "--columns", 5)
    return folder


@pytest.fixture(scope="module")
def swept(large_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("swept")
    run_undrawn("reconstruct", large_scene, "--out", out, *SWEEP)
    return out


def test_sure_depths_and_all_in_focus_are_right(swept: Path, large_scene: Path) -> None:
    depth_mm, confidence, picture = (read_frame(swept / name).pixels_dn for name in MAPS)
    assert np.array_equal(np.isfinite(depth_mm), confidence >= 0.9)
    truth = read_truth(large_scene)
    assert truth is not None
    anywhere = np.zeros(depth_mm.shape, bool)
    for plane in truth.planes:
        _, region = texture_and_region(large_scene, plane)
        sure = np.isfinite(depth_mm) & region
        assert sure.sum() > 0.5 * region.sum()
        assert np.median(np.abs(depth_mm[sure] / plane.depth_mm - 1)) <= 0.02
        anywhere |= region
    away = cv2.dilate(anywhere.astype(np.uint8), np.ones((17, 17))) == 0
    assert np.isfinite(depth_mm[away]).mean() < 0.02
    for at_mm in (500, 700):
        pixels = read_frame(swept / f"plane_{at_mm:07.1f}.tiff").pixels_dn
        there = np.abs(depth_mm - at_mm) < 3
        assert there.sum() > 300
        assert np.sqrt(np.mean((picture - pixels)[there] ** 2)) < 0.25 * np.std(pixels[there])


def test_focus_and_map_are_recorded(swept: Path) -> None:
    focus = read_record(swept)["focus"]
    np.testing.assert_allclose(focus["depth_mm"], np.linspace(400, 900, 11))
    assert len(focus["detail_e2"]) == len(focus["sigma_e2"]) == 11
    assert min(focus["sigma_e2"]) > 0
    np.testing.assert_allclose(focus["sharp_mm"], [500, 700], atol=25)  # half a step
    depth_map = read_record(swept)["depth_map"]
    assert (depth_map["unit"], depth_map["file"]) == ("mm", "depth_mm.tiff")
    assert 0.02 < depth_map["sure_share"] < 0.5
    assert 480 < depth_map["median"] < 720
    assert 'id="depth-map"' in (swept / "report.html").read_text()


@pytest.mark.deep
def test_surfaces_have_no_stairs_and_end_with_sweep(tmp_path: Path, done: Command) -> None:
    # Smaller views are near edges and borders everywhere, and darker ones less clear: few of their depths are sure
    grid = ("--size-px", 240, 180, "--rows", 5, "--columns", 5)
    done("simulate", tmp_path / "set", "--objects", "surfaces", "--snr", 5, *grid)
    done("reconstruct", tmp_path / "set", "--out", tmp_path, "--sweep-mm", "400:700:5", *SWEEP[2:])
    depth_mm = read_frame(tmp_path / "depth_mm.tiff").pixels_dn
    true_mm = read_frame(tmp_path / "set" / "truth" / "true_depth_mm.tiff").pixels_dn
    sure = np.isfinite(depth_mm)
    assert sure[true_mm < 700].mean() > 0.1
    assert sure[true_mm > 770].mean() < 0.02
    # Neighbouring planes of the sweep are farther apart than 4 %: depths at the nearest plane would mostly be wrong
    assert (np.abs(depth_mm[sure] / true_mm[sure] - 1) < 0.02).mean() > 0.9


def test_only_damaged_maps_are_made_again(seen: Searches, simulated_scene: Path, tmp_path: Path, done: Command) -> None:
    """Planes of one pitch make one picture, too."""
    out, own = tmp_path / "out", tmp_path / "own"
    call = ("reconstruct", simulated_scene, "--sweep-mm", "400:900:5", *SWEEP[2:], "--out")
    done(*call, out)
    before = {name: (out / name).stat().st_mtime_ns for name in MAPS}
    assert "5 of 5 planes are there" in done(*call, out).stderr
    assert {name: (out / name).stat().st_mtime_ns for name in MAPS} == before
    kept = (out / MAPS[0]).read_bytes()
    (out / MAPS[0]).write_bytes(b"not a map")
    done(*call, out)
    assert (out / MAPS[0]).read_bytes() == kept
    done(*call, own, "--pitch-mm", 3)
    usual, picture = (read_frame(folder / "all_in_focus.tiff").pixels_dn for folder in (out, own))
    assert picture.shape == read_frame(own / "plane_00900.0.tiff").pixels_dn.shape != usual.shape
    same = cv2.resize(picture, usual.shape[::-1], interpolation=cv2.INTER_AREA)
    assert np.corrcoef(same.ravel(), usual.ravel())[0, 1] > 0.9


def test_disparities_and_colours_are_kept(
    seen: Searches, colour_set: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("faintfield.pipelines.reconstruction.depth.depth_map.SURE", 0.9 * FOUND_CONFIDENCE)
    out = tmp_path / "out"
    done("reconstruct", colour_set, "--out", out, "--sweep-px", "-9:-5:5", *SWEEP[2:])
    assert read_frame(out / "all_in_focus.tiff").pixels_dn.shape == (48, 64, 3)
    # 600 mm; nodes are 50 mm apart, and the focal length is 80 px
    np.testing.assert_allclose(read_frame(out / "disparity_px.tiff").pixels_dn, -80 * 50 / 600, rtol=0.03)
    assert read_record(out)["depth_map"]["unit"] == "px"


def test_range_that_is_searched_is_where_views_overlap(large_scene: Path) -> None:
    elemental_set = load_set(large_scene)
    near_mm, far_mm = searched_range_mm(elemental_set)
    camera = elemental_set.settings.camera
    width, height = camera.size_px
    moved_px = np.abs(elemental_set.poses_rt_cam_ref[:, 3:5]) * camera.fx_px / near_mm
    shared = np.prod(np.maximum(1 - moved_px / [width, height], 0), axis=1).mean()
    assert 0.2 < shared < 0.32  # a quarter, by the grid of points that is counted
    assert far_mm > 1000 * near_mm  # infinity is in view


def _copy(paths: list[Path]) -> None:
    """Give each view the picture of the first."""
    for path in paths[1:]:
        shutil.copyfile(paths[0], path)


def _shuffle(paths: list[Path]) -> None:
    """Give each view the picture of another."""
    pictures = [path.read_bytes() for path in paths]
    for path, index in zip(paths, np.random.default_rng(3).permutation(len(paths)), strict=True):
        path.write_bytes(pictures[index])


def test_colours_are_faint_where_map_is_not_sure(undrawn: pytest.MonkeyPatch) -> None:
    undrawn.undo()
    values, sure = np.ones((60, 80)), np.arange(80) < 40
    pictures = [map_picture(values, "depth (mm)", 0.0, 2.0, mask) for mask in (np.tile(sure, (60, 1)), None)]
    faint, opaque = (cv2.imdecode(np.frombuffer(picture, np.uint8), cv2.IMREAD_COLOR) for picture in pictures)
    assert faint is not None
    assert opaque is not None
    changed = (faint != opaque).any(axis=2)
    middle = round(0.43 * changed.shape[1])  # of the map, beside which the scale stands
    assert not changed[:, : middle - 20].any()
    assert changed[20:-20, middle + 20 : 2 * middle - 20].mean() > 0.95


@pytest.mark.parametrize(
    ("words", "change", "views"),
    [
        (("--surface", "--depth-range-mm", "400:900"), _copy, (0, 1, 3, 4)),
        (("--surface", "--depth-range-mm", "400:900"), _shuffle, range(9)),
        (("--sweep-mm", "400:900:5", "--depth-map"), _copy, range(9)),
        pytest.param(("--depth-mm", "auto"), _shuffle, range(9), marks=pytest.mark.deep),
    ],
)
def test_views_that_show_no_depth_have_no_map(
    words: tuple[str, ...], change: Callable[[list[Path]], None], views: Sequence[int],
    scene: Path, edit: Edit, tmp_path: Path, faintfield: Command,
) -> None:  # fmt: skip
    change(sorted(scene.glob("view_*.tiff")))
    edit(
        scene,
        lambda settings: settings.update(view=[settings["view"][k] for k in views], reference_view=views.index(4)),
    )
    ended = faintfield("reconstruct", scene, "--out", tmp_path / "out", *words)
    assert_refused(ended, "NothingInFocus", f"{scene}: the views agree no better than shuffled ones (p = ")
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
    views = binned_views(elemental_set, depths_mm[13], tmp_path)
    found = depth_map(views.agreements(depths_mm), np.asarray(depths_mm))
    disparity_px = np.interp(found.index, np.arange(27), disparities_px) / 3
    disparity_px[found.confidence < SURE] = np.nan
    silver = ((613, 320), (598, 240), (573, 135), (497, 65))
    black = ((222, 300), (238, 235), (388, 150), (328, 120), (288, 30))
    for pieces in (silver, black):
        places = [(row // views.bins_px, column // views.bins_px) for column, row in pieces]
        near_to_far = [np.nanmedian(disparity_px[r - 3 : r + 4, c - 3 : c + 4]) for r, c in places]
        assert np.diff(near_to_far).min() > 0.15
        # Of this set it is known that points move by −3.4 … +0.8 px
        assert near_to_far[0] == pytest.approx(-3.3, abs=0.2)
        assert -0.2 < near_to_far[-1] < 0.9


SHAPE = (12, 16)


def bring_truth(folder: Path, depth_mm: NDArray[np.floating]) -> None:
    write_plane(folder / "true_depth_mm.tiff", depth_mm, ONE_PIXEL)
    write_json(folder / TRUE_DEPTH_FILE, TrueDepth(1, "true_depth_mm.tiff", "truth.pfm", "0" * 64))


@pytest.fixture
def a_set(make_set: SetMaker, grey_images: list[NDArray[np.uint16]]) -> Path:
    folder = make_set(grey_images)
    true_mm = 1000.0 + 10.0 * np.indices(SHAPE)[0]
    true_mm[0] = np.nan  # nobody knows the first row
    bring_truth(folder, true_mm)
    return folder


def test_errors_are_those_of_what_is_known(a_set: Path, tmp_path: Path) -> None:
    found = 1000.0 + 10.0 * np.indices(SHAPE)[0]
    found[:, :2] *= 1.5  # an eighth of the known ones, once the columns from 8 on are not known
    found[:, 2:] *= 0.99
    found[:, 8:] = np.nan
    write_plane(tmp_path / "depth_mm.tiff", found, ONE_PIXEL)
    errors = write_depth_errors(load_set(a_set), tmp_path, "depth_mm.tiff", "mm")
    assert errors is not None
    assert errors.samples == 11 * 8
    assert errors.share == 0.5
    assert errors.median_relative_error == pytest.approx(0.01, rel=1e-4)
    # Rows 1 to 11 have 6 samples each at 1 % and 2 at 50 %: the median of 88 lies 44th to 45th of the 66 at 1 %
    median_mm = np.median(np.repeat(10.0 + 0.1 * np.arange(1, 12), 6)[43:45])
    assert errors.median_error_mm == pytest.approx(median_mm, rel=1e-3)
    assert errors.within_2_percent == 0.75
    # Nodes are 10 mm apart and the focal length is 50 px: a point at z mm moves by -500/z px from node to node
    write_plane(tmp_path / "disparity_px.tiff", -500.0 / (1.02 * (1000.0 + 10.0 * np.indices(SHAPE)[0])), ONE_PIXEL)
    errors = write_depth_errors(load_set(a_set), tmp_path, "disparity_px.tiff", "px")
    assert errors is not None
    assert errors.median_relative_error == pytest.approx(0.02, rel=1e-4)


def test_what_cannot_be_compared_leaves_no_file(a_set: Path, tmp_path: Path) -> None:
    for shape in (SHAPE, (6, 8)):
        (tmp_path / "depth_errors.json").write_text("of an earlier map")
        write_plane(tmp_path / "depth_mm.tiff", np.full(shape, np.nan), ONE_PIXEL)
        assert write_depth_errors(load_set(a_set), tmp_path, "depth_mm.tiff", "mm") is None
        assert not (tmp_path / "depth_errors.json").exists()


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b'{"format":1,"depth_mm":"../x.tiff","source":"","sha256":""}', "leaves the folder"),
        (b'{"format":1,"depth_mm":"a.tiff","source":"","sha256":"","more":1}', "import the set again"),
    ],
)
def test_damaged_truth_is_refused(content: bytes, words: str, tmp_path: Path) -> None:
    (tmp_path / TRUE_DEPTH_FILE).write_bytes(content)
    with pytest.raises(InputError, match=words):
        read_true_depth_mm(tmp_path)


@pytest.mark.parametrize(
    ("purpose", "options"),
    [
        ("depth map", ("--sweep-mm", "400:900:5", "--method", "backprojection", "--depth-map")),
        ("surface", ("--surface", "--depth-range-mm", "400:900", "--penalty-weight", 0.5, "--passes", 2)),
    ],
)
def test_reconstruction_with_depth_writes_its_errors(
    purpose: str, options: tuple[object, ...], scene: Path, tmp_path: Path, done: Command, seen: Searches,
    monkeypatch: pytest.MonkeyPatch,
) -> None:  # fmt: skip
    out = tmp_path / "out"
    bring_truth(scene, np.full((72, 96), FOUND_MM * 1.25))
    monkeypatch.setattr("faintfield.pipelines.reconstruction.depth.depth_map.SURE", 0.9 * FOUND_CONFIDENCE)
    message = done("reconstruct", scene, "--out", out, *options).stderr
    assert seen
    written = json.loads((out / "depth_errors.json").read_text())
    assert written["median_relative_error"] == pytest.approx(0.2, rel=1e-4)
    assert "median error 150 mm (20.00%)" in message
    assert f"{purpose} between 400 and 900 mm: comparing " in message
