"""Places on a grid from the names of pictures: rows, columns, running numbers and measured positions."""

import math
import re
from collections.abc import Sequence
from dataclasses import dataclass

from faintfield.pipelines.errors import BadValue

# Digits of the largest row, column or running number: times and serial numbers have more.
MAX_DIGITS = 9

# Digits up to which a constant number before the one that varies may be the row of a grid of one row.
_ROW_DIGITS = 2

# Largest position in a name, in any unit.
_MAX_POSITION = 1e9

_WHOLE, _DECIMAL = r"[0-9]+", r"[-+]?[0-9]+\.[0-9]+(?:[eE][-+]?[0-9]+)?"
_NUMBER = r"[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?"

# Fields of a pattern, and what each matches; a whole number may have a fixed number of digits, as in {row:2}.
_FIELDS = {"name": ".*?", "row": _WHOLE, "column": _WHOLE, "index": _WHOLE, "x": _NUMBER, "y": _NUMBER}
_FIELD = re.compile(r"\{([a-z]*)(?::([1-9]))?\}|(\*)")

# Names that say which number is which. A row or column is named by a letter or a word of its own: r3_c12, row3_col12.
_ROW, _COLUMN = r"(?<![a-z])r(?:ow)?[_-]?", r"(?<![a-z])c(?:ol(?:umn)?)?[_-]?"
_LETTERED = [
    re.compile(rf"{_ROW}(?P<row>{_WHOLE})[_-]?{_COLUMN}(?P<column>{_WHOLE})", re.IGNORECASE),
    re.compile(rf"{_COLUMN}(?P<column>{_WHOLE})[_-]?{_ROW}(?P<row>{_WHOLE})", re.IGNORECASE),
    re.compile(rf"(?<![a-z])x_?(?P<column>{_WHOLE})[_-]?y_?(?P<row>{_WHOLE})", re.IGNORECASE),
    re.compile(rf"(?<![a-z])y_?(?P<row>{_WHOLE})[_-]?x_?(?P<column>{_WHOLE})", re.IGNORECASE),
]

# The archives of Stanford: row, column, and the camera's position, first along the rows' axis, then along the columns'.
_WITH_POSITIONS = [
    re.compile(rf"^.*?(?P<row>{_WHOLE})[_-](?P<column>{_WHOLE})_(?P<y>{_DECIMAL})_(?P<x>{_DECIMAL})_*$"),
    re.compile(rf"^.*?(?P<y>{_DECIMAL})_(?P<x>{_DECIMAL})_*$"),
]


@dataclass(frozen=True)
class Place:
    """Place of a picture as its name states it; None for what the name does not state."""

    row: int | None = None
    column: int | None = None
    index: int | None = None
    x: float | None = None
    y: float | None = None


def by_number(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names as people count: 2.png before 10.png."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), part) if part.isascii() and part.isdigit() else (-1, part) for part in parts]


def places_by_pattern(pattern: str, names: Sequence[str]) -> list[Place]:
    """Return what names say by a pattern such as "{name}_{row}_{column}_{y}_{x}.png".

    Parameters
    ----------
    pattern : str
        Fields are `name` (anything), `row`, `column` and `index` (whole numbers, of a fixed number of digits as in
        `{row:2}`), `x` and `y` (the camera's position, any numbers); `*` stands for anything. The suffix may be left
        out.
    names : sequence of str
        Names of the files.

    Raises
    ------
    BadValue
        The pattern says neither row and column, nor x and y, nor index; or a name does not match it.
    """
    expression = _expression(pattern)
    found = [expression.fullmatch(name) or expression.fullmatch(name.rpartition(".")[0]) for name in names]
    unlike = [name for name, match in zip(names, found, strict=True) if match is None]
    if unlike:
        raise BadValue(
            f"--pattern '{pattern}': {unlike[0]} does not match it, {len(names) - len(unlike)} of {len(names)} "
            "pictures do; correct the pattern, or move the other files away"
        )
    return [_place(name, match.groupdict()) for name, match in zip(names, found, strict=True) if match is not None]


def _expression(pattern: str) -> re.Pattern[str]:
    """Return a pattern as a regular expression with a group for each field but `name`."""
    parts, end, used = [], 0, []
    for field in _FIELD.finditer(pattern):
        parts.append(re.escape(pattern[end : field.start()]))
        end = field.end()
        name, digits, star = field.groups()
        if star or name == "name":
            parts.append(".*?")
            continue
        if name not in _FIELDS or (digits and _FIELDS[name] != _WHOLE) or name in used:
            raise BadValue(
                f"--pattern '{pattern}': {field[0]} is no field, or is there twice; use each of "
                f"{', '.join(f'{{{field}}}' for field in _FIELDS)} at most once, and * for anything"
            )
        used.append(name)
        parts.append(f"(?P<{name}>{f'[0-9]{{{digits}}}' if digits else _FIELDS[name]})")
    if not any(set(needed) <= set(used) for needed in (("row", "column"), ("x", "y"), ("index",))):
        raise BadValue(
            f"--pattern '{pattern}': says neither {{row}} and {{column}}, nor {{x}} and {{y}}, nor {{index}}, so no "
            "picture gets a place; name them"
        )
    return re.compile("".join(parts) + re.escape(pattern[end:]), re.DOTALL)


def places_by_habit(names: Sequence[str]) -> list[Place]:
    """Return what names say by the habits of archives and cameras.

    In this order: row, column and position as in `out_00_01_-381.909_1124.376_.png`; a position alone; letters or words
    for row and column; the two numbers that vary from name to name; one number that varies, which is an index. A number
    is never split into digits.

    Raises
    ------
    BadValue
        Names say no place, or numbers that may be rows and columns as well as running ones.
    """
    stems = [name.rpartition(".")[0] or name for name in names]
    for expression in (*_WITH_POSITIONS, *_LETTERED):
        found = [expression.search(stem) for stem in stems]
        if all(found):
            return [
                _place(name, match.groupdict()) for name, match in zip(names, found, strict=True) if match is not None
            ]
    numbers = [re.findall(_WHOLE, stem) for stem in stems]
    lacking = next((name for name, its in zip(names, numbers, strict=True) if not its), None)
    if lacking is not None:
        raise BadValue(f"{lacking}: its name has no row and column; give --rows and --columns to take files in order")
    if len(set(map(len, numbers))) == 1 and len(varying := _varying(numbers)) in (1, 2):
        if len(varying) == 2:
            row, column = varying
            return [
                _place(name, {"row": numbers_of_name[row], "column": numbers_of_name[column]})
                for name, numbers_of_name in zip(names, numbers, strict=True)
            ]
        return _places_of_one_number(names, stems, numbers, varying[0])
    if min(map(len, numbers)) == 1:
        lacking = next(name for name, its in zip(names, numbers, strict=True) if len(its) == 1)
        raise BadValue(
            f"{lacking}: its name has no row and column, while others have; give --rows and --columns to take files in "
            "order, or --pattern"
        )
    return [_place(name, {"row": its[-2], "column": its[-1]}) for name, its in zip(names, numbers, strict=True)]


def _varying(numbers: Sequence[Sequence[str]]) -> list[int]:
    """Return which of the numbers of each name are not the same in all names."""
    return [index for index, its in enumerate(zip(*numbers, strict=True)) if len(set(map(int, its))) > 1]


def _places_of_one_number(
    names: Sequence[str], stems: Sequence[str], numbers: Sequence[Sequence[str]], varying: int
) -> list[Place]:
    """Return the places of names in which one number varies: an index, a column of one row, or a row of one column.

    A short constant number right beside it may be the row or the column of all.
    """
    beside = [other for other in (varying - 1, varying + 1) if 0 <= other < len(numbers[0])]
    short = [other for other in beside if len(numbers[0][other]) <= _ROW_DIGITS and _adjacent(stems[0], other, varying)]
    if not short:
        return [_place(name, {"index": its[varying]}) for name, its in zip(names, numbers, strict=True)]
    side = math.isqrt(len(names))
    shape = f"1 x {len(names)}" if short[0] < varying else f"{len(names)} x 1"
    if side**2 == len(names):
        raise BadValue(
            f"{names[0]}: only one number varies from name to name, which fits a grid of {shape} as well as one of "
            f"{side} x {side}; say which by --rows and --columns"
        )
    row, column = sorted((short[0], varying))
    return [_place(name, {"row": its[row], "column": its[column]}) for name, its in zip(names, numbers, strict=True)]


def _adjacent(stem: str, one: int, other: int) -> bool:
    """Return whether nothing but signs such as _ or x stands between two numbers of a name."""
    first, second = sorted((one, other))
    spans = [found.span() for found in re.finditer(_WHOLE, stem)]
    return re.fullmatch(r"[^a-z0-9]*x?[^a-z0-9]*", stem[spans[first][1] : spans[second][0]], re.IGNORECASE) is not None


def _place(name: str, said: dict[str, str]) -> Place:
    """Return a place from the texts of its numbers."""
    whole = {field: text for field, text in said.items() if _FIELDS[field] == _WHOLE}
    for field, text in whole.items():
        if len(text) > MAX_DIGITS:
            raise BadValue(
                f"{name}: its name has a number of more than {MAX_DIGITS} digits, which is no {field}; "
                "give --rows and --columns to take files in order"
            )
    position = {field: float(text) for field, text in said.items() if field not in whole}
    if any(not abs(value) <= _MAX_POSITION for value in position.values()):
        raise BadValue(
            f"{name}: its position {tuple(position.values())} is beyond {_MAX_POSITION:g}; correct the name, or leave "
            "the position out of --pattern"
        )
    numbers = {field: int(text) for field, text in whole.items()}
    return Place(numbers.get("row"), numbers.get("column"), numbers.get("index"), position.get("x"), position.get("y"))
