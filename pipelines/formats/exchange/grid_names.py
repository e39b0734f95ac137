"""Places on a grid from the names of pictures: rows, columns, running numbers and measured positions."""

import math
import re
from collections.abc import Sequence

import numpy as np

from faintfield.pipelines.errors import BadValue

# Largest row, column, running number or position: times and serial numbers are larger.
_MAX_NUMBER = 1e9

# Digits up to which a constant number before the one that varies may be the row of a grid of one row.
_ROW_DIGITS = 2

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


# Numbers of all names by field: row, column, index, x and y; a field that names do not state is missing.
type Places = dict[str, list[float]]


def by_number(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names as people count: 2.png before 10.png."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), part) if part.isascii() and part.isdigit() else (-1, part) for part in parts]


def places_by_pattern(pattern: str, names: Sequence[str]) -> Places:
    """Return the numbers of names by a pattern such as "{name}_{row}_{column}_{y}_{x}.png".

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
    matches = [expression.fullmatch(name) or expression.fullmatch(name.rpartition(".")[0]) for name in names]
    unlike = [name for name, match in zip(names, matches, strict=True) if match is None]
    if unlike:
        raise BadValue(
            f"--pattern '{pattern}': {unlike[0]} does not match it, {len(names) - len(unlike)} of {len(names)} "
            "pictures do; correct the pattern, or move the other files away"
        )
    return _places(names, [match.groupdict() for match in matches if match is not None])


def _expression(pattern: str) -> re.Pattern[str]:
    """Return a pattern as a regular expression with a group for each field but `name`."""
    parts, end, used = [], 0, set[str]()
    for field in _FIELD.finditer(pattern):
        name, digits, star = field.groups()
        parts.append(re.escape(pattern[end : field.start()]))
        end = field.end()
        if star or name == "name":
            parts.append(".*?")
            continue
        if name not in _FIELDS or (digits and _FIELDS[name] != _WHOLE) or name in used:
            raise BadValue(
                f"--pattern '{pattern}': {field[0]} is no field, or is there twice; use each of "
                f"{', '.join(f'{{{field}}}' for field in _FIELDS)} at most once, and * for anything"
            )
        used.add(name)
        parts.append(f"(?P<{name}>{f'[0-9]{{{digits}}}' if digits else _FIELDS[name]})")
    if not ({"row", "column"} <= used or {"x", "y"} <= used or "index" in used):
        raise BadValue(
            f"--pattern '{pattern}': says neither {{row}} and {{column}}, nor {{x}} and {{y}}, nor {{index}}, so no "
            "picture gets a place; name them"
        )
    return re.compile("".join(parts) + re.escape(pattern[end:]), re.DOTALL)


def places_by_habit(names: Sequence[str]) -> Places:
    """Return the numbers of names by the habits of archives and cameras.

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
        matches = [match for stem in stems if (match := expression.search(stem))]
        if len(matches) == len(names):
            return _places(names, [match.groupdict() for match in matches])
    numbers = [re.findall(_WHOLE, stem) for stem in stems]
    counts = [len(texts) for texts in numbers]
    varying = [place for place, texts in enumerate(zip(*numbers, strict=False)) if len(set(map(int, texts))) > 1]
    alike = min(counts) == max(counts)
    if alike and len(varying) == 2:
        fields = {"row": varying[0], "column": varying[1]}
    elif alike and len(varying) == 1:
        fields = _fields_of_one_number(names, numbers[0], varying[0])
    elif min(counts) >= 2:
        fields = {"row": -2, "column": -1}
    else:
        raise BadValue(
            f"{names[int(np.argmin(counts))]}: its name has no row and column; give --rows and --columns to take files "
            "in order, or --pattern"
        )
    return _places(names, [{field: texts[place] for field, place in fields.items()} for texts in numbers])


def _fields_of_one_number(names: Sequence[str], numbers: Sequence[str], varying: int) -> dict[str, int]:
    """Return the places of the fields among the numbers of names in which one number varies.

    A short constant number right beside it may be the row or the column of all; otherwise the number is an index.
    """
    between = re.split(_WHOLE, names[0])[1:]
    for constant in (varying - 1, varying + 1):
        first, second = sorted((constant, varying))
        if first < 0 or second == len(numbers) or len(numbers[constant]) > _ROW_DIGITS:
            continue
        # Nothing but signs such as _ or x stands between them
        if re.fullmatch(r"[^a-z0-9]*x?[^a-z0-9]*", between[first], re.IGNORECASE):
            side = math.isqrt(len(names))
            if side**2 == len(names):
                shape = f"1 x {len(names)}" if constant < varying else f"{len(names)} x 1"
                raise BadValue(
                    f"{names[0]}: only one number varies from name to name, which fits a grid of {shape} as well as "
                    f"one of {side} x {side}; say which by --rows and --columns"
                )
            return {"row": first, "column": second}
    return {"index": varying}


def _places(names: Sequence[str], texts: Sequence[dict[str, str]]) -> Places:
    """Return the numbers of all names by field; refuse those that are too large."""
    for name, fields in zip(names, texts, strict=True):
        for field, text in fields.items():
            if not abs(float(text)) < _MAX_NUMBER:
                raise BadValue(
                    f"{name}: its name has the number {text}, beyond {_MAX_NUMBER:g}, for {field}; correct it, give "
                    "--rows and --columns to take files in order, or --pattern without it"
                )
    return {field: [float(fields[field]) for fields in texts] for field in texts[0]}
