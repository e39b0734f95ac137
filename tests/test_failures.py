"""Every named failure says what to do: in its message after a semicolon, and in its docstring below the cause."""

import ast
import inspect
from collections.abc import Iterator
from pathlib import Path

import faintfield.calib.errors
import faintfield.pipelines.errors
import faintfield.recon.errors
import faintfield.rig.errors

_ROOT = Path(__file__).parents[1]
_TREES = (faintfield.calib.errors, faintfield.pipelines.errors, faintfield.recon.errors, faintfield.rig.errors)
NAMED = {name for tree in _TREES for name, value in vars(tree).items() if isinstance(value, type)}


def _messages() -> Iterator[tuple[str, str]]:
    """Yield place and text of every message written where a named failure is made, its values as {}."""
    for package in ("calib", "pipelines", "recon", "rig"):
        for path in sorted((_ROOT / package).rglob("*.py")):
            for node in ast.walk(ast.parse(path.read_text())):
                if isinstance(node, ast.Call) and isinstance(node.func, ast.Name) and node.func.id in NAMED:
                    text = "".join(_text(argument) for argument in node.args[:1])
                    if text.replace("{}", "").strip(" :"):  # else it passes on another's message
                        yield f"{path.relative_to(_ROOT)}:{node.lineno}", text


def _text(message: ast.expr) -> str:
    """Return the literal parts of a message."""
    match message:
        case ast.Constant(value=str(text)):
            return text
        case ast.JoinedStr(values=parts):
            return "".join(_text(part) for part in parts)
        case ast.BinOp(left=left, right=right):
            return _text(left) + _text(right)
        case _:
            return "{}"


def test_messages_of_failures_end_with_a_remedy() -> None:
    messages = dict(_messages())
    assert {place.partition("/")[0] for place in messages} == {"calib", "pipelines", "recon", "rig"}
    for place, text in messages.items():
        if not text.endswith("{}"):  # else the last value brings the remedy
            what, _, remedy = text.rpartition("; ")
            assert what.strip(), place
            assert len(remedy.split()) >= 2, place


def test_docstrings_of_failures_have_a_remedy() -> None:
    failures = {kind for tree in _TREES for kind in vars(tree).values() if isinstance(kind, type)}
    assert len(failures) > 60
    for kind in failures.difference(faintfield.pipelines.errors.NAMED_FAILURES):
        cause, _, remedy = inspect.cleandoc(kind.__doc__ or "").partition("\n\n")
        assert cause.endswith("."), kind
        assert len(remedy.partition("\n\n")[0].split()) >= 2, kind
        assert not remedy.startswith("Attributes"), kind
