"""Pictures decoded from BMP, PGM, PPM, PFM and OpenEXR files, each after the size that its header states was accepted.

PGM, PPM and PFM are plain arrays of numbers and are decoded here; BMP and OpenEXR by OpenCV, where it can.
"""

import os
import re
import struct
from io import BufferedReader
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import UnknownFormat
from faintfield.pipelines.formats.decoders import OVERHEAD_BYTES, Accept, decode_with_opencv
from faintfield.rig.files import read_all

NETPBM_SUFFIXES = {".pgm", ".ppm", ".pnm", ".pfm"}

# A header in words: kind, width, height, and the largest value or, for floats, scale and byte order.
_NETPBM = re.compile(
    rb"\A(P[1-7Ff])" + 2 * rb"(?:\s|#[^\n]*\n)+([0-9]{1,9})" + rb"(?:\s|#[^\n]*\n)+([-+.0-9eE]{1,40})[ \t\r\n]"
)
_NETPBM_CHANNELS = {b"P5": 1, b"P6": 3, b"Pf": 1, b"PF": 3}

# Bytes in which the header of such a file ends, and those of an OpenEXR file.
_MAX_HEADER_BYTES, _MAX_EXR_HEADER_BYTES = 4096, 1_000_000

# Ways in which a BMP may be stored: uncompressed, with or without masks of its colours.
_BMP_UNCOMPRESSED = (0, 3, 6)

_EXR = b"\x76\x2f\x31\x01"


def decode_netpbm(file: BufferedReader, path: Path, accept: Accept) -> tuple[NDArray[Any], float | None]:
    """Return the picture of a binary PGM, PPM or PFM file, and the value of white that it states.

    Whole numbers have 8 bits, or 16 if white is above 255; float ones are as they stand in the file, top row first.
    """
    header = _NETPBM.match(file.read(_MAX_HEADER_BYTES))
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


def decode_bmp(file: BufferedReader, accept: Accept) -> NDArray[Any]:
    """Return the picture of an uncompressed BMP, (row, column) or (row, column, RGB), of 8 bits."""
    head = file.read(34)
    if len(head) < 34 or not head.startswith(b"BM"):
        raise ValueError("not a BMP file, or truncated")
    start, header_bytes = struct.unpack_from("<2I", head, 10)
    if header_bytes == 12:
        width, height, _, bits = struct.unpack_from("<4H", head, 18)
        compression = 0
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
    return decode_with_opencv(content)


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
    return decode_with_opencv(read_all(file, 16 * width * height + OVERHEAD_BYTES))


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
