"""Grids, maps of the detector, and windows of a plane: the operator of their samples alone, on the same images."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from faintfield.calib.homography import plane_from_ray, ray_from_surface
from faintfield.calib.lens import Lens
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.geometry import DetectorMaps, scene_geometry, window_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.operator.surface_operator import SurfaceOperator
from tests.recon.displaced import pixel_rays
from tests.recon.operator_cases import FACING_AT_500_MM, Case, cases


def test_sample_indices_count_from_the_first_centre() -> None:
    grid = PlaneGrid((3, 5), 0.5, (-1.0, 2.0))
    column, row, scale = grid.index_from_plane() @ [0.0, 3.0, 1.0]
    assert (column, row, scale) == (2.0, 2.0, 1.0)


def test_grid_covers_a_rectangle() -> None:
    grid = PlaneGrid.covering(-6.0, 2.0, 9.0, 10.0, 2.5)
    assert grid == PlaneGrid((3, 6), 2.5, (-4.75, 3.25))
    assert PlaneGrid.covering(0.0, 0.0, 10.4, 9.6, 1.0).shape == (10, 10), "whole samples, the nearest number"


def test_binned_samples_lie_between_replaced_samples() -> None:
    grid = PlaneGrid((7, 10), 2.0, (5.0, -3.0))
    binned = grid.binned(3)
    assert binned.shape == (2, 3)
    assert binned.pitch_mm == 6.0
    assert binned.origin_mm == (7.0, -1.0)  # the second of three samples 2 mm apart
    assert grid.binned(1) == grid


_SHAPE = (5, 70)


def test_operators_share_maps() -> None:
    flat = np.random.default_rng(1).uniform(0.5, 1, _SHAPE)
    maps = DetectorMaps(pixel_rays(_SHAPE), flat)
    homographies, grid = np.eye(3)[np.newaxis], PlaneGrid((8, 80), 1.0, (-2.0, -2.0))
    for _ in range(2):
        assert np.shares_memory(scene_geometry(homographies[np.newaxis], maps, [grid], None, None).maps, maps.layers)
    shared = PlaneOperator(homographies, maps, grid)
    alone = PlaneOperator(homographies, pixel_rays(_SHAPE), grid, flat=flat)
    plane = np.random.default_rng(2).uniform(0, 1, grid.shape).astype(np.float32)
    np.testing.assert_array_equal(shared.forward(plane), alone.forward(plane))


def test_maps_refuse_flat_field_and_other_dtype() -> None:
    grid = PlaneGrid((8, 80), 1.0, (-2.0, -2.0))
    with pytest.raises(GeometryMismatch, match="already have a flat field; give no other"):
        PlaneOperator(np.eye(3)[np.newaxis], DetectorMaps(pixel_rays(_SHAPE)), grid, flat=np.ones(_SHAPE))
    with pytest.raises(GeometryMismatch, match="of type float32"):
        PlaneOperator(np.eye(3)[np.newaxis], DetectorMaps(pixel_rays(_SHAPE)), grid, dtype=np.float64)


def drawn_slice(data: st.DataObject, size: int) -> slice:
    start = data.draw(st.integers(0, size - 2))
    return slice(start, data.draw(st.integers(start + 2, size)))


@settings(max_examples=15)
@given(case=cases(), data=st.data())
def test_window_is_the_operator_of_its_samples(case: Case, data: st.DataObject) -> None:
    rows, columns = (drawn_slice(data, size) for size in case.grid.shape)
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
    assert whole.sensitivity().shape == case.grid.shape


@pytest.mark.parametrize("corner", [(131, 207), (0, 371)])
def test_small_window_is_located_on_the_detector(corner: tuple[int, int]) -> None:
    """Views look across a large, distorted detector, so that windows are searched among its nodes."""
    lens = Lens((400, 300), 500.0, 500.0, 200.0, 150.0, (-0.2, 0.05))
    poses = np.random.default_rng(1).normal(size=(5, 6)) * np.repeat([0.03, 20.0], 3)
    grid, homographies = PlaneGrid((300, 400), 1.0, (-200.0, -150.0)), plane_from_ray(poses, FACING_AT_500_MM)
    rows, columns = (slice(first, first + 29) for first in corner)
    window = PlaneOperator(homographies, lens.rays(), grid).window(rows, columns)
    alone = PlaneOperator(homographies, lens.rays(), grid.window(rows, columns))
    np.testing.assert_allclose(window.sensitivity(), alone.sensitivity(), atol=1e-3)
    assert window.sensitivity().max() > 1


def test_small_window_looks_at_few_pixels() -> None:
    """Views that overlay the samples see a window of 29 x 29 in as many pixels; rows come in blocks of 64."""
    maps, grid = DetectorMaps(pixel_rays((300, 400)), dtype=np.float64), PlaneGrid((300, 400), 1.0, (0.0, 0.0))
    whole = scene_geometry(np.eye(3)[np.newaxis, np.newaxis], maps, [grid], None, None)
    reach = window_geometry(whole, PlaneGrid((29, 29), 1.0, (207.0, 131.0)), (131, 207)).reach[0]
    looked_at = reach[:, 1] - reach[:, 0]
    assert (looked_at[131:160] > 0).all()
    assert (reach[131:160, 0] <= 207).all()
    assert (reach[131:160, 1] >= 236).all()
    assert np.count_nonzero(looked_at) <= 29 + 4 * 32
    assert looked_at.max() <= 192


def test_window_that_no_view_sees_is_refused() -> None:
    lens = Lens((64, 48), 80.0, 80.0, 32.0, 24.0)
    grid = PlaneGrid((200, 300), 5.0, (-750.0, -500.0))
    operator = PlaneOperator(plane_from_ray(np.zeros((1, 6)), FACING_AT_500_MM), lens.rays(), grid)
    with pytest.raises(GeometryMismatch, match="no pixel"):
        operator.window(slice(0, 10), slice(0, 10))


def test_window_of_a_surface_keeps_its_pixels() -> None:
    """Half of the surface is much nearer: its pixels lie far from where those of the other depth do."""
    inverse_depth = np.full((90, 480), 1 / 1000)
    inverse_depth[:, 240:] = 1 / 400
    poses = np.zeros((3, 6))
    poses[:, 3] = [-150.0, 0.0, 150.0]
    rays = (pixel_rays((90, 480)) - [240, 45]) / 800
    grid = PlaneGrid((90, 480), 1 / 800, (-240 / 800, -45 / 800))
    whole = SurfaceOperator(ray_from_surface(poses), rays, grid, inverse_depth)
    for first in (60, 330):
        rows, columns = slice(30, 70), slice(first, first + 40)
        window = whole.window(rows, columns)
        # All four samples of a pixel within the window: its inner samples lose no pixel
        inner = (slice(1, -1), slice(1, -1))
        expected = whole.sensitivity()[rows, columns][inner]
        np.testing.assert_allclose(window.sensitivity()[inner], expected, atol=1e-3)
        assert expected.max() > 1


@pytest.mark.parametrize(
    ("shape", "pitch_mm", "origin_mm", "words"),
    [
        ((1, 5), 1.0, 0.0, "at least 2 x 2"),
        ((5, 5), 0.0, 0.0, "pitch_mm"),
        ((5, 5), float("nan"), 0.0, "pitch_mm"),
        ((5, 5), 1.0, float("inf"), "origin_mm"),
    ],
)
def test_impossible_grids_are_refused(shape: tuple[int, int], pitch_mm: float, origin_mm: float, words: str) -> None:
    with pytest.raises(ValueError, match=words):
        PlaneGrid(shape, pitch_mm, (0.0, origin_mm))
