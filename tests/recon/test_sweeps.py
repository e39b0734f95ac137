"""Compiled sweeps against the contract, and an operator on another implementation."""

import numpy as np
import pytest

from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.sweeps import CompiledSweeps
from faintfield.testing.sweeps import ArraySweeps, sweeps_contract


def test_sweeps_meet_their_contract() -> None:
    sweeps_contract(CompiledSweeps)


def test_an_operator_works_on_any_sweeps() -> None:
    grid, homographies = PlaneGrid((9, 80), 1.0, (-40.0, -4.0)), np.repeat(np.eye(3)[np.newaxis, np.newaxis], 3, axis=1)
    homographies[0, 1:, 0, 2] = 1.3, -60.0
    rays = np.stack(np.meshgrid(np.arange(-35.0, 35.0), np.arange(-3.0, 4.0)), axis=-1)
    compiled, arrays = (
        SceneOperator(homographies, rays, [grid], dtype=np.float64, sweeps=sweeps)
        for sweeps in (CompiledSweeps, ArraySweeps)
    )
    electrons = np.random.default_rng(4).normal(2, 2, compiled.images_shape)
    images, samples = ElementalImages(electrons, 0.3, 2.0), np.linspace(0.5, 3, grid.shape[0] * grid.shape[1])
    np.testing.assert_array_equal(arrays.seeing_views, compiled.seeing_views)
    np.testing.assert_allclose(arrays.coverage(), compiled.coverage(), rtol=1e-12, atol=1e-12)
    value, ratio = compiled.value_and_ratio(samples, images)
    assert arrays.negative_log_likelihood(samples, images) == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(arrays.adjoint_of_ratio(samples, images), ratio, rtol=1e-12, atol=1e-12)
