"""Views displaced beside one another, whose weights on the samples are known in closed form."""

from collections.abc import Sequence

import numpy as np

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.scene_operator import SceneOperator

SHAPE = (96, 112)


def views_displaced_by(
    shifts: Image,
    shape: tuple[int, int] = SHAPE,
    *,
    width: int = 0,
    dtype: type[np.float32] | type[np.float64] = np.float32,
) -> PlaneOperator:
    """Return views of one pixel per sample, displaced by `shifts` (view, 2) down and right, of `width` columns."""
    rays, grid = _rays(shape, width), PlaneGrid(shape, 1.0, (0.0, 0.0))
    return PlaneOperator(_homographies(shifts), rays, grid, workers=1, dtype=dtype)


def planes_displaced_by(
    shifts: Sequence[Image],
    shape: tuple[int, int] = SHAPE,
    *,
    occluders: Occluders | None = None,
    dtype: type[np.float32] | type[np.float64] = np.float32,
) -> SceneOperator:
    """Return several planes of one shape, each displaced by its own shifts (view, 2) in the views."""
    homographies = np.stack([_homographies(of_plane) for of_plane in shifts])
    grids = [PlaneGrid(shape, 1.0, (0.0, 0.0))] * len(shifts)
    return SceneOperator(homographies, _rays(shape), grids, occluders=occluders, workers=1, dtype=dtype)


def dark_images(operator: SceneOperator, background_e: float, variance_e2: float) -> ElementalImages:
    """Return images without any light."""
    return ElementalImages(np.zeros(operator.images_shape, operator.dtype), background_e, variance_e2)


def noisy_images(
    operator: SceneOperator, samples: Image, background_e: float, variance_e2: float, seed: int
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
    homographies = _homographies(generator.uniform(-2, 2, (49, 2))[:, ::-1])
    rays = _rays(truth.shape)[1:-1, 1:-1]
    operator = PlaneOperator(homographies, rays, PlaneGrid(truth.shape, 1.0, (0.0, 0.0)))
    electrons = generator.poisson(operator.forward(truth)) + generator.normal(0, 3.46, operator.images_shape)
    return operator, ElementalImages(electrons.astype(np.float32), 0.0, 12.0)


def _rays(shape: tuple[int, ...], width: int = 0) -> Image:
    columns, rows = np.meshgrid(np.arange(-1.0, (width or shape[1]) + 1), np.arange(-1.0, shape[0] + 1))
    return np.stack([columns, rows], axis=-1)


def _homographies(shifts: Image) -> Image:
    homographies = np.stack([np.eye(3)] * len(shifts))
    homographies[:, :2, 2] = shifts[:, ::-1]
    return homographies
