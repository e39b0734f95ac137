"""Every named failure says what to do: its message has a remedy after a semicolon."""

import ast
from collections.abc import Iterator
from pathlib import Path

import pytest

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


MESSAGES = dict(_messages())


def test_there_are_messages_of_every_tree() -> None:
    assert {place.partition("/")[0] for place in MESSAGES} == {"calib", "pipelines", "recon", "rig"}
    assert len(MESSAGES) > 150


@pytest.mark.parametrize("place", MESSAGES)
def test_every_named_failure_says_what_to_do(place: str) -> None:
    text = MESSAGES[place]
    if not text.endswith("{}"):  # else the last value brings the remedy
        what, _, remedy = text.rpartition("; ")
        assert what.strip()
        assert len(remedy.split()) >= 2
