"""Tone curves of pictures: that of sRGB, which most of 8 bits have, is undone."""

from functools import cache
from pathlib import Path
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, WrongUsage
from faintfield.pipelines.formats.frames import RAW_SUFFIXES, Frame
from faintfield.pipelines.formats.reading import opened

type Tone = Literal["linear", "srgb"]

# White of the 16-bit pictures that the curve is undone to.
WHITE_DN = 65535

# Bytes of a PNG within which a chunk on its tone lies: before the pixels.
_PNG_HEADER_BYTES = 4096


def asked_tone(*, linear: bool, srgb: bool) -> Tone | None:
    """Return the tone that options ask for, None if they leave it to the pictures."""
    if linear and srgb:
        raise WrongUsage("--linear and --srgb: pictures have one tone curve; give one of the two")
    return "linear" if linear else "srgb" if srgb else None


def tone_of(path: Path, first: Frame, requested: Tone | None) -> Tone:
    """Return the tone curve of pictures, as asked for; say what is assumed.

    By default it is that of sRGB for 8 bits, unless a PNG states a gamma of 1, and none for others.
    """
    if requested == "srgb" and path.suffix.lower() in RAW_SUFFIXES:
        raise BadValue(f"{path}: is a raw file, which has no tone curve; leave --srgb out")
    curved = first.pixels_dn.dtype == np.uint8 and not _states_linear(path)
    tone: Tone = requested or ("srgb" if curved else "linear")
    if requested is None and tone == "srgb":
        inform(
            "8-bit pictures are taken to have the tone curve of sRGB, which is undone; give --linear if their values "
            "are proportional to light"
        )
    return tone


def _states_linear(path: Path) -> bool:
    """Return whether a file is a PNG whose gAMA chunk says that values are proportional to light."""
    if path.suffix.lower() != ".png":
        return False
    with opened(path) as file:
        header = file.read(_PNG_HEADER_BYTES).partition(b"IDAT")[0]
    at = header.find(b"gAMA")
    return at > 0 and b"sRGB" not in header and int.from_bytes(header[at + 4 : at + 8]) == 100_000


def without_curve(pixels: NDArray[Any], white: float | None = None) -> NDArray[np.uint16]:
    """Return pixels of 8 or 16 bits with the sRGB curve as 16-bit values proportional to light, white = 65535.

    White is the value `white` in the pixels, by default their largest possible one.
    """
    table = np.rint(_decoded(pixels.dtype.itemsize, white)).astype(np.uint16)
    return np.asarray(table[pixels])


def rounding_variance_dn2(
    mean_dn: NDArray[np.float64], tone: Tone, bits: int, white: float | None = None
) -> NDArray[np.float64]:
    """Return the variance that rounding to whole values gave to pixels of these means (…)."""
    if tone == "linear":
        return np.full(np.shape(mean_dn), 1 / 12)
    levels = _decoded(bits // 8, white)
    levels = levels[: int(np.argmax(levels)) + 1]  # white may be below the largest value
    steps = np.gradient(levels)
    return np.asarray(np.interp(mean_dn, levels, steps**2) / 12 + 1 / 12)


@cache
def _decoded(item_bytes: int, white: float | None) -> NDArray[np.float64]:
    """Return the light, white = 65535, of each value of 1 or 2 bytes, by IEC 61966-2-1."""
    values = 256**item_bytes
    value = np.minimum(np.arange(values) / (white or values - 1), 1.0)
    return np.where(value <= 0.04045, value / 12.92, ((value + 0.055) / 1.055) ** 2.4) * WHITE_DN
