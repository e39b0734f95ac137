"""The command line: exit codes, which words go where, and the examples of the help."""

import json
import os
import shlex
import tomllib
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest

from faintfield.pipelines import cli, launcher
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.registry import COMMANDS, EXPORTS, IMPORTS
from faintfield.recon.errors import NotConverged

type Command = Callable[..., CompletedProcess[str]]


@pytest.mark.parametrize("words", [("--version",), ("--json", "--version")])
def test_the_version_is_printed(words: tuple[str, ...], faintfield: Command) -> None:
    ended = faintfield(*words)
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert (ended.returncode, ended.stdout) == (0, f"{project['version']}\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nonsense",), 'Unknown command "nonsense"'),
        (("simulate", "OUT", "--seeds", "3"), "Did you mean --seed?"),
        (("simulate", "OUT", "--snr", "nan"), "got nan."),
        (("darken", "SET", "OUT", "--quantum-efficiency", "1.5"), "at most 1, got 1.5."),
    ],
)
def test_wrong_usage_is_exit_code_2_and_nothing_happens(
    words: tuple[str, ...], said: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = faintfield(*words)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert said in " ".join(ended.stderr.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("where", ["before", "after"])
def test_json_prints_one_object_and_nothing_else_on_standard_output(
    where: str, scene: Path, tmp_path: Path, done: Command
) -> None:
    words: tuple[object, ...] = ("reconstruct", scene, "--out", tmp_path / "out", "--depth-mm", 500, *QUICK)
    ended = done(*(("--json", *words) if where == "before" else (*words, "--json")))
    assert len(ended.stdout.splitlines()) == 1
    result = json.loads(ended.stdout)
    assert result["report"] == str(tmp_path / "out" / "report.html")
    assert [plane["depth_mm"] for plane in result["planes"]] == [500.0]
    assert {row["depth_mm"] for row in result["metrics"]["planes"]} == {500.0}


def test_every_command_has_a_json_result(tmp_path: Path, done: Command, small_options: tuple[object, ...]) -> None:
    def result(*words: object) -> dict[str, Any]:
        ended = done("--json", *words)
        found: dict[str, Any] = json.loads(ended.stdout)
        assert ended.stdout.endswith("\n")
        return found

    scene, bright = tmp_path / "scene", tmp_path / "scene" / "noise_free"
    assert result("simulate", scene, *small_options)["views"] == 9
    assert result("darken", bright, tmp_path / "dark")["snr"] == 0.16
    (bright / "flat.tiff").unlink()
    assert result("import", "grid", bright, tmp_path / "set")["rows"] == 3
    words = ("--out", tmp_path / "planes", "--depth-mm", 500, "--method", "backprojection")
    assert result("reconstruct", tmp_path / "dark", *words)["metrics"] is None
    assert result("report", tmp_path / "planes") == {"report": str(tmp_path / "planes" / "report.html")}


def test_without_json_only_the_report_is_on_standard_output(
    scene: Path, tmp_path: Path, done: Command, small_options: tuple[object, ...]
) -> None:
    assert done("simulate", tmp_path / "other", *small_options).stdout == ""
    words = ("--depth-mm", 500, "--method", "backprojection")
    ended = done("reconstruct", scene, "--out", tmp_path / "out", *words)
    assert ended.stdout == f"{tmp_path / 'out' / 'report.html'}\n"
    assert "1 plane(s) in " in ended.stderr


@pytest.mark.parametrize(
    ("failure", "line"),
    [
        (BadValue("x = 3; give 4"), "faintfield: BadValue: x = 3; give 4\n"),
        (NotConverged("[bold]a:100:b[/bold]"), "faintfield: NotConverged: [bold]a:100:b[/bold]\n"),
    ],
)
def test_named_failures_are_one_line_as_it_is_and_exit_code_1(
    failure: Exception, line: str, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    ended = faintfield("report", "folder")
    assert (ended.returncode, ended.stdout, ended.stderr) == (1, "", line)


QUICK = ("--method", "backprojection")

# Each begins a line of its own, hides what follows, or turns its direction
HOSTILE = "\n\r\t\a\b\x1b\x7f\x85\x9b\u200f\u2028\u2029\u202a\u202e\u2066\u2069\ufeff\udcff"

ESCAPED = r"\n\r\t\x07\x08\x1b\x7f\x85\x9b\u200f\u2028\u2029\u202a\u202e\u2066\u2069\ufeff\udcff"


def test_what_a_name_holds_is_escaped_in_a_failure(monkeypatch: pytest.MonkeyPatch, faintfield: Command) -> None:
    def fail(*_: object, **__: object) -> None:
        raise BadValue(f"{HOSTILE}é…[red]: 1 plane(s) in 3.0 s")

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    said = faintfield("report", "folder").stderr
    assert said == f"faintfield: BadValue: {ESCAPED}é…[red]: 1 plane(s) in 3.0 s\n"


def test_what_a_name_holds_is_escaped_in_a_message(tmp_path: Path, done: Command) -> None:
    rig = tmp_path / f"{HOSTILE}.toml"
    said = done("init", rig).stderr
    assert said.startswith(f"wrote {tmp_path}/{ESCAPED}.toml; ")
    assert len(said.splitlines()) == 1


def test_what_a_word_holds_is_escaped_in_wrong_usage(faintfield: Command) -> None:
    for words in ((HOSTILE,), ("verify", f"--{HOSTILE}"), ("simulate", "OUT", "--seed", HOSTILE)):
        ended = faintfield(*words)
        assert ended.returncode == 2
        assert ended.stderr.replace("\n", "").isprintable()
        assert r"\x1b" in ended.stderr
        assert all(line[0] in "╭│╰" for line in ended.stderr.splitlines())


@pytest.mark.parametrize("json_wanted", [False, True])
def test_a_path_that_is_not_utf_8_is_printed(
    json_wanted: bool, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    report = os.fsdecode(b"out \xff/report.html")
    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", lambda folder: Path(report))
    assert cli.run(["report", "folder", *(["--json"] if json_wanted else [])]) == 0
    said = capfdbinary.readouterr().out
    assert json.loads(said)["report"] == report if json_wanted else said == b"out \xff/report.html\n"


def test_an_interrupt_is_one_line_and_exit_code_1(monkeypatch: pytest.MonkeyPatch, faintfield: Command) -> None:
    def interrupt(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", interrupt)
    ended = faintfield("report", "folder")
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.startswith("faintfield: Interrupted: ")
    assert len(ended.stderr.splitlines()) == 1


@pytest.mark.parametrize(
    ("failure", "named"),
    [
        (
            MemoryError("Unable to allocate 8 TiB"),
            "MemoryShort: the command needs more memory than there is (Unable to",
        ),
        (OSError(5, "Input/output error", "/mnt/x"), "FileFailed: /mnt/x: Input/output error"),
    ],
)
def test_what_the_system_refuses_is_a_named_failure(
    failure: Exception, named: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(*_: object) -> None:
        raise failure

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    assert cli.run(["report", "x"]) == 1
    (line,) = capsys.readouterr().err.splitlines()
    assert line.startswith(f"faintfield: {named}")


def test_a_bug_is_not_reported_as_a_named_failure(monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        raise ZeroDivisionError

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    with pytest.raises(ZeroDivisionError):
        cli.run(["report", "folder"])


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


def test_completion_scripts_know_commands_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "completion.bash"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(tmp_path))
        assert cli.run(["--install-completion", "--shell", "bash", "--output", str(script)]) == 0
    assert str(script) in capsys.readouterr().out
    written = script.read_text()
    assert all(word in written for word in ("reconstruct", "--depth-mm", "colmap", "goto"))
    assert str(script) in (tmp_path / ".bashrc").read_text()
