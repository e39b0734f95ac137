"""The descriptor files of EMVA 1288 reference data.

A descriptor is a text file of one-letter lines: `v` release, `n` bits width height, then for each measurement
`b` exposure-in-ns photons-per-pixel (bright) or `d` exposure-in-ns (dark), followed by one `i` line per image. Paths
are relative, often with backslashes; decimals may be commas; `#` begins a comment.
"""

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path, PureWindowsPath

import msgspec

from faintfield.calib.noise import Conditions
from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.limits import MAX_EXPOSURE_S
from faintfield.pipelines.formats.reading import is_file, read_text
from faintfield.pipelines.formats.results.noise import NoiseFrame
from faintfield.pipelines.formats.toml_files import inside

DESCRIPTOR = "descriptor.txt"

_NS_PER_S = 1e9

# The release whose descriptors are written.
_RELEASE = "4.0"


@dataclass
class Descriptor:
    """A descriptor file: release of the standard, bits per pixel, and the frames."""

    release: str = ""
    bits: int = 0
    frames: list[NoiseFrame] = field(default_factory=list)


def read_descriptor(path: Path) -> Descriptor:
    """Read a descriptor file; the frames keep the paths that it states.

    Raises
    ------
    MissingFile
        There is no such file.
    BadValue
        A line is not of the format; the message gives its number.
    """
    if not is_file(path):
        raise MissingFile(f"{path}: no such file; name an EMVA 1288 descriptor file")
    read = Descriptor()
    current: NoiseFrame | None = None
    levels: dict[float, int] = {}
    for number, line in enumerate(read_text(path).splitlines(), 1):
        words = line.split(maxsplit=1)
        if not words or words[0].startswith("#"):
            continue
        try:
            keyword, rest = words
            if keyword in ("b", "d"):
                current = _measurement(keyword, rest, levels)
            else:
                _add(read, current, keyword, rest.strip())
        except ValueError as failure:
            raise BadValue(
                f"{path}: line {number}: '{line.strip():.80}' cannot be read ({failure}); correct it"
            ) from failure
    if not read.frames or not 1 <= read.bits <= 32:
        raise BadValue(
            f"{path}: names {len(read.frames)} images of {read.bits} bits; an 'n' line and images are needed; "
            "name the descriptor of a data set"
        )
    return read


def _add(read: Descriptor, current: NoiseFrame | None, keyword: str, rest: str) -> None:
    """Add a `v`, `n` or `i` line to a descriptor; `current` is the frame of the last `b` or `d` line."""
    match keyword:
        case "v":
            read.release = rest
        case "n":
            read.bits = int(rest.split()[0])
        case "i":
            if current is None:
                raise ValueError("an image before any 'b' or 'd' line")
            read.frames.append(msgspec.structs.replace(current, file=rest))
        case _:
            raise ValueError(f"'{keyword}' is none of v, n, b, d, i")


def _measurement(keyword: str, rest: str, levels: dict[float, int]) -> NoiseFrame:
    """Return the frame of a `b` or `d` line, without its file; equal photons are one light level."""
    numbers = [float(word.replace(",", ".")) for word in rest.split()]
    if len(numbers) != (2 if keyword == "b" else 1):
        raise ValueError("give 'b exposure photons' or 'd exposure'")
    if not all(0 <= number < math.inf for number in numbers):
        raise ValueError("exposures and photons are finite and not negative")
    exposure_s = numbers[0] / _NS_PER_S
    if exposure_s > MAX_EXPOSURE_S:
        raise ValueError(f"an exposure of {exposure_s:g} s is longer than {MAX_EXPOSURE_S:g} s")
    if keyword == "d" or numbers[1] == 0:
        return NoiseFrame("", "dark", exposure_s)
    level = levels.setdefault(numbers[1], len(levels))
    return NoiseFrame("", "flat", exposure_s, None, level, numbers[1])


def image_path(descriptor: Path, stated: str) -> Path:
    """Return the path of an image that a descriptor names with slashes of either kind."""
    path = inside(descriptor.parent, PureWindowsPath(stated).as_posix(), f"{descriptor}: image")
    if not is_file(path):
        raise MissingFile(f"{path}: is named by {descriptor} but missing; unpack all of the data set")
    return path


def descriptor_text(images: Sequence[tuple[Conditions, Sequence[str]]], bits: int, size_px: tuple[int, int]) -> str:
    """Return the text of a descriptor file.

    Parameters
    ----------
    images : sequence of (Conditions, sequence of str)
        The series with the paths of their images; flats need their photons.
    bits : int
        Bits per pixel.
    size_px : (int, int)
        Width and height of an image.
    """
    lines = [f"v {_RELEASE}", f"n {bits} {size_px[0]} {size_px[1]}"]
    for conditions, names in images:
        exposure_ns = repr(conditions.exposure_s * _NS_PER_S)
        lines.append(f"d {exposure_ns}" if conditions.kind == "dark" else f"b {exposure_ns} {conditions.photons!r}")
        lines += ["i " + str(PureWindowsPath(name)) for name in names]
    return "\n".join(lines) + "\n"
