"""Sweeps against their contract; the contract against sweeps with faults; an operator on another implementation."""

from typing import Any

import numpy as np
import pytest

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator import kernels
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.scene_blocks import Hiding
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.sweeps import CompiledSweeps, Sweeps
from faintfield.testing.sweeps import ArraySweeps, sweeps_contract


@pytest.mark.parametrize("implementation", [CompiledSweeps, ArraySweeps])
def test_sweeps_meet_their_contract(implementation: type[Sweeps]) -> None:
    sweeps_contract(implementation)


class _WithoutMasks(ArraySweeps):
    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None:
        super().__init__(geometry._replace(valid=geometry.valid[:0]), hiding, workers)


class _Transparent(ArraySweeps):
    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None:
        super().__init__(geometry, hiding._replace(opacities=hiding.opacities[:0]), workers)


class _OneLattice(ArraySweeps):
    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None:
        super().__init__(geometry._replace(lattice_of_view=geometry.lattice_of_view * 0), hiding, workers)


class _Flat(ArraySweeps):
    def __init__(self, geometry: kernels.SceneGeometry, hiding: Hiding, workers: int) -> None:
        super().__init__(geometry._replace(relief=np.maximum(geometry.relief, 0)), hiding, workers)


class _AllViews(ArraySweeps):
    def run(self, operation: int, views: Any, image_of_view: Any, **arrays: Any) -> tuple[float, Image]:
        chosen = np.arange(len(image_of_view)) if operation == kernels.ADJOINT else views
        return super().run(operation, chosen, image_of_view, **arrays)


class _Greedy(ArraySweeps):
    def run(self, operation: int, views: Any, image_of_view: Any, **arrays: Any) -> tuple[float, Image]:
        result = super().run(operation, views, image_of_view, **arrays)
        if operation == kernels.RATIO:
            arrays["images"][0, 0, 0] += 1
        return result


@pytest.mark.parametrize("faulty", [_WithoutMasks, _Transparent, _OneLattice, _Flat, _AllViews, _Greedy])
def test_the_contract_finds(faulty: type[Sweeps]) -> None:
    with pytest.raises(AssertionError):
        sweeps_contract(faulty)


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
