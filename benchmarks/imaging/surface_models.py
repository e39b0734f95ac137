"""The models that `benchmarks.imaging.surface_scenes` renders: shapes, textures and lamps, in the terms of Mitsuba 3.

The reference camera is at the origin and looks along z, with x to the right and y down, in mm.
"""

from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

try:
    import mitsuba as mi
except ModuleNotFoundError:
    mi = None

type Tile = NDArray[np.float64]
type Vector = tuple[float, float, float]
type Rotations = tuple[tuple[Vector, float], ...]

_X, _Y = (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)

# Each lamp has a scene of its own, whose pictures are added: Mitsuba would else choose lamps by chance, with noise.
_LAMPS: tuple[dict[str, Any], ...] = (
    {"type": "directional", "direction": [-0.3, 0.9, 0.6], "irradiance": {"type": "rgb", "value": 1.2}},
    {"type": "directional", "direction": [0.4, 0.7, 1.0], "irradiance": {"type": "rgb", "value": 2.2}},
    {"type": "point", "position": [-350, -400, 150], "intensity": {"type": "rgb", "value": 6e5}},
)

# Direct light only, one ray to the lamp: exact, as the lamps are points.
_INTEGRATOR = {"type": "direct", "emitter_samples": 1, "bsdf_samples": 0, "hide_emitters": True}

# Through glass and by mirrors too; what is matt reflects light of the lamps only once or twice.
_REFLECTIONS = {"type": "path", "max_depth": 5, "hide_emitters": True}


def model(name: str) -> list[Any]:
    """Return a scene once per lamp, as Mitsuba's objects."""
    objects = {"type": "scene", "integrator": _INTEGRATOR, **SCENES[name]()}
    return [mi.load_dict({**objects, "lamp": lamp}) for lamp in _LAMPS]


def opaque(name: str) -> Any:
    """Return a scene without its panes of glass, whose light comes from what is behind them."""
    objects = {
        key: value for key, value in SCENES[name]().items() if value.get("bsdf", {}).get("type") != "thindielectric"
    }
    return mi.load_dict({"type": "scene", **objects})


def room() -> dict[str, Any]:
    """Return a room: a slanted wall, a floor, a ball, a cube and a rod 10 mm thick."""
    return {
        "wall": rectangle((0, 0, 820), (1600, 1300), ((_Y, 22),), noise(1, 1.0, 768)),
        "floor": rectangle((0, 210, 700), (1800, 1100), ((_X, 90),), blobs(2, 1.3, 768, low=0.2)),
        "ball": sphere((-110, 110, 620), 95, noise(3, 1.0)),
        "cube": cube((130, 130, 560), 33, 75, text(4)),
        "rod": cylinder((20, -400, 520), (45, 210, 520), 5, plain()),
    }


def desk() -> dict[str, Any]:
    """Return a desk: half of its wall is even; a page, two balls, a cube, and a rod 8 mm thick across the view."""
    return {
        "wall": rectangle((0, 0, 980), (2000, 1600), ((_Y, -15), (_X, 10)), blobs(11, 1.5)),
        "floor": rectangle((0, 240, 760), (2000, 1200), ((_X, 90),), noise(12, 1.5)),
        "page": rectangle((-120, 40, 640), (220, 280), ((_Y, -28), (_X, 15)), text(13)),
        "ball": sphere((120, 150, 600), 80, stripes(14)),
        "second_ball": sphere((200, -60, 760), 110, noise(15, 1.1)),
        "rod": cylinder((-300, 120, 530), (330, -60, 560), 4, plain()),
        "cube": cube((10, 190, 700), 50, 50, checks(17)),
    }


def hills() -> dict[str, Any]:
    """Return five balls of different textures before a slanted wall, and a narrow card."""
    return {
        "wall": rectangle((0, 0, 850), (1800, 1500), ((_X, -25),), noise(21, 1.2)),
        "ball_0": sphere((-160, -70, 700), 90, noise(30, 1.3)),
        "ball_1": sphere((100, -90, 620), 60, blobs(31, 1.3)),
        "ball_2": sphere((40, 110, 660), 100, text(32)),
        "ball_3": sphere((-140, 120, 560), 50, checks(33)),
        "ball_4": sphere((230, 60, 760), 90, noise(34, 1.3)),
        "card": rectangle((-60, 20, 540), (70, 160), ((_Y, 40),), text(40)),
    }


def even() -> dict[str, Any]:
    """Return the room without texture but on its floor: depth shows at outlines and in shades only."""
    return {
        "wall": rectangle((0, 0, 900), (1800, 1500), ((_Y, 22),), plain()),
        "floor": rectangle((0, 210, 700), (1800, 1100), ((_X, 90),), checks(2)),
        "ball": sphere((-110, 110, 620), 95, plain()),
        "cube": cube((130, 130, 560), 33, 75, plain(0.4)),
    }


def mirror() -> dict[str, Any]:
    """Return the room with a mirror before its wall and a mirror ball, and a wall behind the camera that they show."""
    silver = {"type": "twosided", "sides": {"type": "conductor", "material": "none"}}
    flat = rectangle((110, 10, 700), (240, 260), ((_Y, -12),), plain())
    return {
        "integrator": _REFLECTIONS,
        "wall": rectangle((0, 0, 820), (1600, 1300), ((_Y, 22),), noise(1, 1.0, 768)),
        "floor": rectangle((0, 210, 700), (1800, 1100), ((_X, 90),), blobs(2, 1.3, 768, low=0.2)),
        "behind": rectangle((0, 0, -200), (1600, 500), (), blobs(5, 1.2)),
        "mirror": {**flat, "bsdf": silver},
        "mirror_ball": {**sphere((-110, 110, 620), 95, plain()), "bsdf": silver},
    }


def glass() -> dict[str, Any]:
    """Return the room with a ball and a pane of glass before its wall."""
    pane = rectangle((110, 10, 640), (240, 260), ((_Y, -30),), plain())
    return {
        "integrator": _REFLECTIONS,
        "wall": rectangle((0, 0, 820), (1600, 1300), ((_Y, 22),), noise(1, 1.0, 768)),
        "floor": rectangle((0, 210, 700), (1800, 1100), ((_X, 90),), blobs(2, 1.3, 768, low=0.2)),
        "ball": {**sphere((-110, 110, 620), 95, plain()), "bsdf": {"type": "dielectric"}},
        "pane": {**pane, "bsdf": {"type": "thindielectric"}},
    }


def repeated() -> dict[str, Any]:
    """Return a wall and a floor of squares of 10 mm, all alike, so that several depths explain the views alike."""
    return {
        "wall": rectangle((0, 0, 820), (1600, 1280), (), squares(160, 128)),
        "floor": rectangle((0, 210, 700), (1800, 1120), ((_X, 90),), squares(180, 112)),
    }


SCENES: dict[str, Callable[[], dict[str, Any]]] = {
    "room": room,
    "desk": desk,
    "hills": hills,
    "even": even,
    "mirror": mirror,
    "glass": glass,
    "repeated": repeated,
}


def rectangle(centre: Vector, size: tuple[float, float], rotations: Rotations, tile: Tile) -> dict[str, Any]:
    """Return a rectangle of a size, turned about its centre; the last rotation (axis, degrees) comes first."""
    place = mi.ScalarTransform4f().translate(centre)
    for axis, degrees in rotations:
        place = place @ mi.ScalarTransform4f().rotate(axis, degrees)
    scaled = place @ mi.ScalarTransform4f().scale([size[0] / 2, size[1] / 2, 1])
    return {"type": "rectangle", "to_world": scaled, "bsdf": matt(tile)}


def cube(centre: Vector, degrees: float, half_side: float, tile: Tile) -> dict[str, Any]:
    """Return a cube, turned about the vertical through its centre."""
    place = mi.ScalarTransform4f().translate(centre) @ mi.ScalarTransform4f().rotate(_Y, degrees)
    return {"type": "cube", "to_world": place @ mi.ScalarTransform4f().scale(half_side), "bsdf": matt(tile)}


def sphere(centre: Vector, radius: float, tile: Tile) -> dict[str, Any]:
    """Return a ball."""
    return {"type": "sphere", "center": list(centre), "radius": radius, "bsdf": matt(tile)}


def cylinder(start: Vector, end: Vector, radius: float, tile: Tile) -> dict[str, Any]:
    """Return a rod from start to end."""
    return {"type": "cylinder", "p0": list(start), "p1": list(end), "radius": radius, "bsdf": matt(tile)}


def matt(tile: Tile) -> dict[str, Any]:
    """Return a matt surface whose reflectance is a tile (row, column), the same from both sides."""
    bitmap = mi.Bitmap(np.repeat(tile.astype(np.float32)[:, :, np.newaxis], 3, axis=2))
    texture = {"type": "bitmap", "bitmap": bitmap, "raw": True, "filter_type": "bilinear"}
    return {"type": "twosided", "sides": {"type": "diffuse", "reflectance": texture}}


def spectrum(seed: int, slope: float, size: int) -> Tile:
    """Return noise whose amplitude falls with frequency to the power of `slope`, of mean 0 and deviation 1."""
    frequency = np.hypot(*np.meshgrid(np.fft.fftfreq(size), np.fft.fftfreq(size)))
    frequency[0, 0] = 1
    white = np.random.default_rng(seed).standard_normal((size, size))
    found = np.fft.ifft2(np.fft.fft2(white) / frequency**slope).real
    return np.asarray((found - found.mean()) / found.std())


def noise(seed: int, slope: float, size: int = 512) -> Tile:
    """Return detail of all sizes."""
    return np.clip(0.5 + 0.25 * spectrum(seed, slope, size), 0.08, 0.95)


def blobs(seed: int, slope: float, size: int = 512, low: float = 0.08) -> Tile:
    """Return blobs of three shades with faint detail within."""
    found = spectrum(seed, slope, size)
    return np.clip(np.select([found > 0.3, found < -0.5], [0.9, 0.15], 0.5) + 0.03 * found, low, 0.95)


def checks(seed: int) -> Tile:
    """Return a chessboard of 8 × 8 squares with faint detail."""
    index = np.arange(512) // 64
    odd = (index[:, np.newaxis] + index) % 2
    return np.clip(np.where(odd, 0.85, 0.2) + 0.04 * spectrum(seed, 1.3, 512), 0.08, 0.95)


def squares(across: int, down: int) -> Tile:
    """Return a chessboard of even squares, 8 × 8 numbers each."""
    odd = np.add.outer(np.arange(8 * down) // 8, np.arange(8 * across) // 8) % 2
    return np.where(odd, 0.85, 0.2)


def stripes(seed: int) -> Tile:
    """Return ten pairs of stripes with faint detail."""
    across = 0.5 + 0.4 * np.sign(np.sin(np.arange(512) / 512 * 20 * np.pi))
    return np.clip(across + 0.05 * spectrum(seed, 1.3, 512), 0.08, 0.95)


def text(seed: int) -> Tile:
    """Return lines of dark and grey words on white."""
    generator = np.random.default_rng(seed)
    generator.standard_normal((512, 512))  # unused: the scenes that were first measured have the words that follow
    tile = np.full((512, 512), 0.9)
    for top in range(16, 492, 28):
        left = 10
        while left < 492:
            width = int(generator.integers(3, 14))
            if generator.random() < 0.8:
                tile[top : top + 14, left : left + width] = 0.1 if generator.random() < 0.7 else 0.5
            left += width + int(generator.integers(2, 6))
    return tile


def plain(reflectance: float = 0.6) -> Tile:
    """Return an even shade."""
    return np.full((8, 8), reflectance)
