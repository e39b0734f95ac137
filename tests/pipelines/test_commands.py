"""The help that teaches: groups in the order of an experiment, and examples that are real commands."""

import shlex
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from faintfield.pipelines import cli
from faintfield.pipelines.registry import COMMANDS, EXPORTS, IMPORTS, Command

EXAMPLES = [
    *(example for commands in COMMANDS.values() for example in commands),
    *(each._replace(example=f"import {each.example}") for each in IMPORTS),
    *(each._replace(example=f"export {each.example}") for each in EXPORTS),
]


@pytest.mark.parametrize("command", EXAMPLES, ids=lambda command: command.example)
def test_every_example_is_a_call_of_its_command(command: Command) -> None:
    words = shlex.split(command.example)
    function, bound, _ = cli.app.parse_args(words, print_error=False, exit_on_error=False)
    module, _, name = command.target.partition(":")
    assert (function.__module__, function.__name__) == (module, name)
    assert command.name in words[:2]
    assert bound.arguments


@pytest.mark.parametrize("command", EXAMPLES, ids=lambda command: command.example)
def test_every_help_ends_with_its_example(command: Command, faintfield: Callable[..., CompletedProcess[str]]) -> None:
    words = shlex.split(command.example)
    said = faintfield(*words[: words.index(command.name) + 1], "--help").stdout
    assert " ".join(said.split()).endswith(f" Example: faintfield {command.example}")  # wrapped at the console's width


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
