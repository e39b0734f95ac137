"""Image files that are read, with the sensor's own values: TIFF, PNG, JPEG, and raw files with their colour mosaic."""

import contextlib
import logging
import struct
import zlib
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.errors import MissingFile, UnreadableImage

TIFF_SUFFIXES = {".tif", ".tiff"}
PHOTO_SUFFIXES = {".png", ".jpg", ".jpeg"}
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".3fr", ".iiq"}
IMAGE_SUFFIXES = TIFF_SUFFIXES | PHOTO_SUFFIXES | RAW_SUFFIXES

# What tifffile raises on damaged or truncated files. Its log messages are dropped: UnreadableImage says it all.
_TIFF_FAILURES = (
    *(tifffile.TiffFileError, zlib.error, struct.error, OSError, LookupError, RuntimeError, TypeError, ValueError),
    *(ArithmeticError, MemoryError),
)
logging.getLogger("tifffile").addHandler(logging.NullHandler())

# The last bytes of a whole file. OpenCV silently fills the rest of a truncated photograph with grey.
_END_MARKS = {".png": b"IEND", ".jpg": b"\xff\xd9", ".jpeg": b"\xff\xd9"}

# Masked pixels this close to the active area are not used, px: they catch a little of its light.
_MASKED_GUARD_PX = 4


def mosaic_period(mosaic: Sequence[str] | None) -> tuple[int, int]:
    """Return rows and columns of the period of a mosaic such as ("RG", "GB"); (1, 1) without filters."""
    return (1, 1) if mosaic is None else (len(mosaic), len(mosaic[0]))


def at_phase(pixels: NDArray[Any], phase: tuple[int, int], period: tuple[int, int]) -> NDArray[Any]:
    """Return the pixels of a phase, as a view of an array (row, column)."""
    return pixels[phase[0] :: period[0], phase[1] :: period[1]]


@dataclass(frozen=True)
class Lattice:
    """The detector pixels of one phase of a mosaic; all pixels without colour filters.

    Attributes
    ----------
    first, step : (int, int)
        Row and column of its first pixel, and the distance to its next.
    shape : (int, int)
        Rows and columns; an incomplete period at the far edges is left out.
    """

    first: tuple[int, int]
    step: tuple[int, int]
    shape: tuple[int, int]

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the lattice's part of an image (row, column), as a view."""
        return at_phase(pixels, self.first, self.step)[: self.shape[0], : self.shape[1]]


@dataclass(frozen=True)
class Frame:
    """One exposure.

    Attributes
    ----------
    pixels_dn : array
        (row, column), or (row, column, colour) in the order red, green, blue.
    mosaic : tuple of str, optional
        Rows of the smallest period of the colour filter array, such as ("RG", "GB"); None without filters.
    black_dn : array, optional
        Black level of each phase of the mosaic (row, column of the period), from the sensor's masked pixels if it has
        any, else as the camera states it; None if the file states none.
    saturation_dn : float, optional
        The white level that the camera states; None if the file states none.
    exposure_s : float, optional
        From EXIF; None if it is missing or zero.
    """

    pixels_dn: NDArray[Any]
    mosaic: tuple[str, ...] | None = None
    black_dn: NDArray[np.float64] | None = None
    saturation_dn: float | None = None
    exposure_s: float | None = None


def read_frame(path: Path) -> Frame:
    """Read one image file.

    Raises
    ------
    MissingFile
        There is no such file.
    UnreadableImage
        The file cannot be decoded, is truncated, or has no pixels.
    """
    if not path.is_file():
        raise MissingFile(f"{path}: no such image; put it there or correct the name")
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        return _read_raw(path)
    if suffix not in IMAGE_SUFFIXES:
        readable = ", ".join(sorted(IMAGE_SUFFIXES))
        raise UnreadableImage(f"{path}: '{suffix}' is not a format that is read; use one of {readable}")
    pixels = _read_tiff(path) if suffix in TIFF_SUFFIXES else _read_with_opencv(path)
    if pixels.ndim == 3 and pixels.shape[2] == 4:
        pixels = pixels[:, :, :3]
    if pixels.size == 0:
        raise UnreadableImage(_cannot_decode(path, "no pixels"))
    if pixels.ndim not in (2, 3) or (pixels.ndim == 3 and pixels.shape[2] != 3):
        raise UnreadableImage(
            f"{path}: holds an array of shape {pixels.shape}; one grey or RGB picture is wanted; export it as such"
        )
    return Frame(pixels)


def _read_tiff(path: Path) -> NDArray[Any]:
    """Read a TIFF; compressions for which tifffile needs extra packages are read by OpenCV."""
    try:
        return np.asarray(tifffile.imread(path))
    except _TIFF_FAILURES as failure:
        if "imagecodecs" in str(failure):
            return _read_with_opencv(path)
        raise UnreadableImage(_cannot_decode(path, str(failure))) from failure


def _read_with_opencv(path: Path) -> NDArray[Any]:
    """Read a file with OpenCV as (row, column) or (row, column, RGB), with its own bit depth and orientation."""
    cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)  # the failure below says it in one line
    try:
        content = path.read_bytes()
        whole = _END_MARKS.get(path.suffix.lower(), b"") in content[-1024:] and _sound_png(content)
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED) if content and whole else None
    except (OSError, cv2.error) as failure:
        raise UnreadableImage(_cannot_decode(path, str(failure))) from failure
    if pixels is None:
        raise UnreadableImage(_cannot_decode(path, "not an image, or truncated"))
    if pixels.ndim == 3 and pixels.shape[2] >= 3:
        pixels = cv2.cvtColor(pixels[:, :, :3], cv2.COLOR_BGR2RGB)
    return np.asarray(pixels)


def _sound_png(content: bytes) -> bool:
    """Return whether every chunk of a PNG has a right checksum, True for other files; the decoder would only print."""
    start = 8
    while content.startswith(b"\x89PNG") and start < len(content):
        end = start + 8 + int.from_bytes(content[start : start + 4])
        if zlib.crc32(content[start + 4 : end]) != int.from_bytes(content[end : end + 4]) or end + 4 > len(content):
            return False
        if content[start + 4 : start + 8] == b"IEND":
            break
        start = end + 4
    return True


def _read_raw(path: Path) -> Frame:
    """Read the mosaic of a raw file, and its black level from the masked pixels."""
    import rawpy  # slow to load, and only raw files need it

    try:
        with rawpy.imread(str(path)) as raw:
            if raw.raw_image.ndim != 2:
                raise UnreadableImage(f"{path}: holds demosaiced colour; record raw files with their mosaic")
            pixels = raw.raw_image_visible.copy()
            mosaic = _mosaic_of(raw)
            black_dn = _masked_black_dn(raw, mosaic_period(mosaic))
            saturation_dn = float(raw.white_level)
    except rawpy.LibRawError as failure:
        reason = failure.args[0].decode() if isinstance(failure.args[0], bytes) else str(failure)
        raise UnreadableImage(_cannot_decode(path, reason)) from failure
    return Frame(pixels, mosaic, black_dn, saturation_dn, exif_exposure_s(path))


def _mosaic_of(raw: Any) -> tuple[str, ...] | None:
    """Return the colour filters of one period of the visible area, as rows of letters."""
    if raw.raw_pattern is None or raw.raw_pattern.shape == (1, 1):
        return None
    rows, columns = raw.raw_pattern.shape
    letters = raw.color_desc.decode()
    return tuple("".join(letters[colour] for colour in row) for row in raw.raw_colors_visible[:rows, :columns])


def _masked_black_dn(raw: Any, period: tuple[int, int]) -> NDArray[np.float64]:
    """Return the black level per phase: the mean of the masked pixels without outliers, else the stated level."""
    top, left = raw.sizes.top_margin, raw.sizes.left_margin
    masked = np.zeros(raw.raw_image.shape, bool)
    masked[:, : max(left - _MASKED_GUARD_PX, 0)] = True
    masked[: max(top - _MASKED_GUARD_PX, 0), :] = True
    black_dn = np.empty(period)
    for row, column in np.ndindex(*period):
        phase = ((top + row) % period[0], (left + column) % period[1])
        levels = at_phase(raw.raw_image, phase, period)[at_phase(masked, phase, period)].astype(float)
        if levels.size < 100:
            black_dn[row, column] = raw.black_level_per_channel[int(raw.raw_colors_visible[row, column])]
            continue
        centre = np.median(levels)
        spread = 1.4826 * np.median(np.abs(levels - centre)) + 0.5
        black_dn[row, column] = levels[np.abs(levels - centre) <= 5 * spread].mean()
    return black_dn


def exif_exposure_s(path: Path) -> float | None:
    """Return the exposure that EXIF states, None if it states none (rawpy would report 1 s)."""
    import exifread  # slow to load, and only raw files need it

    with contextlib.suppress(OSError, ValueError), path.open("rb") as file:
        tag = exifread.process_file(file, details=False, stop_tag="EXIF ExposureTime").get("EXIF ExposureTime")
        if tag is not None and tag.values and float(tag.values[0]) > 0:
            return float(tag.values[0])
    return None


def _cannot_decode(path: Path, reason: str) -> str:
    """Return the message for a file that cannot be decoded."""
    reason = " ".join(reason.split())
    return f"{path}: cannot be decoded ({reason}; {path.stat().st_size} bytes); take or copy the image again"
