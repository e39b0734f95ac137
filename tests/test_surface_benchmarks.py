"""The accuracy of a surface on maps made by hand, and the sets of Mitsuba's scenes as this program reads them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from benchmarks import surface_accuracy, surface_confidence, surface_scenes
from benchmarks.surface_accuracy import (
    depth_accuracy,
    depth_edges,
    median_edge_distance_px,
    picture_psnr_db,
    reliability,
    report_lines,
)
from faintfield.pipelines.formats.sets.elemental_set import load_set

TRUTH = np.full((10, 10), 500.0)


def depths_off(*errors: tuple[float, int]) -> NDArray[np.float64]:
    """The true depths with relative errors, each of so many samples."""
    off = np.zeros(100)
    ends = np.cumsum([count for _, count in errors])
    for (error, count), end in zip(errors, ends, strict=True):
        off[end - count : end] = error
    return TRUTH * (1 + off.reshape(10, 10))


def test_shares_are_of_all_samples_and_unknown_depths_are_wrong() -> None:
    depth = depths_off((0.03, 10), (-0.015, 20), (np.nan, 30), (0.005, 40))
    confidence = np.full(100, 0.5)
    confidence[[5, 15, 65, 66]] = 0.95  # one wrong by 3 %, three within 2 %
    confidence[40] = np.nan
    found = depth_accuracy(depth, confidence.reshape(10, 10), TRUTH)
    assert (found.within_2, found.within_1) == (0.6, 0.4)
    assert found.median == pytest.approx(0.005)  # of the 70 known ones
    assert (found.sure, found.sure_within_2) == (0.04, 0.75)


def test_samples_without_a_true_depth_do_not_count() -> None:
    truth = TRUTH.copy()
    truth[:5] = np.nan
    found = depth_accuracy(depths_off((0.5, 50)), np.ones((10, 10)), truth)
    assert (found.within_2, found.sure) == (1, 1)


def test_a_map_without_any_depth_is_wrong_everywhere() -> None:
    found = depth_accuracy(np.full((10, 10), np.nan), np.zeros((10, 10)), TRUTH)
    assert (found.within_2, found.within_1, found.sure) == (0, 0, 0)
    assert np.isnan([found.median, found.sure_within_2]).all()


def test_reliability_compares_each_confidence_with_how_often_it_is_right() -> None:
    depth = depths_off((0.1, 20))
    confidence = np.full(100, 0.85)
    confidence[:10], confidence[10:30], confidence[-5:], confidence[30] = 0.2, 0.6, 1.0, np.nan
    bins = {(one.low, one.high): one for one in reliability(depth, confidence.reshape(10, 10), TRUTH)}
    assert set(bins) == {(0.0, 0.1), (0.1, 0.3), (0.5, 0.7), (0.8, 0.9), (0.99, 1.0)}
    assert (bins[0.1, 0.3].share, bins[0.1, 0.3].right) == (0.1, 0)
    assert (bins[0.5, 0.7].share, bins[0.5, 0.7].right) == (0.2, 0.5)
    assert bins[0.5, 0.7].confidence == pytest.approx(0.6)
    assert (bins[0.99, 1.0].share, bins[0.99, 1.0].right) == (0.05, 1)
    assert sum(one.share for one in bins.values()) == pytest.approx(1)


def test_the_peak_of_the_psnr_is_the_maximum_of_the_truth() -> None:
    truth = np.linspace(0, 4, 100).reshape(10, 10)
    sign = np.where(np.arange(100) % 2, 1, -1).reshape(10, 10)
    assert picture_psnr_db(truth + 0.04 * sign, truth) == pytest.approx(40)
    assert picture_psnr_db(truth, truth) == np.inf
    blind = truth.copy()
    blind[9, 9] = np.nan  # there the truth is 4
    assert picture_psnr_db(blind, truth) == pytest.approx(10 * np.log10(100))


def test_a_straight_line_is_fitted_only_if_asked() -> None:
    truth = np.linspace(0, 4, 100).reshape(10, 10)
    assert picture_psnr_db(3 * truth + 7, truth, affine=True) > 200
    assert picture_psnr_db(3 * truth + 7, truth) < 0


def test_edges_are_steps_of_more_than_5_percent_between_neighbours() -> None:
    depth = np.full((6, 8), 500.0)
    depth[:, 3:] = 526.0
    depth[4:, :] *= 1.04
    depth[0, 7] = np.nan
    expected = np.zeros((6, 8), bool)
    expected[:, 2] = True
    np.testing.assert_array_equal(depth_edges(depth), expected)
    np.testing.assert_array_equal(depth_edges(depth.T), expected.T)
    np.testing.assert_array_equal(depth_edges(depth[:, ::-1]), expected[:, ::-1])


def test_edges_are_as_far_apart_as_they_were_moved_but_no_farther_than_20_px() -> None:
    near = np.full((30, 60), 500.0)
    near[:, 20:] = 600.0
    for moved, expected in ((0, 0.0), (5, 5.0), (39, 20.0)):
        far = np.full((30, 60), 500.0)
        far[:, 20 + moved :] = 600.0
        found = median_edge_distance_px(depth_edges(near), depth_edges(far))
        assert found == expected
    flat = np.zeros((30, 60), bool)
    assert median_edge_distance_px(depth_edges(near), flat) == 20
    assert np.isnan(median_edge_distance_px(flat, depth_edges(near)))


def _write(folder: Path, **maps: NDArray[np.float64]) -> Path:
    folder.mkdir()
    for name, values in maps.items():
        tifffile.imwrite(folder / f"{name}.tiff", values.astype(np.float32))
    return folder


def test_the_command_scales_the_truth_and_prints_the_table(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    picture = np.linspace(0, 2, 100).reshape(10, 10)
    depth, sure = depths_off((0.03, 10), (0.015, 20)), np.full((10, 10), 0.97)
    result = _write(tmp_path / "result", picture=picture + 0.002, depth_mm=depth, depth_confidence=sure)
    truth = _write(tmp_path / "truth", true_picture=picture * 1000, true_depth_mm=TRUTH)
    surface_accuracy.main([str(result), str(truth), "--scale-e", "0.001"])
    said = capsys.readouterr().out
    assert [line.split()[-1] for line in said.splitlines()[:6]] == ["60.00", "90.0", "70.0", "0.00", "100.0", "90.0"]
    assert said.splitlines()[-1].split() == ["0.95", "…", "0.99", "100.0", "97.0", "90.0"]
    lines = report_lines(picture + 0.002, depth, sure, picture, TRUTH)
    assert lines[1:] == said.splitlines()[1:]
    _write(tmp_path / "small", true_picture=picture, true_depth_mm=TRUTH[:5])
    with pytest.raises(SystemExit):
        surface_accuracy.main([str(result), str(tmp_path / "small")])
    assert "different sizes" in capsys.readouterr().err


def test_the_fit_finds_the_coefficients_under_which_samples_were_drawn() -> None:
    """Of two sets, one of which has four times as many samples: they count alike."""
    generator = np.random.default_rng(1)
    sets = []
    for count, shift in ((80_000, 0.5), (20_000, -0.5)):
        x = np.column_stack([np.ones(count), generator.standard_normal((count, 2))])
        right = generator.random(count) < 1 / (1 + np.exp(-(x @ [shift, 1.0, -0.5])))
        sets.append((x, right))
    # The mean of both sets is steeper nowhere: coefficients shrink a little where their constants differ
    assert surface_confidence.fitted(sets) == pytest.approx([0.0, 0.94, -0.47], abs=0.05)


def test_a_set_of_mitsubas_has_the_poses_of_its_nodes(tmp_path: Path) -> None:
    camera, nodes = surface_scenes.Camera(8, 6, 10.0, 1), surface_scenes.grid(3, 50.0)
    (tmp_path / "elemental.toml").write_text(surface_scenes.settings_text(camera, nodes))
    for node in nodes:
        tifffile.imwrite(tmp_path / node.image, np.zeros((6, 8), np.uint16))
    loaded = load_set(tmp_path)
    assert loaded.settings.reference_view == 4
    np.testing.assert_array_equal(loaded.poses_rt_cam_ref[4], 0)
    assert (loaded.lens.cx_px, loaded.lens.cy_px, loaded.lens.fy_px) == (3.5, 2.5, 10)
    # The view at row 2, column 0 is below and to the left, and its camera's centre becomes its origin
    pose = loaded.poses_rt_cam_ref[6]
    centre = nodes[6].centre_mm
    np.testing.assert_allclose(centre, [-50, 50, 0], atol=2)
    ahead = np.array(centre) + nodes[6].rotation.apply([0, 0, 100.0])
    np.testing.assert_allclose(cv2.Rodrigues(pose[:3])[0] @ ahead + pose[3:], [0, 0, 100], atol=1e-6)
    assert 0 < np.linalg.norm(pose[:3]) < 0.02


def test_without_mitsuba_no_scene_is_rendered(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(surface_scenes, "mi", None)
    with pytest.raises(SystemExit):
        surface_scenes.main(["room", str(tmp_path / "out")])
    assert "mitsuba is not installed" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
