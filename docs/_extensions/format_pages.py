"""File formats: the keys of each table or object, from the types by which files are read and written."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import get_origin

import msgspec
from docstrings import body, linked, summary, table
from msgspec import inspect as types

from faintfield.pipelines.formats.key_meanings import key_meanings

type _Record = types.StructType | types.DataclassType

_UNITS = {
    **{"mm": "mm", "px": "px", "s": "s", "ms": "ms", "e": "e⁻", "e2": "e⁻²", "dn": "DN", "mrad": "mrad", "deg": "°"},
    **{"c": "°C", "um": "µm", "rad": "rad", "mm2": "mm²", "s2": "s²", "min": "min", "photons": "photons"},
}
_WORDS = {types.IntType: "whole number", types.FloatType: "number", types.BoolType: "true or false"}
# Largest number of tables of one type whose names are in a heading.
_MOST_NAMES = 3
_LIMITS = {"ge": "at least {}", "gt": "more than {}", "le": "at most {}", "lt": "less than {}"}


@dataclass(frozen=True)
class _Part:
    """A table or object of a file, and the keys that lead to it."""

    path: str
    record: _Record
    repeated: bool = False

    def name(self, *, toml: bool) -> str:
        """Return the name: `[table]` or `[[table]]` in TOML, `object` or `object[]` in JSON."""
        if toml:
            return f"`[[{self.path}]]`" if self.repeated else f"`[{self.path}]`"
        return f"`{self.path}[]`" if self.repeated else f"`{self.path}`"


def file_format(kind: type, *, toml: bool) -> str:
    """Return the keys of a file that holds a record of this type."""
    root = types.type_info(kind)
    assert isinstance(root, types.StructType | types.DataclassType)
    parts: dict[type, list[_Part]] = {}
    for part in _parts(_Part("", root)):
        parts.setdefault(part.record.cls, []).append(part)
    return "\n".join(f"## {_title(same, toml=toml)}\n\n{_keys(same[0].record)}" for same in parts.values())


def _title(parts: list[_Part], *, toml: bool) -> str:
    """Return the names of the parts of one type, and the key that chooses this type."""
    if not parts[0].path:
        return "Top level"
    names = ", ".join(part.name(toml=toml) for part in parts[:_MOST_NAMES])
    more = f" and {len(parts) - _MOST_NAMES} more" if len(parts) > _MOST_NAMES else ""
    record = parts[0].record
    tag = f' with {record.tag_field} = "{record.tag}"' if isinstance(record, types.StructType) and record.tag else ""
    return f"{names}{more}{tag}"


def _parts(part: _Part) -> Iterator[_Part]:
    """Yield a record and those in its fields, in the order of the keys; no type has itself in its fields."""
    yield part
    for field in part.record.fields:
        for record, repeated in _records(field.type):
            yield from _parts(_Part(f"{part.path}.{field.encode_name}".lstrip("."), record, repeated))


def _records(kind: types.Type, repeated: bool = False) -> Iterator[tuple[_Record, bool]]:
    match kind:
        case types.StructType() | types.DataclassType():
            yield kind, repeated
        case types.UnionType(types=choices) | types.TupleType(item_types=choices):
            for choice in choices:
                yield from _records(choice, repeated)
        case types.ListType(item_type=inner) | types.VarTupleType(item_type=inner):
            yield from _records(inner, True)
        case types.DictType(value_type=inner):
            yield from _records(inner)
        case types.Metadata(type=inner):
            yield from _records(inner, repeated)


def _keys(record: _Record) -> str:
    """Return the docstring of a type and a table of its fields."""
    kind = get_origin(record.cls) or record.cls
    meanings = key_meanings(record.cls)

    def cells(field: types.Field) -> tuple[str, ...]:
        return _value(field), _default(field), linked(meanings.get(field.name, ""))

    # Keys that share a meaning, such as fx_px and fy_px, share a row.
    rows: list[tuple[str, ...]] = [
        (", ".join(f"`{field.encode_name}`" for field in fields), *shared)
        for shared, fields in groupby(record.fields, cells)
    ]
    if any(row[-1] for row in rows):
        text = table(("key", "value", "default", "meaning"), "20 22 13 45", rows)
    else:
        text = table(("key", "value", "default"), "40 40 20", [row[:-1] for row in rows])
    return f"{linked(summary(kind))}\n\n{body(kind)}\n\n{text}"


def _default(field: types.Field) -> str:
    if field.required:
        return "required"
    value = field.default
    stated = isinstance(value, str | int | float | tuple) and value not in ("", ()) and value == value
    return f"`{msgspec.json.encode(value).decode()}`" if stated else ""


def _value(field: types.Field) -> str:
    text, unit = _words(field.type), _unit(field.name)
    return re.sub(r"\bnumbers?\b", rf"\g<0> in {unit}", text, count=1) if unit else text


def _unit(name: str) -> str:
    """Return the unit that a name ends with, such as `gain_dn_per_e`."""
    endings = [part.rpartition("_")[2] for part in name.split("_per_")]
    return "/".join(_UNITS[ending] for ending in endings) if set(endings) <= _UNITS.keys() else ""


def _words(kind: types.Type) -> str:
    """Return the values that a type allows, in words."""
    match kind:
        case types.Metadata(type=inner):
            return _words(inner)
        case types.UnionType(types=choices):
            return " or ".join(
                dict.fromkeys(_words(choice) for choice in choices if type(choice) is not types.NoneType)
            )
        case types.LiteralType(values=values):
            return ", ".join(f"`{msgspec.json.encode(value).decode()}`" for value in values)
        case types.IntType() | types.FloatType():
            limits = [
                words.format(f"{limit:g}")
                for key, words in _LIMITS.items()
                if (limit := getattr(kind, key)) is not None
            ]
            return ", ".join((_WORDS[type(kind)], *limits))
        case types.BoolType():
            return _WORDS[types.BoolType]
        case types.StrType(max_length=length):
            return f"text of at most {length} characters" if length else "text"
        case types.TupleType(item_types=items):
            words = list(map(_words, items))
            return f"{len(words)} × {words[0]}" if len(set(words)) == 1 else f"[{'; '.join(words)}]"
        case types.NamedTupleType(fields=fields):
            return f"[{', '.join(field.name for field in fields)}]"
        case types.ListType(item_type=inner) | types.VarTupleType(item_type=inner):
            item = _words(inner)
            return "list of records" if item == "record" else f"list of {item.replace('number', 'numbers', 1)}"
        case types.DictType(value_type=inner):
            return f"by name: {_words(inner)}"
        case types.StructType() | types.DataclassType():
            return "record"
        case _:
            return "any value"
