"""Maps of the detector's pixels: what they hold, that operators share them, and what they refuse."""

import numpy as np
import pytest

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.operator.detector_maps import DetectorMaps
from faintfield.recon.operator.geometry import scene_geometry
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator

_SHAPE = (5, 70)


def _rays() -> np.ndarray:
    columns, rows = np.meshgrid(np.arange(70.0), np.arange(5.0))
    return np.stack([columns, rows], axis=-1)


def test_layers_are_rays_and_response_padded_by_nan() -> None:
    """A ray is (column, row) here, the response a number of its own."""
    flat = np.random.default_rng(1).uniform(0.5, 1, _SHAPE)
    maps = DetectorMaps(_rays(), flat, np.float64)
    assert maps.shape == (1, *_SHAPE)
    np.testing.assert_array_equal(maps.rays[0], _rays())
    np.testing.assert_array_equal(maps.layers[2, 0, :, :70], flat)
    assert np.isnan(maps.layers[..., 70:]).all()
    assert maps.layers.shape[3] > 70


def test_operators_share_maps_and_agree_with_those_that_make_their_own() -> None:
    """Nothing of the maps' size is made for a second plane."""
    flat = np.random.default_rng(1).uniform(0.5, 1, _SHAPE)
    maps = DetectorMaps(_rays(), flat)
    homographies, grid = np.eye(3)[np.newaxis], PlaneGrid((8, 80), 1.0, (-2.0, -2.0))
    for _ in range(2):
        assert np.shares_memory(scene_geometry(homographies[np.newaxis], maps, [grid], None, None).maps, maps.layers)
    shared = PlaneOperator(homographies, maps, grid)
    alone = PlaneOperator(homographies, _rays(), grid, flat=flat)
    plane = np.random.default_rng(2).uniform(0, 1, grid.shape).astype(np.float32)
    np.testing.assert_array_equal(shared.forward(plane), alone.forward(plane))


def test_maps_that_have_a_flat_field_take_no_other() -> None:
    """The second would silently win or lose."""
    grid = PlaneGrid((8, 80), 1.0, (-2.0, -2.0))
    with pytest.raises(GeometryMismatch, match="already have a flat field; give no other"):
        PlaneOperator(np.eye(3)[np.newaxis], DetectorMaps(_rays()), grid, flat=np.ones(_SHAPE))
    with pytest.raises(GeometryMismatch, match="of type float32"):
        PlaneOperator(np.eye(3)[np.newaxis], DetectorMaps(_rays()), grid, dtype=np.float64)
