"""File formats: the keys of each table or object, from the types by which files are read and written."""

import re
from collections.abc import Iterator
from dataclasses import dataclass
from itertools import groupby
from typing import get_origin

import msgspec
from docstrings import body, linked, parse_docstring, summary, table
from msgspec import inspect as types

type _Record = types.StructType | types.DataclassType

_UNITS = {
    **{"mm": "mm", "px": "px", "s": "s", "ms": "ms", "e": "e⁻", "e2": "e⁻²", "dn": "DN", "mrad": "mrad", "deg": "°"},
    **{"c": "°C", "um": "µm", "rad": "rad", "mm2": "mm²", "s2": "s²", "min": "min", "photons": "photons"},
}
_WORDS = {types.IntType: "whole number", types.FloatType: "number", types.BoolType: "true or false"}
_LIMITS = {"ge": "at least {}", "gt": "more than {}", "le": "at most {}", "lt": "less than {}"}


@dataclass(frozen=True)
class _Part:
    """A table or object of a file, and the keys that lead to it."""

    path: str
    record: _Record
    repeated: bool = False

    def title(self, *, toml: bool) -> str:
        """Return the heading: `[table]` or `[[table]]` in TOML, `object` or `object[]` in JSON."""
        if not self.path:
            return "Top level"
        name = f"[{self.path}]" if toml else f"{self.path}{'[]' * self.repeated}"
        tag = getattr(self.record, "tag", None)
        suffix = f' with {self.record.tag_field} = "{tag}"' if isinstance(self.record, types.StructType) and tag else ""
        return f"`{f'[{name}]' if toml and self.repeated else name}`{suffix}"


def file_format(kind: type, *, toml: bool) -> str:
    """Return the keys of a file that holds a record of this type."""
    root = types.type_info(kind)
    assert isinstance(root, types.StructType | types.DataclassType)
    return "\n".join(_section(part, toml=toml) for part in _parts(_Part("", root)))


def _parts(root: _Part) -> Iterator[_Part]:
    """Yield a record and the records in its fields, each type once, in the order of the keys."""
    known, waiting = {root.record.cls}, [root]
    while waiting:
        part = waiting.pop(0)
        yield part
        inner = [
            _Part(f"{part.path}.{field.encode_name}".lstrip("."), record, repeated)
            for field in part.record.fields
            for record, repeated in _records(field.type)
            if record.cls not in known
        ]
        known.update(child.record.cls for child in inner)
        waiting = inner + waiting


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


def _section(part: _Part, *, toml: bool) -> str:
    kind = get_origin(part.record.cls) or part.record.cls

    def cells(field: types.Field) -> tuple[str, str, str]:
        return _value(field), _default(field), _meaning(kind, field.name)

    # Keys that share a meaning, such as fx_px and fy_px, share a row.
    rows = (
        (", ".join(f"`{field.encode_name}`" for field in fields), *row)
        for row, fields in groupby(part.record.fields, cells)
    )
    return "\n".join(
        (
            f"## {part.title(toml=toml)}\n",
            f"{linked(summary(kind))}\n\n{body(kind)}\n",
            table(("key", "value", "default", "meaning"), "20 22 13 45", rows),
        )
    )


def _meaning(kind: type, name: str) -> str:
    """Return what the docstring of a type, or of one that it is derived from, says of a field.

    Several fields described together have a part each, or the whole in common.
    """
    for parent in (parent for parent in kind.__mro__ if parent.__module__.startswith("faintfield")):
        sections = parse_docstring(parent)
        for entry in (*sections["Parameters"], *sections["Attributes"]):
            if name in (names := entry.name.split(", ")):
                parts = "\n".join(entry.desc).removesuffix(".").split("; ")
                text = parts[names.index(name)] if len(parts) == len(names) else "; ".join(parts)
                return linked(f"{text[:1].upper()}{text[1:]}.")
    return ""


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
            return " or ".join(dict.fromkeys(_words(choice) for choice in choices if type(choice) is not types.NoneType))
        case types.LiteralType(values=values):
            return ", ".join(f"`{msgspec.json.encode(value).decode()}`" for value in values)
        case types.IntType() | types.FloatType():
            limits = [words.format(f"{limit:g}") for key, words in _LIMITS.items() if (limit := getattr(kind, key)) is not None]
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
            words = _words(inner)
            return f"list of {'tables' if words == 'table' else words.replace('number', 'numbers', 1)}"
        case types.DictType(value_type=inner):
            return f"by name: {_words(inner)}"
        case types.StructType() | types.DataclassType():
            return "table"
        case _:
            return "any value"
