"""Public names of `faintfield`, and the types that they take and return: a table of each group, and a page of each."""

import inspect
from collections.abc import Mapping
from pathlib import Path

from docstrings import summary, table
from types_of_names import full_name, shows_constructor, types_of_names

import faintfield

_GROUPS = {
    "recon": "Planes: operators and solvers",
    "calib": "Lens, boards, geometry and noise",
    "rig": "Stage, camera and session",
    "pipelines": "Sets and images",
}
_FAILURES = "Failures"


def grouped_names() -> dict[str, list[str]]:
    """Return the public names by group: exceptions by themselves, all others by the package they come from."""
    groups: dict[str, list[str]] = {group: [] for group in (*_GROUPS.values(), _FAILURES)}
    for name in faintfield.__all__:
        value = getattr(faintfield, name)
        failure = inspect.isclass(value) and issubclass(value, Exception)
        groups[_FAILURES if failure else _GROUPS[value.__module__.split(".")[1]]].append(name)
    return groups


def name_tables(folder: str) -> str:
    """Return a table of each group; the pages of the names are in a folder."""
    return "\n".join(
        f"## {group}\n\n{_table({f'faintfield.{name}': getattr(faintfield, name) for name in names}, folder)}"
        for group, names in grouped_names().items()
    )


def type_table(folder: str) -> str:
    """Return a table of the types that public names take and return; their pages are in a folder."""
    return _table({full_name(kind): kind for kind in types_of_names()}, folder)


def _table(values: Mapping[str, object], folder: str) -> str:
    rows = ((f"{{py:obj}}`{_last(name)} <{name}>`", summary(value)) for name, value in values.items())
    pages = "\n".join(f"{folder}/{_page(name)}" for name in values)
    return f"{table(('name', 'meaning'), '30 70', rows)}\n```{{toctree}}\n:hidden:\n\n{pages}\n```\n"


def _last(name: str) -> str:
    return name.rpartition(".")[2]


def _page(name: str) -> str:
    return name.removeprefix("faintfield.")


def write_name_pages(folder: Path) -> None:
    """Write a page of each name and type, which autodoc fills."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in faintfield.__all__:
        _write_page(folder, f"faintfield.{name}", getattr(faintfield, name), "")
    for kind in types_of_names():
        _write_page(folder, full_name(kind), kind, "" if shows_constructor(kind) else "()")


def _write_page(folder: Path, name: str, value: object, signature: str) -> None:
    module, _, last = name.rpartition(".")
    kind = "class" if inspect.isclass(value) else "function"
    directive = "exception" if inspect.isclass(value) and issubclass(value, Exception) else kind
    members = "\n   :members:" if kind == "class" else ""
    heading = f"{last}\n{'=' * len(last)}\n\n.. currentmodule:: {module}\n\n"
    (folder / f"{_page(name)}.rst").write_text(f"{heading}.. auto{directive}:: {last}{signature}{members}\n")
