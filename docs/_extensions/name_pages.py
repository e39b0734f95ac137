"""Public names of `faintfield`: a table of each group, and a page of each name."""

import inspect
from pathlib import Path

from docstrings import summary, table

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
    return "\n".join(_group(group, names, folder) for group, names in grouped_names().items())


def _group(group: str, names: list[str], folder: str) -> str:
    rows = ((f"{{py:obj}}`{name} <faintfield.{name}>`", summary(getattr(faintfield, name))) for name in names)
    pages = "\n".join(f"{folder}/{name}" for name in names)
    return f"## {group}\n\n{table(('name', 'meaning'), '30 70', rows)}\n```{{toctree}}\n:hidden:\n\n{pages}\n```\n"


def write_name_pages(folder: Path) -> None:
    """Write a page of each name, which autodoc fills."""
    folder.mkdir(parents=True, exist_ok=True)
    for name in faintfield.__all__:
        value = getattr(faintfield, name)
        kind = "class" if inspect.isclass(value) else "function"
        directive = "exception" if inspect.isclass(value) and issubclass(value, Exception) else kind
        members = "\n   :members:" if kind == "class" else ""
        text = f"{name}\n{'=' * len(name)}\n\n.. currentmodule:: faintfield\n\n.. auto{directive}:: {name}{members}\n"
        (folder / f"{name}.rst").write_text(text)
