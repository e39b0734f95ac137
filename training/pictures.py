"""Procedural pictures to train on: light from 0 to 1, none of them a picture that the product is measured with."""

from collections.abc import Callable

import cv2
import numpy as np
from numpy.typing import NDArray

type Picture = NDArray[np.float32]
type Drawing = NDArray[np.uint8]

# Pictures are drawn this many times larger, and averaged.
_OVERSAMPLING = 2

# Textures that the shapes of one picture share.
_MOST_FILLS = 8

_FONTS = (
    cv2.FONT_HERSHEY_SIMPLEX,
    cv2.FONT_HERSHEY_PLAIN,
    cv2.FONT_HERSHEY_DUPLEX,
    cv2.FONT_HERSHEY_COMPLEX,
    cv2.FONT_HERSHEY_TRIPLEX,
    cv2.FONT_HERSHEY_SCRIPT_SIMPLEX,
    cv2.FONT_HERSHEY_SCRIPT_COMPLEX,
)
_LETTERS = np.array(list("ABCDEFGHIJKLMNOPQRSTUVWXYZabcdefghijklmnopqrstuvwxyz0123456789-+/=?&#"))


# Filled shapes and lines -----------------------------------------------------------------------------------------


def _blank(size: int) -> Drawing:
    return np.zeros((size, size), np.uint8)


def _mask(drawing: Drawing) -> Picture:
    return drawing.astype(np.float32) / np.float32(255)


def _drawn_polygon(size: int, corners: NDArray[np.floating]) -> Picture:
    """Return a mask of a polygon given by its corners (corner, xy) in samples."""
    drawing = _blank(size)
    cv2.fillPoly(drawing, [np.round(corners * 16).astype(np.int32)], 255, cv2.LINE_AA, 4)
    return _mask(drawing)


def ellipse(random: np.random.Generator, size: int, radius: float, centre: NDArray[np.floating]) -> Picture:
    """Return a mask of an ellipse, or of a disc."""
    aspect = 1.0 if random.random() < 0.5 else random.uniform(0.3, 1)
    angles = np.linspace(0, 2 * np.pi, 96, endpoint=False)
    return _turned(random, size, centre, radius * np.stack([np.cos(angles), aspect * np.sin(angles)], axis=1))


def box(random: np.random.Generator, size: int, radius: float, centre: NDArray[np.floating]) -> Picture:
    """Return a mask of a rectangle, often upright."""
    x, y = radius, radius * random.uniform(0.15, 1)
    if random.random() < 0.5:
        x, y = y, x
    corners = np.array([[-x, -y], [x, -y], [x, y], [-x, y]])
    return _turned(random, size, centre, corners, upright=0.6)


def polygon(random: np.random.Generator, size: int, radius: float, centre: NDArray[np.floating]) -> Picture:
    """Return a mask of a polygon of three to nine corners, or of a smooth outline."""
    angles = np.sort(random.uniform(0, 2 * np.pi, random.integers(3, 10)))
    radii = radius * random.uniform(0.3, 1, len(angles))
    if random.random() < 0.4:
        fine = np.linspace(0, 2 * np.pi, 90, endpoint=False)
        waves = sum(
            random.normal() / k * np.cos(k * fine + random.uniform(0, 2 * np.pi))
            for k in range(1, random.integers(2, 7))
        )
        angles, radii = fine, radius * np.clip(0.7 + 0.2 * np.asarray(waves), 0.1, 1.2)
    return _turned(random, size, centre, radii[:, np.newaxis] * np.stack([np.cos(angles), np.sin(angles)], axis=1))


def _turned(
    random: np.random.Generator,
    size: int,
    centre: NDArray[np.floating],
    corners: NDArray[np.floating],
    upright: float = 0.2,
) -> Picture:
    angle = 0.0 if random.random() < upright else random.uniform(0, np.pi)
    turn = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    return _drawn_polygon(size, corners @ turn.T + centre)


def ring(random: np.random.Generator, size: int, radius: float, centre: NDArray[np.floating]) -> Picture:
    """Return a mask of a ring."""
    drawing = _blank(size)
    thickness = max(1, int(radius * random.uniform(0.05, 0.4)))
    cv2.circle(
        drawing, tuple(np.round(centre * 16).astype(int).tolist()), int(radius * 16), 255, thickness, cv2.LINE_AA, 4
    )
    return _mask(drawing)


def rods(random: np.random.Generator, size: int, radius: float, centre: NDArray[np.floating]) -> Picture:
    """Return a mask of one to six thin lines, parallel or in all directions."""
    drawing = _blank(size)
    thickness = int(random.integers(1, 7))
    angle, gap = random.uniform(0, np.pi), random.uniform(2.5, 8) * thickness
    for k in range(random.integers(1, 7)):
        if random.random() < 0.3:
            angle = random.uniform(0, np.pi)
        along = np.array([np.cos(angle), np.sin(angle)]) * radius
        across = np.array([-np.sin(angle), np.cos(angle)]) * gap * k
        start, end = (np.round((centre + across + d * along) * 16).astype(int).tolist() for d in (-1, 1))
        cv2.line(drawing, start, end, 255, thickness, cv2.LINE_AA, 4)
    return _mask(drawing)


def text(random: np.random.Generator, size: int, radius: float, centre: NDArray[np.floating]) -> Picture:
    """Return a mask of a few letters, about twice the radius wide, turned by any small angle or upright."""
    count = int(random.integers(1, 9))
    letters = "".join(random.choice(_LETTERS, count))
    font, scale = int(random.choice(_FONTS)), float(random.uniform(0.5, 3.0))
    (width, height), _ = cv2.getTextSize(letters, font, 1.0, 1)
    scale = max(0.5, min(scale, 2.5 * radius / max(width, height)))
    drawing = _blank(size)
    at = (int(centre[0] - scale * width / 2), int(centre[1] + scale * height / 2))
    cv2.putText(drawing, letters, at, font, scale, 255, int(random.integers(1, 2 + int(2 * scale))), cv2.LINE_AA)
    if random.random() < 0.5:
        turn = cv2.getRotationMatrix2D(tuple(centre.tolist()), random.uniform(-180, 180), 1.0)
        drawing = cv2.warpAffine(drawing, turn, (size, size), flags=cv2.INTER_LINEAR)
    return _mask(drawing)


_SHAPES: tuple[Callable[..., Picture], ...] = (ellipse, box, box, polygon, ring, rods, text)


# What fills them -------------------------------------------------------------------------------------------------


def constant(random: np.random.Generator, size: int) -> Picture:
    """Return one level."""
    return np.full((size, size), random.uniform(0, 1), np.float32)


def gradient(random: np.random.Generator, size: int) -> Picture:
    """Return levels that rise in some direction."""
    x, y = np.meshgrid(*2 * [np.linspace(-1, 1, size, dtype=np.float32)])
    angle, slope = random.uniform(0, 2 * np.pi), random.uniform(0.1, 0.7)
    levels = random.uniform(0.2, 0.8) + slope * (x * np.cos(angle) + y * np.sin(angle))
    return np.asarray(np.clip(levels, 0, 1), np.float32)


def shading(random: np.random.Generator, size: int) -> Picture:
    """Return levels that fall from a bright place, as on a ball."""
    x, y = np.meshgrid(*2 * [np.linspace(0, 1, size, dtype=np.float32)])
    cx, cy = random.uniform(0, 1, 2)
    far = ((x - cx) ** 2 + (y - cy) ** 2) / random.uniform(0.1, 1) ** 2
    return np.asarray(random.uniform(0.5, 1) * np.sqrt(np.clip(1 - far, 0.02, 1)), np.float32)


def stripes(random: np.random.Generator, size: int) -> Picture:
    """Return stripes, sharp or like waves, or a chequered pattern."""
    x, y = np.meshgrid(*2 * [np.arange(size, dtype=np.float32)])
    angle = random.choice([0.0, np.pi / 2, random.uniform(0, np.pi)])
    period = _OVERSAMPLING * np.exp(random.uniform(np.log(5), np.log(60)))
    wave = np.sin(2 * np.pi * (x * np.cos(angle) + y * np.sin(angle)) / period)
    if random.random() < 0.4:
        wave = wave * np.sin(2 * np.pi * (y * np.cos(angle) - x * np.sin(angle)) / period)
    if random.random() < 0.7:
        wave = np.clip(wave * period / 3, -1, 1)
    low, high = np.sort(random.uniform(0, 1, 2))
    return np.asarray(low + (high - low) * (wave + 1) / 2, np.float32)


def noise_texture(random: np.random.Generator, size: int) -> Picture:
    """Return filtered noise: fine or coarse, with a spectrum that falls as a power of frequency, or spotted."""
    frequency = np.hypot(*np.meshgrid(np.fft.rfftfreq(size), np.fft.fftfreq(size)))
    amplitude = np.maximum(frequency, 1 / size) ** -random.uniform(0.6, 2.2) * np.exp(-((frequency / 0.3) ** 2))
    if random.random() < 0.4:
        centre = 1 / (_OVERSAMPLING * random.uniform(4, 25))
        amplitude = np.exp(-(((frequency - centre) / (0.4 * centre)) ** 2))
    amplitude[0, 0] = 0
    wave = np.fft.irfft2(np.fft.rfft2(random.normal(size=(size, size))) * amplitude, (size, size))
    wave /= wave.std()
    if random.random() < 0.3:
        wave = 2 * np.tanh(4 * wave)
    return np.clip(random.uniform(0.2, 0.8) + random.uniform(0.05, 0.25) * wave, 0, 1).astype(np.float32)


_FILLS: tuple[Callable[..., Picture], ...] = (constant, constant, constant, gradient, shading, stripes, noise_texture)


# Pictures --------------------------------------------------------------------------------------------------------


def _fill(random: np.random.Generator, size: int) -> Picture:
    return _FILLS[random.integers(len(_FILLS))](random, size)


def _put(canvas: Picture, mask: Picture, fill: Picture | float) -> None:
    canvas += mask * (fill - canvas)


def _scattered(random: np.random.Generator, size: int, canvas: Picture, count: int, radii: tuple[float, float]) -> None:
    """Put shapes at random places onto a canvas, sizes even on a logarithmic scale, large ones first."""
    fills: list[Picture | float] = [_fill(random, size) for _ in range(_MOST_FILLS)]
    low, high = (float(np.log(radius)) for radius in radii)
    for radius in np.sort(np.exp(random.uniform(low, high, count)))[::-1] * size:
        shape = _SHAPES[random.integers(len(_SHAPES))]
        fill = random.random() if random.random() < 0.5 else fills[random.integers(_MOST_FILLS)]
        _put(canvas, shape(random, size, float(radius), random.uniform(0, size, 2)), fill)


def dead_leaves(random: np.random.Generator, size: int) -> Picture:
    """Return shapes over shapes, all over the picture."""
    canvas = _fill(random, size)
    _scattered(random, size, canvas, int(random.integers(15, 150)), (0.015, 0.35))
    return canvas


def lit_object(random: np.random.Generator, size: int) -> Picture:
    """Return objects of many parts before a dark background."""
    canvas = np.full((size, size), random.choice([0, 0, random.uniform(0, 0.15)]), np.float32)
    for _ in range(random.choice([1, 1, 2, 3])):
        outline = np.zeros((size, size), np.float32)
        middle = random.uniform(0.3, 0.7, 2) * size
        for _ in range(random.integers(1, 6)):
            shape = (ellipse, box, box, polygon)[random.integers(4)]
            np.maximum(
                outline,
                shape(random, size, size * random.uniform(0.08, 0.4), middle + random.normal(0, 0.13 * size, 2)),
                out=outline,
            )
        inner = _fill(random, size)
        _scattered(random, size, inner, int(random.integers(3, 70)), (0.01, 0.2))
        _put(canvas, outline, np.asarray(random.uniform(0.3, 1) * inner + random.uniform(0, 0.2), np.float32))
    if random.random() < 0.4:
        _put(canvas, rods(random, size, 0.5 * size, random.uniform(0, size, 2)), _fill(random, size))
    return canvas


def writing(random: np.random.Generator, size: int) -> Picture:
    """Return lines of text, dark on bright or bright on dark."""
    canvas, ink = _fill(random, size), np.full((size, size), random.choice([0.0, 1.0, random.random()]), np.float32)
    for _ in range(random.integers(5, 40)):
        _put(canvas, text(random, size, size * random.uniform(0.03, 0.3), random.uniform(0, size, 2)), ink)
    return canvas


def lines(random: np.random.Generator, size: int) -> Picture:
    """Return thin lines and rods before a plain or dark background."""
    canvas = random.choice([0.0, 0.0, 1.0]) * _fill(random, size)
    for _ in range(random.integers(2, 25)):
        mask = (rods, ring)[random.integers(2)](
            random, size, size * random.uniform(0.05, 0.8), random.uniform(0, size, 2)
        )
        _put(canvas, mask, _fill(random, size))
    return np.asarray(canvas, np.float32)


def texture(random: np.random.Generator, size: int) -> Picture:
    """Return two textures, side by side or one."""
    canvas = noise_texture(random, size)
    if random.random() < 0.7:
        radius = size * random.uniform(0.2, 0.6)
        _put(
            canvas,
            polygon(random, size, radius, random.uniform(0, size, 2)),
            (stripes, noise_texture)[random.integers(2)](random, size),
        )
    return canvas


def smooth(random: np.random.Generator, size: int) -> Picture:
    """Return a plain field, a gradient, a shaded ball, or hardly any light."""
    kind = random.integers(5)
    if kind == 0:
        return np.full((size, size), 1e-3, np.float32)
    canvas = (constant, gradient, shading)[random.integers(3)](random, size)
    if kind == 1:
        canvas = canvas * ellipse(random, size, size * random.uniform(0.2, 0.5), np.full(2, size / 2))
    return np.asarray(np.maximum(canvas, 0.02 if kind > 1 else 0), np.float32)


_PICTURES: tuple[tuple[float, Callable[..., Picture]], ...] = (
    (0.20, dead_leaves),
    (0.38, lit_object),
    (0.09, writing),
    (0.10, lines),
    (0.10, texture),
    (0.13, smooth),
)


def picture(random: np.random.Generator, size: int) -> tuple[str, Picture]:
    """Return the kind of a picture and its light (size, size), 0 to 1, drawn at random."""
    kinds = np.array([share for share, _ in _PICTURES])
    make = _PICTURES[random.choice(len(_PICTURES), p=kinds / kinds.sum())][1]
    large = make(random, _OVERSAMPLING * size)
    light = cv2.resize(large, (size, size), interpolation=cv2.INTER_AREA)
    if random.random() < 0.5:
        light = cv2.GaussianBlur(light, (0, 0), random.uniform(0.3, 2.0))
    gamma = random.choice([1.0, random.uniform(0.6, 2.4)])
    return make.__name__, np.clip(light, 0, 1).astype(np.float32) ** np.float32(gamma)
