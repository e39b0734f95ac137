"""Views of one textured scene from a grid of cameras, painted layer over layer: near layers hide far ones."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import map_coordinates

type Views = dict[tuple[int, int], NDArray[np.float32]]


@dataclass(frozen=True)
class Layer:
    """A flat card: how far it moves from node to node, its centre and half size in px; no size is a whole wall."""

    disparity_px: float
    centre_px: tuple[float, float] = (0.0, 0.0)
    half_size_px: tuple[float, float] = (np.inf, np.inf)


# A wall, and cards before it: cameras that move right and down see near points move left and up.
CARDS = (
    Layer(-1.0),
    Layer(-2.0, (-45, -25), (20, 18)),
    Layer(-2.6, (30, -20), (14, 26)),
    Layer(-3.2, (-20, 28), (26, 14)),
    Layer(-3.8, (48, 30), (12, 16)),
    Layer(-3.4, (5, 2), (9, 9)),
)


def light_field(
    layers: tuple[Layer, ...] = CARDS,
    grid: tuple[int, int] = (7, 7),
    size_px: tuple[int, int] = (160, 120),
    *,
    aligned_px: float = 0.0,
    ratio: float = 1.0,
    detail: float = 1.0,
    seed: int = 1,
) -> Views:
    """Return views (row, column) by node (row, column), of values 0…1, of layers from far to near.

    `aligned_px` is added to every disparity, as aligning the pictures on a plane does; `ratio` is the pitch along
    columns over that along rows; `detail` is the slope of the textures' spectrum: larger is smoother.
    """
    generator = np.random.default_rng(seed)
    textures = [_texture(generator, detail) for _ in layers]
    width, height = size_px
    fine = (np.arange(2) + 0.5) / 2 - 0.5
    x = (np.arange(width)[:, np.newaxis] + fine).ravel() - (width - 1) / 2
    y = (np.arange(height)[:, np.newaxis] + fine).ravel() - (height - 1) / 2
    views = {}
    for row, column in np.ndindex(*grid):
        picture = np.zeros((len(y), len(x)))
        for layer, texture in zip(layers, textures, strict=True):
            moved_px = layer.disparity_px + aligned_px
            on_x = x - ratio * moved_px * (column - grid[1] // 2) - layer.centre_px[0]
            on_y = y - moved_px * (row - grid[0] // 2) - layer.centre_px[1]
            rows = np.flatnonzero(np.abs(on_y) <= layer.half_size_px[1])
            columns = np.flatnonzero(np.abs(on_x) <= layer.half_size_px[0])
            places = np.meshgrid(on_y[rows], on_x[columns], indexing="ij")
            picture[np.ix_(rows, columns)] = map_coordinates(texture, places, order=1, mode="grid-wrap")
        views[row, column] = picture.reshape(height, 2, width, 2).mean(axis=(1, 3)).astype(np.float32)
    return views


def with_noise(views: Views, snr: float, seed: int = 5) -> Views:
    """Return the views with noise of such deviation that the mean light is `snr` times it."""
    generator = np.random.default_rng(seed)
    sigma = float(np.mean([view.mean() for view in views.values()])) / snr
    return {node: (view + generator.normal(0, sigma, view.shape)).astype(np.float32) for node, view in views.items()}


def _texture(generator: np.random.Generator, slope: float) -> NDArray[np.float64]:
    """Return a tile with detail of all sizes, 0…1, of a mean of its own."""
    size = 256
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = np.inf
    noise = np.fft.ifft2(np.fft.fft2(generator.standard_normal((size, size))) / frequency**slope).real
    return np.clip(generator.uniform(0.35, 0.65) + 0.15 * noise / noise.std(), 0, 1)
