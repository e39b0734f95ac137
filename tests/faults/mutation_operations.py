"""Operations that damage a file: each draws its arguments at random, and applies given arguments.

An operation and its arguments are JSON, so that a mutation can be kept and made again whatever the random numbers are.
"""

import json
import os
import re
import stat
import tomllib
from collections.abc import Callable, Sequence
from contextlib import suppress
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import numpy as np
import tifffile
import tomli_w

from faintfield.pipelines.formats.provenance import DIGEST_KEY, with_digest
from tests.faults.contained import FORGED, MAX_FILE_BYTES, SCRIPT

# A file in the folder around all of a case's files; nothing may be written to it.
VICTIM = "victim.txt"

type Arguments = list[Any]


class Operation(NamedTuple):
    """Operation on a file: the function that draws its arguments, and the one that applies them."""

    draw: Callable[[Random, Path], Arguments]
    apply: Callable[..., None]
    weight: int = 1


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
    at, length = (
        rng.choice([0, size, rng.randint(0, size)]),
        rng.choice([0, 1, 4, 8, 100, rng.randint(0, size), 1 << 60]),
    )
    extremes = (b"\0", b"\xff", b"\xff\xfe", b"\xef\xbb\xbf", b"\n", bytes(64), b"\xff" * 8, bytes(6) + b"\xf8\x7f")
    return [at, length, rng.choice([b"", *extremes, rng.randbytes(rng.choice([1, 8, 300]))]).hex()]


def _splice(path: Path, at: int, removed: int, added: str) -> None:
    content = path.read_bytes()
    path.write_bytes(content[:at] + bytes.fromhex(added) + content[at + removed :])


_LINKS = ("/dev/zero", "/dev/full", "/dev/null", "/proc/self/mem", "/", f"@guard@/{VICTIM}", "@guard@/beside/new.txt")
_BECOMES = ("missing", "folder", "pipe", "huge", "itself", "another", "unreadable", *_LINKS)


def _become(path: Path, what: str) -> None:
    other = path.rename(path.with_name(f"{path.name}.other")) if what == "another" else path
    content = other.read_bytes()
    path.unlink(missing_ok=True)
    match what:
        case "missing":
            pass
        case "folder":
            path.mkdir()
            (path / path.name).write_bytes(content)
        case "pipe":
            os.mkfifo(path)
        case "huge":
            path.write_bytes(content)
            os.truncate(path, 3 << 30)
        case "unreadable":
            path.write_bytes(content)
            path.chmod(0)
        case "itself" | "another":
            path.symlink_to(other.name)
        case _:
            path.symlink_to(what)


def guard_of(path: Path) -> Path:
    """Return the folder around all files of a case, which holds the victim."""
    return next(folder for folder in path.parents if (folder / VICTIM).is_file())


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


def _draw_raw(rng: Random, present: Any) -> str:
    """Draw what to put in place of a value, as it will stand in the file."""
    kind = rng.random()
    if isinstance(present, str) and kind < 0.6:
        return json.dumps(rng.choice(_names(present)), ensure_ascii=rng.random() < 0.5)
    if isinstance(present, int | float) and kind < 0.6:
        factor = rng.choice([-1, 0.0, 0.9, 1.001, 10, 1e3, 1e6, 1e12])
        return repr(present * factor) if rng.random() < 0.4 else rng.choice(_NUMBERS)
    if isinstance(present, list) and kind < 0.3:
        if rng.random() < 0.5 and present:
            return f"[@{rng.choice([1, 2, 1000])}*{json.dumps(present)[1:-1]}, @{json.dumps(present)[1:]}"
        return json.dumps(present[: len(present) // 2])
    if kind < 0.9:
        return rng.choice(_NUMBERS if kind < 0.7 else _OTHERS)
    depth = rng.choice([70, 900, 3000, 100_000])
    opened, closed = rng.choice([("[", "]"), ('{"a":', "}"), ("{a=", "}")])
    return f"@{depth}*{opened}@1@{depth}*{closed}@"


def _names(present: str) -> list[str]:
    """Return what a name in a file may become."""
    return [
        *("", " ", "..", "/", "\0", present + "\0", "../" + present, f"../../{VICTIM}", f"../{VICTIM}"),
        *(f"@guard@/{VICTIM}", "@guard@/beside/new", f"../../beside/{present}", "/dev/zero", "/dev/full", "/dev/stdin"),
        *("/proc/self/mem", "@5000*x@", "@3000*x/@", present.swapcase(), f"{present}\n{FORGED} all is well"),
        *(f"\r{FORGED} done", f"\x1b[31m{present}\x1b[0m", "\u202e" + present, "\x9b31m", "\u2028" + FORGED),
        *(SCRIPT, f'">{SCRIPT}', f"[red]{present}[/red]", "[/nothing]", "{present}", "{0}%s%n", "日本", "a b", "-rf"),
        *("--help", "f" * 64, "NaN", "1", "true", "\ud800", "*", "[", "\\"),
    ]


def _read_tree(path: Path) -> Any:
    content = path.read_bytes().decode()
    return tomllib.loads(content) if path.suffix == ".toml" else json.loads(content)


def _value_at(tree: Any, place: Sequence[Any]) -> Any:
    for key in place:
        tree = tree[key]
    return tree


def _draw_place(rng: Random, tree: Any) -> list[Any]:
    """Draw the place of a value within a tree, most often that of a leaf."""
    place: list[Any] = []
    while isinstance(tree, dict | list) and tree and (not place or rng.random() < 0.9):
        place.append(rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree)))
        tree = tree[place[-1]]
    return place


def _draw_set(rng: Random, path: Path) -> Arguments:
    tree = _read_tree(path)
    place = _draw_place(rng, tree)
    kind = rng.random()
    if kind < 0.2:
        return [place, ""]
    if kind < 0.4:
        return [[*place[:-1], rng.choice([*_names("x")[:12], "@5000*x@", "inputs"])], _draw_raw(rng, None)]
    return [place, _draw_raw(rng, _value_at(tree, place))]


def _set(path: Path, place: Sequence[Any], raw: str) -> None:
    """Give a place a value as it will stand in the file, add one to a list, or remove that of the place if empty."""
    tree = _read_tree(path)
    holder = _value_at(tree, place[:-1])
    if raw == "":
        del holder[place[-1]]
    elif isinstance(holder, list) and not isinstance(place[-1], int):
        holder.append("@@")
    else:
        holder[place[-1]] = "@@"
    text = tomli_w.dumps(tree) if path.suffix == ".toml" else json.dumps(tree)
    path.write_text(text.replace('"@@"', raw), encoding="utf-8", errors="surrogatepass")


_DIGEST = re.compile(rf',\s*"{DIGEST_KEY}":\s*"[^"]*"')


def _sign(path: Path) -> None:
    """Renew the digest that a record holds of itself, so that its damaged values are read."""
    if path.suffix == ".json" and DIGEST_KEY.encode() in path.read_bytes():
        path.write_bytes(with_digest(_DIGEST.sub("", path.read_text()).encode()))


_WORD = re.compile(r"[^\s\"'\[\]{},:=]+")


def _text(path: Path) -> str:
    return path.read_bytes().decode("latin-1")


def _draw_word(rng: Random, path: Path) -> Arguments:
    count = max(len(_WORD.findall(_text(path))), 1)
    return [rng.randrange(count), rng.choice([*_NUMBERS, *_OTHERS, "", " ", *_names("x")])]


def _word(path: Path, number: int, replacement: str) -> None:
    text = _text(path)
    word = list(_WORD.finditer(text))[number]
    new = replacement.encode("utf-8", "surrogatepass")
    path.write_bytes(text[: word.start()].encode("latin-1") + new + text[word.end() :].encode("latin-1"))


def _draw_line(rng: Random, path: Path) -> Arguments:
    count = len(_text(path).split("\n"))
    return [rng.choice(["remove", "twice", "often", "last", "join", "empty", "long"]), rng.randrange(count)]


def _line(path: Path, what: str, number: int) -> None:
    lines = _text(path).split("\n")
    line = lines[number]
    changed = {
        **{"remove": [], "twice": [line, line], "often": [line] * 3000, "last": lines[-2:-1]},
        **{"join": [line.replace(" ", "")], "empty": ["", "", line], "long": [line + " 0" * 100_000]},
    }[what]
    path.write_bytes("\n".join([*lines[:number], *changed, *lines[number + 1 :]]).encode("latin-1"))


def _draw_pixels(rng: Random, path: Path) -> Arguments:
    with tifffile.TiffFile(path) as file:
        height, width = file.pages[0].shape[:2]
    shape = rng.choice([(height, width), (width, height), (height, width, 3), (1, 1), (2, height, width)])
    kind = rng.choice(["u1", "u2", "u4", "u8", "i2", "i4", "f2", "f4", "f8", "c8", "?"])
    fill = rng.choice(["zeros", "largest", "random", "nan", "inf"])
    return [list(shape), kind, fill, rng.choice([1, 1, 2]), rng.choice([None, None, "zlib"])]


def _pixels(path: Path, shape: Sequence[int], kind: str, fill: str, pages: int, compression: str | None) -> None:
    """Write different pixels; a second page has a different size."""
    array = np.zeros(shape, kind)
    if fill == "largest":
        array[...] = np.iinfo(kind).max if array.dtype.kind in "iu" else 3e4
    elif fill == "random":
        array = np.random.default_rng(1).integers(0, 200, shape).astype(kind)
    elif fill in ("nan", "inf") and array.dtype.kind in "fc":
        array[...] = float(fill)
    with tifffile.TiffWriter(path) as file:
        for page in range(pages):
            part = array if page == 0 else array[: max(1, len(array) // 2)]
            file.write(part, compression=compression, contiguous=False)


_BYTES = {"flip": Operation(_draw_flips, _flip), "splice": Operation(_draw_splice, _splice, weight=2)}
_FILE = {"become": Operation(lambda rng, _: [rng.choice(_BECOMES)], _become)}
_TREE = {"set": Operation(_draw_set, _set)}
_TEXT = {"word": Operation(_draw_word, _word), "line": Operation(_draw_line, _line)}
_TIFF = {"pixels": Operation(_draw_pixels, _pixels)}
_ALL = {**_BYTES, **_FILE, **_TREE, **_TEXT, **_TIFF, "sign": Operation(lambda *_: [], _sign)}
_OF_SUFFIX = {
    **dict.fromkeys((".toml", ".json"), (_TREE, _TREE, _TREE, _TEXT)),
    **dict.fromkeys((".txt", ".cameramodel", ".csv", ".cfg"), (_TEXT, _TEXT, _TEXT)),
    **{".tiff": (_TIFF, _TIFF), "": (_TEXT,)},
}


def draw(rng: Random, path: Path) -> tuple[str, Arguments]:
    """Draw an operation on a file, and its arguments."""
    group = rng.choice([*_OF_SUFFIX.get(path.suffix, ()), _BYTES, _BYTES, _FILE])
    name = rng.choices(list(group), [operation.weight for operation in group.values()])[0]
    try:
        return name, group[name].draw(rng, path)
    except Exception:  # an earlier mutation of the file makes its parsers raise anything
        return "flip", [[[rng.randrange(400), rng.randrange(8)]]]


def _expanded(argument: Any, guard: Path) -> Any:
    """Return an argument in which `@guard@` is the folder around all files, and `@3*x@` is xxx."""
    if isinstance(argument, list):
        return [_expanded(part, guard) for part in argument]
    if not isinstance(argument, str):
        return argument
    argument = argument.replace("@guard@", str(guard))
    return re.sub(r"@(\d+)\*([^@]+)@", lambda repeat: repeat[2] * int(repeat[1]), argument)


def can_be_mutated(path: Path) -> bool:
    """Return whether a path is that of a regular file of moderate size, and not a link."""
    with suppress(OSError, ValueError):
        state = path.lstat()
        return stat.S_ISREG(state.st_mode) and state.st_size <= MAX_FILE_BYTES // 8
    return False


def apply(path: Path, name: str, arguments: Arguments) -> None:
    """Do an operation to a file; nothing if an earlier one left nothing of its kind."""
    if can_be_mutated(path):
        with suppress(Exception):
            _ALL[name].apply(path, *(_expanded(argument, guard_of(path)) for argument in arguments))
