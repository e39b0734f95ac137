"""The contract that every linear operator must keep."""

from collections.abc import Callable

import numpy as np
import pytest

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane_operator import PlaneOperator

type LinearOperatorCheck = Callable[[PlaneOperator], Image]

# Numbers are of order one and sums have a few hundred terms
_ROUNDING = 1e-12


@pytest.fixture(scope="session")
def check_linear_operator() -> LinearOperatorCheck:
    """The contract as a function of a float64 operator; it returns the dense matrix (pixel of any view, sample)."""

    def check(operator: PlaneOperator) -> Image:
        generator = np.random.default_rng(20110919)
        x, other = generator.normal(size=(2, *operator.grid.shape))
        y = generator.normal(size=operator.images_shape)
        dense = dense_matrix(operator)
        assert dense.min() >= 0 < dense.max()
        _check_linearity(operator, x, other)
        _check_adjoint(operator, x, y)
        _check_matrix(operator, dense, x, y)
        _check_fused_ratio(operator, dense, generator)
        _check_views(operator, dense, x, y)
        return dense

    return check


def dense_matrix(operator: PlaneOperator) -> Image:
    units = np.eye(operator.grid.shape[0] * operator.grid.shape[1])
    return np.stack([operator.forward(unit.reshape(operator.grid.shape)).ravel() for unit in units], axis=1)


def _check_linearity(operator: PlaneOperator, x: Image, other: Image) -> None:
    combined = operator.forward(2.0 * x - 3.0 * other)
    np.testing.assert_allclose(combined, 2.0 * operator.forward(x) - 3.0 * operator.forward(other), atol=_ROUNDING)


def _check_adjoint(operator: PlaneOperator, x: Image, y: Image) -> None:
    seen = operator.forward(x)
    # Against the norms of Hx and y: against the inner product, a lost border column would pass
    miss = abs(np.vdot(seen, y) - np.vdot(x, operator.adjoint(y)))
    assert miss <= 1e-12 * np.linalg.norm(seen) * np.linalg.norm(y)


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
    images = ElementalImages(electrons, background_e=0.25, read_variance_e2=2.0)
    ratio = np.maximum(electrons + 2.0, 0.0).ravel() / (dense @ plane.ravel() + 0.25 + 2.0)
    expected = (dense.T @ ratio).reshape(operator.grid.shape)
    np.testing.assert_allclose(operator.adjoint_of_ratio(plane, images), expected, atol=_ROUNDING)
    value, back = operator.value_and_ratio(plane, images)
    np.testing.assert_array_equal(back, operator.adjoint_of_ratio(plane, images))
    mean, shifted = (dense @ plane.ravel() + 2.25), np.maximum(electrons + 2.0, 0.0).ravel()
    seen = dense.any(axis=1)
    terms = mean - shifted + shifted * np.log(np.where(shifted > 0, shifted, 1.0) / mean)
    assert value == pytest.approx(terms[seen].sum(), rel=1e-12)
    assert operator.negative_log_likelihood(plane, images) == pytest.approx(value, rel=1e-12)


def _check_views(operator: PlaneOperator, dense: Image, x: Image, y: Image) -> None:
    some, others = operator.all_views[::-2], operator.all_views[-2::-2]
    np.testing.assert_array_equal(operator.forward(x, some), operator.forward(x)[some])
    both = operator.adjoint(y, some) + operator.adjoint(y, others)
    np.testing.assert_allclose(both, operator.adjoint(y), atol=_ROUNDING)
    of_last = dense[-y[-1].size :].T @ y[-1].ravel()
    last = int(operator.all_views[-1])
    np.testing.assert_allclose(operator.adjoint_of_view(y[-1], last), of_last.reshape(x.shape), atol=_ROUNDING)
    both = operator.adjoint_of_forward(x, some) + operator.adjoint_of_forward(x, others)
    np.testing.assert_allclose(both, operator.adjoint_of_forward(x), atol=_ROUNDING)
    both = operator.sensitivity(some) + operator.sensitivity(others)
    np.testing.assert_allclose(both, operator.sensitivity(), atol=_ROUNDING)
