"""Pictures decoded from files, each after the size that its header states was accepted.

TIFF is decoded by tifffile; PNG, JPEG, BMP and OpenEXR by OpenCV; PGM, PPM and PFM, which are plain arrays, here.
"""

import logging
import os
import re
import struct
import zlib
from collections.abc import Callable, Iterator
from contextlib import suppress
from io import BufferedReader
from itertools import islice
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.errors import UnknownFormat, UnreadableImage
from faintfield.pipelines.formats.units import MAX_FRAME_BYTES
from faintfield.rig.files import read_all

# Takes width and height in px and the size in bytes of a picture when it is decoded; raises if it is too large.
type Accept = Callable[[int, int, int], None]

# What the content of a PNG or JPEG file begins with.
_PNG, _JPEG = b"\x89PNG\r\n\x1a\n", b"\xff\xd8\xff"

# Likewise of others; a BMP has the size of its second header at byte 14.
_TIFF = (b"II*\0", b"MM\0*", b"II+\0", b"MM\0+")
_BMP_HEADER_BYTES = (12, 40, 52, 56, 64, 108, 124)

# Number of channels of a PNG, by its colour type; a palette is decoded to colours.
_PNG_CHANNELS = {0: 1, 2: 3, 3: 3, 4: 2, 6: 4}

# The last bytes of a whole file. OpenCV silently fills the rest of a truncated photograph with grey.
_END_MARKS = {_PNG: b"IEND", _JPEG: b"\xff\xd9"}

# Compressions of a TIFF that tifffile decodes itself: none, two names of deflate, and packbits.
_DEFLATE = (8, 32946)
_OWN_COMPRESSIONS = (1, *_DEFLATE, 32773)

# Deflate shrinks by at most this factor; a strip whose content cannot exceed the limit in bytes is decoded untested.
_DEFLATE_RATIO, _UNTESTED_BYTES = 1032, 300_000_000

# What a file may have in bytes besides its pixels: its header, and a picture of its own.
OVERHEAD_BYTES = 64_000_000

# Pictures in one TIFF: more than any grid of cameras has nodes.
_MAX_PAGES = 100_000

# A JPEG has some ten segments and fill bytes before its picture.
_MAX_SEGMENTS = 10_000

# TIFFs of microscopes and scanners, whose pages tifffile would look for in ways of their own.
_NO_SPECIAL_KIND: dict[str, Any] = {f"is_{kind}": False for kind in ("lsm", "ndpi", "philips", "scanimage", "stk")}

NETPBM_SUFFIXES = {".pgm", ".ppm", ".pnm", ".pfm"}

# A header in words: kind, width, height, and the largest value or, for floats, scale and byte order.
_NETPBM = re.compile(
    rb"\A(P[1-7Ff])" + 2 * rb"(?:\s|#[^\n]*\n)+([0-9]{1,9})" + rb"(?:\s|#[^\n]*\n)+([-+.0-9eE]{1,40})[ \t\r\n]"
)
_NETPBM_CHANNELS = {b"P5": 1, b"P6": 3, b"Pf": 1, b"PF": 3}

# Bytes in which the header of such a file ends, and those of an OpenEXR file.
MAX_HEADER_BYTES, _MAX_EXR_HEADER_BYTES = 4096, 1_000_000

# Ways in which a BMP may be stored: uncompressed, with or without masks of its colours.
_BMP_UNCOMPRESSED = (0, 3, 6)

_EXR = b"\x76\x2f\x31\x01"

# Messages of the libraries are dropped: the failure says it all.
logging.getLogger("tifffile").addHandler(logging.NullHandler())
cv2.utils.logging.setLogLevel(cv2.utils.logging.LOG_LEVEL_SILENT)


def kind_of_content(head: bytes) -> str | None:
    """Return the suffix of the kind of picture whose file has this beginning, None if it is none that is decoded here.

    A raw file is a TIFF by its beginning.
    """
    if head.startswith((_PNG, _JPEG)):
        return ".png" if head.startswith(_PNG) else ".jpg"
    if head.startswith(_TIFF):
        return ".tif"
    if head.startswith(_EXR):
        return ".exr"
    if head.startswith(b"BM") and int.from_bytes(head[14:18], "little") in _BMP_HEADER_BYTES:
        return ".bmp"
    netpbm = _NETPBM.match(head)
    return None if netpbm is None else ".pfm" if netpbm[1] in (b"Pf", b"PF") else ".ppm"


def decode_tiff(file: BufferedReader, path: Path, accept: Accept, number: int | None = None) -> NDArray[Any]:
    """Return the picture of a TIFF, or that of a number in a stack; as any other function here, raise any exception.

    Compressions for which tifffile needs extra packages are decoded by OpenCV.
    """
    with tifffile.TiffFile(file, name="frame", **_NO_SPECIAL_KIND) as tiff:
        page = tiff.pages.first if number is None else tiff.pages[number]
        if page.dtype is None or not isinstance(page, tifffile.TiffPage):
            raise ValueError("its pixels are of no known type")
        accept(page.imagewidth, page.imagelength, page.nbytes)
        if page.compression in _OWN_COMPRESSIONS:
            if number is None:
                _require_one_page(tiff, path)
            _require_honest_strips(page, file)
            return np.asarray(page.asarray(maxworkers=1))  # several frames are decoded at a time
    file.seek(0)
    max_bytes = MAX_FRAME_BYTES if number is not None else page.nbytes + OVERHEAD_BYTES
    return _decode_with_opencv(read_all(file, max_bytes), number)


def count_pages(file: BufferedReader) -> int:
    """Return how many pictures of the first one's size and type a TIFF holds from its beginning, at most 100 000."""
    with tifffile.TiffFile(file, name="frame", **_NO_SPECIAL_KIND) as tiff:
        alike = list(_alike(tiff))
    count = [*alike, False].index(False)
    if any(alike[count:]):
        raise ValueError(f"picture {count + 1} has another size or type than those around it")
    return count


def _alike(tiff: tifffile.TiffFile) -> Iterator[bool]:
    """Yield for each picture whether it has the size and type of the first."""
    first = tiff.pages.first
    with suppress(IndexError):  # at the end; a slice would first look for this, and chains of pages may have none
        for number in range(_MAX_PAGES):
            page = tiff.pages[number]
            yield bool((page.shape, page.dtype) == (first.shape, first.dtype))


def decode_photo(file: BufferedReader, _: Path, accept: Accept) -> NDArray[Any]:
    """Return the picture of a PNG or JPEG, (row, column) or (row, column, RGB), with its own depth and orientation."""
    mark = next((mark for mark in _END_MARKS if file.peek(8).startswith(mark)), None)
    if mark is None:
        raise ValueError("not an image, or truncated")
    width, height, pixel_bytes = _png_size(file) if mark is _PNG else _jpeg_size(file)
    size_bytes = width * height * pixel_bytes
    accept(width, height, size_bytes)
    file.seek(0)
    content = read_all(file, size_bytes + OVERHEAD_BYTES)
    if _END_MARKS[mark] not in content[-1024:] or (mark is _PNG and not _sound_png(content)):
        raise ValueError("not an image, or truncated")
    return _decode_with_opencv(content)


def _require_one_page(tiff: tifffile.TiffFile, path: Path) -> None:
    """Refuse a stack; a smaller picture after the first, as cameras add, is passed over."""
    if list(islice(_alike(tiff), 2)) == [True, True]:
        raise UnreadableImage(
            f"{path}: holds several pictures of one size; export one to a file of its own, or, if they are views of a "
            "grid, name this file in `faintfield import grid`"
        )


def _require_honest_strips(page: tifffile.TiffPage, file: BufferedReader) -> None:
    """Refuse strips or tiles that take more memory than the picture, compressed or decompressed."""
    pixel_bytes = page.samplesperpixel * -(-page.bitspersample // 8)
    most = max(page.tilewidth * page.tilelength * page.tiledepth * pixel_bytes, page.nbytes)
    if most > page.nbytes + OVERHEAD_BYTES or sum(page.databytecounts) > 2 * most + OVERHEAD_BYTES:
        raise ValueError("its strips or tiles are larger than the picture")
    if page.compression not in _DEFLATE:
        return
    for offset, size in zip(page.dataoffsets, page.databytecounts, strict=True):
        if size * _DEFLATE_RATIO > _UNTESTED_BYTES:
            file.seek(offset)
            if len(zlib.decompressobj().decompress(file.read(size), most + 1)) > most:
                raise ValueError("a strip decompresses to more than the picture")


def _png_size(file: BufferedReader) -> tuple[int, int, int]:
    width, height, depth, colour_type = struct.unpack(">16x2I2B", file.read(26))
    return width, height, _PNG_CHANNELS.get(colour_type, 4) * (2 if depth > 8 else 1)


def _jpeg_size(file: BufferedReader) -> tuple[int, int, int]:
    """Return width, height and bytes per pixel that the frame header of a JPEG states."""
    file.seek(2)
    for _ in range(_MAX_SEGMENTS):
        begin, marker, length = struct.unpack(">BBH", file.read(4))
        if begin == marker == 0xFF:  # a marker may be preceded by any number of these
            file.seek(-3, 1)
            continue
        if begin != 0xFF or length < 2:
            raise ValueError("not an image, or truncated")
        if marker in range(0xC0, 0xD0) and marker not in (0xC4, 0xC8, 0xCC):  # tables, not frames
            _, height, width, channels = struct.unpack(">BHHB", file.read(6))
            return width, height, channels
        file.seek(length - 2, 1)
    raise ValueError("its picture does not begin")


def _decode_with_opencv(content: bytes, number: int | None = None) -> NDArray[Any]:
    """Return the picture of a file's content, or one of a stack, its colours in the order red, green, blue."""
    pixels: Any = None
    if number is None:
        pixels = cv2.imdecode(np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED)
    else:
        pages: Any = cv2.imdecodemulti(
            np.frombuffer(content, np.uint8), cv2.IMREAD_UNCHANGED, None, (number, number + 1)
        )[1]
        pixels = pages[0] if len(pages) == 1 else None
    if pixels is None:
        raise ValueError("not an image, or truncated")
    if pixels.ndim == 3 and pixels.shape[2] >= 3:
        pixels = cv2.cvtColor(pixels[:, :, :3], cv2.COLOR_BGR2RGB)
    return np.asarray(pixels)


def _sound_png(content: bytes) -> bool:
    """Return whether every chunk of a PNG has a right checksum; the decoder would only print."""
    start = 8
    while start < len(content):
        end = start + 8 + int.from_bytes(content[start : start + 4])
        if zlib.crc32(content[start + 4 : end]) != int.from_bytes(content[end : end + 4]) or end + 4 > len(content):
            return False
        if content[start + 4 : start + 8] == b"IEND":
            break
        start = end + 4
    return True


def decode_netpbm(file: BufferedReader, path: Path, accept: Accept) -> tuple[NDArray[Any], float | None]:
    """Return the picture of a binary PGM, PPM or PFM file, and the value of white that it states.

    Whole numbers have 8 bits, or 16 if white is above 255; float ones are as they stand in the file, top row first.
    """
    header = _NETPBM.match(file.read(MAX_HEADER_BYTES))
    if header is None:
        raise ValueError("not a PGM, PPM or PFM file, or truncated")
    kind, width, height = header[1], int(header[2]), int(header[3])
    if kind not in _NETPBM_CHANNELS:
        raise UnknownFormat(
            f"{path}: is of the kind {kind.decode()}; binary PGM, PPM and PFM (P5, P6, Pf, PF) are read: convert it"
        )
    channels, scale = _NETPBM_CHANNELS[kind], float(header[4])
    dtype: np.dtype[Any] = np.dtype("<f4" if scale < 0 else ">f4")
    white: float | None = None
    if kind in (b"P5", b"P6"):
        if not 1 <= scale <= 65535 or not scale.is_integer():
            raise ValueError(f"white is {scale:g}, from 1 to 65535 is possible")
        dtype, white = np.dtype(">u2" if scale > 255 else "u1"), scale
    size_bytes = width * height * channels * dtype.itemsize
    accept(width, height, size_bytes)
    file.seek(header.end())
    content = file.read(size_bytes)
    if len(content) != size_bytes:
        raise ValueError(f"truncated: {len(content)} of {size_bytes} bytes of pixels")
    pixels = np.frombuffer(content, dtype).reshape((height, width, channels) if channels > 1 else (height, width))
    return (pixels[::-1] if white is None else pixels).astype(dtype.newbyteorder("=")), white


def decode_bmp(file: BufferedReader, _: Path, accept: Accept) -> NDArray[Any]:
    """Return the picture of an uncompressed BMP, (row, column) or (row, column, RGB), of 8 bits."""
    head = file.read(34)
    if len(head) < 34 or not head.startswith(b"BM"):
        raise ValueError("not a BMP file, or truncated")
    start, header_bytes = struct.unpack_from("<2I", head, 10)
    if header_bytes == 12:
        (width, height, _, bits), compression = struct.unpack_from("<4H", head, 18), 0
    else:
        width, height, _, bits, compression = struct.unpack_from("<2i2HI", head, 18)
    if compression not in _BMP_UNCOMPRESSED or bits not in (1, 4, 8, 16, 24, 32):
        raise ValueError("not an uncompressed BMP file")
    height = abs(height)  # negative where the top row comes first
    accept(width, height, 4 * width * height)
    file.seek(0)
    content = read_all(file, 4 * width * height + OVERHEAD_BYTES)
    if len(content) < start + (width * bits + 31) // 32 * 4 * height:
        raise ValueError("truncated")
    return _decode_with_opencv(content)


def decode_exr(file: BufferedReader, path: Path, accept: Accept) -> NDArray[Any]:
    """Return the picture of an OpenEXR file, of float values linear in light; UnknownFormat if OpenCV reads none."""
    width, height = _exr_size(file.read(_MAX_EXR_HEADER_BYTES))
    accept(width, height, 16 * width * height)
    if re.search(r"OpenEXR:\s+NO\b", cv2.getBuildInformation()):
        raise UnknownFormat(
            f"{path}: the installed OpenCV {cv2.__version__} reads no OpenEXR; convert it to TIFF or PFM of floats "
            "(oiiotool in.exr -d float -o out.tif), or install an OpenCV built with OpenEXR"
        )
    os.environ.setdefault("OPENCV_IO_ENABLE_OPENEXR", "1")  # OpenCV asks for it when it first decodes one
    file.seek(0)
    return _decode_with_opencv(read_all(file, 16 * width * height + OVERHEAD_BYTES))


def _exr_size(head: bytes) -> tuple[int, int]:
    """Return width and height that the header of an OpenEXR file states: the extent of its dataWindow."""
    if not head.startswith(_EXR):
        raise ValueError("not an OpenEXR file")
    at = 8
    while at < len(head) and head[at]:
        name_end = head.index(b"\0", at)
        type_end = head.index(b"\0", name_end + 1)
        (size,) = struct.unpack_from("<i", head, type_end + 1)
        at = type_end + 5
        if head[:name_end].endswith(b"dataWindow") and size == 16:
            left, top, right, bottom = struct.unpack_from("<4i", head, at)
            return right - left + 1, bottom - top + 1
        if size < 0:
            break
        at += size
    raise ValueError("its header states no dataWindow")
