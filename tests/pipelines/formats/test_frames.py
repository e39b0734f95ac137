"""Frames of every kind: read as the sensor gave them, or refused when they are not whole."""

import os
import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray
from PIL import Image

from faintfield.pipelines.errors import MissingFile, UnknownFormat, UnreadableImage, WrongSize
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded, write_frame

type Writer = Callable[[Path, NDArray[np.generic]], object]


def _tiff(**options: Any) -> Writer:
    return lambda path, pixels: tifffile.imwrite(path, pixels, **options)


def _opencv(*options: int) -> Writer:
    def write(path: Path, pixels: NDArray[np.generic]) -> None:
        ordered = pixels if pixels.ndim == 2 else np.ascontiguousarray(pixels[:, :, ::-1])
        assert cv2.imwrite(str(path), ordered, list(options))

    return write


LOSSLESS: dict[str, tuple[str, Writer]] = {
    "plain TIFF": ("tiff", _tiff()),
    "zlib TIFF": ("tiff", _tiff(compression="zlib", predictor=True)),
    "zlib TIFF in strips": ("tif", _tiff(compression="zlib", rowsperstrip=5)),
    "TIFF in tiles": ("tiff", _tiff(tile=(16, 16))),
    "LZW TIFF": ("tiff", _opencv(cv2.IMWRITE_TIFF_COMPRESSION, 5)),
    "PNG": ("png", _opencv()),
}


def _pixels(dtype: type[np.unsignedinteger], *shape: int) -> NDArray[np.unsignedinteger]:
    return np.random.default_rng(20110919).integers(0, np.iinfo(dtype).max, shape, dtype, endpoint=True)


@pytest.mark.parametrize(("dtype", "shape"), [(np.uint8, (40, 50, 3)), (np.uint16, (40, 50))], ids=["RGB", "grey"])
@pytest.mark.parametrize("kind", LOSSLESS)
def test_lossless_files_keep_pixels_and_type(
    kind: str, dtype: type[np.unsignedinteger], shape: tuple[int, ...], tmp_path: Path
) -> None:
    suffix, write = LOSSLESS[kind]
    pixels = _pixels(dtype, *shape)
    write(tmp_path / f"frame.{suffix}", pixels)
    frame = read_frame(tmp_path / f"frame.{suffix}")
    assert frame.pixels_dn.dtype == dtype
    np.testing.assert_array_equal(frame.pixels_dn, pixels)
    assert [frame.mosaic, frame.black_dn, frame.saturation_dn, frame.exposure_s] == [None] * 4


def test_frames_are_written_uncompressed_in_one_piece(tmp_path: Path) -> None:
    pixels = _pixels(np.uint16, 40, 50, 3)
    write_frame(tmp_path / "frame.tiff", pixels)
    content = (tmp_path / "frame.tiff").read_bytes()
    assert pixels.tobytes() in content
    assert len(content) < pixels.nbytes + 1000
    np.testing.assert_array_equal(read_frame(tmp_path / "frame.tiff").pixels_dn, pixels)


def test_photograph_is_read_as_red_green_blue(tmp_path: Path) -> None:
    colour = np.array([200, 120, 40], np.uint8)
    _opencv(cv2.IMWRITE_JPEG_QUALITY, 95)(tmp_path / "photo.JPG", np.broadcast_to(colour, (32, 48, 3)))
    pixels = read_frame(tmp_path / "photo.JPG").pixels_dn
    assert pixels.shape == (32, 48, 3)
    np.testing.assert_allclose(pixels, np.broadcast_to(colour, pixels.shape), atol=2)


def test_opacity_is_left_out(tmp_path: Path) -> None:
    rgba = _pixels(np.uint8, 9, 8, 4)
    tifffile.imwrite(tmp_path / "frame.tiff", rgba, photometric="rgb", extrasamples=["unassalpha"])
    cv2.imwrite(str(tmp_path / "frame.png"), np.ascontiguousarray(rgba[:, :, [2, 1, 0, 3]]))
    for path in tmp_path.iterdir():
        np.testing.assert_array_equal(read_frame(path).pixels_dn, rgba[:, :, :3])


ALL_KINDS = {**LOSSLESS, "JPEG": ("jpg", _opencv())}


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_truncated_file_is_refused(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    suffix, write = ALL_KINDS[kind]
    path = tmp_path / f"frame.{suffix}"
    write(path, _pixels(np.uint8, 40, 50))
    read_frame(path)
    whole = path.read_bytes()
    for length in {0, 1, 8, *range(0, len(whole), len(whole) // 8)}:
        path.write_bytes(whole[:length])
        with pytest.raises(UnreadableImage, match=rf"cannot be decoded .*{length} bytes") as refused:
            read_frame(path)
        assert "\n" not in str(refused.value)
    assert capfd.readouterr() == ("", "")


def test_damaged_png_is_refused_without_printing(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    path = tmp_path / "frame.png"
    _opencv()(path, _pixels(np.uint16, 40, 50))
    whole = path.read_bytes()
    for place in range(8, len(whole), len(whole) // 10):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        with pytest.raises(UnreadableImage, match=r"frame\.png: cannot be decoded"):
            read_frame(path)
    assert capfd.readouterr() == ("", "")


def test_tiff_of_impossible_size_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "frame.tiff"
    tifffile.imwrite(path, _pixels(np.uint16, 40, 50), byteorder="<")
    whole = path.read_bytes()
    for tag in (b"\0\1", b"\1\1", b"\2\1"):  # width, length and bits
        entry, content = whole.index(tag, 10), bytearray(whole)
        struct.pack_into("<HII", content, entry + 2, 4, 1, 0x7FFFFFFF)
        path.write_bytes(content)
        with pytest.raises(UnreadableImage, match=r"frame\.tiff: "):
            read_frame(path)


def test_stacks_missing_and_endless_files_are_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "stack.tiff", _pixels(np.uint16, 5, 40, 50), photometric="minisblack")
    with pytest.raises(UnreadableImage, match="holds several pictures of one size; export one"):
        read_frame(tmp_path / "stack.tiff")
    with pytest.raises(MissingFile, match="no such image"):
        read_frame(tmp_path / "nowhere.tiff")
    (tmp_path / "view.jpg").write_bytes(b"\xff\xd8" + b"\xff" * 30_000_000 + b"\xff\xd9")
    with pytest.raises(UnreadableImage, match="its picture does not begin"):
        read_frame(tmp_path / "view.jpg")


def test_raw_file_is_a_mosaic_without_margins(real_data: Path, tmp_path: Path) -> None:
    """A raw file of a real camera: a Bayer mosaic with masked margins, EXIF without an exposure."""
    path = real_data / "raw" / "colorchart.dng"
    frame = read_frame(path)
    assert frame.pixels_dn.shape == (1156, 1734)
    assert frame.pixels_dn.dtype == np.uint16
    assert frame.mosaic == ("RG", "GB")
    assert (frame.saturation_dn, frame.exposure_s) == (15000.0, None)  # the decoder would make it 1 s
    # The two greens of a period see the same light, the other colours do not
    red, green, other_green, blue = (float(frame.pixels_dn[r::2, c::2].mean()) for r, c in np.ndindex(2, 2))
    assert abs(green - other_green) < 0.1 * min(green - red, green - blue)
    assert frame.black_dn is not None
    assert frame.black_dn.shape == (2, 2)
    assert 2040 < frame.black_dn.min() <= frame.black_dn.max() < 2052  # of masked pixels; the file states 2056
    whole = path.read_bytes()
    for part in (0.001, 0.5, 0.999):
        (tmp_path / "short.dng").write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(UnreadableImage, match=r"short\.dng: cannot be decoded[^\n]*$"):
            read_frame(tmp_path / "short.dng")


@pytest.mark.parametrize("name", ["view.tiff", "view.jpg"])
def test_file_far_larger_than_picture_is_refused(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(encoded(np.zeros((12, 16), np.uint8), path.suffix))
    os.truncate(path, 1_500_000_000)  # sparse: its description could be as long
    with pytest.raises(UnreadableImage, match=r"holds 1500000000 bytes, at most \d+ are read; .*; take or copy"):
        read_frame(path, (16, 12))


def noise(shape: tuple[int, ...], dtype: str) -> NDArray[Any]:
    """Pixels that differ everywhere, so that a turned or mirrored picture shows."""
    most = 2.0 if dtype == "f4" else 2 ** (8 * np.dtype(dtype).itemsize)
    return (np.random.default_rng(11).random(shape) * most).astype(dtype)


@pytest.mark.parametrize("shape", [(5, 7), (5, 7, 3)], ids=["grey", "colour"])
@pytest.mark.parametrize(("suffix", "dtype"), [("bmp", "u1"), ("ppm", "u1"), ("ppm", "u2"), ("pfm", "f4")])
def test_values_are_those_that_opencv_wrote(shape: tuple[int, ...], suffix: str, dtype: str, tmp_path: Path) -> None:
    suffix = "pgm" if suffix == "ppm" and len(shape) == 2 else suffix
    pixels, path = noise(shape, dtype), tmp_path / f"a.{suffix.upper()}"
    assert cv2.imwrite(str(tmp_path / f"a.{suffix}"), pixels if pixels.ndim == 2 else pixels[:, :, ::-1])
    (tmp_path / f"a.{suffix}").rename(path)
    decoded = read_frame(path).pixels_dn
    assert decoded.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(decoded, pixels)
    with pytest.raises(WrongSize, match="is 7 x 5 px, the camera 5 x 7 px"):
        read_frame(path, (5, 7))


@pytest.mark.parametrize("mode", ["1", "P"])
def test_bmp_of_another_library_is_read(mode: str, tmp_path: Path) -> None:
    pixels = noise((5, 7, 3), "u1")
    picture = Image.fromarray(pixels).convert(mode)
    picture.save(tmp_path / "a.bmp")
    expected = np.asarray(picture.convert("RGB"))
    decoded = read_frame(tmp_path / "a.bmp").pixels_dn
    np.testing.assert_array_equal(decoded if decoded.ndim == 3 else np.dstack([decoded] * 3), expected)


def test_byte_orders_of_pfm_are_read(tmp_path: Path) -> None:
    pixels = noise((2, 3), "f4")
    for scale, order in (("-1.0", "<f4"), ("1", ">f4")):
        (tmp_path / "a.pfm").write_bytes(f"Pf\n3 2\n{scale}\n".encode() + pixels[::-1].astype(order).tobytes())
        np.testing.assert_array_equal(read_frame(tmp_path / "a.pfm").pixels_dn, pixels)


HUGE = struct.pack("<2sI2H4I2H6I", b"BM", 54, 0, 0, 54, 40, 60_000, 60_000, 1, 24, 0, 0, 0, 0, 0, 0)
EXR = b"\x76\x2f\x31\x01\2\0\0\0"
WINDOW = b"dataWindow\0box2i\0" + struct.pack("<i", 16)


@pytest.mark.parametrize(
    ("name", "content", "failure", "words"),
    [
        ("a.pgm", b"P5 60000 60000 255 ", UnreadableImage, "60000 x 60000 px"),
        ("a.pgm", b"P5 4 4 255 abc", UnreadableImage, "truncated: 3 of 16 bytes of pixels"),
        ("a.pgm", b"P5 4 4 70000 ", UnreadableImage, "white is 70000, from 1 to 65535 is possible"),
        ("a.pgm", b"P2 2 1 255 1 2", UnknownFormat, "is of the kind P2; binary PGM, PPM and PFM"),
        ("a.bmp", HUGE, UnreadableImage, "60000 x 60000 px"),
        ("a.bmp", HUGE[:30] + struct.pack("<I", 1) + HUGE[34:], UnreadableImage, "not an uncompressed BMP"),
        ("a.exr", EXR, UnreadableImage, "its header states no dataWindow"),
        ("a.exr", EXR + WINDOW + struct.pack("<4i", 0, 0, 59_999, 59_999), UnreadableImage, "60000 x 60000 px"),
    ],
)
def test_impossible_files_are_refused(
    name: str, content: bytes, failure: type[Exception], words: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(failure, match=rf"{words}[^\n]*$"):
        read_frame(tmp_path / name)
