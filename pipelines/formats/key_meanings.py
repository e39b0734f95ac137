"""Meanings of the keys of files, from the docstrings of the types that read and write them."""

import inspect
import re
from typing import get_origin

# Sections of a docstring, and the entries of one that lists fields.
SECTION = re.compile(r"\n\n(\w+)\n-+\n(.*?)(?=\n\n\w+\n-+\n|\Z)", re.DOTALL)
_ENTRY = re.compile(r"^(\w[\w, ]*)(?: : .*)?\n((?:    .*(?:\n|\Z)|\n)+)", re.MULTILINE)


def key_meanings(record: type) -> dict[str, str]:
    """Return the meaning of each field of a record that its docstring, or that of a type it is derived from, describes.

    Fields described together have a part of the text each, between semicolons, or the whole in common.

    >>> from faintfield import Grid
    >>> key_meanings(Grid)["pitch_mm"]
    'Distance of neighbouring nodes along both axes.'
    """
    meanings: dict[str, str] = {}
    for parent in reversed((get_origin(record) or record).__mro__):
        sections = SECTION.findall(inspect.cleandoc(parent.__doc__ or ""))
        for names, text in (
            entry
            for heading, section in sections
            if heading in ("Parameters", "Attributes")
            for entry in _ENTRY.findall(section)
        ):
            meanings |= _text_of_each(names.split(", "), " ".join(text.split()))
    return meanings


def _text_of_each(names: list[str], text: str) -> dict[str, str]:
    """Return the part of a text for each of the names, as a sentence."""
    parts = text.removesuffix(".").split("; ")
    if len(parts) != len(names):
        parts = ["; ".join(parts)] * len(names)
    return {name: _sentence(part) for name, part in zip(names, parts, strict=True)}


def _sentence(text: str) -> str:
    """Return a text that begins with a capital letter, unless a symbol such as k1 or β stands there, and has an end."""
    return f"{re.sub(r'^[a-z](?=[a-z]+\b)', lambda letter: letter[0].upper(), text)}."
