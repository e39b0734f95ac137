"""The contract that every linear operator must keep."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import PlaneOperator

# Numbers are of order one and sums have a few hundred terms
_ROUNDING = 1e-12


def check_linear_operator(operator: PlaneOperator) -> None:
    """Check a float64 operator against its dense matrix."""
    generator = np.random.default_rng(20110919)
    x = generator.normal(size=operator.grid.shape)
    y = generator.normal(size=operator.images_shape)
    dense = dense_matrix(operator)
    assert dense.min() >= 0 < dense.max()
    _check_matrix(operator, dense, x, y)
    _check_fused_ratio(operator, dense, generator)
    _check_views(operator, dense, x, y)


def dense_matrix(operator: SceneOperator, views: NDArray[np.intp] | None = None) -> Image:
    """Return H of some views (pixel of any view, sample) by the images of unit vectors."""
    units = np.eye(int(np.prod(operator.samples_shape))).reshape(-1, *operator.samples_shape)
    return np.stack([operator.forward(unit, views).ravel() for unit in units], axis=1)


def _check_matrix(operator: PlaneOperator, dense: Image, x: Image, y: Image) -> None:
    shape, ones = operator.grid.shape, np.ones(operator.images_shape)
    np.testing.assert_allclose(operator.forward(x).ravel(), dense @ x.ravel(), atol=_ROUNDING)
    np.testing.assert_allclose(operator.adjoint(y), (dense.T @ y.ravel()).reshape(shape), atol=_ROUNDING)
    np.testing.assert_array_equal(operator.sensitivity(), operator.adjoint(ones))
    np.testing.assert_allclose(operator.sensitivity(), dense.sum(axis=0).reshape(shape), atol=_ROUNDING)
    coverage = dense.T @ dense.sum(axis=1)
    np.testing.assert_allclose(operator.coverage(), coverage.reshape(shape), atol=_ROUNDING)
    both_ways = (dense.T @ (dense @ x.ravel())).reshape(shape)
    np.testing.assert_allclose(operator.adjoint_of_forward(x), both_ways, atol=_ROUNDING)


def _check_fused_ratio(operator: PlaneOperator, dense: Image, generator: np.random.Generator) -> None:
    plane = generator.uniform(0.5, 2.0, operator.grid.shape)
    electrons = generator.normal(1.0, 3.0, operator.images_shape)
    # One background and variance for each lattice of pixels
    maps = generator.uniform(0.2, 2.0, (2, *operator.maps_shape))
    background, variance = maps[:, operator.lattice_of_view]
    images = ElementalImages(electrons, *maps)
    mean, shifted = dense @ plane.ravel() + (background + variance).ravel(), np.maximum(electrons + variance, 0).ravel()
    expected = (dense.T @ (shifted / mean)).reshape(operator.grid.shape)
    np.testing.assert_allclose(operator.adjoint_of_ratio(plane, images), expected, atol=_ROUNDING)
    expected = (dense.T @ background.ravel()).reshape(operator.grid.shape)
    np.testing.assert_allclose(operator.adjoint_of_map(maps[0]), expected, atol=_ROUNDING)
    value, back = operator.value_and_ratio(plane, images)
    np.testing.assert_array_equal(back, operator.adjoint_of_ratio(plane, images))
    terms = mean - shifted + shifted * np.log(np.where(shifted > 0, shifted, 1.0) / mean)
    assert value == pytest.approx(terms[dense.any(axis=1)].sum(), rel=1e-12)
    assert operator.negative_log_likelihood(plane, images) == pytest.approx(value, rel=1e-12)


def _check_views(operator: PlaneOperator, dense: Image, x: Image, y: Image) -> None:
    first, second = operator.all_views[::-2], operator.all_views[-2::-2]
    np.testing.assert_array_equal(operator.forward(x, first), operator.forward(x)[first])
    both = operator.adjoint(y, first) + operator.adjoint(y, second)
    np.testing.assert_allclose(both, operator.adjoint(y), atol=_ROUNDING)
    both = operator.adjoint_of_forward(x, first) + operator.adjoint_of_forward(x, second)
    np.testing.assert_allclose(both, operator.adjoint_of_forward(x), atol=_ROUNDING)
    both = operator.sensitivity(first) + operator.sensitivity(second)
    np.testing.assert_allclose(both, operator.sensitivity(), atol=_ROUNDING)
