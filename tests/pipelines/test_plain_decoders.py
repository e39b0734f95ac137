"""BMP, PGM, PPM, PFM and OpenEXR from anyone: values as other libraries write them, and damage named in one line."""

import struct
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from PIL import Image

from faintfield.pipelines.errors import UnknownFormat, UnreadableImage, WrongSize
from faintfield.pipelines.formats.frames import read_frame


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
    found = read_frame(path).pixels_dn
    assert found.dtype == np.dtype(dtype)
    np.testing.assert_array_equal(found, pixels)


@pytest.mark.parametrize("mode", ["1", "P"])
def test_a_bmp_of_another_library_is_read(mode: str, tmp_path: Path) -> None:
    pixels = noise((5, 7, 3), "u1")
    picture = Image.fromarray(pixels).convert(mode)
    picture.save(tmp_path / "a.bmp")
    expected = np.asarray(picture.convert("RGB"))
    found = read_frame(tmp_path / "a.bmp").pixels_dn
    np.testing.assert_array_equal(found if found.ndim == 3 else np.dstack([found] * 3), expected)


def test_both_byte_orders_of_pfm_begin_with_the_lowest_row(tmp_path: Path) -> None:
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
def test_files_that_cannot_be_are_refused(
    name: str, content: bytes, failure: type[Exception], words: str, tmp_path: Path
) -> None:
    (tmp_path / name).write_bytes(content)
    with pytest.raises(failure) as caught:
        read_frame(tmp_path / name)
    assert words in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("suffix", ["pgm", "pfm"])
def test_the_expected_size_is_asked_for_before_decoding(suffix: str, tmp_path: Path) -> None:
    assert cv2.imwrite(str(tmp_path / f"a.{suffix}"), noise((5, 7), "f4" if suffix == "pfm" else "u1"))
    with pytest.raises(WrongSize, match="is 7 x 5 px, the camera 5 x 7 px"):
        read_frame(tmp_path / f"a.{suffix}", (5, 7))


@settings(suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(
    kind=st.sampled_from(["bmp", "pgm", "ppm", "pfm", "exr"]),
    place=st.integers(0, 80),
    patch=st.binary(min_size=1, max_size=8),
    keep=st.integers(0, 400),
)
def test_changed_bytes_give_a_picture_or_a_named_failure(
    kind: str, place: int, patch: bytes, keep: int, tmp_path: Path
) -> None:
    if kind == "exr":
        content = EXR + WINDOW + struct.pack("<4i", 0, 0, 6, 4) + bytes(200)
    else:
        shape = (5, 7, 3) if kind == "ppm" else (5, 7)
        content = cv2.imencode(f".{kind}", noise(shape, "f4" if kind == "pfm" else "u1"))[1].tobytes()
    (tmp_path / f"a.{kind}").write_bytes((content[:place] + patch + content[place + len(patch) :])[:keep])
    try:
        pixels = read_frame(tmp_path / f"a.{kind}").pixels_dn
    except (UnreadableImage, WrongSize):
        return
    assert pixels.ndim in (2, 3)
    assert pixels.size > 0
