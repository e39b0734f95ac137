"""The help that teaches: groups in the order of an experiment, and examples that are real commands."""

import shlex
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from faintfield.pipelines import cli, launcher
from faintfield.pipelines.registry import COMMANDS, EXPORTS, IMPORTS

EXAMPLES = [*(example for examples in COMMANDS.values() for example in examples), *IMPORTS, *EXPORTS]


def _path(example: str) -> list[str]:
    """The words that name a command."""
    words = shlex.split(example)
    return words[: 2 if words[0] in ("import", "export") else 1]


@pytest.mark.parametrize("example", EXAMPLES)
def test_every_example_is_a_call_of_its_command(example: str) -> None:
    function, bound, _ = launcher.app.parse_args(shlex.split(example), print_error=False, exit_on_error=False)
    path = _path(example)
    module = path[0] if len(path) == 1 else f"{path[0]}s.{path[1]}"
    assert function.__module__ == f"faintfield.pipelines.commands.{module}"
    assert function.__name__ == "_".join(path)
    assert bound.arguments


@pytest.mark.parametrize("example", EXAMPLES)
def test_every_help_ends_with_its_example(example: str, faintfield: Callable[..., CompletedProcess[str]]) -> None:
    said = faintfield(*_path(example), "--help").stdout
    assert " ".join(said.split()).endswith(f" Example: faintfield {example}")  # wrapped at the console's width


def test_groups_stand_in_the_order_of_an_experiment(faintfield: Callable[..., CompletedProcess[str]]) -> None:
    said = faintfield("--help").stdout
    titles = [
        "Try it without hardware",
        "At the rig",
        "Calibrate",
        "Reconstruct",
        "Other people's files",
        "Every command",
    ]
    places = [said.index(title) for title in titles]
    assert places == sorted(places)
    rig = [said.index(f"│ {name} ") for name in ("init", "check", "stage", "board", "capture", "verify")]
    assert rig == sorted(rig)
    assert said.index("Start with: faintfield demo") > places[-1]


def test_completion_scripts_know_commands_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "completion.bash"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(tmp_path))
        assert cli.run(["--install-completion", "--shell", "bash", "--output", str(script)]) == 0
    assert str(script) in capsys.readouterr().out
    written = script.read_text()
    assert all(word in written for word in ("reconstruct", "--depth-mm", "colmap", "goto"))
    assert str(script) in (tmp_path / ".bashrc").read_text()
