"""The objects of the simulated experiments: flat toys, a resolution chart, a ball; and a scene of surfaces."""

from functools import cache

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.rig.simulation.scene import TexturedPlane
from faintfield.rig.simulation.surfaces import Cylinder, Rectangle, Shape, Sphere, Surface

# Objects are drawn this many times finer than the texture and averaged, so that edges are smooth.
_OVERSAMPLING = 4

# Distance of texture samples: finer than a pixel of the 640 px camera at the objects' depths.
_TEXTURE_PITCH_MM = 0.25

type Colour = tuple[float, float, float]

_RED, _YELLOW, _WHITE = (0.95, 0.30, 0.25), (1.0, 0.85, 0.35), (1.0, 1.0, 1.0)
_BLUE, _GREY, _DARK = (0.35, 0.55, 0.95), (0.60, 0.62, 0.65), (0.18, 0.18, 0.20)


class _Canvas:
    """A drawing with an outline; coordinates in mm from its centre, x to the right and y down."""

    def __init__(self, width_mm: float, height_mm: float) -> None:
        self._scale = _OVERSAMPLING / _TEXTURE_PITCH_MM
        self._size = (round(width_mm * self._scale), round(height_mm * self._scale))
        self._colour = np.zeros((self._size[1], self._size[0], 3), np.uint8)
        self._opacity = np.zeros((self._size[1], self._size[0]), np.float32)

    def polygon(self, corners_mm: list[tuple[float, float]], colour: Colour) -> None:
        points = self._pixels(corners_mm)
        cv2.fillPoly(self._colour, [points], _levels(colour))
        cv2.fillPoly(self._opacity, [points], 1.0)

    def box(self, left_mm: float, top_mm: float, right_mm: float, bottom_mm: float, colour: Colour) -> None:
        self.polygon([(left_mm, top_mm), (right_mm, top_mm), (right_mm, bottom_mm), (left_mm, bottom_mm)], colour)

    def ellipse(self, x_mm: float, y_mm: float, radius_x_mm: float, radius_y_mm: float, colour: Colour) -> None:
        angle = np.linspace(0, 2 * np.pi, 240)
        self.polygon([(x_mm + radius_x_mm * np.cos(a), y_mm + radius_y_mm * np.sin(a)) for a in angle], colour)

    def text(self, caption: str, x_mm: float, y_mm: float, height_mm: float, colour: Colour) -> None:
        """Write text with its lower left corner at x, y, on what is already drawn."""
        scale = height_mm * self._scale / 21  # the font's capitals are 21 px high at scale 1
        at = tuple(int(value) for value in self._pixels([(x_mm, y_mm)])[0])
        thickness = round(3 * scale)
        cv2.putText(self._colour, caption, at, cv2.FONT_HERSHEY_DUPLEX, scale, _levels(colour), thickness, cv2.LINE_AA)

    def plane(self, name: str, x_mm: float, y_mm: float, depth_mm: float, shading: float) -> TexturedPlane:
        """Return the drawing as an object at x, y and a depth; shading darkens it towards its lower right."""
        size = (self._size[0] // _OVERSAMPLING, self._size[1] // _OVERSAMPLING)
        colour = cv2.resize(self._colour, size, interpolation=cv2.INTER_AREA).astype(np.float32) / 255
        opacity = cv2.resize(self._opacity, size, interpolation=cv2.INTER_AREA)
        rows, columns = np.mgrid[0 : 1 : size[1] * 1j, 0 : 1 : size[0] * 1j]
        light = (1 - shading * (rows + columns) / 2)[:, :, np.newaxis]
        # Divided by the opacity, the colour of partly covered samples is that of their covered part
        inside = colour * light / np.maximum(opacity, 1e-3)[:, :, np.newaxis]
        reflectance = np.clip(inside, 0, 1).astype(np.float32)
        reflectance.flags.writeable = opacity.flags.writeable = False  # shared by all scenes that hold the object
        return TexturedPlane(name, reflectance, opacity, _TEXTURE_PITCH_MM, (0, 0, 0, x_mm, y_mm, depth_mm))

    def _pixels(self, points_mm: list[tuple[float, float]]) -> NDArray[np.int32]:
        centre = np.array(self._size) / 2
        return np.rint(np.array(points_mm) * self._scale + centre).astype(np.int32)


def _levels(colour: Colour) -> tuple[int, int, int]:
    red, green, blue = (round(255 * part) for part in colour)
    return red, green, blue


@cache
def toy_truck(x_mm: float, y_mm: float, depth_mm: float) -> TexturedPlane:
    """Return a toy truck 190 mm long, seen from the side, at x, y and a depth."""
    canvas = _Canvas(200, 120)
    canvas.box(-95, 22, 90, 32, _GREY)
    canvas.box(-95, -48, 38, 24, _YELLOW)
    for x_mm_plank in range(-95, 30, 19):
        canvas.box(x_mm_plank, -48, x_mm_plank + 2, 24, (0.75, 0.55, 0.15))
    canvas.box(-95, -48, 38, -43, (0.85, 0.35, 0.20))
    canvas.box(-95, 14, 38, 18, (0.85, 0.35, 0.20))
    canvas.box(-80, -32, 26, 4, _WHITE)
    canvas.text("TOYS 49", -72, -7, 14, _DARK)
    canvas.polygon([(42, 32), (42, -34), (70, -34), (86, -4), (94, 2), (94, 32)], _RED)
    canvas.polygon([(50, -27), (67, -27), (78, -4), (50, -4)], (0.80, 0.92, 1.0))
    canvas.box(48, 4, 60, 8, _WHITE)
    canvas.box(86, 10, 94, 17, _YELLOW)
    canvas.box(80, 25, 96, 32, _GREY)
    for x_mm_wheel in (-68, -38, 68):
        canvas.ellipse(x_mm_wheel, 34, 17, 17, _DARK)
        canvas.ellipse(x_mm_wheel, 34, 10, 10, (0.85, 0.85, 0.88))
        for angle in np.arange(5) * 2 * np.pi / 5:
            canvas.ellipse(x_mm_wheel + 6 * np.cos(angle), 34 + 6 * np.sin(angle), 1.8, 1.8, _DARK)
        canvas.ellipse(x_mm_wheel, 34, 2.5, 2.5, _RED)
    return canvas.plane("truck", x_mm, y_mm, depth_mm, shading=0.25)


@cache
def toy_airplane(x_mm: float, y_mm: float, depth_mm: float) -> TexturedPlane:
    """Return a toy airplane 265 mm long, seen from above, at x, y and a depth."""
    canvas = _Canvas(280, 250)
    for side in (-1, 1):
        canvas.polygon([(28, 10 * side), (-22, 116 * side), (-48, 116 * side), (-28, 10 * side)], _BLUE)
        canvas.polygon([(-3, 76 * side), (-22, 116 * side), (-48, 116 * side), (-42, 76 * side)], _WHITE)
        canvas.polygon([(-12, 95 * side), (-17, 106 * side), (-46, 106 * side), (-44, 95 * side)], _RED)
        canvas.polygon([(-92, 8 * side), (-116, 46 * side), (-130, 46 * side), (-122, 8 * side)], _RED)
        canvas.ellipse(16, 42 * side, 20, 9, _WHITE)
        canvas.ellipse(32, 42 * side, 4, 8, _DARK)
        canvas.ellipse(-18, 52 * side, 12, 12, _WHITE)
        canvas.ellipse(-18, 52 * side, 8, 8, _RED)
        canvas.ellipse(-18, 52 * side, 3.5, 3.5, _YELLOW)
    canvas.ellipse(0, 0, 132, 17, _WHITE)
    canvas.polygon([(-128, -3), (-70, -2), (-70, 2), (-128, 3)], _RED)
    canvas.ellipse(84, 0, 22, 11, (0.25, 0.35, 0.50))
    canvas.box(82, -11, 85, 11, _WHITE)
    canvas.box(-60, -9, 48, -5, _DARK)
    canvas.box(-60, 5, 48, 9, _DARK)
    canvas.text("FAINT", -42, 4.2, 8, _BLUE)
    canvas.ellipse(126, 0, 7, 8, _RED)
    return canvas.plane("airplane", x_mm, y_mm, depth_mm, shading=0.2)


def sailing_boat(x_mm: float, y_mm: float, depth_mm: float) -> TexturedPlane:
    """Return a toy sailing boat 180 mm long, seen from the side, at x, y and a depth."""
    canvas = _Canvas(190, 190)
    canvas.box(-3, -84, 2, 44, (0.75, 0.55, 0.15))
    canvas.polygon([(2, -92), (30, -84), (2, -76)], _RED)
    canvas.polygon([(5, -72), (5, 30), (80, 30)], _WHITE)
    canvas.polygon([(5, 6), (5, 16), (70, 16), (62, 6)], _BLUE)
    canvas.text("F 16", 11, -3, 12, _DARK)
    canvas.polygon([(-7, -66), (-7, 30), (-72, 30)], _YELLOW)
    canvas.polygon([(-7, -34), (-7, -18), (-40, -18), (-29, -34)], (0.85, 0.35, 0.20))
    canvas.polygon([(-90, 40), (90, 40), (68, 84), (-64, 84)], _RED)
    canvas.polygon([(-90, 40), (90, 40), (86, 48), (-85, 48)], _WHITE)
    canvas.polygon([(-73, 70), (75, 70), (68, 84), (-64, 84)], _BLUE)
    for x_mm_porthole in (-50, -20, 10, 40):
        canvas.ellipse(x_mm_porthole, 58, 7, 7, _GREY)
        canvas.ellipse(x_mm_porthole, 58, 4.5, 4.5, _DARK)
    return canvas.plane("boat", x_mm, y_mm, depth_mm, shading=0.2)


def star_chart(x_mm: float, y_mm: float, depth_mm: float, radius_mm: float = 75.0, spokes: int = 24) -> TexturedPlane:
    """Return a Siemens star on a white disc, at x, y and a depth: full contrast at every spatial frequency."""
    canvas = _Canvas(2.1 * radius_mm, 2.1 * radius_mm)
    canvas.ellipse(0, 0, radius_mm, radius_mm, _WHITE)
    for angle in 2 * np.pi * np.arange(spokes) / spokes:
        edges = angle + np.pi / spokes * np.array([-0.5, 0.5])
        corners = [(0.92 * radius_mm * np.cos(edge), 0.92 * radius_mm * np.sin(edge)) for edge in edges]
        canvas.polygon([(0.0, 0.0), *corners], _DARK)
    return canvas.plane("star", x_mm, y_mm, depth_mm, shading=0.0)


def shaded_ball(x_mm: float, y_mm: float, depth_mm: float, radius_mm: float = 75.0) -> TexturedPlane:
    """Return a picture of a ball lit from the upper left, at x, y and a depth: smooth shades inside its rim."""
    side = round(2.1 * radius_mm / _TEXTURE_PITCH_MM)
    y, x = (np.mgrid[:side, :side] - (side - 1) / 2) * (_TEXTURE_PITCH_MM / radius_mm)
    squared = x**2 + y**2
    towards = np.sqrt(np.maximum(1 - squared, 0))
    lit = np.maximum((-0.45 * x - 0.45 * y + 0.77 * towards), 0)
    reflectance = np.clip(0.12 + 0.72 * lit + 0.16 * lit**12, 0, 1).astype(np.float32)
    rim = (1 - np.sqrt(squared)) * radius_mm / _TEXTURE_PITCH_MM + 0.5
    colour = np.repeat(reflectance[:, :, np.newaxis], 3, axis=2)
    opacity = np.clip(rim, 0, 1).astype(np.float32)
    return TexturedPlane("ball", colour, opacity, _TEXTURE_PITCH_MM, (0, 0, 0, x_mm, y_mm, depth_mm))


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
        _paint("wall", wall, _clouds(1, 1024, 1.1), 1.0, (0.10, 0.12, 0.20), (0.95, 0.90, 0.80)),
        _paint("floor", floor, _patches(2, 1024, 1.4), 1.0, (0.30, 0.16, 0.08), (0.90, 0.75, 0.55)),
        _paint("ball", ball, _clouds(3, 512, 1.1), 0.5, (0.45, 0.05, 0.05), (1.00, 0.85, 0.75)),
        _paint("page", page, _print(4, 512), 0.5, (0.06, 0.06, 0.10), (0.95, 0.95, 0.90)),
        _paint("rod", rod, _clouds(5, 128, 1.1), 0.5, (0.70, 0.60, 0.20), (1.00, 0.95, 0.60)),
    )


def _paint(name: str, shape: Shape, tile: Tile, pitch_mm: float, dark: Colour, bright: Colour) -> Surface:
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
