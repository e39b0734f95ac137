"""Operations that damage a file: each draws its arguments at random, and applies given arguments.

An operation and its arguments are JSON, so that a mutation can be kept and made again whatever the random numbers are.
"""

import os
import re
import stat
import struct
import zlib
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any

import numpy as np
import tifffile

from faintfield.pipelines.formats.digests import DIGEST_KEY, with_digest
from tests.faults.contained import MAX_FILE_BYTES
from tests.faults.mutation_text import TEXT, TREE, VICTIM, Arguments, Operation


def _draw_flips(rng: Random, path: Path) -> Arguments:
    size = max(path.stat().st_size, 1)
    within = size if rng.random() < 0.5 else min(size, 400)
    return [[[rng.randrange(within), rng.randrange(8)] for _ in range(rng.choice([1, 1, 1, 2, 8]))]]


def _flip(path: Path, bits: Sequence[tuple[int, int]]) -> None:
    content = bytearray(path.read_bytes())
    for offset, bit in bits:
        if content:
            content[offset % len(content)] ^= 1 << bit
    path.write_bytes(content)


def _draw_splice(rng: Random, path: Path) -> Arguments:
    size = path.stat().st_size
    at = rng.choice([0, size, rng.randint(0, size), rng.randint(0, size)])
    removed = rng.choice([0, 1, 4, 100, rng.randint(0, size), 1 << 60])
    added = rng.choice(
        [b"", b"\0", b"\xff\xfe", b"\xef\xbb\xbf", b"\n", bytes(64), rng.randbytes(rng.choice([1, 8, 300]))]
    )
    return [at, removed, added.hex()]


def _splice(path: Path, at: int, removed: int, added: str) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:at] + bytes.fromhex(added) + content[at + removed :])


def _draw_repeat(rng: Random, path: Path) -> Arguments:
    size = path.stat().st_size
    first = rng.randint(0, size)
    return [first, min(size, first + rng.choice([1, 10, 100, 1000, size])), rng.choice([2, 2, 3, 1000])]


def _repeat(path: Path, first: int, last: int, times: int) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:first] + content[first:last] * times + content[last:])


BYTES = {
    "flip": Operation(_draw_flips, _flip),
    "splice": Operation(_draw_splice, _splice),
    "repeat": Operation(_draw_repeat, _repeat),
}

# --- the file as such

_HUGE_BYTES = 3 << 30
_BECOMES = (
    *("missing", "empty", "folder", "full folder", "pipe", "huge", "itself", "beside", "victim", "nowhere"),
    *("/dev/zero", "/dev/full", "/dev/null", "/proc/self/mem", "/", "unreadable"),
)


def _become(path: Path, what: str) -> None:
    if what == "unreadable":
        path.chmod(0)
        return
    content = path.read_bytes()
    path.unlink()
    match what:
        case "missing":
            pass
        case "empty":
            path.touch()
        case "folder":
            path.mkdir()
        case "full folder":
            path.mkdir()
            (path / path.name).write_bytes(content)
        case "pipe":
            os.mkfifo(path)
        case "huge":
            path.write_bytes(content)
            os.truncate(path, _HUGE_BYTES)
        case "itself":
            path.symlink_to(path.name)
        case "beside":
            other = path.with_name(f"{path.name}.other")
            other.write_bytes(content)
            path.symlink_to(other.name)
        case "victim":
            path.symlink_to(guard_of(path) / VICTIM)
        case "nowhere":
            path.symlink_to(guard_of(path) / "beside" / "new.txt")
        case _:
            path.symlink_to(what)


def guard_of(path: Path) -> Path:
    """Return the folder around all files of a case, which holds the victim."""
    return next(folder for folder in path.parents if (folder / VICTIM).is_file())


WHOLE_FILE = {"become": Operation(lambda rng, _: [rng.choice(_BECOMES)], _become)}

_DIGEST = re.compile(rf',\s*"{DIGEST_KEY}":\s*"[^"]*"')


def _sign(path: Path) -> None:
    """Renew the digest that a record holds of itself, so that its damaged values are read."""
    if path.suffix == ".json" and DIGEST_KEY.encode() in path.read_bytes():
        path.write_bytes(with_digest(_DIGEST.sub("", path.read_text()).encode()))


_SIDES = (0, 1, 2, 23, 25, 40_000, 65_535, 1 << 20, (1 << 31) - 1, (1 << 32) - 1)
_TIFF_TYPES = (1, 2, 3, 4, 5, 7, 12, 13, 16, 99)


def _tiff_entries(content: bytes | bytearray) -> Iterator[tuple[int, int]]:
    """Yield the offset and the tag of each entry of the first page of a little-endian TIFF."""
    (first,) = struct.unpack_from("<I", content, 4)
    (count,) = struct.unpack_from("<H", content, first)
    for index in range(count):
        at = first + 2 + 12 * index
        yield at, struct.unpack_from("<H", content, at)[0]


def _draw_field(rng: Random, path: Path) -> Arguments:
    tags = [tag for _, tag in _tiff_entries(path.read_bytes())]
    part = rng.choice(["type", "count", "value", "value", "value", "tag"])
    value = rng.choice(_TIFF_TYPES) if part == "type" else rng.choice([*_SIDES, 8, 3, 4, 5, 6, 32946, 34712, 50_000])
    return [rng.choice(tags), part, value]


def _field(path: Path, tag: int, part: str, value: int) -> None:
    content = bytearray(path.read_bytes())
    for at, found in list(_tiff_entries(content)):
        if found == tag:
            layout, offset = {"tag": ("<H", 0), "type": ("<H", 2), "count": ("<I", 4), "value": ("<I", 8)}[part]
            struct.pack_into(layout, content, at + offset, value & (0xFFFF if layout == "<H" else 0xFFFFFFFF))
    path.write_bytes(content)


_PIXEL_TYPES = ("u1", "u2", "u4", "u8", "i2", "i4", "f2", "f4", "f8", "c8", "?")
_FILLS = ("zeros", "ones", "largest", "random", "nan", "inf")


def _draw_pixels(rng: Random, path: Path) -> Arguments:
    with tifffile.TiffFile(path) as file:
        height, width = file.pages[0].shape[:2]
    shapes = [(height, width), (height, width), (width, height), (height, width, 3), (1, 1), (2, height, width)]
    shape, kind, fill = rng.choice(shapes), rng.choice(_PIXEL_TYPES), rng.choice(_FILLS)
    return [list(shape), kind, fill, rng.choice([1, 1, 2]), rng.choice([None, None, "zlib"])]


def _pixels(path: Path, shape: Sequence[int], kind: str, fill: str, pages: int, compression: str | None) -> None:
    """Write different pixels; a second page has a different size."""
    array = _filled(tuple(shape), np.dtype(kind), fill)
    with tifffile.TiffWriter(path) as file:
        for page in range(pages):
            part = array if page == 0 else array[: max(1, len(array) // 2)]
            file.write(part, compression=compression, contiguous=False)


def _filled(shape: tuple[int, ...], kind: np.dtype[Any], fill: str) -> np.ndarray[Any, Any]:
    with np.errstate(all="ignore"):
        match fill:
            case "zeros":
                return np.zeros(shape, kind)
            case "largest" if kind.kind in "iu":
                return np.full(shape, np.iinfo(kind).max, kind)
            case "largest" if kind.kind == "f":
                return np.full(shape, np.finfo(kind).max, kind)
            case "nan" | "inf" if kind.kind in "fc":
                return np.full(shape, float(fill), kind)
            case "random":
                return np.random.default_rng(1).integers(0, 200, shape).astype(kind)
    return np.ones(shape, kind)


def _header_of_png(path: Path, width: int, height: int, bits: int, colour: int) -> None:
    content = path.read_bytes()
    header = b"IHDR" + struct.pack(">IIBBBBB", width & 0xFFFFFFFF, height & 0xFFFFFFFF, bits, colour, 0, 0, 0)
    path.write_bytes(content[:12] + header + struct.pack(">I", zlib.crc32(header)) + content[33:])


TIFF = {
    "field": Operation(_draw_field, _field, weight=2),
    "pixels": Operation(_draw_pixels, _pixels),
}
PNG = {
    "PNG header": Operation(
        lambda rng, _: [*rng.choices(_SIDES, k=2), rng.choice([0, 1, 8, 16, 99]), rng.choice([0, 2, 3, 6, 9])],
        _header_of_png,
    ),
}


_PACKED = ("d nan", "d inf", "d -1e300", "d 0", "Q 0", "Q 1099511627776", "Q 18446744073709551615", "q -1", "i -1")


def _draw_packed(rng: Random, path: Path) -> Arguments:
    return [rng.randrange(max(1, path.stat().st_size)), rng.choice(_PACKED)]


def _packed(path: Path, at: int, number: str) -> None:
    kind, value = number.split()
    packed = struct.pack(f"<{kind}", float(value) if kind == "d" else int(value))
    content = path.read_bytes()
    path.write_bytes(content[:at] + packed + content[at + len(packed) :])


BINARY = {"number": Operation(_draw_packed, _packed)}


SIGN = {"sign": Operation(lambda *_: [], _sign)}

_OF_SUFFIX: dict[str, tuple[dict[str, Operation], ...]] = {
    ".toml": (TREE, TREE, TREE, TEXT),
    ".json": (TREE, TREE, TREE, TEXT),
    ".txt": (TEXT, TEXT, TEXT),
    "": (TEXT,),
    ".cameramodel": (TEXT, TEXT, TEXT),
    ".bin": (BINARY, BINARY),
    ".tiff": (TIFF, TIFF),
    ".png": (PNG, PNG),
}
ALL = {
    name: operation
    for group in (BYTES, WHOLE_FILE, TREE, TEXT, TIFF, PNG, BINARY, SIGN)
    for name, operation in group.items()
}


def draw(rng: Random, path: Path) -> tuple[str, Arguments]:
    """Draw an operation on a file, and its arguments."""
    groups = [*_OF_SUFFIX.get(path.suffix, ()), BYTES, BYTES, WHOLE_FILE]
    group = rng.choice(groups)
    name = rng.choices(list(group), [operation.weight for operation in group.values()])[0]
    try:
        arguments = group[name].draw(rng, path)
    except Exception:  # an earlier mutation of the file makes its parsers raise anything
        return "flip", [[[rng.randrange(400), rng.randrange(8)]]]
    return name, arguments


def _expanded(argument: Any, guard: Path) -> Any:
    """Return an argument in which `@guard@` is the folder around all files, and `@3*x@` is xxx."""
    if isinstance(argument, list):
        return [_expanded(part, guard) for part in argument]
    if not isinstance(argument, str):
        return argument
    argument = argument.replace("@guard@", str(guard))
    return re.sub(r"@(\d+)\*([^@]+)@", lambda found: found[2] * int(found[1]), argument)


def can_be_mutated(path: Path) -> bool:
    """Return whether a path is that of a regular file of moderate size, and not a link."""
    try:
        state = path.lstat()
    except (OSError, ValueError):
        return False
    return stat.S_ISREG(state.st_mode) and state.st_size <= MAX_FILE_BYTES // 8


def apply(path: Path, name: str, arguments: Arguments) -> None:
    """Do an operation to a file; nothing if an earlier one left nothing of its kind."""
    if can_be_mutated(path):
        with suppress(Exception):
            ALL[name].apply(path, *(_expanded(argument, guard_of(path)) for argument in arguments))
