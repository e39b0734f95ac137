"""The slanted, curved and thin objects of a simulated scene: a wall, a floor, a ball, a page and a rod."""

import numpy as np
from numpy.typing import NDArray

from faintfield.rig.simulation.shapes import Cylinder, Rectangle, Shape, Sphere
from faintfield.rig.simulation.surfaces import Surface

type Colour = tuple[float, float, float]
type Tile = NDArray[np.float32]

# Angle in rad at which the floor rises away from the camera.
_RISE = 0.16


def surface_scene() -> tuple[Surface, ...]:
    """Return the scene: a wall and a rising floor fill every view, before them a ball, a page, and a rod 6 mm thick.

    The reference camera sees depths from 517 to 1009 mm. The cameras of a grid that spans 300 mm are all above the
    floor, and see the rod from the floor, or the lower edge of the view, to the upper edge.
    """
    wall = Rectangle((0.0, -0.38, 0.0, 0.0, 0.0, 850.0))
    floor = Rectangle((_RISE - np.pi / 2, 0.0, 0.0, 0.0, 215.0, 520.0))
    ball = Sphere((-120.0, 118.0, 680.0), 70.0)
    page = Rectangle((-0.2, 0.5, 0.0, 125.0, 60.0, 600.0), (85.0, 105.0))
    rod = Cylinder((45.0, 500.0, 520.0), (5.0, -500.0, 520.0), 3.0)
    return (
        _painted("wall", wall, _clouds(1, 1024, 1.1), 1.0, (0.10, 0.12, 0.20), (0.95, 0.90, 0.80)),
        _painted("floor", floor, _patches(2, 1024, 1.4), 1.0, (0.30, 0.16, 0.08), (0.90, 0.75, 0.55)),
        _painted("ball", ball, _clouds(3, 512, 1.1), 0.5, (0.45, 0.05, 0.05), (1.00, 0.85, 0.75)),
        _painted("page", page, _print(4, 512), 0.5, (0.06, 0.06, 0.10), (0.95, 0.95, 0.90)),
        _painted("rod", rod, _clouds(5, 128, 1.1), 0.5, (0.70, 0.60, 0.20), (1.00, 0.95, 0.60)),
    )


def _painted(name: str, shape: Shape, tile: Tile, pitch_mm: float, dark: Colour, bright: Colour) -> Surface:
    low, high = np.array(dark), np.array(bright)
    return Surface(name, shape, (low + tile[:, :, np.newaxis] * (high - low)).astype(np.float32), pitch_mm)


def _noise(seed: int, size: int, slope: float) -> Tile:
    """Return noise whose amplitude falls with frequency to the power of `slope`, of deviation 1; it repeats."""
    generator = np.random.default_rng(seed)
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = np.inf
    noise = np.fft.ifft2(np.fft.fft2(generator.standard_normal((size, size))) / frequency**slope).real
    return np.asarray(noise / noise.std(), np.float32)


def _clouds(seed: int, size: int, slope: float) -> Tile:
    return np.asarray(np.clip(0.5 + 0.25 * _noise(seed, size, slope), 0, 1), np.float32)


def _patches(seed: int, size: int, slope: float) -> Tile:
    """Return patches of three shades with faint detail within, 0…1."""
    noise = _noise(seed, size, slope)
    shades = np.select([noise > 0.4, noise > -0.4], [0.9, 0.5], 0.1)
    return np.asarray(np.clip(shades + 0.04 * noise, 0, 1), np.float32)


def _print(seed: int, size: int) -> Tile:
    generator = np.random.default_rng(seed)
    tile = np.ones((size, size), np.float32)
    for top in range(8, size - 20, 28):
        left = 8
        while left < size - 24:
            width = int(generator.integers(4, 16))
            tile[top : top + 14, left : left + width] = generator.choice([0.0, 0.0, 0.45])
            left += width + int(generator.integers(3, 8))
    return tile
