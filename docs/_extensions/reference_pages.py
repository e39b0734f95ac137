"""Sphinx directives for the pages of the reference, which are made from the code."""

from collections.abc import Callable
from pathlib import Path
from pkgutil import resolve_name

from command_pages import command_group, command_list
from docstrings import PAGE_NAME
from docutils import nodes
from error_pages import error_table, grbl_table
from format_pages import file_format
from name_pages import name_tables, type_table, write_name_pages
from sphinx.application import Sphinx
from sphinx.util.docutils import SphinxDirective
from types_of_names import full_name, shows_constructor, types_of_names

# Folder of the pages of public names, in the folder of the page that lists them.
NAMES = "names"

_MAKERS: dict[str, Callable[[str], str]] = {
    "command-list": lambda _: command_list(),
    "commands": command_group,
    "errors": lambda name: error_table(resolve_name(name)),
    "grbl-codes": grbl_table,
    "toml-format": lambda name: file_format(resolve_name(name), toml=True),
    "json-format": lambda name: file_format(resolve_name(name), toml=False),
    "public-names": lambda _: name_tables(NAMES),
    "types-of-names": lambda _: type_table(NAMES),
}


_WITHOUT_CONSTRUCTOR = {full_name(kind) for kind in types_of_names() if not shows_constructor(kind)}


class MadeFromCode(SphinxDirective):
    """A part of a page, in Markdown made from the code."""

    optional_arguments = 1
    final_argument_whitespace = True

    def run(self) -> list[nodes.Node]:
        """Parse the Markdown at this place."""
        text = _MAKERS[self.name](" ".join(self.arguments))
        content: list[nodes.Node] = self.parse_text_to_nodes(text, allow_section_headings=True)
        return content


def _link_pages(app: Sphinx, what: str, name: str, value: object, options: object, lines: list[str]) -> None:
    """Link the pages that a docstring names."""
    lines[:] = [PAGE_NAME.sub(r":doc:`\1 </\1>`", line) for line in lines]


def _leave_out_constructor(app: Sphinx, what: str, name: str, *_: object) -> tuple[str, None] | None:
    """Show a type that nobody has to construct by its name alone; its docstring describes its attributes."""
    return ("", None) if what == "class" and name in _WITHOUT_CONSTRUCTOR else None


def _leave_out_tuple_fields(app: Sphinx, what: str, name: str, value: object, *_: object) -> bool | None:
    """Leave out the fields of a named tuple, which its docstring describes."""
    return True if (getattr(value, "__doc__", None) or "").startswith("Alias for field number") else None


def setup(app: Sphinx) -> dict[str, bool]:
    """Add the directives, and write the pages of the public names and their types."""
    for name in _MAKERS:
        app.add_directive(name, MadeFromCode)
    app.connect("autodoc-process-docstring", _link_pages)
    app.connect("autodoc-process-signature", _leave_out_constructor)
    app.connect("autodoc-skip-member", _leave_out_tuple_fields)
    write_name_pages(Path(app.srcdir) / "reference" / NAMES)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
