"""The pixel formats of GenICam cameras that are read: grey or a Bayer mosaic, of 8 to 16 bits, packed or not."""

import re
from dataclasses import dataclass

import numpy as np

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.errors import CameraError

_NAME = re.compile(r"(?:Mono|Bayer(RG|GR|GB|BG))(?:(8|10|12|14|16)|(10|12)(p|Packed))")
# Colours of the second row below each first row.
_SECOND_ROW = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}


@dataclass(frozen=True)
class PixelFormat:
    """A pixel format, by its name in the Pixel Format Naming Convention (PFNC), such as Mono12p or BayerRG10Packed.

    Parameters
    ----------
    name : str
        The name.
    bits : int
        Bits of a value.
    packing : str
        How values share bytes: `""` if each fills one or two bytes, `"p"` for one stream of bits that begins with the
        lowest bit, `"Packed"` for GigE Vision's three bytes for two values, with the high bits in the outer ones.
    mosaic : tuple of str or None
        Rows of one period of the colour filters.
    """

    name: str
    bits: int
    packing: str
    mosaic: tuple[str, ...] | None

    @classmethod
    def named(cls, name: str) -> "PixelFormat":
        """Return the format of this name; raises `ValueError` if it is not one that is read."""
        match = _NAME.fullmatch(name)
        if match is None:
            raise ValueError(
                f"camera.pixel_format = {name!r} is not read; give Mono or BayerRG, GR, GB or BG, then 8, 10, 12, "
                "14 or 16, or 10p, 12p, 10Packed or 12Packed"
            )
        first_row = match[1]
        mosaic = (first_row, _SECOND_ROW[first_row]) if first_row else None
        return cls(name, int(match[2] or match[3]), match[4] or "", mosaic)

    @property
    def stored_bits(self) -> int:
        """Bits that a pixel takes in a frame, as PFNC also states them in the number of the format."""
        if self.packing:
            return self.bits if self.packing == "p" else 12
        return 8 if self.bits == 8 else 16

    def frame_bytes(self, width: int, height: int) -> int:
        """Return the size in bytes of a frame without padding; the last byte of a stream of bits may be incomplete."""
        return -(-width * height * self.stored_bits // 8)

    def values(self, content: bytes, width: int, height: int) -> Pixels:
        """Return the values of a frame without padding; what follows it, such as chunks, is ignored.

        Returns
        -------
        array of uint8 or uint16, (height, width)
            The values as the sensor counts them: those of 12 bits end at 4095.

        Raises
        ------
        CameraError
            There are fewer bytes than the frame has, or a value has more bits than the format.
        """
        needed = self.frame_bytes(width, height)
        if min(width, height) < 1 or len(content) < needed:
            raise CameraError(
                f"a frame of {width} x {height} pixels in {self.name} has {needed} bytes, the camera sent "
                f"{len(content)}; check its region and pixel format"
            )
        stored = np.frombuffer(content, np.uint8, needed)
        match self.packing:
            case "p":
                values = _stream_of_bits(stored, self.bits, width * height)
            case "Packed":
                values = _outer_bytes(stored, self.bits, width * height)
            case _:
                values = stored if self.bits == 8 else stored.view("<u2").astype(np.uint16)
        if int(values.max()) >> self.bits:
            raise CameraError(
                f"a value of {int(values.max())} came in {self.name}, which ends at {(1 << self.bits) - 1}; "
                "the camera aligns its values otherwise: set another pixel_format"
            )
        return values.reshape(height, width)


def _stream_of_bits(stored: Pixels, bits: int, count: int) -> Pixels:
    """Return values that lie one after the other in a stream of bits, each from its lowest bit."""
    values = np.zeros(count, np.uint16)
    period = 4 if bits == 10 else 2  # values that begin anew at a byte
    for place in range(period):
        first, shift = divmod(place * bits, 8)
        step = period * bits // 8
        part = values[place::period]
        low, high = stored[first::step][: part.size], stored[first + 1 :: step][: part.size]
        part[:] = ((low.astype(np.uint16) >> shift) | (high.astype(np.uint16) << (8 - shift))) & ((1 << bits) - 1)
    return values


def _outer_bytes(stored: Pixels, bits: int, count: int) -> Pixels:
    """Return values of which two share three bytes: the outer ones have their high bits, the middle one the others."""
    values = np.zeros(count, np.uint16)
    low_bits = bits - 8
    mask = (1 << low_bits) - 1
    first, second = values[::2], values[1::2]
    high = stored[::3][: first.size].astype(np.uint16)
    first[:] = high << low_bits | stored[1::3][: first.size] & mask
    high = stored[2::3][: second.size].astype(np.uint16)
    second[:] = high << low_bits | stored[1::3][: second.size] >> 4 & mask
    return values
