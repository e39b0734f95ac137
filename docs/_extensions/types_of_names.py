"""Types that public names take or return and that are no public names themselves."""

import inspect
from collections.abc import Iterator
from functools import cache, cached_property
from types import FunctionType
from typing import TypeAliasType, get_args, get_origin, get_type_hints

from msgspec import Struct

import faintfield

# Fields are followed from a public name to what it holds, and to what that holds.
_STEPS_OF_FIELDS = 2


@cache
def types_of_names() -> list[type]:
    """Return the types in the signatures and fields of public names, and those in the signatures and fields of these.

    Fields of records are left out: they have pages of their own, those of the file formats.
    """
    return sorted((kind for kind in _found() if isinstance(kind, type)), key=full_name)


def type_aliases() -> list[str]:
    """Return the names of the type aliases in the same signatures, which have no pages."""
    return [full_name(alias) for alias in _found() if isinstance(alias, TypeAliasType)]


def full_name(kind: type | TypeAliasType) -> str:
    """Return the name of a type with its module."""
    return f"{kind.__module__}.{kind.__name__}"


@cache
def _found() -> frozenset[type | TypeAliasType]:
    public = {getattr(faintfield, name) for name in faintfield.__all__}
    found, new, steps = set(public), set(public), 0
    while new:
        new = {kind for value in new for kind in _annotations(value, fields=steps < _STEPS_OF_FIELDS)} - found
        found |= new
        steps += 1
    return frozenset(found - public)


def shows_constructor(kind: type) -> bool:
    """Return whether the page of a type shows its constructor, whose parameters its docstring then describes."""
    return "Parameters\n----------" in inspect.cleandoc(kind.__doc__ or "")


def _annotations(value: object, *, fields: bool) -> Iterator[type | TypeAliasType]:
    """Yield the types and aliases of the package in the signatures of a function or class, and in its fields."""
    annotated: list[object] = [value] if inspect.isfunction(value) else []
    if isinstance(value, type):
        annotated += _functions(value)
        is_record = issubclass(value, Struct) and value.__name__ not in faintfield.__all__
        if shows_constructor(value) or (fields and not is_record):
            annotated.append(value)
    for item in annotated:
        for name, hint in get_type_hints(item).items():
            if not name.startswith("_"):
                yield from _types(hint)


def _functions(kind: type) -> Iterator[FunctionType]:
    """Yield the functions of a class whose signatures its page shows."""
    for name, member in vars(kind).items():
        function = member.fget if isinstance(member, property) else member
        function = function.func if isinstance(function, cached_property) else getattr(function, "__func__", function)
        shown = shows_constructor(kind) if name == "__init__" else not name.startswith("_")
        if shown and isinstance(function, FunctionType):
            yield function


def _types(hint: object) -> Iterator[type | TypeAliasType]:
    """Yield the types and aliases of the package in an annotation."""
    if isinstance(hint, TypeAliasType):
        yield hint
        yield from _types(hint.__value__)
    elif isinstance(hint, list | tuple):
        for part in hint:
            yield from _types(part)
    else:
        kind = get_origin(hint) or hint
        if isinstance(kind, type) and kind.__module__.startswith(faintfield.__name__):
            yield kind
        yield from _types(get_args(hint))
