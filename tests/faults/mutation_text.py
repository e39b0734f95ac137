"""Operations on text: the values of TOML and JSON files, and the words and lines of any other."""

import json
import re
import tomllib
from collections.abc import Callable, Sequence
from pathlib import Path
from random import Random
from typing import Any, NamedTuple

import tomli_w

from tests.faults.contained import FORGED, SCRIPT

# A file in the folder around all of a case's files; nothing may be written to it.
VICTIM = "victim.txt"

type Arguments = list[Any]


class Operation(NamedTuple):
    """What can be done to a file: how its arguments are drawn, and the function that applies them."""

    draw: Callable[[Random, Path], Arguments]
    apply: Callable[..., None]
    weight: int = 1


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


def draw_raw(rng: Random, present: Any) -> str:
    """Draw what to put in place of a value, as it will stand in the file."""
    kind = rng.random()
    if isinstance(present, str) and kind < 0.6:
        return json.dumps(rng.choice(names(present)), ensure_ascii=rng.random() < 0.5)
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


def names(present: str) -> list[str]:
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


def _write_tree(path: Path, tree: Any, raw: Sequence[str] = ()) -> None:
    """Write a tree in which the string `@@number@@` stands for the raw text of that number."""
    text = tomli_w.dumps(tree) if path.suffix == ".toml" else json.dumps(tree)
    for number, piece in enumerate(raw):
        text = text.replace(f'"@@{number}@@"', piece)
    path.write_text(text, encoding="utf-8", errors="surrogatepass")


def draw_place(rng: Random, tree: Any) -> list[Any]:
    """Draw the place of a value within a tree, most often that of a leaf."""
    place: list[Any] = []
    while isinstance(tree, dict | list) and tree and (not place or rng.random() < 0.9):
        key = rng.choice(list(tree)) if isinstance(tree, dict) else rng.randrange(len(tree))
        place.append(key)
        tree = tree[key]
    return place


def value_at(tree: Any, place: Sequence[Any]) -> Any:
    for key in place:
        tree = tree[key]
    return tree


def _draw_set(rng: Random, path: Path) -> Arguments:
    tree = _read_tree(path)
    place = draw_place(rng, tree)
    return [place, draw_raw(rng, value_at(tree, place))]


def _set(path: Path, place: Sequence[Any], raw: str) -> None:
    tree = _read_tree(path)
    if not place:
        path.write_text(raw)
        return
    value_at(tree, place[:-1])[place[-1]] = "@@0@@"
    _write_tree(path, tree, [raw])


def _remove(path: Path, place: Sequence[Any]) -> None:
    tree = _read_tree(path)
    del value_at(tree, place[:-1])[place[-1]]
    _write_tree(path, tree)


def _draw_add(rng: Random, path: Path) -> Arguments:
    tree = _read_tree(path)
    place = draw_place(rng, tree)[:-1]
    return [place, rng.choice([*names("x")[:12], "@5000*x@", "inputs"]), draw_raw(rng, None)]


def _add(path: Path, place: Sequence[Any], key: str, raw: str) -> None:
    tree = _read_tree(path)
    holder = value_at(tree, place)
    if isinstance(holder, list):
        holder.append("@@0@@")
    else:
        holder[key] = "@@0@@"
    _write_tree(path, tree, [raw])


TREE = {
    "set": Operation(_draw_set, _set, weight=3),
    "remove": Operation(lambda rng, path: [draw_place(rng, _read_tree(path))], _remove),
    "add": Operation(_draw_add, _add),
}

# --- lines and words

_WORD = re.compile(r"[^\s\"'\[\]{},:=]+")


def _text(path: Path) -> str:
    return path.read_bytes().decode("latin-1")


def _draw_word(rng: Random, path: Path) -> Arguments:
    count = max(len(_WORD.findall(_text(path))), 1)
    replacement = rng.choice([*_NUMBERS, *_OTHERS, "", " ", *names("x")])
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
