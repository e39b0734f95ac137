"""Parts of docstrings as Markdown, and tables of them."""

import inspect
import re
from collections.abc import Iterable, Sequence

from numpydoc.docscrape import NumpyDocString


def parse_docstring(value: object) -> NumpyDocString:
    """Return the sections of a docstring."""
    return NumpyDocString(inspect.cleandoc(value.__doc__ or ""))


def summary(value: object) -> str:
    """Return the first line of a docstring."""
    return " ".join(parse_docstring(value)["Summary"])


def body(value: object) -> str:
    """Return the text between the first line and the sections of a docstring."""
    return linked("\n".join(parse_docstring(value)["Extended Summary"]).strip())


# Name of a page in a text, such as docs/explanation/noise.md.
PAGE_NAME = re.compile(r"`?docs/([\w/-]+)\.md`?")


def linked(text: str) -> str:
    """Return Markdown with links to the pages that it names."""
    return PAGE_NAME.sub(r"[\1](/\1.md)", text)


def table(head: Sequence[str], widths: str, rows: Iterable[Sequence[str]]) -> str:
    """Return a table in Markdown whose cells may have several paragraphs."""
    lines = ["```{list-table}", ":header-rows: 1", ":class: stacked", f":widths: {widths}", ""]
    for row in (head, *rows):
        for place, cell in enumerate(row):
            first, *others = cell.split("\n") or [""]
            lines += [f"{'* -' if place == 0 else '  -'} {first}", *(f"    {line}" for line in others)]
    return "\n".join([*lines, "```", ""])
