"""Views displaced beside one another, whose weights on the samples are known in closed form."""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.pmlem import PmlemIterate

SHAPE = (96, 112)


def views_displaced_by(
    shifts: Image, shape: tuple[int, int] = SHAPE, *, margin: int = 1, width: int = 0, **options: Any
) -> PlaneOperator:
    """Return views of one pixel per sample, displaced by `shifts` (view, 2) down and right, of `width` columns.

    They show `margin` samples beyond each edge of the plane, or fewer than the plane has if it is negative.
    """
    rays = pixel_rays((shape[0], width or shape[1]), margin)
    return PlaneOperator(homographies(shifts), rays, PlaneGrid(shape, 1.0, (0.0, 0.0)), **{"workers": 1, **options})


def planes_displaced_by(
    shifts: Sequence[Image], shape: tuple[int, int] = SHAPE, *, margin: int = 1, **options: Any
) -> SceneOperator:
    """Return several planes of one shape, each displaced by its own shifts (view, 2) in the views."""
    of_planes = np.stack([homographies(of_plane) for of_plane in shifts])
    grids = [PlaneGrid(shape, 1.0, (0.0, 0.0))] * len(shifts)
    return SceneOperator(of_planes, pixel_rays(shape, margin), grids, **{"workers": 1, **options})


def pixel_rays(shape: tuple[int, int], margin: int = 0) -> Image:
    """Return rays (row, column, 2) through samples of pitch one, and through a margin around them."""
    rows, columns = (np.arange(-margin, size + margin, dtype=float) for size in shape)
    return np.stack(np.meshgrid(columns, rows), axis=-1)


def homographies(shifts: Image) -> Image:
    """Return the homographies (view, 3, 3) of views displaced by `shifts` (view, 2) down and right."""
    result = np.stack([np.eye(3)] * len(shifts))
    result[:, :2, 2] = shifts[:, ::-1]
    return result


def dark_images(operator: SceneOperator, background_e: float, variance_e2: float) -> ElementalImages:
    """Return images without any light."""
    return ElementalImages(np.zeros(operator.images_shape, operator.dtype), background_e, variance_e2)


def noisy_images(
    operator: SceneOperator, samples: Image, background_e: float, variance_e2: float, seed: int | np.random.Generator
) -> ElementalImages:
    """Return images of planes with the noise of light and of the sensor."""
    generator = np.random.default_rng(seed)
    light = generator.poisson(operator.forward(samples) + background_e)
    electrons = light + generator.normal(0, np.sqrt(variance_e2), light.shape)
    return ElementalImages(electrons.astype(operator.dtype), background_e, variance_e2)


def pieces(size: int) -> Image:
    """Return a plane of flat pieces and some waves, of about one electron."""
    y, x = np.mgrid[:size, :size] / size
    disc = 1.0 * ((x - 0.4) ** 2 + (y - 0.5) ** 2 < 0.08)
    return np.asarray(0.2 + disc + 0.4 * ((x > 0.6) & (y > 0.3)) + 0.2 * np.sin(9 * x) * (y < 0.25), np.float32)


def dark_views(truth: Image, seed: int) -> tuple[PlaneOperator, ElementalImages]:
    """Return 49 views of a square plane with Poisson light and the read noise of the paper's camera."""
    generator = np.random.default_rng(seed)
    shifts = generator.uniform(-2, 2, (49, 2))[:, ::-1]
    operator = views_displaced_by(shifts, (truth.shape[0], truth.shape[1]), margin=0, workers=None)
    return operator, noisy_images(operator, truth, 0.0, 12.0, generator)


def run_until(iterates: Iterator[PmlemIterate], tolerance: float, most: int) -> PmlemIterate:
    """Return the first iterate that is certified within a tolerance, or the one after `most` passes."""
    for iterate in iterates:
        if iterate.certificate.distance <= tolerance or iterate.passes >= most:
            break
    return iterate
