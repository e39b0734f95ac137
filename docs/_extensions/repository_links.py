"""Links from pages to files and folders of the repository lead to pages with their source, or a list of the folder."""

import os
from collections.abc import Iterator
from html import escape
from pathlib import Path
from typing import Any

from docutils import nodes
from pygments import highlight
from pygments.formatters import HtmlFormatter
from pygments.lexers import TextLexer, get_lexer_for_filename
from pygments.util import ClassNotFound
from sphinx import addnodes
from sphinx.application import Sphinx

_ROOT = Path(__file__).parents[2]

# Files and folders that have a page of their own.
_PAGES = {
    "README.md": "readme",
    "CONTRIBUTING.md": "contributing",
    "CHANGELOG.md": "changelog",
    "training/README.md": "training",
    "docs/decisions": "explanation/decisions",
}

# Entry of a page's metadata: the paths of the repository that it links to.
_LINKED = "repository_paths"


def _redirect(app: Sphinx, document: nodes.document) -> None:
    """Replace links that are no pages for Sphinx, but paths of the repository."""
    page = app.env.docname
    paths = set()
    for link in [*document.findall(addnodes.download_reference), *document.findall(addnodes.pending_xref)]:
        name, _, anchor = str(link.get("reftarget", "")).partition("#")
        if link.get("refdomain") == "doc" and Path(name).is_absolute():  # a Markdown file that is outside of docs
            name, anchor = f"{name}.md", link["reftargetid"] or ""
        elif link.get("refdomain") is not None:
            continue
        if link.get("reftype") == "myst" and (path := _path(app, page, name)):
            paths.add(path)
            link.replace_self(_reference(app, page, path, anchor, link.children))
    app.env.metadata[page][_LINKED] = "\n".join(sorted(paths))


def _path(app: Sphinx, page: str, name: str) -> str | None:
    """Return the path in the repository that a link of a page means; included pages give it from the root."""
    for folder in ((Path(app.srcdir) / page).parent, _ROOT):
        path = os.path.relpath(folder / name, _ROOT)
        if name and not path.startswith("..") and (_ROOT / path).exists():
            return path
    return None


def _reference(app: Sphinx, page: str, path: str, anchor: str, children: list[nodes.Node]) -> nodes.Element:
    if path in _PAGES:
        return addnodes.pending_xref(
            "",
            *children,
            refdomain="doc",
            reftype="myst",
            reftarget=_PAGES[path],
            reftargetid=anchor or None,
            refdoc=page,
            refexplicit=True,
        )
    return nodes.reference("", "", *children, internal=True, refuri=app.builder.get_relative_uri(page, _source(path)))


def _source(path: str) -> str:
    return f"source/{path}"


def _source_pages(app: Sphinx) -> Iterator[tuple[str, dict[str, Any], str]]:
    """Yield the page of each linked path that has none."""
    linked = {path for data in app.env.metadata.values() for path in data.get(_LINKED, "").splitlines()}
    for path in sorted(linked - _PAGES.keys()):
        body = _listing(_ROOT / path) if (_ROOT / path).is_dir() else _code(_ROOT / path)
        yield _source(path), {"title": path, "body": f"<h1>{escape(path)}</h1>{body}"}, "page.html"


def _code(file: Path) -> str:
    try:
        lexer = get_lexer_for_filename(file.name)
    except ClassNotFound:
        lexer = TextLexer()
    page: str = highlight(file.read_text("utf-8"), lexer, HtmlFormatter())
    return page


def _listing(folder: Path) -> str:
    """Return the first sentence of each module of a folder."""
    modules = ((file, file.read_text("utf-8").splitlines()[0].strip('"')) for file in sorted(folder.glob("*.py")))
    return "".join(f"<p><code>{escape(file.name)}</code><br>{escape(sentence)}</p>" for file, sentence in modules)


def setup(app: Sphinx) -> dict[str, bool]:
    """Replace the links before Sphinx collects downloads, and add the pages that they lead to."""
    app.connect("doctree-read", _redirect, priority=100)
    app.connect("html-collect-pages", _source_pages)
    return {"parallel_read_safe": True, "parallel_write_safe": True}
