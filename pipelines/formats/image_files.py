"""Image files that are written: 16-bit frames, float planes with their scale, and previews."""

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.formats.files import write_whole, writing

type Picture = NDArray[np.uint8]

# Of a lossy film, 0 to 100: above it, size grows faster than anyone can see.
_FILM_QUALITY = 80

# Hatching of samples of light that are not known, by its period along a row and its two RGB colours. Grey stripes would
# be taken for what is painted on an object.
_HATCH_PERIOD_PX, _HATCH_DARK, _HATCH_BRIGHT = 8, (125, 0, 95), (240, 60, 205)


def write_frame(path: Path, pixels: NDArray[Any]) -> None:
    """Write a frame (row, column[, colour]) as TIFF of its own data type, uncompressed: decision 029."""
    with writing(path) as file:
        tifffile.imwrite(file, pixels, photometric="rgb" if pixels.ndim == 3 else "minisblack")


@dataclass(frozen=True)
class Spacing:
    """The distance of the samples of a plane, in mm or else in a unit that TIFF has no name for."""

    pitch: float
    in_mm: bool = True


# Of maps whose samples are a constant angle apart, one detector pixel.
ONE_PIXEL = Spacing(1.0, in_mm=False)


def write_plane(path: Path, plane: NDArray[np.floating], spacing: Spacing) -> None:
    """Write a plane (row, column[, colour]) as float32 TIFF whose resolution tags give its pitch."""
    resolution = (10.0 if spacing.in_mm else 1.0) / spacing.pitch
    with writing(path) as file:
        tifffile.imwrite(
            file,
            plane.astype(np.float32),
            photometric="rgb" if plane.ndim == 3 else "minisblack",
            resolution=(resolution, resolution),
            resolutionunit="CENTIMETER" if spacing.in_mm else "NONE",
        )


def write_png(path: Path, picture: Picture) -> None:
    """Write a picture (row, column[, RGB]) as PNG."""
    write_whole(path, encoded(picture, ".png"))


def encoded(picture: Picture, suffix: str) -> bytes:
    """Return a picture (row, column[, RGB]) as the bytes of a file with that suffix."""
    ordered = picture if picture.ndim == 2 else np.ascontiguousarray(picture[:, :, ::-1])
    done, content = cv2.imencode(suffix, ordered)
    if not done:
        raise ValueError(f"no picture of shape {picture.shape} can be encoded as {suffix}")
    return content.tobytes()


def encoded_film(frames: Sequence[Picture], frame_ms: int) -> bytes | None:
    """Return pictures (row, column[, RGB]) of one size as an animated WebP that repeats for ever.

    None if OpenCV cannot write one: it needs version 4.12, built with WebP.
    """
    if not hasattr(cv2, "imencodeanimation"):
        return None
    film = cv2.Animation(0)
    film.frames = [
        cv2.cvtColor(frame, cv2.COLOR_GRAY2BGR if frame.ndim == 2 else cv2.COLOR_RGB2BGR) for frame in frames
    ]
    film.durations = [frame_ms] * len(frames)
    try:
        done, content = cv2.imencodeanimation(".webp", film, [cv2.IMWRITE_WEBP_QUALITY, _FILM_QUALITY])
    except cv2.error:
        return None
    return content.tobytes() if done else None


def grey_levels(plane: NDArray[np.floating], white: float, black: float = 0.0) -> Picture:
    """Return a plane as 8-bit levels on a linear scale from black to white."""
    return np.asarray(np.rint(255 * _relative(plane, white, black)), np.uint8)


def _relative(plane: NDArray[np.floating], white: float, black: float) -> NDArray[np.float32]:
    """Return a plane relative to the scale from black to white, 0 to 1; NaN is black."""
    # Clipped first: files may hold infinite values
    inside = np.clip(np.nan_to_num(np.asarray(plane, np.float32), nan=black), black, max(white, black))
    return (inside - np.float32(black)) * np.float32(1 / max(white - black, 1e-30))


def light_picture(
    light: NDArray[np.floating], white: float, black: float = 0.0, *, tone_curve: bool = False
) -> Picture:
    """Return light (row, column[, colour]) as 8-bit levels from black to white; if some is NaN, as RGB, that hatched.

    With the tone curve of sRGB levels are what a screen expects, and what photographs have; without it they are
    proportional to light.
    """
    share = _relative(light, white, black)
    levels = np.asarray(np.rint(255 * (srgb_encoded(share) if tone_curve else share)), np.uint8)
    unknown = np.isnan(light) if light.ndim == 2 else np.isnan(light).any(axis=2)
    if unknown.any():
        rows, columns = np.nonzero(unknown)
        dark = (rows + columns) % _HATCH_PERIOD_PX < 2
        levels = levels if light.ndim == 3 else np.repeat(levels[:, :, np.newaxis], 3, axis=2)
        levels[rows, columns] = np.where(dark[:, np.newaxis], _HATCH_DARK, _HATCH_BRIGHT)
    return levels


def srgb_encoded(share: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the values (0 to 1) of light relative to white by the tone curve of IEC 61966-2-1."""
    return np.asarray(np.where(share <= 0.0031308, 12.92 * share, 1.055 * np.maximum(share, 0.0) ** (1 / 2.4) - 0.055))


def mask_picture(mask: NDArray[np.bool_]) -> Picture:
    """Return a mask as a picture, white where it is true."""
    return np.where(mask, np.uint8(255), np.uint8(0))


def white_level(plane: NDArray[np.floating]) -> float:
    """Return the white level of a plane's grey scale: the 99.8 % quantile of its finite values, 0 without any."""
    finite = plane[np.isfinite(plane)]
    return float(np.quantile(finite, 0.998)) if finite.size else 0.0


def contact_sheet(views: list[Picture], columns: int) -> Picture:
    """Return small pictures of one size (row, column[, RGB]) laid out in rows, with thin lines between them."""
    gap = 3  # px; thinner lines vanish when a page is shown smaller
    height, width = views[0].shape[:2]
    rows = -(-len(views) // columns)
    sheet = np.full((rows * (height + gap) - gap, columns * (width + gap) - gap, *views[0].shape[2:]), 40, np.uint8)
    for index, view in enumerate(views):
        top, left = (index // columns) * (height + gap), (index % columns) * (width + gap)
        sheet[top : top + height, left : left + width] = view
    return sheet


def shrunk(picture: Picture, width_px: int) -> Picture:
    """Return a picture reduced to a width by averaging, or the picture itself if it is no wider."""
    height, width = picture.shape[:2]
    if width <= width_px:
        return picture
    size = (width_px, max(round(height * width_px / width), 1))
    return np.asarray(cv2.resize(picture, size, interpolation=cv2.INTER_AREA), np.uint8)
