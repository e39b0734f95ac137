"""Sets of all kinds for `reconstruct --surface`: what the search for depths is given, and what is refused."""

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import write_frame
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.reconstruction.channels import channel_layouts, load_channel
from faintfield.pipelines.reconstruction.depth.comparison import BETWEEN_PIXELS, between_pixels
from faintfield.pipelines.reconstruction.depth.search import depths_of_set, enlarged
from faintfield.pipelines.reconstruction.operators import OperatorFactory, plane_grid
from faintfield.pipelines.reconstruction.planes.penalised import Objective, solve_then_sigma
from faintfield.pipelines.reconstruction.planes.solve import solve
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.surface.pinhole_views import UNKNOWN
from tests.pipelines.conftest import Command, Edit, assert_refused
from tests.pipelines.surfaces import Searches, found_at_once
from tests.recon.surface_scene import GRID

RANGE = ("--depth-range-mm", "400:900")
FAST = (*RANGE, "--penalty-weight", 0.5, "--passes", 2)


def _plain(settings: dict[str, Any]) -> None:
    """Leave out the distortion and the flat field, so that electrons can be computed by hand."""
    settings["camera"]["distortion"] = []
    settings["camera"].pop("flat", None)


def _light_e(folder: Path, view: str) -> NDArray[np.float64]:
    """Return the electrons of a view less the dark current, by hand: 100 DN, 2 DN/e⁻, 0.2 e⁻/s in 0.1 s."""
    return np.asarray((read_frame(folder / view).pixels_dn - 100.0) / 2.0 - 0.02)


def test_search_is_given_electrons_of_light(seen: Searches, scene: Path, edit: Edit, done: Command) -> None:
    edit(scene, _plain)
    write_frame(scene / "view_r0_c1.tiff", np.full((72, 96), 65535, np.uint16))  # saturated
    done("reconstruct", scene, "--surface", *FAST, "--out", scene / "out")
    edit(scene, lambda settings: [view.pop("node") for view in settings["view"]])
    done("reconstruct", scene, "--surface", *FAST, "--out", scene / "row")
    (views, inverse_depths), (row_of_views, _) = seen
    assert row_of_views.nodes.tolist() == [[0, index] for index in range(9)]
    assert views.light_e.shape == (9, 72, 96)
    np.testing.assert_allclose(views.light_e[5], _light_e(scene, "view_r1_c2.tiff"), atol=1e-4)
    assert (views.light_e[1] == UNKNOWN).all()
    assert (np.delete(views.light_e, 1, axis=0) > -100).all()
    assert tifffile.imread(scene / "out" / "visibility.tiff").max() < 8.5
    assert (1 / inverse_depths[[-1, 0]]).tolist() == pytest.approx([400, 900])
    assert views.nodes[5].tolist() == [1, 2]


def test_mosaic_is_binned_by_its_period(
    seen: Searches, colour_set: Path, tmp_path: Path, edit: Edit, done: Command
) -> None:
    folder = Path(shutil.copytree(colour_set, tmp_path / "set"))
    edit(folder, _plain)
    done("reconstruct", folder, "--surface", *FAST, "--out", tmp_path / "out")
    cells = _light_e(folder, "view_r1_c1.tiff").reshape(24, 2, 32, 2).sum(axis=(1, 3))
    np.testing.assert_allclose(seen[0][0].light_e[4], cells, atol=1e-3)
    assert tifffile.imread(tmp_path / "out" / "picture.tiff").shape == (48, 64, 3)
    visibility = tifffile.imread(tmp_path / "out" / "visibility.tiff")
    assert visibility[20:28, 26:38].mean() == pytest.approx(9, rel=0.1)
    assert tifffile.imread(tmp_path / "out" / "depth_mm.tiff").shape == (48, 64)


def test_imported_grid_may_have_own_principal_points(
    seen: Searches, scene: Path, tmp_path: Path, done: Command
) -> None:
    """Pictures aligned on a plane: what moves by −12 px from node to node, aligned on −2 px, is left with −10 px."""
    (tmp_path / "pictures").mkdir()
    for path in scene.glob("view_r*_c*.tiff"):
        shutil.copy(path, tmp_path / "pictures")
    done("import", "grid", tmp_path / "pictures", tmp_path / "set", "--disparity-px", 2)
    options = ("--disparity-range-px=-12:-1", *FAST[2:])
    done("reconstruct", tmp_path / "set", "--surface", *options, "--out", tmp_path / "out")
    depth = 1 / seen[0][1]
    assert depth[0] / depth[-1] == pytest.approx((12 + 2) / (1 + 2), rel=1e-6)


def _middle_row(settings: dict[str, Any]) -> None:
    settings.update(view=settings["view"][3:6], reference_view=1)


def _all_at_once(settings: dict[str, Any]) -> None:
    for view in settings["view"]:
        view["rt_cam_ref"] = [0.0] * 6


@pytest.mark.parametrize(
    ("change", "words", "code", "message"),
    [
        (_middle_row, RANGE, 1, "BadValue: {set}: has 3 views, and a surface needs at least 4"),
        (_all_at_once, RANGE, 1, "NothingInFocus: {set}: all views were taken from one place"),
        (None, ("--depth-range-mm", "5:20"), 1, "GeometryMismatch: between 5 and 20 mm the other views see 0%"),
        (None, ("--depth-range-mm", "0.01:900"), 1, "GeometryMismatch: surface between 0.01 and 900 mm: 128 depths"),
        (None, ("--depth-range-mm", "400:400"), 2, "is no range; give two different numbers as NEAR:FAR"),
        (None, ("--depth-range-mm=-9:400",), 2, "depths are positive, and at most 1000000000 mm"),
        (None, ("--disparity-range-px=-9:3",), 1, "BadValue: no plane in front of the cameras has a disparity of 3"),
        (None, (*RANGE, "--depth-mm", 500), 2, "--depth-mm would have no effect"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    change: Callable[[dict[str, Any]], object] | None, words: tuple[object, ...], code: int, message: str,
    seen: Searches, scene: Path, edit: Edit, faintfield: Command,
) -> None:  # fmt: skip
    if change is not None:
        edit(scene, change)
    ended = faintfield("reconstruct", scene, "--surface", *words, "--out", scene / "out")
    assert (ended.returncode, seen) == (code, [])
    assert message.format(set=scene) in ended.stderr
    assert len(ended.stderr.splitlines()) == 1
    assert not (scene / "out").exists()


def test_range_up_to_infinity_is_searched(seen: Searches, scene: Path, faintfield: Command, done: Command) -> None:
    call = ("reconstruct", scene, "--surface", *FAST[2:], "--out", scene / "out", "--depth-range-mm")
    assert "warning" not in done(*call, "400:1000000000").stderr
    assert "a narrower range would find more" in done(*call, "10:900").stderr
    assert 1 / seen[0][1][0] == pytest.approx(1e9)


@pytest.mark.parametrize(("at_600_mm", "share"), [(0.005, None), (0.12, "by 12% at 600 mm")])
def test_error_that_all_depths_share_is_counted_and_said(
    at_600_mm: float, share: str | None, scene: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    counted = mock.Mock(side_effect=lambda views, *_: found_at_once(views))
    monkeypatch.setattr("faintfield.pipelines.reconstruction.depth.search.estimate_surface", counted)
    sigma = at_600_mm / 600
    with caplog.at_level("INFO", "faintfield"):
        depths_of_set(replace(load_set(scene), inverse_depth_sigma=sigma), (450.0, 900.0), scene)
    assert counted.call_args.args[2] == sigma
    assert ("leave all depths uncertain together" in caplog.text) == (share is not None)
    assert (share or "") in caplog.text


def test_saturated_or_too_small_views_are_refused(
    seen: Searches, scene: Path, tmp_path: Path, faintfield: Command, done: Command
) -> None:
    for path in scene.glob("view_*.tiff"):
        write_frame(path, np.full((72, 96), 65535, np.uint16))
    done("simulate", tmp_path / "small", "--size-px", 30, 20, "--rows", 2, "--columns", 2)
    for folder, failure, message in (
        (scene, "GeometryMismatch", "no pixel of any of the 9 views sees the plane"),
        (tmp_path / "small", "BadValue", "has views of 30 x 20 px, and a surface needs at least 24 px"),
    ):
        assert_refused(
            faintfield("reconstruct", folder, "--surface", *FAST, "--out", tmp_path / "out"), failure, message
        )
        assert (seen, (tmp_path / "out").exists()) == ([], False)


def test_deviation_without_images_is_that_of_plane(simulated_scene: Path) -> None:
    elemental_set = load_set(simulated_scene)
    (layout,) = channel_layouts(elemental_set)
    images = load_channel(elemental_set, layout)
    operator = OperatorFactory(elemental_set, layout, images).at(500.0, plane_grid(elemental_set, 500.0))
    settings = SolverOptions(penalty_weight=0.5, passes=5)
    solution, sigma = solve_then_sigma(Objective.of(SceneProblem(operator, images), settings))
    expected = solve(operator, images, "pmlem", replace(settings, uncertainty=True))
    np.testing.assert_array_equal(solution.plane, expected.plane)
    np.testing.assert_array_equal(sigma(), expected.sidecars["sigma"])


@pytest.mark.parametrize("bins", [2, 3])
def test_each_sample_has_value_of_nearest_bin(bins: int) -> None:
    generator = np.random.default_rng(1)
    part, shape = generator.normal(size=(6, 8)), (6 * bins + bins // 2, 8 * bins + bins - 1)
    middles = [bins * (np.arange(count) + 0.5) - 0.5 for count in part.shape]
    expected = np.empty(shape)
    for row, column in np.ndindex(shape):
        i, j = (int(np.abs(middle - at).argmin()) for middle, at in zip(middles, (row, column), strict=True))
        expected[row, column] = part[i, j]
    np.testing.assert_array_equal(enlarged(part, shape, bins), expected)


def test_samples_between_pixels_have_mean_blur() -> None:
    places = (np.arange(1000) + 0.5) / 1000
    anywhere = np.mean((1 - places) ** 2 + places**2)
    assert (1 - BETWEEN_PIXELS) ** 2 + BETWEEN_PIXELS**2 == pytest.approx(anywhere, rel=1e-5)
    before, after = GRID, between_pixels(GRID)
    moved_mm = np.subtract(after.origin_mm, before.origin_mm)
    np.testing.assert_allclose(moved_mm, BETWEEN_PIXELS * before.pitch_mm, rtol=1e-9)
    assert (after.shape, after.pitch_mm) == (before.shape, before.pitch_mm)
