"""Tables of the exceptions with cause and remedy, and of the numbers that GRBL reports."""

from collections.abc import Iterator

from docstrings import body, linked, summary, table

from faintfield.rig.stages.grbl_alarms import ALARMS, ERRORS


def error_table(root: type[BaseException]) -> str:
    """Return an exception and all derived ones: the first line of a docstring is the cause, the text below the remedy.

    The root of a tree has no remedy, and no row.
    """
    rows = ((f"{{index}}`{kind.__name__}`", linked(summary(kind)), body(kind)) for kind in _tree(root) if body(kind))
    return table(("name", "cause", "remedy"), "18 32 50", rows)


def grbl_table(word: str) -> str:
    """Return the alarms (`ALARM`) or errors (`error`) of GRBL."""
    codes = {"ALARM": ALARMS, "error": ERRORS}[word]
    rows = ((f"{{index}}`{word} {code}`", meaning, remedy) for code, (meaning, remedy) in codes.items())
    return table(("number", "meaning", "remedy"), "15 40 45", rows)


def _tree(root: type[BaseException]) -> Iterator[type[BaseException]]:
    yield root
    for kind in root.__subclasses__():
        if kind.__module__ == root.__module__:
            yield from _tree(kind)
