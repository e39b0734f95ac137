"""Pictures of a folder that are views, and their places on a grid by names: rows, columns, numbers and positions."""

import math
import re
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

import numpy as np

from faintfield.pipelines.errors import BadValue, MissingFile
from faintfield.pipelines.formats.frames import IMAGE_SUFFIXES, picture_kind
from faintfield.pipelines.formats.reading import is_file, is_folder
from faintfield.pipelines.formats.toml_files import inside

# Words in the names of files that go along with views, and are none.
_COMPANION = re.compile(
    r"(?<![a-z])(masks?|depths?|disp|disparity|disparities|thumbs?|thumbnails?|previews?|normals?|labels?|segmentation"
    r"|objectids?|oid|gt|truth|contact|centerview|flow|confidence)(?![a-z])",
    re.IGNORECASE,
)

# Files that nobody takes for views; others are named with their kind. A .thm of a camera is a small JPEG.
_TEXTS = {".txt", ".md", ".json", ".toml", ".csv", ".cfg", ".xml", ".yaml", ".yml", ".html", ".pdf", ".py", ".m"}
_NO_PICTURES = _TEXTS | {".thm"}

# Largest row, column, running number or position: times and serial numbers are larger.
_MAX_NUMBER = 1e9

# Digits up to which a constant number before the one that varies may be the row of a grid of one row.
_ROW_DIGITS = 2

_WHOLE, _DECIMAL = r"[0-9]+", r"[-+]?[0-9]+\.[0-9]+(?:[eE][-+]?[0-9]+)?"
_NUMBER = r"[-+]?[0-9]+(?:\.[0-9]*)?(?:[eE][-+]?[0-9]+)?"

# Fields of a pattern, and what each matches; a whole number may have a fixed number of digits, as in {row:2}.
_FIELDS = {"name": ".*?", "row": _WHOLE, "column": _WHOLE, "index": _WHOLE, "x": _NUMBER, "y": _NUMBER}
_FIELD = re.compile(r"\{([a-z]*)(?::([1-9]))?\}|(\*)")

# First the archives of Stanford: row, column, and the camera's position, first along the rows' axis, then along the
# columns'; then a row or column named by a letter or a word of its own: r3_c12, row3_col12.
_ROW, _COLUMN = r"(?<![a-z])r(?:ow)?[_-]?", r"(?<![a-z])c(?:ol(?:umn)?)?[_-]?"
_HABITS = [
    re.compile(expression, re.IGNORECASE)
    for expression in (
        rf"^.*?(?P<row>{_WHOLE})[_-](?P<column>{_WHOLE})_(?P<y>{_DECIMAL})_(?P<x>{_DECIMAL})_*$",
        rf"^.*?(?P<y>{_DECIMAL})_(?P<x>{_DECIMAL})_*$",
        rf"{_ROW}(?P<row>{_WHOLE})[_-]?{_COLUMN}(?P<column>{_WHOLE})",
        rf"{_COLUMN}(?P<column>{_WHOLE})[_-]?{_ROW}(?P<row>{_WHOLE})",
        rf"(?<![a-z])x_?(?P<column>{_WHOLE})[_-]?y_?(?P<row>{_WHOLE})",
        rf"(?<![a-z])y_?(?P<row>{_WHOLE})[_-]?x_?(?P<column>{_WHOLE})",
    )
]

# Numbers of all names by field: row, column, index, x and y; a field that names do not state is missing.
type Places = dict[str, list[float]]


def pictures_in(folder: Path, *, every: bool = False) -> tuple[list[Path], list[str]]:
    """Return the pictures of a folder, as people count, and a remark on each kind of file that is left out.

    Left out are files that are not read and, unless `every` picture is meant, masks, depth maps and thumbnails by their
    names, and a few pictures of another kind than most.

    Raises
    ------
    MissingFile
        There is no such folder, or it holds no picture that is read, or more files of another kind; the kinds that it
        holds are named.
    BadValue
        It holds pictures of several kinds under the same names.
    """
    if not is_folder(folder):
        raise MissingFile(f"{folder}: no such folder; name the folder that holds the pictures")
    entries = sorted(folder.iterdir(), key=lambda path: by_number(path.name))
    files = [path for path in entries if not path.name.startswith(".") and is_file(path)]
    candidates = [path for path in files if path.suffix.lower() not in _NO_PICTURES]
    kinds = _kinds_of(candidates)
    pictures = list(kinds)
    if not pictures:
        if not files and (folders := [path.name for path in entries if is_folder(path)]):
            raise MissingFile(f"{folder}: holds folders only, such as {folders[0]}; name the one with the pictures")
        kinds_held = _count_kinds(files) or "nothing"
        raise MissingFile(
            f"{folder}: holds {kinds_held}; convert pictures to PNG or TIFF (read are "
            f"{', '.join(sorted(IMAGE_SUFFIXES))}), or name the folder that holds them"
        )
    unread = [path for path in candidates if path not in kinds]
    remarks = [f"left out: {_count_kinds(unread)}, which are not read"] if unread else []
    if every:
        return pictures, remarks
    masks = [path for path in pictures if _COMPANION.search(path.stem)]
    if max(Counter(path.suffix.lower() for path in unread).values(), default=0) > len(pictures) - len(masks):
        raise MissingFile(
            f"{folder}: holds {_count_kinds(unread)}, which are not read, and only {_count_kinds(pictures)} of those "
            f"that are ({pictures[0].name}); convert the views to PNG or TIFF, or leave nothing else in the folder"
        )
    pictures = _leave_out(pictures, masks, remarks, "by their names no views")
    kind, count = Counter(kinds[path] for path in pictures).most_common(1)[0]
    common = [path for path in pictures if kinds[path] == kind]
    rest = [path for path in pictures if kinds[path] != kind]
    if named_alike := {path.stem for path in common} & {path.stem for path in rest}:
        raise BadValue(
            f"{folder}: holds pictures of several kinds ({_count_kinds(pictures)}), with {min(named_alike)} in two of "
            "them; leave one kind in the folder"
        )
    # Pictures of another kind whose names differ in their numbers only are views, too
    forms = {name_form(path) for path in common}
    foreign = [path for path in rest if name_form(path) not in forms]
    return _leave_out(pictures, foreign, remarks, f"of another kind than the {count} {kind} files"), remarks


def name_form(path: Path) -> str:
    """Return a name without suffix and with 0 for each number: alike for pictures of one series."""
    return re.sub(_WHOLE, "0", path.stem)


def _kinds_of(files: Sequence[Path]) -> dict[Path, str]:
    """Return the kind of each picture, by content; some with other suffixes than pictures have are no views."""
    kinds = {path: kind for path in files if (kind := picture_kind(path))}
    named = {path for path in kinds if path.suffix.lower() in IMAGE_SUFFIXES}
    views = Counter(kinds[path] for path in named if not _COMPANION.search(path.stem))
    others = Counter(kinds[path] for path in kinds.keys() - named)
    # Where most have the suffix of their kind, others are copies, as of programs that edit pictures
    return {path: kind for path, kind in kinds.items() if path in named or others[kind] > views[kind]}


def _count_kinds(paths: Sequence[Path]) -> str:
    """Return the number of files of each kind, most first: "256 .gif files, 1 .txt file"."""
    kinds = Counter(path.suffix.lower() for path in paths).most_common(4)
    return ", ".join(f"{n} {kind} file{'s' * (n > 1)}" if kind else f"{n} without a suffix" for kind, n in kinds)


def _leave_out(paths: list[Path], unwanted: Sequence[Path], remarks: list[str], reason: str) -> list[Path]:
    """Return the paths without some, and say so; all of them if no smaller number would be left than is left out."""
    if not 0 < 2 * len(unwanted) <= len(paths):
        return paths
    remarks.append(f"left out: {len(unwanted)} of {len(paths)} pictures, {reason} ({unwanted[0].name})")
    return [path for path in paths if path not in unwanted]


def picture_named(folder: Path, name: str, key: str) -> Path:
    """Return the picture of a name that another file states, with or without its suffix; it may be missing.

    Raises
    ------
    BadValue
        The name leads out of the folder.
    """
    path = inside(folder, name, key)
    suffixes = sorted(IMAGE_SUFFIXES) if path.name and not is_file(path) else []
    candidates = (path.with_name(path.name + suffix) for suffix in suffixes)
    return next((file for file in candidates if is_file(inside(folder, str(file.relative_to(folder)), key))), path)


def by_number(name: str) -> list[tuple[int, str]]:
    """Return a key that sorts names as people count: 2.png before 10.png."""
    parts = re.split(r"([0-9]+)", name)
    return [(int(part), part) if part.isascii() and part.isdigit() else (-1, part) for part in parts]


def places_by_pattern(pattern: str, names: Sequence[str]) -> Places:
    """Return the numbers of file names by a pattern such as "{name}_{row}_{column}_{y}_{x}.png".

    Fields are `name` (anything), `row`, `column` and `index` (whole numbers, of a fixed number of digits as in
    `{row:2}`), `x` and `y` (the camera's position); `*` stands for anything. The suffix may be left out.

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
    """Return the numbers of names by the habits of archives and cameras, see docs/how-to/import_pictures.md.

    In this order: row, column and position; a position alone; letters or words for row and column; the two numbers that
    vary from name to name; one number that varies, which is an index. A number is never split into digits.

    Raises
    ------
    BadValue
        Names say no place, or numbers that may be rows and columns as well as running ones.
    """
    stems = [name.rpartition(".")[0] or name for name in names]
    for expression in _HABITS:
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
    entries = [(name, *item) for name, fields in zip(names, texts, strict=True) for item in fields.items()]
    for name, field, text in entries:
        if not abs(float(text)) < _MAX_NUMBER:
            raise BadValue(
                f"{name}: its name has the number {text}, beyond {_MAX_NUMBER:g}, for {field}; correct it, give --rows "
                "and --columns to take files in order, or --pattern without it"
            )
    return {field: [float(fields[field]) for fields in texts] for field in texts[0]}
