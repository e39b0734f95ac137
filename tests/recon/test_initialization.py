"""Back-projection, the smooth start and the universal weight, against their definitions."""

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.solver.initialization import back_projection, smooth_start, universal_penalty_weight
from tests.recon.test_solvers import SHAPE, box, drawn, shifted_views


@pytest.mark.parametrize("views", [None, [0, 3]])
@pytest.mark.parametrize("estimate", [back_projection, smooth_start])
def test_a_constant_plane_stays_constant_under_flat_field_mask_and_background(
    views: list[int] | None, estimate: Callable[..., Image]
) -> None:
    generator = np.random.default_rng(3)
    valid = generator.random((4, 11, 9)) < 0.8
    operator = shifted_views(4, unseen_columns=4, flat=generator.uniform(0.4, 1, (11, 9)), valid=valid)
    background_e = generator.uniform(0, 5, (1, 11, 9))
    images = ElementalImages(operator.forward(np.full(SHAPE, 2.5)) + background_e, background_e)
    plane = estimate(operator, images) if estimate is smooth_start else estimate(operator, images, views)
    seen = operator.coverage(views) > 1e-3
    assert 0 < seen.sum() < seen.size
    np.testing.assert_allclose(plane[seen], 2.5, rtol=1e-12)


def test_back_projection_without_flat_field_is_divided_by_the_number_of_views_and_zero_where_none_sees() -> None:
    operator = shifted_views(1, unseen_columns=4)
    electrons = np.random.default_rng(3).normal(size=operator.images_shape)
    plane = back_projection(operator, ElementalImages(electrons, background_e=0.5))
    np.testing.assert_allclose(plane[:, :-4], electrons[0, 1:-1, 1:] - 0.5, rtol=1e-12)
    np.testing.assert_array_equal(plane[:, -4:], 0.0)


def test_a_start_is_positive_even_where_the_data_are_negative() -> None:
    operator = shifted_views(3, unseen_columns=5)
    assert smooth_start(operator, ElementalImages(np.full(operator.images_shape, -1.0))).min() > 0
    electrons = np.where(np.arange(operator.images_shape[2]) < 3, 50.0, -1.0) * np.ones(operator.images_shape)
    level_e = operator.adjoint(electrons).sum() / operator.coverage().sum()
    start = smooth_start(operator, ElementalImages(electrons))
    assert start.min() == pytest.approx(0.01 * level_e, rel=1e-9)
    assert start.max() > 2 * level_e


def test_far_from_seen_samples_a_start_has_the_mean_level() -> None:
    operator = shifted_views(3, unseen_columns=10)
    start = smooth_start(operator, ElementalImages(np.full(operator.images_shape, 7.0)))
    assert (operator.coverage()[:, 3:] == 0).all()
    np.testing.assert_allclose(start, 7.0, rtol=1e-12)


def test_the_universal_weight_is_the_noise_of_the_likelihoods_gradient() -> None:
    operator = shifted_views(6)
    images = drawn(operator, box(2, 6), background_e=0.5, variance_e2=12.0)
    weight = universal_penalty_weight(operator, images, np.full(SHAPE, 3.0))
    assert weight == pytest.approx(0.7 * np.sqrt(6 / 15.5), rel=1e-12)
    brighter = replace(images, background_e=0.5 + 15.5 * 3)
    assert universal_penalty_weight(operator, brighter, np.full(SHAPE, 3.0)) == pytest.approx(weight / 2, rel=1e-12)
