"""Planes that hide others; data that stay on disk; opacities; sweeps."""

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator import kernels
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders, opacity
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.sweeps import CompiledSweeps
from faintfield.testing.sweeps import ArraySweeps, sweeps_contract
from tests.recon.displaced import pixel_rays, planes_displaced_by, views_displaced_by

SHAPES = ((6, 8), (9, 12), (7, 10))
GRIDS = tuple(PlaneGrid(shape, 1.0, (0.0, 0.0)) for shape in SHAPES)
DEPTHS_MM = (400.0, 500.0, 900.0)
HOMOGRAPHIES = np.zeros((3, 4, 3, 3)) + np.eye(3)


def test_nearer_planes_hide_farther_ones() -> None:
    """Samples lie on pixels; the planes come in any order, and the first two hide not each other."""
    generator = np.random.default_rng(7)
    alphas, depths_mm = generator.uniform(0, 1, (3, 6, 8)), (700.0, 700.0, 300.0)
    hiding = Occluders(list(alphas), depths_mm)
    scene = planes_displaced_by([np.zeros((1, 2))] * 3, (6, 8), margin=0, occluders=hiding, dtype=np.float64)
    lights, image = generator.normal(size=(3, 6, 8)), generator.normal(size=(1, 6, 8))
    through = np.stack([1 - alphas[2], 1 - alphas[2], np.ones((6, 8))])
    np.testing.assert_allclose(scene.forward(scene.samples_of(list(lights)))[0], (through * lights).sum(axis=0))
    np.testing.assert_allclose(scene.planes_of(scene.adjoint(image)), through * image)


@pytest.mark.parametrize(
    ("bad", "words"),
    [
        ({"occluders": Occluders([np.ones((2, 2))] * 3, DEPTHS_MM)}, "opacities of shapes"),
        ({"occluders": Occluders([np.ones(grid.shape) for grid in GRIDS], DEPTHS_MM[:2])}, "and 2 depths do not fit"),
        ({"occluders": Occluders([np.full(grid.shape, -0.1) for grid in GRIDS], DEPTHS_MM)}, "an opacity is negative"),
        ({"grids": (*GRIDS[:2], PlaneGrid((5, 5), 1.0, (9e5, 0.0)))}, "no pixel of any of the 4 views"),
    ],
)
def test_parts_that_do_not_fit_are_refused(bad: dict[str, Any], words: str) -> None:
    with pytest.raises(GeometryMismatch, match=words):
        SceneOperator(HOMOGRAPHIES, pixel_rays((6, 8)), **{"grids": GRIDS, **bad})


def test_planes_of_other_shapes_are_refused() -> None:
    scene = SceneOperator(HOMOGRAPHIES, pixel_rays((6, 8)), GRIDS)
    with pytest.raises(GeometryMismatch, match="shapes"):
        scene.samples_of([np.ones(grid.shape) for grid in GRIDS[::-1]])


def test_data_on_disk_are_neither_copied_nor_compiled(tmp_path: Path) -> None:
    electrons = np.random.default_rng(5).normal(1, 3, (60, 128, 128)).astype(np.float32)
    np.save(tmp_path / "electrons.npy", electrons)
    operator = views_displaced_by(np.zeros((60, 2)), (128, 128), margin=0, workers=2)
    plane = np.ones((128, 128), np.float32)
    in_memory = operator.adjoint_of_ratio(plane, ElementalImages(electrons, 0.1, 9.0))
    compiled = len(kernels.sweep.signatures)
    tracemalloc.start()
    on_disk = ElementalImages(np.load(tmp_path / "electrons.npy", mmap_mode="r"), 0.1, 9.0)
    np.testing.assert_array_equal(operator.adjoint_of_ratio(plane, on_disk), in_memory)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < electrons.nbytes / 4
    assert len(kernels.sweep.signatures) == compiled


@pytest.mark.parametrize(("share", "expected"), [(0.15, 0.0), (0.2, 0.25), (0.35, 1.0)])
def test_opacity_rises_with_light(share: float, expected: float) -> None:
    # Halves of light 1 and b have the typical light (1 + b²)/(1 + b), and b shall be `share` of it
    b = (np.sqrt(1 + 4 * share * (1 - share)) - 1) / (2 * (1 - share))
    plane = np.ones((40, 80))
    plane[:, 40:] = b
    assert b * (1 + b) == pytest.approx(share * (1 + b**2))
    result = opacity(plane)
    assert result[20, 10] == 1.0
    assert result[20, 70] == pytest.approx(expected, abs=0.03)


def test_black_plane_is_transparent() -> None:
    assert not opacity(np.zeros((8, 8), np.float32)).any()
    assert opacity(np.zeros((8, 8), np.float32)).dtype == np.float32


def test_view_without_valid_pixels_sees_nothing() -> None:
    valid = np.ones((3, 6, 8), bool)
    valid[1] = False
    for mask, seeing in ((valid, [0, 2]), (None, [0, 1, 2])):
        operator = views_displaced_by(np.zeros((3, 2)), (6, 8), margin=0, valid=mask)
        assert operator.seeing_views.tolist() == seeing


def test_sweeps_meet_their_contract() -> None:
    sweeps_contract(CompiledSweeps)


def test_an_operator_works_on_any_sweeps() -> None:
    shifts, opacity_of_each = np.array([[0.0, 0.0], [0.0, 1.3], [0.0, -60.0]]), np.linspace(0, 1, 720).reshape(9, 80)
    hiding = Occluders([opacity_of_each] * 2, [500.0, 700.0])
    compiled, arrays = (
        planes_displaced_by([shifts, 2 * shifts], (9, 80), margin=-1, occluders=hiding, dtype=np.float64, sweeps=sweeps)
        for sweeps in (CompiledSweeps, ArraySweeps)
    )
    electrons = np.random.default_rng(4).normal(2, 2, compiled.images_shape)
    images, samples = ElementalImages(electrons, 0.3, 2.0), np.linspace(0.5, 3, 2 * 9 * 80)
    np.testing.assert_array_equal(arrays.seeing_views, compiled.seeing_views)
    np.testing.assert_allclose(arrays.coverage(), compiled.coverage(), rtol=1e-12, atol=1e-12)
    value, ratio = compiled.value_and_ratio(samples, images)
    assert arrays.negative_log_likelihood(samples, images) == pytest.approx(value, rel=1e-12)
    np.testing.assert_allclose(arrays.adjoint_of_ratio(samples, images), ratio, rtol=1e-12, atol=1e-12)
