"""Image files that are read, with the sensor's own values: TIFF, PNG, JPEG, others, and raw files with their mosaic."""

import contextlib
import logging
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any

import exifread
import numpy as np
import rawpy
from numpy.typing import NDArray

from faintfield.calib.lens import MAX_PIXELS, MAX_SIDE_PX
from faintfield.pipelines.errors import InputError, MissingFile, UnknownFormat, UnreadableImage, WrongSize
from faintfield.pipelines.formats.decoders import (
    MAX_HEADER_BYTES,
    NETPBM_SUFFIXES,
    OVERHEAD_BYTES,
    Accept,
    count_pages,
    decode_bmp,
    decode_exr,
    decode_netpbm,
    decode_photo,
    decode_tiff,
    kind_of_content,
)
from faintfield.pipelines.formats.reading import is_file, opened
from faintfield.pipelines.formats.units import MAX_EXPOSURE_S, MAX_FRAME_BYTES
from faintfield.rig.files import require_size

_TIFF_SUFFIXES = {".tif", ".tiff"}
_PHOTO_SUFFIXES = {".png", ".jpg", ".jpeg"}
RAW_SUFFIXES = {".dng", ".cr2", ".cr3", ".nef", ".arw", ".raf", ".rw2", ".orf", ".pef", ".srw", ".3fr", ".iiq"}
_PLAIN_SUFFIXES = NETPBM_SUFFIXES | {".bmp", ".exr"}
IMAGE_SUFFIXES = _TIFF_SUFFIXES | _PHOTO_SUFFIXES | _PLAIN_SUFFIXES | RAW_SUFFIXES

# Suffixes of one kind of picture, and that by which `picture_kind` calls it.
_ALIKE = {".tiff": ".tif", ".jpeg": ".jpg", ".pnm": ".ppm", ".pgm": ".ppm"}

_COLOUR_NAMES = {"R": "red", "G": "green", "B": "blue"}
_RGB = ("red", "green", "blue")

# Complaints about damaged EXIF are dropped: such a file states no exposure.
logging.getLogger("exifread").addHandler(logging.NullHandler())

# Masked pixels this close to the active area are not used, px: they catch a little of its light.
_MASKED_GUARD_PX = 4


# Bytes of a pixel decoded: four channels of the largest type.
_MAX_PIXEL_BYTES = 32


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
        Row and column of the first pixel; distance to the next pixel along rows and columns.
    shape : (int, int)
        Number of rows and columns; an incomplete period at the far edges is left out.
    """

    first: tuple[int, int]
    step: tuple[int, int]
    shape: tuple[int, int]

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the lattice's part of an image (row, column), as a view."""
        return at_phase(pixels, self.first, self.step)[: self.shape[0], : self.shape[1]]


@dataclass(frozen=True)
class Frame:
    """One exposure. What a file does not state is None.

    Attributes
    ----------
    pixels_dn : array (row, column) or (row, column, RGB)
        Values of the pixels.
    mosaic : tuple of str, optional
        Rows of the smallest period of the colour filters, such as ("RG", "GB").
    black_dn : float array (row, column of the period), optional
        Black level of each phase, from the sensor's masked pixels if it has any, else as the camera states it.
    saturation_dn, exposure_s : float, optional
        White level and exposure time that the file states.
    """

    pixels_dn: NDArray[Any]
    mosaic: tuple[str, ...] | None = None
    black_dn: NDArray[np.float64] | None = None
    saturation_dn: float | None = None
    exposure_s: float | None = None


@dataclass(frozen=True)
class ChannelLayout:
    """Position of one colour in the frames.

    Attributes
    ----------
    name : {"grey", "red", "green", "blue"}
        The colour.
    plane_of_colour : int, optional
        Index of the colour in RGB frames; None for frames of one value per pixel.
    lattices : tuple of Lattice
        Pixels that have this colour: one lattice for each phase of a mosaic that has it.
    """

    name: str
    plane_of_colour: int | None
    lattices: tuple[Lattice, ...]

    def of(self, pixels: NDArray[Any]) -> NDArray[Any]:
        """Return the part of a frame (row, column[, colour]) that can hold this colour, (row, column)."""
        return pixels if self.plane_of_colour is None else pixels[:, :, self.plane_of_colour]


def layouts_of(frame: Frame, mosaic: Sequence[str] | None = None) -> list[ChannelLayout]:
    """Return the colours of a frame; those of `mosaic`, if it is stated."""
    mosaic, (height, width) = mosaic or frame.mosaic, frame.pixels_dn.shape[:2]
    everything = Lattice((0, 0), (1, 1), (height, width))
    if frame.pixels_dn.ndim == 3:
        return [ChannelLayout(name, index, (everything,)) for index, name in enumerate(_RGB)]
    if mosaic is None:
        return [ChannelLayout("grey", None, (everything,))]
    period = mosaic_period(mosaic)
    shape = (height // period[0], width // period[1])
    layouts = []
    for letter in sorted(set("".join(mosaic)), key="RGB".find):
        phases = [(r, c) for r, c in np.ndindex(*period) if mosaic[r][c] == letter]
        lattices = tuple(Lattice(phase, period, shape) for phase in phases)
        layouts.append(ChannelLayout(_COLOUR_NAMES.get(letter, letter), None, lattices))
    return layouts


def read_frame(
    path: Path,
    expected_px: tuple[int, int] | None = None,
    *,
    of: str = "the camera",
    page: int | None = None,
) -> Frame:
    """Read one image file with the sensor's own values: TIFF, PNG, JPEG and others, or a raw file with its mosaic.

    Parameters
    ----------
    path : Path
        The file.
    expected_px : (int, int), optional
        Width and height that it must have, compared with its header before its pixels are read.
    of : str
        Owner of that size, for the message.
    page : int, optional
        Index of the picture in a TIFF that holds several; without it, a file holds one.

    Returns
    -------
    Frame
        `pixels_dn` (row, column) or (row, column, RGB); `mosaic`, `black_dn`, `saturation_dn` and `exposure_s` as far
        as the file states them, else None.

    Raises
    ------
    MissingFile, WrongSize
        The file cannot be opened, or does not have the size that is expected.
    UnknownFormat
        Files of this kind cannot be decoded here, or the beginning of a raw file is damaged.
    UnreadableImage
        The file cannot be decoded, is truncated, has no pixels, or is larger than any that is read.

    Examples
    --------
    >>> import tempfile
    >>> from pathlib import Path
    >>> import numpy as np
    >>> import tifffile
    >>> from faintfield import read_frame
    >>> with tempfile.TemporaryDirectory() as folder:
    ...     tifffile.imwrite(Path(folder, "dark.tiff"), np.full((48, 64), 100, np.uint16))
    ...     frame = read_frame(Path(folder, "dark.tiff"), expected_px=(64, 48))
    >>> frame.pixels_dn.shape, frame.pixels_dn.dtype
    ((48, 64), dtype('uint16'))
    """
    if not is_file(path):
        raise MissingFile(f"{path}: no such image file; put it there or correct the name")

    def accept(width: int, height: int, size_bytes: int) -> None:
        _require_sane_size(path, width, height, size_bytes)
        if expected_px is not None and (width, height) != expected_px:
            raise WrongSize(
                f"{path}: is {width} x {height} px, {of} {expected_px[0]} x {expected_px[1]} px; "
                "take it again with the same settings, or correct the size that is stated"
            )

    most = MAX_FRAME_BYTES
    if expected_px is not None and page is None:
        most = expected_px[0] * expected_px[1] * _MAX_PIXEL_BYTES
    with opened(path) as file:
        kind = _kind(file, path)
        if kind is None:
            readable = ", ".join(sorted(IMAGE_SUFFIXES))
            raise UnknownFormat(f"{path}: '{path.suffix}' is not a format that is read; use one of {readable}")
        try:
            require_size(file, most + OVERHEAD_BYTES)  # decoders read what a header states before they tell its size
            frame = _decoded(file, path, kind, accept, page)
        except InputError:
            raise
        except Exception as failure:  # decoders raise exceptions of a dozen types
            raise UnreadableImage(_cannot_decode(path, getattr(failure, "strerror", None) or str(failure))) from failure
    shape, dtype = frame.pixels_dn.shape, frame.pixels_dn.dtype
    if len(shape) not in (2, 3) or shape[2:] not in ((), (3,)) or dtype.kind not in "buif":
        raise UnreadableImage(
            f"{path}: holds {dtype} values of shape {shape}; one grey or RGB picture of real numbers is wanted; export "
            "it as such"
        )
    return frame


def read_ahead[Item, Content](
    items: Iterable[Item], read: Callable[[Item], Content], workers: int = 2
) -> Iterator[tuple[Item, Content]]:
    """Yield each item with what `read` makes of it in a thread, in order; at most `workers` wait to be taken."""
    queue = iter(items)
    with ThreadPoolExecutor(workers) as pool:
        waiting = deque((item, pool.submit(read, item)) for item in islice(queue, workers))
        try:
            while waiting:
                item, content = waiting.popleft()
                yield item, content.result()
                waiting.extend((item, pool.submit(read, item)) for item in islice(queue, 1))
        finally:
            for _, content in waiting:
                content.cancel()


def picture_kind(path: Path) -> str | None:
    """Return the kind of picture in a file, as a suffix such as ".jpg", whatever its name; None if none is read.

    A raw file is known by its suffix alone. So is a damaged one of any kind.
    """
    with opened(path) as file:
        return _kind(file, path)


def _kind(file: BufferedReader, path: Path) -> str | None:
    suffix = path.suffix.lower()
    if suffix in RAW_SUFFIXES:
        return suffix
    kind = kind_of_content(file.peek(MAX_HEADER_BYTES))
    # Raw files of other makers are TIFFs, too, whose first picture is a small one
    if kind is None or (kind == ".tif" and suffix not in IMAGE_SUFFIXES | {""}):
        return _ALIKE.get(suffix, suffix) if suffix in IMAGE_SUFFIXES else None
    return kind


def pages_in(path: Path) -> int:
    """Return how many pictures of one size and type a file holds, one after the other; 1 for all files but TIFF."""
    if picture_kind(path) != ".tif":
        return 1
    with opened(path) as file:
        try:
            return count_pages(file)
        except Exception as failure:  # tifffile raises exceptions of a dozen types
            raise UnreadableImage(_cannot_decode(path, str(failure))) from failure


def _require_sane_size(path: Path, width: int, height: int, size_bytes: int) -> None:
    if not min(width, height) > 0:
        raise UnreadableImage(_cannot_decode(path, "no pixels"))
    if max(width, height) > MAX_SIDE_PX or width * height > MAX_PIXELS or size_bytes > MAX_FRAME_BYTES:
        raise UnreadableImage(
            f"{path}: is {width} x {height} px of {size_bytes / 1e6:.1f} MB; at most {MAX_SIDE_PX} px a side, "
            f"{MAX_PIXELS / 1e6:g} million pixels and {MAX_FRAME_BYTES / 1e6:g} MB are read; bin or crop it"
        )


def _decoded(file: BufferedReader, path: Path, kind: str, accept: Accept, page: int | None) -> Frame:
    if kind in RAW_SUFFIXES:
        return _read_raw(file, path, accept)
    white_dn = None
    if kind in NETPBM_SUFFIXES:
        pixels, white_dn = decode_netpbm(file, path, accept)
    elif kind == ".tif":
        pixels = decode_tiff(file, path, accept, page)
    else:
        decode = {".bmp": decode_bmp, ".exr": decode_exr}.get(kind, decode_photo)
        pixels = decode(file, path, accept)
    return Frame(pixels[:, :, :3] if pixels.ndim == 3 and pixels.shape[2] == 4 else pixels, saturation_dn=white_dn)


def _read_raw(file: BufferedReader, path: Path, accept: Accept) -> Frame:
    require_size(file, MAX_FRAME_BYTES)
    try:
        with rawpy.imread(file) as raw:
            sizes = raw.sizes
            _require_sane_size(path, sizes.raw_width, sizes.raw_height, 2 * sizes.raw_width * sizes.raw_height)
            accept(sizes.width, sizes.height, 2 * sizes.width * sizes.height)
            if raw.raw_image.ndim != 2:
                raise UnreadableImage(f"{path}: holds demosaiced colour; record raw files with their mosaic")
            pixels = raw.raw_image_visible.copy()
            mosaic = _mosaic_of(raw)
            black_dn = _masked_black_dn(raw, mosaic_period(mosaic))
            saturation_dn = float(raw.white_level)
    except rawpy.LibRawError as failure:
        reason = failure.args[0].decode() if isinstance(failure.args[0], bytes) else str(failure)
        if isinstance(failure, rawpy.LibRawFileUnsupportedError):
            raise UnknownFormat(_cannot_decode(path, reason)) from failure
        raise ValueError(reason) from failure
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
    with opened(path) as file, contextlib.suppress(Exception):  # of any type, if EXIF is damaged
        tag = exifread.process_file(file, details=False, stop_tag="EXIF ExposureTime").get("EXIF ExposureTime")
        if tag is not None and tag.values and 0 < float(tag.values[0]) <= MAX_EXPOSURE_S:
            return float(tag.values[0])
    return None


def _cannot_decode(path: Path, reason: str) -> str:
    reason = " ".join(reason.split())
    return f"{path}: cannot be decoded ({reason}; {path.stat().st_size} bytes); take or copy the image again"
