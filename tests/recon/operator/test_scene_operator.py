"""Several planes in one sweep against operators of one plane each; data that stay on disk; opacities; sweeps."""

import tracemalloc
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from faintfield.calib.lens import Lens
from faintfield.recon.errors import GeometryMismatch
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator import kernels
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders, opacity
from faintfield.recon.operator.placement import BLOCK_PX
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.sweeps import CompiledSweeps
from faintfield.testing.sweeps import ArraySweeps, sweeps_contract

# Four blocks of pixels and a rest; poses in step with the planes, turned so that they are not, and far aside
LENS = Lens((4 * BLOCK_PX + 9, 13), 300.0, 300.0, 130.2, 6.1, (-0.08, 0.02))
POSES = np.array([[0.0] * 6, [2e-3, -3e-3, 4e-3, 30, -4, 3], [0, 0, 0.2, -20, 5, 0], [0, 0, 0, -190, 0, 0]])
DEPTHS_MM = (400.0, 500.0, 900.0)
GRIDS = tuple(
    PlaneGrid((rows, columns), pitch * depth / 300.0, (-columns * pitch * depth / 600.0, -rows * pitch * depth / 600.0))
    for depth, rows, columns, pitch in zip(DEPTHS_MM, (21, 15, 9), (260, 270, 101), (1.0, 1.0, 2.0), strict=True)
)

HOMOGRAPHIES = np.stack([plane_from_ray(POSES, fronto_parallel_rt_ref_plane(depth)) for depth in DEPTHS_MM])
IMAGES_SHAPE = (len(POSES), LENS.size_px[1], LENS.size_px[0])


def known(generator: np.random.Generator) -> dict[str, Any]:
    return {
        "flat": generator.uniform(0.5, 1.0, IMAGES_SHAPE[1:]),
        "valid": generator.random(IMAGES_SHAPE) > 0.05,
        "dtype": np.float64,
        "workers": 2,
    }


@pytest.fixture
def generator() -> np.random.Generator:
    return np.random.default_rng(7)


def singles(options: dict[str, Any]) -> list[PlaneOperator]:
    return [PlaneOperator(h, LENS.rays(), grid, **options) for h, grid in zip(HOMOGRAPHIES, GRIDS, strict=True)]


def planes_of(generator: np.random.Generator) -> list[Image]:
    return [generator.normal(size=grid.shape) for grid in GRIDS]


def occluders(generator: np.random.Generator) -> Occluders:
    """A few opaque samples on each plane, of which many blocks see none; the first two planes hide not each other."""
    opacities = [(generator.random(grid.shape) < 0.02) * generator.uniform(0, 1, grid.shape) for grid in GRIDS]
    opacities[2][3:5, 40:60] = 1.0
    return Occluders(opacities, [700.0, 700.0, 300.0])


def transmission_of(hiding: Occluders) -> Image:
    """What nearer planes leave of each plane's light (plane, view, row, column), by operators of one plane each."""
    alone = [PlaneOperator(h, LENS.rays(), grid, dtype=np.float64) for h, grid in zip(HOMOGRAPHIES, GRIDS, strict=True)]
    left = [1 - operator.forward(alpha) for operator, alpha in zip(alone, hiding.opacities, strict=True)]
    through = [
        [part for part, other_mm in zip(left, hiding.depths_mm, strict=True) if other_mm < depth_mm]
        for depth_mm in hiding.depths_mm
    ]
    return np.stack([np.prod([np.ones(IMAGES_SHAPE), *parts], axis=0) for parts in through])


@pytest.mark.parametrize("occluded", [False, True])
def test_scene_is_the_sum_of_its_planes(occluded: bool, generator: np.random.Generator) -> None:
    options, hiding = known(generator), occluders(generator) if occluded else None
    scene = SceneOperator(HOMOGRAPHIES, LENS.rays(), GRIDS, **options, occluders=hiding)
    transmission = transmission_of(hiding) if hiding else np.ones((len(GRIDS), 1, 1, 1))
    alone = singles(options)
    planes, images = planes_of(generator), generator.normal(size=IMAGES_SHAPE)
    expected = sum(t * operator.forward(plane) for operator, plane, t in zip(alone, planes, transmission, strict=True))
    np.testing.assert_allclose(scene.forward(scene.samples_of(planes)), expected, atol=1e-12)
    for back, operator, t in zip(scene.planes_of(scene.adjoint(images)), alone, transmission, strict=True):
        np.testing.assert_allclose(back, operator.adjoint(t * images), atol=1e-12)


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
        SceneOperator(HOMOGRAPHIES, LENS.rays(), **{"grids": GRIDS, **bad})


def test_planes_of_other_shapes_are_refused() -> None:
    scene = SceneOperator(HOMOGRAPHIES, LENS.rays(), GRIDS)
    with pytest.raises(GeometryMismatch, match="shapes"):
        scene.samples_of([np.ones(grid.shape) for grid in GRIDS[::-1]])


def test_data_on_disk_are_neither_copied_nor_compiled(tmp_path: Path) -> None:
    shape, grid = (60, 128, 128), PlaneGrid((128, 128), 1.0, (0.0, 0.0))
    electrons = np.random.default_rng(5).normal(1, 3, shape).astype(np.float32)
    np.save(tmp_path / "electrons.npy", electrons)
    rays = np.stack(np.meshgrid(np.arange(128.0), np.arange(128.0)), axis=-1)
    operator = PlaneOperator(np.repeat(np.eye(3)[np.newaxis], 60, axis=0), rays, grid, workers=2)
    plane = np.ones(grid.shape, np.float32)
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
    rays = np.stack(np.meshgrid(np.arange(8.0), np.arange(6.0)), axis=-1)
    valid = np.ones((3, 6, 8), bool)
    valid[1] = False
    grid = PlaneGrid((6, 8), 1.0, (0.0, 0.0))
    homographies = np.stack([np.eye(3)] * 3)[np.newaxis]
    masked = SceneOperator(homographies, rays, [grid], valid=valid)
    assert masked.seeing_views.tolist() == [0, 2]
    assert SceneOperator(homographies, rays, [grid]).seeing_views.tolist() == [0, 1, 2]


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
