"""Values are unpacked as the standards lay out their bits, which are placed here one by one."""

import numpy as np
import pytest

from faintfield.rig.cameras.aravis_frames import PixelFormat
from faintfield.rig.errors import CameraError

MOSAICS = {"RG": ("RG", "GB"), "GR": ("GR", "BG"), "GB": ("GB", "RG"), "BG": ("BG", "GR")}
DEPTHS = ["8", "10", "12", "14", "16", "10p", "12p", "10Packed", "12Packed"]


def bits_of_pixel(depth: str, index: int) -> list[tuple[int, int]]:
    """Return byte and bit of each bit of a value, from the lowest.

    PFNC, chapter 6.2 ("p": least significant bit first), and GigE Vision, figures of GVSP_PIX_MONO10_PACKED and
    MONO12_PACKED: the first of two pixels has its high bits in byte 0 and its low ones from bit 0 of byte 1, the second
    its high bits in byte 2 and its low ones from bit 4 of byte 1.
    """
    if depth.endswith("Packed"):
        low = int(depth[:2]) - 8
        group, second = divmod(index, 2)
        return [(3 * group + 1, 4 * second + bit) for bit in range(low)] + [
            (3 * group + 2 * second, bit) for bit in range(8)
        ]
    if depth.endswith("p"):
        width = int(depth[:2])
        return [divmod(index * width + bit, 8) for bit in range(width)]
    size = 1 if depth == "8" else 2
    return [(size * index + bit // 8, bit % 8) for bit in range(int(depth))]


def packed(depth: str, values: list[int]) -> bytes:
    """Place the values' bits, one after the other."""
    content: dict[int, int] = {}
    for index, value in enumerate(values):
        for number, (byte, bit) in enumerate(bits_of_pixel(depth, index)):
            content[byte] = content.get(byte, 0) | (value >> number & 1) << bit
        if depth in ("10", "12", "14"):
            content.setdefault(2 * index + 1, 0)
    return bytes(content.get(byte, 0) for byte in range(max(content) + 1))


@pytest.mark.parametrize("size", [(5, 1), (7, 3)])
@pytest.mark.parametrize("depth", DEPTHS)
def test_values_are_unpacked_bit_by_bit(depth: str, size: tuple[int, int]) -> None:
    width, height = size
    bits = int(depth.rstrip("pacPked"))
    values = np.random.default_rng(7).integers(0, 1 << bits, (height, width))
    values.flat[0] = (1 << bits) - 1
    content = packed(depth, values.ravel().tolist())
    for name in ("Mono", "BayerRG"):
        form = PixelFormat.named(name + depth)
        assert form.frame_bytes(width, height) == len(content)
        read = form.values(content + b"\xff chunks", width, height)
        assert read.dtype == (np.uint8 if depth == "8" else np.uint16)
        np.testing.assert_array_equal(read, values)
        with pytest.raises(CameraError, match=rf"has {len(content)} bytes, the camera sent {len(content) - 1}; "):
            form.values(content[:-1], width, height)


def test_mosaics() -> None:
    for first_row, mosaic in MOSAICS.items():
        assert PixelFormat.named(f"Bayer{first_row}12Packed").mosaic == mosaic
    assert PixelFormat.named("Mono12p").mosaic is None


@pytest.mark.parametrize("name", ["RGB8", "Mono16p", "BayerXX8"])
def test_other_formats_are_refused(name: str) -> None:
    with pytest.raises(ValueError, match=r"is not read; give Mono or"):
        PixelFormat.named(name)


@pytest.mark.parametrize("depth", ["10", "14"])
def test_values_beyond_the_format_are_refused(depth: str) -> None:
    with pytest.raises(CameraError, match=r"a value of \d+ came in Mono1\d, which ends at"):
        PixelFormat.named(f"Mono{depth}").values((1 << int(depth)).to_bytes(2, "little"), 1, 1)


def test_frame_without_pixels_is_refused() -> None:
    for size in ((0, 4), (4, 0), (-2, -2)):
        with pytest.raises(CameraError, match="check its region"):
            PixelFormat.named("Mono8").values(bytes(100), *size)
