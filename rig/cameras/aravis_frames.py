"""Frames of GenICam cameras: values by their pixel format, and refusal of exposures begun before their request."""

import re
import time
from dataclasses import dataclass

import numpy as np

from faintfield.rig.cameras.protocol import Pixels
from faintfield.rig.errors import CameraError

_NAME = re.compile(r"(?:Mono|Bayer(RG|GR|GB|BG))(?:(8|10|12|14|16)|(10|12)(p|Packed))")
# Colours of the second row below each first row.
_SECOND_ROW = {"RG": "GB", "GR": "BG", "GB": "RG", "BG": "GR"}
# An exposure may be this much shorter than it was set.
_SHORTEST_SHARE = 0.9
# The computer's date may run this much faster or slower than its clock while it is corrected, besides a jump in s.
_DATE_RATE = 1e-3
_DATE_JUMP_S = 0.01
# How often clock and date are read for one moment.
_READINGS = 3
# The camera's clock may run this much faster or slower than the computer's; and how exact its time stamps are, in s.
_CAMERA_RATE = 2e-4
_CAMERA_JITTER_S = 0.01


@dataclass(frozen=True)
class PixelFormat:
    """A pixel format, by its name in the Pixel Format Naming Convention (PFNC), such as Mono12p or BayerRG10Packed.

    `packing` is how values of `bits` share bytes: `""` if each fills one or two bytes, `"p"` for a stream of bits that
    begins with the lowest bit, `"Packed"` for three bytes for two values, with the high bits in the outer ones.
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
        mosaic = (match[1], _SECOND_ROW[match[1]]) if match[1] else None
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
        """Return a frame without padding, (row, column), uint8 or uint16; what follows it, such as chunks, is ignored.

        Values are as the sensor counts them: those of 12 bits end at 4095. Raises `CameraError` if bytes are missing,
        or a value has more bits than the format.
        """
        needed = self.frame_bytes(width, height)
        if min(width, height) < 1 or len(content) < needed:
            problem = f"a frame of {width} x {height} in {self.name} has {needed} bytes, the camera sent {len(content)}"
            raise CameraError(f"{problem}; check its region and pixel format")
        stored = np.frombuffer(content, np.uint8, needed)
        match self.packing:
            case "p":
                values = _stream_of_bits(stored, self.bits, width * height)
            case "Packed":
                values = _outer_bytes(stored, self.bits, width * height)
            case _:
                values = stored if self.bits == 8 else stored.view("<u2").astype(np.uint16)
        top, limit = int(values.max()), (1 << self.bits) - 1
        if top > limit:
            raise CameraError(f"a value of {top} came in {self.name}, which ends at {limit}; set another pixel_format")
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


@dataclass(frozen=True)
class Moment:
    """A moment by the computer's clock and date, in ns."""

    clock_ns: int
    date_ns: int

    @classmethod
    def now(cls) -> "Moment":
        """Return the present moment: of several pairs of readings the closest, as another process may interrupt one."""
        pairs = []
        for _ in range(_READINGS):
            before_ns, date_ns, after_ns = time.monotonic_ns(), time.time_ns(), time.monotonic_ns()
            pairs.append((after_ns - before_ns, before_ns, date_ns))
        _, clock_ns, date_ns = min(pairs)
        return cls(clock_ns, date_ns)


@dataclass(frozen=True)
class Stamps:
    """Dates of a frame: when the computer received its beginning, and by the camera's own clock, 0 if it has none."""

    received_ns: int
    camera_ns: int


class FrameTimes:
    """Check by two clocks that a frame began after it was requested.

    A frame that is received sooner after its request than its exposure lasts began before the request. A frame that
    was held back on its way shows by the camera's clock, which is compared with the frame before of the same exposure
    time: whatever moment of a frame the camera stamps, it is the same in both.
    """

    def __init__(self) -> None:
        self._last: dict[float, tuple[int, int]] = {}  # when received, by the computer's clock; the camera's stamp
        self._newest_ns = 0

    def check(self, stamps: Stamps, requested: Moment, now: Moment, exposure_s: float) -> None:
        """Raise `CameraError` if the frame's exposure began before it was requested, or that cannot be told.

        `now` is a moment after the frame came. `exposure_s` is 0 if the camera only pretends to expose.
        """
        passed_s = 1e-9 * (now.clock_ns - requested.clock_ns)
        by_date_s = 1e-9 * (now.date_ns - requested.date_ns)
        if abs(by_date_s - passed_s) > _DATE_JUMP_S + _DATE_RATE * passed_s:
            jump_s = by_date_s - passed_s
            raise CameraError(f"the computer's date jumped by {jump_s:+.3f} s during the exposure; take it again")
        after_ns = stamps.received_ns - requested.date_ns // 1000 * 1000  # dates of the library end at microseconds
        after_s = 1e-9 * after_ns
        if after_s < _SHORTEST_SHARE * exposure_s:
            raise CameraError(
                f"a frame came {1e3 * after_s:.1f} ms after it was requested, sooner than its exposure of "
                f"{exposure_s:g} s lasts: it began before the request; take it again"
            )
        if stamps.camera_ns:
            self._check_camera_clock(stamps, requested, exposure_s)
            self._newest_ns = stamps.camera_ns
            self._last[exposure_s] = (requested.clock_ns + after_ns, stamps.camera_ns)

    def _check_camera_clock(self, stamps: Stamps, requested: Moment, exposure_s: float) -> None:
        if stamps.camera_ns <= self._newest_ns:
            raise CameraError("a frame is not newer by the camera's clock than the one before; open the camera again")
        last = self._last.get(exposure_s)
        if last is None:
            return
        received_ns, camera_ns = last
        earliest_s = 1e-9 * (requested.clock_ns - received_ns) + _SHORTEST_SHARE * exposure_s
        slack_s = _CAMERA_JITTER_S + _CAMERA_RATE * abs(earliest_s)
        passed_s = 1e-9 * (stamps.camera_ns - camera_ns)
        if passed_s < earliest_s - slack_s:
            raise CameraError(
                f"a frame came that is {1e3 * (earliest_s - passed_s):.0f} ms too old by the camera's clock: its "
                "exposure began before the request; take it again"
            )
