"""What can be done to a file: each operation draws its arguments at random, and applies given ones.

An operation and its arguments are JSON, so that a mutation can be kept and made again whatever the random numbers are.
"""

import hashlib
import json
import os
import re
import sqlite3
import stat
import struct
import tomllib
import zipfile
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import closing, suppress
from io import BytesIO
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np
import tifffile
import tomli_w

from faintfield.pipelines.formats.digests import DIGEST_KEY, with_digest
from faintfield.rig.session import chain
from faintfield.rig.session.session import JOURNAL, PLAN, SUMS
from tests.faults.contained import FORGED, MAX_FILE_BYTES, SCRIPT

# Names in the folder around all of a case's files; nothing may be written to any of them.
VICTIM = "victim.txt"

type Arguments = list[Any]


class Operation(NamedTuple):
    """One thing that can be done to a file: how its arguments are drawn, and how it is done."""

    draw: Callable[[Random, Path], Arguments]
    apply: Callable[..., None]


# --- bytes


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
    *("missing", "empty", "folder", "full folder", "pipe", "huge", "itself", "chain", "beside", "victim", "nowhere"),
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
        case "chain":
            other = path.with_name(f"{path.name}.other")
            path.symlink_to(other.name)
            other.symlink_to(path.name)
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

# --- settings and records

_NUMBERS = (
    *("0", "1", "-1", "2", "-0.0", "0.5", "1e-320", "1e-30", "1e-6", "1e6", "1e9", "1e15", "1e30", "-1e30", "1e308"),
    *("1e999", "-1e999", "nan", "NaN", "inf", "-inf", "Infinity", "3.5", "100000", "200000", "65536", "4294967296"),
    *(str(2**31 - 1), str(2**31), str(2**53 + 1), str(2**63 - 1), str(2**63), str(2**64), str(-(2**63)), "@400*9@"),
    *("@5000*9@", "0.@5000*3@", "1e-400", "0x10", "1_000", "+1", "01"),
)
_OTHERS = (
    *("true", "false", "null", '""', '"x"', "[]", "{}", "[[]]", "[0]", "[1.0, 2.0]", "[[0, 0], [0, 0]]", '{"a" = 1}'),
    *('{"a": 1}', '"1"', '["x"]', "[null]", "2026-11-22", "2026-11-22T10:00:00Z"),
)
_DEPTHS = (70, 200, 900, 3000, 100_000)


def _draw_raw(rng: Random, present: Any) -> str:
    """Draw what to put in place of a value, as it will stand in the file."""
    kind = rng.random()
    if isinstance(present, str) and kind < 0.6:
        return json.dumps(rng.choice(_names(present)), ensure_ascii=rng.random() < 0.5)
    if isinstance(present, int | float) and kind < 0.6:
        factor = rng.choice([-1, 0.0, 0.9, 1.001, 10, 1e3, 1e6, 1e12])
        return repr(present * factor) if rng.random() < 0.4 else rng.choice(_NUMBERS)
    if isinstance(present, list) and kind < 0.3:
        times = rng.choice([2, 3, 1000, 100_000 // (len(present) + 1)])
        if rng.random() < 0.5 and present:
            return f"[@{times - 1}*{json.dumps(present)[1:-1]}, @{json.dumps(present)[1:]}"
        return json.dumps(present[: len(present) // 2])
    if kind < 0.7:
        return rng.choice(_NUMBERS)
    if kind < 0.9:
        return rng.choice(_OTHERS)
    depth = rng.choice(_DEPTHS)
    opened, closed = rng.choice([("[", "]"), ('{"a":', "}"), ("{a=", "}")])
    return f"@{depth}*{opened}@1@{depth}*{closed}@"


def _names(present: str) -> list[str]:
    """Return what a name in a file may become."""
    return [
        *("", " ", ".", "..", "/", "~", "con", "\0", present + "\0", present + "/", "./" + present, "../" + present),
        *(f"../../{VICTIM}", f"../{VICTIM}", f"../../../{VICTIM}", f"@guard@/{VICTIM}", "@guard@/beside/new"),
        *(f"../../beside/{present}", f"x/../../{VICTIM}", "/dev/zero", "/dev/full", "/dev/stdin", "/proc/self/mem"),
        *("@5000*x@", "@3000*x/@", present * 2, present.upper(), present.swapcase()),
        *(f"{present}\n{FORGED} all is well", f"\n{FORGED} all is well", f"\r{FORGED} done"),
        *(f"\x1b[31m{present}\x1b[0m", f"\x1b]0;x\x07{present}", "\u202e" + present, "\x9b31m", "\u2028" + FORGED),
        *(SCRIPT, f'">{SCRIPT}', f"[red]{present}[/red]", "[/nothing]", "{present}", "{0}%s%n", "ünï", "日本", "a b"),
        *("-rf", "--help", "0" * 64, "f" * 64, "NaN", "1", "true", "\ud800", "*", "[", "\\", f"..\\..\\{VICTIM}"),
    ]


def _read_tree(path: Path) -> Any:
    content = path.read_bytes().decode()
    return tomllib.loads(content) if path.suffix == ".toml" else json.loads(content)


def _write_tree(path: Path, tree: Any, raw: Sequence[str] = ()) -> None:
    """Write a tree in which the string `@@number@@` stands for the raw text of that number."""
    text = tomli_w.dumps(tree) if path.suffix == ".toml" else json.dumps(tree)
    for number, piece in enumerate(raw):
        text = text.replace(f'"@@{number}@@"', piece)
    path.write_text(text, encoding="utf-8", errors="surrogatepass")


def _draw_place(rng: Random, tree: Any) -> list[Any]:
    """Draw the place of a value within a tree, most often that of a leaf."""
    place: list[Any] = []
    while isinstance(tree, dict | list) and tree and (not place or rng.random() < 0.9):
        key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
        place.append(key)
        tree = tree[key]
    return place


def _at(tree: Any, place: Sequence[Any]) -> Any:
    for key in place:
        tree = tree[key]
    return tree


def _draw_set(rng: Random, path: Path) -> Arguments:
    tree = _read_tree(path)
    place = _draw_place(rng, tree)
    return [place, _draw_raw(rng, _at(tree, place))]


def _set(path: Path, place: Sequence[Any], raw: str) -> None:
    tree = _read_tree(path)
    if not place:
        path.write_text(raw)
        return
    _at(tree, place[:-1])[place[-1]] = "@@0@@"
    _write_tree(path, tree, [raw])


def _remove(path: Path, place: Sequence[Any]) -> None:
    tree = _read_tree(path)
    del _at(tree, place[:-1])[place[-1]]
    _write_tree(path, tree)


def _draw_add(rng: Random, path: Path) -> Arguments:
    tree = _read_tree(path)
    place = _draw_place(rng, tree)[:-1]
    return [place, rng.choice([*_names("x")[:12], "@5000*x@", "inputs"]), _draw_raw(rng, None)]


def _add(path: Path, place: Sequence[Any], key: str, raw: str) -> None:
    tree = _read_tree(path)
    holder = _at(tree, place)
    if isinstance(holder, list):
        holder.append("@@0@@")
    else:
        holder[key] = "@@0@@"
    _write_tree(path, tree, [raw])


def _draw_exchange(rng: Random, path: Path) -> Arguments:
    tree = _read_tree(path)
    return [_draw_place(rng, tree), _draw_place(rng, tree)]


def _exchange(path: Path, one: Sequence[Any], other: Sequence[Any]) -> None:
    tree = _read_tree(path)
    first, second = json.loads(json.dumps([_at(tree, one), _at(tree, other)]))
    _at(tree, one[:-1])[one[-1]] = second
    try:
        _at(tree, other[:-1])[other[-1]] = first
    except (LookupError, TypeError):
        pass  # the one held the other
    _write_tree(path, tree)


TREE = {
    "set": Operation(_draw_set, _set),
    "set ": Operation(_draw_set, _set),  # drawn three times as often as the others
    "set  ": Operation(_draw_set, _set),
    "remove": Operation(lambda rng, path: [_draw_place(rng, _read_tree(path))], _remove),
    "add": Operation(_draw_add, _add),
    "exchange": Operation(_draw_exchange, _exchange),
}

# --- lines and words

_WORD = re.compile(r"[^\s\"'\[\]{},:=]+")


def _text(path: Path) -> str:
    return path.read_bytes().decode("latin-1")


def _draw_word(rng: Random, path: Path) -> Arguments:
    count = max(len(_WORD.findall(_text(path))), 1)
    replacement = rng.choice([*_NUMBERS, *_OTHERS, "", " ", *_names("x")])
    return [rng.randrange(count), replacement]


def _word(path: Path, number: int, replacement: str) -> None:
    text = _text(path)
    for index, found in enumerate(_WORD.finditer(text)):
        if index == number:
            new = replacement.encode("utf-8", "surrogatepass")
            path.write_bytes(text[: found.start()].encode("latin-1") + new + text[found.end() :].encode("latin-1"))


def _draw_line(rng: Random, path: Path) -> Arguments:
    count = max(len(_text(path).split("\n")), 1)
    return [rng.choice(["remove", "twice", "often", "last", "join", "empty", "long"]), rng.randrange(count)]


def _line(path: Path, what: str, number: int) -> None:
    lines = _text(path).split("\n")
    line = lines[number]
    changed = {
        "remove": [],
        "twice": [line, line],
        "often": [line] * 3000,
        "last": [lines[-2] if len(lines) > 1 else ""],
        "join": [line.replace(" ", "")],
        "empty": ["", "", line],
        "long": [line + " 0" * 100_000],
    }[what]
    path.write_bytes("\n".join([*lines[:number], *changed, *lines[number + 1 :]]).encode("latin-1"))


TEXT = {"word": Operation(_draw_word, _word), "line": Operation(_draw_line, _line)}

# --- pictures

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


def _next_page(path: Path, offset: int | None) -> None:
    """Let the first page be followed by the page at an offset, by default by itself."""
    content = bytearray(path.read_bytes())
    (first,) = struct.unpack_from("<I", content, 4)
    (count,) = struct.unpack_from("<H", content, first)
    struct.pack_into("<I", content, first + 2 + 12 * count, first if offset is None else offset)
    path.write_bytes(content)


_PIXEL_TYPES = ("u1", "u2", "u4", "u8", "i2", "i4", "f2", "f4", "f8", "c8", "?")
_FILLS = ("zeros", "ones", "largest", "random", "nan", "inf")


def _draw_pixels(rng: Random, path: Path) -> Arguments:
    with tifffile.TiffFile(path) as file:
        height, width = file.pages[0].shape[:2]
    shapes = [(height, width), (height, width), (width, height), (height, width, 3), (height, width, 4), (1, 1)]
    shapes += [(2, height, width), (height,), (height - 1, width), (height, 2 * width), (3, height, width)]
    pages = rng.choice([1, 1, 1, 2, 3])
    return [
        list(rng.choice(shapes)),
        rng.choice(_PIXEL_TYPES),
        rng.choice(_FILLS),
        pages,
        rng.choice([None, None, "zlib", "lzw"]),
    ]


def _pixels(path: Path, shape: Sequence[int], kind: str, fill: str, pages: int, compression: str | None) -> None:
    """Write other pixels; a second page has another size."""
    array = _filled(tuple(shape), np.dtype(kind), fill)
    with tifffile.TiffWriter(path) as file:
        for page in range(pages):
            file.write(
                array if page == 0 else array[: max(1, len(array) // 2)], compression=compression, contiguous=False
            )


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


def _repeated_zeros(block: int, times: int) -> bytes:
    """Return a zlib stream of `block` · `times` zero bytes, made without compressing them all."""
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    packer.compress(bytes(1))
    piece_packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    piece = piece_packer.compress(bytes(block)) + piece_packer.flush(zlib.Z_FULL_FLUSH)
    end = zlib.compressobj(9, zlib.DEFLATED, -15).flush()
    checksum = struct.pack(">I", (((block * times) % 65521) << 16) | 1)
    return b"\x78\xda" + piece * times + end + checksum


def _tiff_bomb(path: Path, side: int, bits: int) -> None:
    """Write a TIFF of side² zeros in strips that share their compressed bytes."""
    rows = max(1, min(side, (1 << 24) // side))
    strips = -(-side // rows)
    packed = zlib.compress(bytes(rows * side * bits // 8), 9)
    at, lists = 8, 8 + len(packed) + len(packed) % 2
    entries = [(256, 4, 1, side), (257, 4, 1, side), (258, 3, 1, bits), (259, 3, 1, 8), (262, 3, 1, 1)]
    entries += [(273, 4, strips, lists), (277, 3, 1, 1), (278, 4, 1, rows), (279, 4, strips, lists + 4 * strips)]
    page = lists + 8 * strips
    content = b"II*\0" + struct.pack("<I", page) + packed.ljust(lists - 8, b"\0")
    content += struct.pack(f"<{strips}I", *[at] * strips) + struct.pack(f"<{strips}I", *[len(packed)] * strips)
    content += struct.pack("<H", len(entries)) + b"".join(struct.pack("<HHII", *entry) for entry in entries) + bytes(4)
    path.write_bytes(content)


def _png_chunk(name: bytes, content: bytes) -> bytes:
    return struct.pack(">I", len(content)) + name + content + struct.pack(">I", zlib.crc32(name + content))


def _png_bomb(path: Path, side: int, bits: int) -> None:
    """Write a grey PNG of side² zeros."""
    line = 1 + side * bits // 8
    header = struct.pack(">IIBBBBB", side, side, bits, 0, 0, 0, 0)
    data = _repeated_zeros(line * 16, -(-side // 16))
    path.write_bytes(
        b"\x89PNG\r\n\x1a\n" + _png_chunk(b"IHDR", header) + _png_chunk(b"IDAT", data) + _png_chunk(b"IEND", b"")
    )


def _header_of_png(path: Path, width: int, height: int, bits: int, colour: int) -> None:
    content = path.read_bytes()
    header = struct.pack(">IIBBBBB", width & 0xFFFFFFFF, height & 0xFFFFFFFF, bits, colour, 0, 0, 0)
    path.write_bytes(content[:8] + _png_chunk(b"IHDR", header) + content[33:])


def _header_of_jpeg(path: Path, width: int, height: int) -> None:
    content = bytearray(path.read_bytes())
    for marker in (b"\xff\xc0", b"\xff\xc1", b"\xff\xc2"):
        if (at := content.find(marker)) >= 0:
            struct.pack_into(">HH", content, at + 5, height & 0xFFFF, width & 0xFFFF)
            break
    path.write_bytes(content)


TIFF = {
    "field": Operation(_draw_field, _field),
    "field ": Operation(_draw_field, _field),
    "next page": Operation(lambda rng, _: [rng.choice([None, None, 1, 8, 1 << 31])], _next_page),
    "pixels": Operation(_draw_pixels, _pixels),
    "TIFF bomb": Operation(lambda rng, _: [rng.choice([5000, 40_000, 65_000]), rng.choice([8, 16])], _tiff_bomb),
}
PNG = {
    "PNG header": Operation(
        lambda rng, _: [
            rng.choice(_SIDES),
            rng.choice(_SIDES),
            rng.choice([0, 1, 8, 16, 99]),
            rng.choice([0, 2, 3, 6, 9]),
        ],
        _header_of_png,
    ),
    "PNG bomb": Operation(lambda rng, _: [rng.choice([5000, 30_000]), rng.choice([8, 16])], _png_bomb),
}
JPEG = {"JPEG header": Operation(lambda rng, _: [rng.choice(_SIDES), rng.choice(_SIDES)], _header_of_jpeg)}

# --- archives of arrays

_HEADERS = (
    "{'descr': '<f4', 'fortran_order': False, 'shape': (100000, 100000), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (-1, 4), }",
    "{'descr': '<f4', 'fortran_order': False, 'shape': (9223372036854775807, 9), }",
    "{'descr': '|O', 'fortran_order': False, 'shape': (2,), }",
    "{'descr': '<f4', 'fortran_order': 3, 'shape': (2,), }",
    "{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (2,), }",
    "@500*(@@500*)@",
    "__import__('os').system('true')",
    "{'descr': '<f4'",
    "",
    "\x00\xff",
)


def _draw_member(rng: Random, path: Path) -> Arguments:
    with np.load(path, allow_pickle=False) as stored:
        name = rng.choice(list(stored.files))
    what = rng.choice(["type", "fill", "shape", "remove", "rename", "header", "twice", "pickle", "bytes", "empty"])
    argument: Any = {
        "type": rng.choice([*_PIXEL_TYPES, "S4", "U4", "M8[s]", "V8"]),
        "fill": rng.choice(_FILLS),
        "shape": rng.choice([[], [0], [1], [3, 5], [1, 1, 1, 1], "reversed", "one more", "doubled"]),
        "rename": rng.choice([f"../../{VICTIM}", "/dev/null", "@5000*x@", f"x\n{FORGED}", "", "a/b"]),
        "header": rng.choice(_HEADERS),
        "bytes": [rng.random(), rng.randrange(256)],
    }.get(what)
    return [name, what, argument]


def _member(path: Path, name: str, what: str, argument: Any) -> None:
    """Change one array of an archive."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = dict(stored)
    array = arrays[name]
    pieces = {f"{it}.npy": _as_npy(other) for it, other in arrays.items()}
    piece = f"{name}.npy"
    match what:
        case "remove":
            del pieces[piece]
        case "type":
            with np.errstate(all="ignore"):
                blank = np.zeros(array.shape, argument)
                pieces[piece] = _as_npy(blank if blank.dtype.kind in "SUMV" else array.astype(argument))
        case "fill":
            pieces[piece] = _as_npy(_filled(array.shape, array.dtype, argument))
        case "shape":
            shapes = {"reversed": array.shape[::-1], "one more": (*array.shape, 1)}
            changed = (
                np.repeat(array, 2) if argument == "doubled" else np.resize(array, shapes.get(str(argument), argument))
            )
            pieces[piece] = _as_npy(changed)
        case "rename":
            pieces[argument] = pieces.pop(piece)
        case "header":
            text = argument.encode("latin-1") + b"\n"
            pieces[piece] = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(text)) + text + bytes(64)
        case "pickle":
            pieces[piece] = _as_npy(np.array([{"a": 1}], object))
        case "empty":
            pieces[piece] = b""
        case "bytes":
            changed_bytes = bytearray(pieces[piece])
            changed_bytes[int(argument[0] * len(changed_bytes))] ^= argument[1]
            pieces[piece] = bytes(changed_bytes)
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for it, content in pieces.items():
            archive.writestr(it or ".", content)
        if what == "twice":
            archive.writestr(zipfile.ZipInfo(piece), pieces[piece][: len(pieces[piece]) // 2])


def _as_npy(array: np.ndarray[Any, Any]) -> bytes:
    buffer = BytesIO()
    np.lib.format.write_array(buffer, array, allow_pickle=True)
    return buffer.getvalue()


def _zip_bomb(path: Path, name: str, gigabytes: int) -> None:
    """Let an array hold gigabytes of zeros, which take megabytes in the archive."""
    count = gigabytes << 28
    header = f"{{'descr': '<f4', 'fortran_order': False, 'shape': ({count},), }}".ljust(117) + "\n"
    head = b"\x93NUMPY\x01\x00" + struct.pack("<H", len(header)) + header.encode()
    stream = _repeated_zeros(1 << 20, gigabytes << 10)[2:-4]
    packer = zlib.compressobj(9, zlib.DEFLATED, -15)
    body = packer.compress(head) + packer.flush(zlib.Z_FULL_FLUSH) + stream
    member, size = f"{name}.npy".encode(), len(head) + 4 * count
    local = struct.pack("<4sHHHHHIIIHH", b"PK\3\4", 20, 0, 8, 0, 33, 0, len(body), size & 0xFFFFFFFF, len(member), 0)
    central = struct.pack(
        *("<4sHHHHHHIIIHHHHHII", b"PK\1\2", 20, 20, 0, 8, 0, 33, 0, len(body), size & 0xFFFFFFFF, len(member)),
        *(0, 0, 0, 0, 0, 0),
    )
    at = len(local) + len(member) + len(body)
    end = struct.pack("<4sHHHHIIH", b"PK\5\6", 0, 0, 1, 1, len(central) + len(member), at, 0)
    path.write_bytes(local + member + body + central + member + end)


def _draw_zip_bomb(rng: Random, path: Path) -> Arguments:
    with np.load(path, allow_pickle=False) as stored:
        return [rng.choice(list(stored.files)), 3]


NPZ = {
    "member": Operation(_draw_member, _member),
    "member ": Operation(_draw_member, _member),
    "zip bomb": Operation(_draw_zip_bomb, _zip_bomb),
}

# --- databases


def _draw_cell(rng: Random, path: Path) -> Arguments:
    with closing(sqlite3.connect(path)) as db:
        tables = [row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type='table' ORDER BY name")]
        table = rng.choice([name for name in tables if not name.startswith("sqlite_")] * 4 + tables)
        column = rng.choice([row[1] for row in db.execute(f'PRAGMA table_info("{table}")')] or ["rowid"])
        rows = [row[0] for row in db.execute(f'SELECT rowid FROM "{table}" ORDER BY rowid')] or [0]
        row = rng.choice(rows)
        found = db.execute(f'SELECT "{column}" FROM "{table}" WHERE rowid = ?', (row,)).fetchone()
    present = found[0] if found else None
    return [table, column, row, *_draw_cell_value(rng, present)]


def _draw_cell_value(rng: Random, present: Any) -> tuple[str, Any]:
    """Draw a value and how it is stored: as it is, as bytes in hexadecimal, or as a piece of SQL."""
    if isinstance(present, str) and present.startswith("{") and rng.random() < 0.6:
        tree = json.loads(present)
        place = _draw_place(rng, tree)
        raw = _draw_raw(rng, _at(tree, place))
        if place:
            _at(tree, place[:-1])[place[-1]] = "@@0@@"
            return "value", json.dumps(tree).replace('"@@0@@"', raw)
        return "value", raw
    kind = rng.random()
    if isinstance(present, str) and kind < 0.6:
        name = rng.choice(_names(present))
        return ("bytes as text", b"\xff\xfe".hex()) if "\ud800" in name else ("value", name)
    if isinstance(present, int | float) and kind < 0.4:
        return "value", rng.choice([present + 1, -present, present * 1000, 0, 10_000, 1 << 40])
    values = [None, "x", "", 1.5, -1, 0, 1 << 62, 1e300, "@5000*9@", "@100000*[@"]
    others = [("bytes", "ff00fe"), ("bytes", ""), ("bytes as text", "fffe41")]
    others += [("sql", "9e999"), ("sql", "zeroblob(100000000)"), ("sql", "hex(zeroblob(1000000))")]
    return rng.choice([*(("value", value) for value in values), *others])


def _cell(path: Path, table: str, column: str, row: int, how: str, value: Any) -> None:
    with closing(_opened(path)) as db:
        place = {"sql": str(value), "bytes as text": "CAST(? AS TEXT)"}.get(how, "?")
        values = [] if how == "sql" else [bytes.fromhex(value)] if how.startswith("bytes") else [value]
        _attempt(db, f'UPDATE OR REPLACE "{table}" SET "{column}" = {place} WHERE rowid = {row}', values)


def _opened(path: Path) -> sqlite3.Connection:
    """Open a database for any change."""
    db = sqlite3.connect(path, isolation_level=None)
    for setting in ("synchronous = OFF", "foreign_keys = OFF", "ignore_check_constraints = ON", "writable_schema = ON"):
        _attempt(db, f"PRAGMA {setting}")
    return db


def _attempt(db: sqlite3.Connection, statement: str, values: Sequence[Any] = ()) -> None:
    """Execute a statement; what the schema itself refuses stays as it is."""
    try:
        db.execute(statement, values)
        db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    except (sqlite3.Error, OverflowError):
        pass


def _draw_statement(rng: Random, path: Path) -> Arguments:
    with closing(sqlite3.connect(path)) as db:
        tables = [row[0] for row in db.execute("SELECT name FROM sqlite_master WHERE type='table' ORDER BY name")]
        table = rng.choice([name for name in tables if not name.startswith("sqlite_")])
        columns = [row[1] for row in db.execute(f'PRAGMA table_info("{table}")')]
        rows = [row[0] for row in db.execute(f'SELECT rowid FROM "{table}" ORDER BY rowid')] or [0]
    row, column = rng.choice(rows), rng.choice(columns)
    others = ", ".join(f'"{name}"' for name in columns[1:]) or '"rowid"'
    return [
        rng.choice(
            [
                f'DELETE FROM "{table}" WHERE rowid = {row}',
                f'DELETE FROM "{table}" WHERE rowid = {row}',
                f'DELETE FROM "{table}"',
                f'INSERT INTO "{table}" ({others}) SELECT {others} FROM "{table}" WHERE rowid = {row}',
                f'UPDATE OR REPLACE "{table}" SET rowid = rowid + 1000 WHERE rowid = {row}',
                f'DROP TABLE "{table}"',
                f'ALTER TABLE "{table}" RENAME TO other',
                f'ALTER TABLE "{table}" RENAME COLUMN "{column}" TO other',
                f'ALTER TABLE "{table}" DROP COLUMN "{column}"',
                f'ALTER TABLE "{table}" ADD COLUMN other INTEGER',
                f'CREATE TRIGGER forged AFTER INSERT ON event BEGIN DELETE FROM "{table}"; END',
                f'CREATE VIEW forged AS SELECT * FROM "{table}"',
                f'CREATE INDEX forged ON "{table}" ("{column}")',
                f"UPDATE sqlite_master SET sql = replace(sql, 'TEXT', 'BLOB') WHERE name = '{table}'",
                f"UPDATE sqlite_master SET rootpage = 2 WHERE name = '{table}'",
                f"UPDATE sqlite_master SET sql = 'CREATE TABLE' WHERE name = '{table}'",
                f"UPDATE sqlite_master SET type = 'view', rootpage = 0, sql = 'CREATE VIEW x AS WITH RECURSIVE n(i) AS "
                f"(SELECT 1 UNION ALL SELECT i + 1 FROM n) SELECT * FROM n' WHERE name = '{table}'",
                "PRAGMA user_version = 77",
                "PRAGMA application_id = 77",
                "PRAGMA journal_mode = DELETE",
                "CREATE VIRTUAL TABLE forged USING fts5(x)",
            ]
        )
    ]


def _statement(path: Path, statement: str) -> None:
    with closing(_opened(path)) as db:
        _attempt(db, statement)


SQLITE = {
    "cell": Operation(_draw_cell, _cell),
    "cell ": Operation(_draw_cell, _cell),
    "cell  ": Operation(_draw_cell, _cell),
    "statement": Operation(_draw_statement, _statement),
    "statement ": Operation(_draw_statement, _statement),
}

# --- numbers in binary files

_PACKED = (
    "d nan",
    "d inf",
    "d -1e300",
    "d 0",
    "Q 0",
    "Q 1099511627776",
    "Q 18446744073709551615",
    "q -1",
    "i -1",
    "i 0",
)


def _draw_packed(rng: Random, path: Path) -> Arguments:
    return [rng.randrange(max(1, path.stat().st_size)), rng.choice(_PACKED)]


def _packed(path: Path, at: int, number: str) -> None:
    kind, value = number.split()
    packed = struct.pack(f"<{kind}", float(value) if kind == "d" else int(value))
    content = path.read_bytes()
    path.write_bytes(content[:at] + packed + content[at + len(packed) :])


BINARY = {"number": Operation(_draw_packed, _packed)}

# --- what vouches for a file

_DIGEST = re.compile(rf',\s*"{DIGEST_KEY}":\s*"[^"]*"')


def _sign(path: Path) -> None:
    """Renew what vouches for a file, as one who alters it on purpose would do."""
    if path.suffix == ".json" and DIGEST_KEY in _text(path):
        path.write_bytes(with_digest(_DIGEST.sub("", path.read_text()).encode()))
    session = next((folder for folder in path.parents if (folder / JOURNAL).is_file()), None)
    if session is None:
        return
    with closing(_opened(session / JOURNAL)) as db:
        if path.name == PLAN:
            digest = json.dumps({"plan_sha256": hashlib.sha256(path.read_bytes()).hexdigest()})
            _attempt(db, "UPDATE event SET detail = ? WHERE kind = 'begun'", [digest])
        _renew_chain(db)
    if can_be_mutated(session / SUMS):
        lines = (session / SUMS).read_text(errors="replace").splitlines()
        (session / SUMS).write_text("".join(f"{_line_of_sum(session, line)}\n" for line in lines))


def _line_of_sum(session: Path, line: str) -> str:
    """Return a line of SHA256SUMS with the hash of its file as it is now."""
    path = session / line.partition("  ")[2]
    if not can_be_mutated(path):
        return line
    return f"{hashlib.sha256(path.read_bytes()).hexdigest()}  {line.partition('  ')[2]}"


def _renew_chain(db: sqlite3.Connection) -> None:
    """Compute the hashes of a journal's chain anew."""
    head = chain.START
    for number, table, first, last in db.execute('SELECT id, "table", first, last FROM chain ORDER BY id').fetchall():
        head, _ = chain._digest(db, head, table, first, last)  # noqa: SLF001 # as who forges a journal would do
        _attempt(db, "UPDATE chain SET sha256 = ? WHERE id = ?", [head, number])


SIGN = {"sign": Operation(lambda *_: [], _sign)}

_OF_SUFFIX: dict[str, tuple[dict[str, Operation], ...]] = {
    ".toml": (TREE, TREE, TREE, TEXT),
    ".json": (TREE, TREE, TREE, TEXT),
    ".txt": (TEXT, TEXT, TEXT),
    "": (TEXT,),
    ".cameramodel": (TEXT, TEXT, TEXT),
    ".bin": (BINARY, BINARY),
    ".tiff": (TIFF, TIFF),
    ".dng": (TIFF,),
    ".png": (PNG, PNG),
    ".jpg": (JPEG,),
    ".npz": (NPZ, NPZ),
    ".sqlite": (SQLITE, SQLITE, SQLITE, SQLITE),
}
ALL = {
    name.strip(): operation
    for group in (BYTES, WHOLE_FILE, TREE, TEXT, TIFF, PNG, JPEG, NPZ, SQLITE, BINARY, SIGN)
    for name, operation in group.items()
}


def draw(rng: Random, path: Path) -> tuple[str, Arguments]:
    """Draw an operation on a file, and its arguments."""
    groups = [*_OF_SUFFIX.get(path.suffix, ()), BYTES, BYTES, WHOLE_FILE]
    group = rng.choice(groups)
    name = rng.choice(list(group))
    try:
        arguments = group[name].draw(rng, path)
    except Exception:  # an earlier mutation of the file makes its parsers raise anything
        return "flip", [[[rng.randrange(400), rng.randrange(8)]]]
    return name.strip(), arguments


def _expanded(argument: Any, guard: Path) -> Any:
    """Return an argument in which `@guard@` is the folder around all files, and `@3*x@` is xxx."""
    if isinstance(argument, list):
        return [_expanded(it, guard) for it in argument]
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
            ALL[name].apply(path, *(_expanded(it, guard_of(path)) for it in arguments))
