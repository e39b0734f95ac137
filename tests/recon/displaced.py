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
    turn_rad: float = 0.0,
    dtype: type[np.float32] | type[np.float64] = np.float32,
) -> PlaneOperator:
    """Views of one pixel per sample, displaced by `shifts` (view, 2) down and right; `width` columns are seen."""
    rays, grid = _rays(shape, width), PlaneGrid(shape, 1.0, (0.0, 0.0))
    return PlaneOperator(_homographies(shifts, turn_rad), rays, grid, workers=1, dtype=dtype)


def planes_displaced_by(
    shifts: Sequence[Image],
    shape: tuple[int, int] = SHAPE,
    *,
    occluders: Occluders | None = None,
    dtype: type[np.float32] | type[np.float64] = np.float32,
) -> SceneOperator:
    """Several planes of one shape, each displaced by its own shifts (view, 2) in the views."""
    homographies = np.stack([_homographies(of_plane) for of_plane in shifts])
    grids = [PlaneGrid(shape, 1.0, (0.0, 0.0))] * len(shifts)
    return SceneOperator(homographies, _rays(shape), grids, occluders=occluders, workers=1, dtype=dtype)


def dark_images(operator: SceneOperator, background_e: float, variance_e2: float) -> ElementalImages:
    """Images in which nothing is seen."""
    return ElementalImages(np.zeros(operator.images_shape, operator.dtype), background_e, variance_e2)


def noisy_images(
    operator: SceneOperator, samples: Image, background_e: float, variance_e2: float, seed: int
) -> ElementalImages:
    """Images of planes with the noise of light and of the sensor."""
    generator = np.random.default_rng(seed)
    light = generator.poisson(operator.forward(samples) + background_e)
    electrons = light + generator.normal(0, np.sqrt(variance_e2), light.shape)
    return ElementalImages(electrons.astype(operator.dtype), background_e, variance_e2)


def _rays(shape: tuple[int, int], width: int = 0) -> Image:
    columns, rows = np.meshgrid(np.arange(-1.0, (width or shape[1]) + 1), np.arange(-1.0, shape[0] + 1))
    return np.stack([columns, rows], axis=-1)


def _homographies(shifts: Image, turn_rad: float = 0.0) -> Image:
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    homographies = np.stack([np.eye(3)] * len(shifts))
    homographies[:, :2, :2], homographies[:, :2, 2] = turn, shifts[:, ::-1]
    return homographies
