"""Windows of a plane: the operator of their samples alone, on the same images, and where they are."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from faintfield.calib.homography import plane_from_ray, ray_from_surface
from faintfield.calib.lens import Lens
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.detector_maps import DetectorMaps
from faintfield.recon.operator.geometry import scene_geometry, window_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.surface_operator import SurfaceOperator
from faintfield.recon.solver import windows
from faintfield.recon.solver.data_fit import SceneProblem
from tests.recon.operator_cases import FACING_AT_500_MM, Case, cases


def a_slice(data: st.DataObject, size: int) -> slice:
    start = data.draw(st.integers(0, size - 2))
    return slice(start, data.draw(st.integers(start + 2, size)))


@given(case=cases(), data=st.data())
def test_a_window_is_the_operator_of_its_samples(case: Case, data: st.DataObject) -> None:
    rows, columns = (a_slice(data, size) for size in case.grid.shape)
    try:
        alone = replace(case, grid=case.grid.window(rows, columns)).operator()
    except GeometryMismatch:
        assume(False)
    whole = case.operator()
    window = whole.window(rows, columns)
    generator = np.random.default_rng(3)
    samples, images = generator.normal(size=window.grid.shape), generator.normal(size=window.images_shape)
    np.testing.assert_allclose(window.forward(samples), alone.forward(samples), atol=1e-9)
    np.testing.assert_allclose(window.adjoint(images), alone.adjoint(images), atol=1e-9)
    np.testing.assert_allclose(window.sensitivity(), alone.sensitivity(), atol=1e-9)
    assert window.seeing_views.tolist() == alone.seeing_views.tolist()
    # The whole keeps its own
    assert whole.sensitivity().shape == case.grid.shape


def large_operator() -> tuple[PlaneOperator, np.ndarray, Lens, PlaneGrid]:
    """Views that look across a large, distorted detector, so that windows are found among its nodes."""
    lens = Lens((400, 300), 500.0, 500.0, 200.0, 150.0, (-0.2, 0.05))
    generator = np.random.default_rng(1)
    poses = generator.normal(size=(5, 6)) * np.repeat([0.03, 20.0], 3)
    grid = PlaneGrid((300, 400), 1.0, (-200.0, -150.0))
    homographies = plane_from_ray(poses, FACING_AT_500_MM)
    return PlaneOperator(homographies, lens.rays(), grid), homographies, lens, grid


@pytest.mark.parametrize("corner", [(131, 207), (0, 371)])
def test_a_small_window_of_a_large_plane_is_found_on_the_detector(corner: tuple[int, int]) -> None:
    operator, homographies, lens, grid = large_operator()
    rows, columns = (slice(first, first + 29) for first in corner)
    window = operator.window(rows, columns)
    alone = PlaneOperator(homographies, lens.rays(), grid.window(rows, columns))
    np.testing.assert_allclose(window.sensitivity(), alone.sensitivity(), atol=1e-3)
    assert window.sensitivity().max() > 1


def test_few_pixels_are_looked_at_for_a_small_window() -> None:
    """Views that overlay the samples see a window of 29 x 29 in as many pixels; rows come in blocks of 64."""
    rays = np.stack(np.meshgrid(np.arange(400.0), np.arange(300.0)), axis=-1)
    args = (
        np.eye(3)[np.newaxis, np.newaxis],
        DetectorMaps(rays, dtype=np.float64),
        [PlaneGrid((300, 400), 1.0, (0.0, 0.0))],
    )
    whole = scene_geometry(*args, None, None)
    reach = window_geometry(whole, PlaneGrid((29, 29), 1.0, (207.0, 131.0)), (131, 207)).reach[0]
    looked_at = reach[:, 1] - reach[:, 0]
    assert (looked_at[131:160] > 0).all()
    assert (reach[131:160, 0] <= 207).all()
    assert (reach[131:160, 1] >= 236).all()
    assert np.count_nonzero(looked_at) <= 29 + 4 * 32
    assert looked_at.max() <= 192


def test_a_window_that_no_view_sees_is_refused() -> None:
    lens = Lens((64, 48), 80.0, 80.0, 32.0, 24.0)
    grid = PlaneGrid((200, 300), 5.0, (-750.0, -500.0))
    operator = PlaneOperator(plane_from_ray(np.zeros((1, 6)), FACING_AT_500_MM), lens.rays(), grid)
    with pytest.raises(GeometryMismatch, match="no pixel"):
        operator.window(slice(0, 10), slice(0, 10))


def problem_of(shape: tuple[int, int], views: int = 9) -> SceneProblem:
    """Views that each see all of a plane but a few samples."""
    rays = np.stack(np.meshgrid(np.arange(float(shape[1])), np.arange(float(shape[0]))), axis=-1)
    homographies = np.stack([np.eye(3)] * views)
    homographies[:, 0, 2] = np.linspace(-3, 3, views)
    operator = PlaneOperator(homographies, rays, PlaneGrid(shape, 1.0, (0.0, 0.0)))
    return SceneProblem(operator, ElementalImages(np.ones((views, *shape), np.float32)))


def test_windows_of_a_large_plane_are_spread_over_it_and_do_not_meet(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "SIDE", 8)
    monkeypatch.setattr(windows, "_MIN_SAMPLES", 8 * 8 * 6)
    problem = problem_of((64, 96))
    found = windows.windows_of(problem, 4)
    used = np.zeros((64, 96), int)
    for window in found:
        column, row = np.array(window.operator.grids[0].origin_mm).astype(int)
        assert window.operator.grids[0].shape == (8, 8)
        assert window.images is problem.images
        used[row : row + 8, column : column + 8] += 1
    assert used.max() == 1
    assert 1 / 16 <= used.mean() <= 1.3 / 16
    assert used.reshape(2, 32, 3, 32).any(axis=(1, 3)).all()
    # All four edges are equally far
    rows, columns = np.flatnonzero(used.any(axis=1)), np.flatnonzero(used.any(axis=0))
    assert abs(rows[0] - (63 - rows[-1])) <= 1
    assert abs(columns[0] - (95 - columns[-1])) <= 1


@pytest.mark.parametrize("shape", [(64, 11), (20, 20)])
def test_a_small_or_narrow_plane_stands_for_itself(shape: tuple[int, int], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "SIDE", 8)
    monkeypatch.setattr(windows, "_MIN_SAMPLES", 300)
    assert windows.windows_of(problem_of(shape), 4) == []


def test_windows_that_few_views_see_are_left_out(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "SIDE", 8)
    monkeypatch.setattr(windows, "_MIN_SAMPLES", 8 * 8 * 6)
    whole = problem_of((64, 96))
    assert isinstance(whole.operator, PlaneOperator)
    homographies = np.stack([np.eye(3)] * 9)
    homographies[:6, 0, 2] = 60  # six of nine views see only the right of the plane
    rays = np.stack(np.meshgrid(np.arange(96.0), np.arange(64.0)), axis=-1)
    problem = SceneProblem(PlaneOperator(homographies, rays, whole.operator.grid), whole.images)
    left = [window.operator.grids[0].origin_mm[0] for window in windows.windows_of(problem, 4)]
    assert left
    assert min(left) >= 60


def test_a_window_of_a_surface_keeps_all_pixels_that_see_it() -> None:
    """Half of the surface is much nearer: its pixels lie far from where those of the other depth do."""
    inverse_depth = np.full((90, 480), 1 / 1000)
    inverse_depth[:, 240:] = 1 / 400
    poses = np.zeros((3, 6))
    poses[:, 3] = [-150.0, 0.0, 150.0]
    rays = (np.stack(np.meshgrid(np.arange(480.0), np.arange(90.0)), axis=-1) - [240, 45]) / 800
    grid = PlaneGrid((90, 480), 1 / 800, (-240 / 800, -45 / 800))
    whole = SurfaceOperator(ray_from_surface(poses), rays, grid, inverse_depth, dtype=np.float64)
    for first in (60, 330):
        rows, columns = slice(30, 70), slice(first, first + 40)
        window = whole.window(rows, columns)
        # All four samples of a pixel within the window: its inner samples lose no pixel
        inner = (slice(1, -1), slice(1, -1))
        expected = whole.sensitivity()[rows, columns][inner]
        np.testing.assert_allclose(window.sensitivity()[inner], expected, atol=1e-9)
        assert expected.max() > 1


def test_a_view_without_pixels_that_count_sees_nothing() -> None:
    rays = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1)
    valid = np.ones((3, 6, 8), bool)
    valid[1] = False
    grid = PlaneGrid((6, 8), 1.0, (0.0, 0.0))
    homographies = np.stack([np.eye(3)] * 3)[np.newaxis]
    masked = SceneOperator(homographies, rays, [grid], valid=valid)
    assert masked.seeing_views.tolist() == [0, 2]
    assert SceneOperator(homographies, rays, [grid]).seeing_views.tolist() == [0, 1, 2]


def test_a_long_plane_has_windows(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(windows, "SIDE", 8)
    monkeypatch.setattr(windows, "_MIN_SAMPLES", 8 * 8 * 3)
    assert len(windows.windows_of(problem_of((2000, 16)), 4)) > 10
    assert len(windows.windows_of(problem_of((16, 2000)), 4)) > 10
