"""Frames of every kind: read as the sensor gave them, or refused when they are not whole."""

import os
import struct
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import tifffile
from numpy.typing import NDArray

from faintfield.pipelines.errors import MissingFile, UnreadableImage
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
def test_lossless_files_keep_every_pixel_and_its_type(
    kind: str, dtype: type[np.unsignedinteger], shape: tuple[int, ...], tmp_path: Path
) -> None:
    suffix, write = LOSSLESS[kind]
    pixels = _pixels(dtype, *shape)
    write(tmp_path / f"frame.{suffix}", pixels)
    frame = read_frame(tmp_path / f"frame.{suffix}")
    assert frame.pixels_dn.dtype == dtype
    np.testing.assert_array_equal(frame.pixels_dn, pixels)
    assert [frame.mosaic, frame.black_dn, frame.saturation_dn, frame.exposure_s] == [None] * 4


@pytest.mark.parametrize("shape", [(40, 50), (40, 50, 3)], ids=["grey", "RGB"])
def test_frames_are_written_uncompressed_in_one_piece(shape: tuple[int, ...], tmp_path: Path) -> None:
    pixels = _pixels(np.uint16, *shape)
    write_frame(tmp_path / "frame.tiff", pixels)
    content = (tmp_path / "frame.tiff").read_bytes()
    assert pixels.tobytes() in content
    assert len(content) < pixels.nbytes + 1000
    np.testing.assert_array_equal(read_frame(tmp_path / "frame.tiff").pixels_dn, pixels)


def test_a_photograph_is_read_in_the_order_red_green_blue(tmp_path: Path) -> None:
    colour = np.array([200, 120, 40], np.uint8)
    _opencv(cv2.IMWRITE_JPEG_QUALITY, 95)(tmp_path / "photo.JPG", np.broadcast_to(colour, (32, 48, 3)))
    pixels = read_frame(tmp_path / "photo.JPG").pixels_dn
    assert pixels.shape == (32, 48, 3)
    np.testing.assert_allclose(pixels, np.broadcast_to(colour, pixels.shape), atol=2)


@pytest.mark.parametrize("suffix", ["tiff", "png"])
def test_opacity_is_left_out(suffix: str, tmp_path: Path) -> None:
    rgba = _pixels(np.uint8, 9, 8, 4)
    path = tmp_path / f"frame.{suffix}"
    if suffix == "tiff":
        tifffile.imwrite(path, rgba, photometric="rgb", extrasamples=["unassalpha"])
    else:
        cv2.imwrite(str(path), np.ascontiguousarray(rgba[:, :, [2, 1, 0, 3]]))
    np.testing.assert_array_equal(read_frame(path).pixels_dn, rgba[:, :, :3])


ALL_KINDS = {**LOSSLESS, "JPEG": ("jpg", _opencv())}


@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_truncated_file_is_refused(kind: str, tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
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


@pytest.mark.deep
@pytest.mark.parametrize("kind", ALL_KINDS)
def test_a_file_that_lacks_its_last_bytes_is_refused_unless_no_pixel_is_among_them(kind: str, tmp_path: Path) -> None:
    suffix, write = ALL_KINDS[kind]
    path = tmp_path / f"frame.{suffix}"
    write(path, _pixels(np.uint8, 40, 50))
    pixels, whole = read_frame(path).pixels_dn, path.read_bytes()
    for lost in range(1, 30):
        path.write_bytes(whole[:-lost])
        try:
            np.testing.assert_array_equal(read_frame(path).pixels_dn, pixels)
        except UnreadableImage:
            continue
        assert kind == "LZW TIFF"  # OpenCV ends these with the link to a next page that is not there


def test_a_png_with_a_damaged_byte_is_refused_without_the_decoder_printing(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    path = tmp_path / "frame.png"
    _opencv()(path, _pixels(np.uint16, 40, 50))
    whole = path.read_bytes()
    for place in range(8, len(whole), len(whole) // 10):
        path.write_bytes(whole[:place] + bytes([whole[place] ^ 0x10]) + whole[place + 1 :])
        with pytest.raises(UnreadableImage, match=r"frame\.png: cannot be decoded"):
            read_frame(path)
    assert capfd.readouterr() == ("", "")


@pytest.mark.parametrize("tag", [256, 257, 258], ids=["width", "length", "bits"])
@pytest.mark.parametrize("value", [0x7FFFFFFF])
def test_a_tiff_of_impossible_size_is_refused(tag: int, value: int, tmp_path: Path) -> None:
    path = tmp_path / "frame.tiff"
    tifffile.imwrite(path, _pixels(np.uint16, 40, 50), byteorder="<")
    content = bytearray(path.read_bytes())
    count = struct.unpack_from("<H", content, 8)[0]
    entry = next(at for at in range(10, 10 + 12 * count, 12) if struct.unpack_from("<H", content, at)[0] == tag)
    struct.pack_into("<HII", content, entry + 2, 4, 1, value)
    path.write_bytes(content)
    with pytest.raises(UnreadableImage, match=r"frame\.tiff: "):
        read_frame(path)


def test_a_png_that_claims_to_be_enormous_is_refused(tmp_path: Path) -> None:
    def chunk(kind: bytes, content: bytes) -> bytes:
        return struct.pack(">I", len(content)) + kind + content + struct.pack(">I", zlib.crc32(kind + content))

    header = chunk(b"IHDR", struct.pack(">IIBBBBB", 200_000, 200_000, 16, 0, 0, 0, 0))
    body = chunk(b"IDAT", zlib.compress(b"nothing")) + chunk(b"IEND", b"")
    (tmp_path / "frame.png").write_bytes(b"\x89PNG\r\n\x1a\n" + header + body)
    with pytest.raises(UnreadableImage, match=r"frame\.png: is 200000 x 200000 px of"):
        read_frame(tmp_path / "frame.png")


def test_a_stack_of_pictures_is_refused(tmp_path: Path) -> None:
    tifffile.imwrite(tmp_path / "stack.tiff", _pixels(np.uint16, 5, 40, 50), photometric="minisblack")
    with pytest.raises(UnreadableImage, match="holds several pictures of one size; export one"):
        read_frame(tmp_path / "stack.tiff")


@pytest.mark.parametrize("name", ["nowhere.tiff"])
def test_a_file_that_is_not_there_is_missing(name: str, tmp_path: Path) -> None:
    with pytest.raises(MissingFile, match="no such image"):
        read_frame(tmp_path / name)


class TestRawFile:
    """A raw file of a real camera: a Bayer mosaic with masked margins, EXIF without an exposure."""

    @pytest.fixture
    def path(self, real_data: Path) -> Path:
        return real_data / "raw" / "colorchart.dng"

    def test_its_mosaic_is_kept_and_its_margins_are_not(self, path: Path) -> None:
        frame = read_frame(path)
        assert frame.pixels_dn.shape == (1156, 1734)
        assert frame.pixels_dn.dtype == np.uint16
        assert frame.mosaic == ("RG", "GB")
        assert frame.saturation_dn == 15000.0
        # The two greens of a period see the same light, the other colours do not
        (red, green), (other_green, blue) = [
            [float(frame.pixels_dn[row::2, column::2].mean()) for column in (0, 1)] for row in (0, 1)
        ]
        assert abs(green - other_green) < 0.1 * min(green - red, green - blue)

    def test_its_black_level_is_that_of_masked_pixels_not_the_one_it_states(self, path: Path) -> None:
        black_dn = read_frame(path).black_dn
        assert black_dn is not None
        assert black_dn.shape == (2, 2)
        assert 2040 < black_dn.min() <= black_dn.max() < 2052  # it states 2056

    @pytest.mark.parametrize("part", [0.001, 0.5, 0.999])
    def test_a_truncated_one_is_refused(self, path: Path, part: float, tmp_path: Path) -> None:
        whole = path.read_bytes()
        (tmp_path / "short.dng").write_bytes(whole[: int(part * len(whole))])
        with pytest.raises(UnreadableImage, match=r"short\.dng: cannot be decoded") as refused:
            read_frame(tmp_path / "short.dng")
        assert "\n" not in str(refused.value)


@pytest.mark.parametrize("name", ["view.tiff", "view.jpg"])
def test_a_file_far_larger_than_its_picture_is_not_handed_to_a_decoder(name: str, tmp_path: Path) -> None:
    path = tmp_path / name
    path.write_bytes(encoded(np.zeros((12, 16), np.uint8), path.suffix))
    os.truncate(path, 1_500_000_000)  # sparse: its description could be as long
    with pytest.raises(UnreadableImage, match=r"holds 1500000000 bytes, at most \d+ are read; .*; take or copy"):
        read_frame(path, (16, 12))


def test_a_jpeg_that_never_begins_is_given_up(tmp_path: Path) -> None:
    path = tmp_path / "view.jpg"
    path.write_bytes(b"\xff\xd8" + b"\xff" * 30_000_000 + b"\xff\xd9")
    with pytest.raises(UnreadableImage, match="its picture does not begin"):
        read_frame(path)
