"""The command line: help, exit codes, and which words go where."""

import io
import json
import os
import tomllib
from collections.abc import Callable, Iterator
from pathlib import Path
from subprocess import CompletedProcess
from typing import Any

import pytest
from cyclopts import App
from rich.console import Console

from faintfield.pipelines import cli, console, launcher
from faintfield.pipelines.errors import BadValue
from faintfield.recon.errors import NotConverged

type Command = Callable[..., CompletedProcess[str]]


def _commands(app: App, before: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Every command and group of commands that is registered."""
    for name in app:
        if not name.startswith("-"):
            yield (*before, name)
            yield from _commands(app[name], (*before, name))


COMMANDS = list(_commands(launcher.app))


def test_the_commands_of_the_design_are_there() -> None:
    expected = {"simulate", "darken", "import", "reconstruct", "report", "demo"}
    assert expected <= {name for name, *_ in COMMANDS}
    assert ("import", "grid") in COMMANDS


@pytest.mark.parametrize("command", [(), *COMMANDS], ids=" ".join)
def test_every_command_explains_itself(command: tuple[str, ...], faintfield: Command) -> None:
    ended = faintfield(*command, "--help")
    assert ended.returncode == 0
    assert ended.stderr == ""
    assert "Usage: faintfield" in ended.stdout
    for word in command:
        assert word in ended.stdout


def test_the_help_names_every_command(faintfield: Command) -> None:
    said = faintfield("--help").stdout
    for name, *_ in COMMANDS:
        assert f" {name} " in said


@pytest.mark.parametrize("words", [("--version",), ("--json", "--version"), ("report", "--version")])
def test_the_version_is_printed(words: tuple[str, ...], faintfield: Command) -> None:
    ended = faintfield(*words)
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert (ended.returncode, ended.stdout) == (0, f"{project['version']}\n")


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("nonsense",), 'Unknown command "nonsense"'),
        (("simulate",), "requires an argument"),
        (("simulate", "OUT", "--nonsense", "3"), "Unknown option: --nonsense"),
        (("simulate", "OUT", "--seeds", "3"), "Did you mean --seed?"),
        (("simulate", "OUT", "EXTRA"), "EXTRA"),
        (("simulate", "OUT", "--snr", "much"), "much"),
        (("simulate", "OUT", "--colour", "purple"), "purple"),
        (("simulate", "OUT", "--seed", "-1"), "Must be at least 0, got -1."),
        (("simulate", "OUT", "--snr", "0"), "Must be at least 1e-09, got 0."),
        (("simulate", "OUT", "--snr", "nan"), "got nan."),
        (("simulate", "OUT", "--snr", "inf"), "got inf."),
        (("simulate", "OUT", "--rows", "0"), "Must be at least 1, got 0."),
        (("simulate", "OUT", "--size-px", "640", "-480"), "Must be at least 2, got -480."),
        (("simulate", "OUT", "--position-error-mm", "-1"), "Must be at least 0, got -1."),
        (("darken", "SET", "OUT", "--quantum-efficiency", "1.5"), "at most 1, got 1.5."),
        (("import", "grid", "SRC", "OUT", "--rows", "0"), "Must be at least 1, got 0."),
        (("import", "grid", "SRC", "OUT", "--disparity-px", "-2"), "Must be at least 0, got -2."),
        (("reconstruct", "SET", "--penalty-weight", "-1"), "Must be at least 0, got -1."),
        (("reconstruct", "SET", "--penalty-weight", "nan"), "got nan."),
        (("import", "nonsense"), "nonsense"),
        (("reconstruct", "SET", "--depth-mm", "500"), "--out"),
        (("reconstruct", "SET", "--out", "OUT", "--method", "magic"), "magic"),
        (("reconstruct", "SET", "--out", "OUT", "--passes", "0"), "Must be at least 1, got 0."),
        (("demo", "--snr", "-1"), "Must be at least 1e-09, got -1."),
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


def test_usage_errors_are_told_in_full_on_a_narrow_terminal(
    monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    monkeypatch.setenv("COLUMNS", "50")
    said = faintfield("darken", "SET", "OUT", "--quantum-efficiency", "1.5").stderr
    assert "Must be a number of at most 1, got 1.5." in " ".join(said.replace("│", " ").split())


@pytest.mark.parametrize("where", ["before", "after"])
def test_json_prints_one_object_and_nothing_else_on_standard_output(
    where: str, scene: Path, tmp_path: Path, done: Command
) -> None:
    words: tuple[object, ...] = ("reconstruct", scene, "--out", tmp_path / "out", "--depth-mm", 500, "--passes", 2)
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


def test_no_bar_is_drawn_where_there_is_no_terminal(
    tmp_path: Path, done: Command, small_options: tuple[object, ...]
) -> None:
    said = done("simulate", tmp_path / "set", *small_options).stderr
    assert "\x1b" not in said
    assert "\r" not in said
    assert len(said.splitlines()) == 1


@pytest.mark.parametrize(
    ("failure", "line"),
    [
        (BadValue("x = 3; give 4"), "faintfield: BadValue: x = 3; give 4\n"),
        (NotConverged("[bold]a:100:b[/bold]"), "faintfield: NotConverged: [bold]a:100:b[/bold]\n"),
        (BadValue("long " * 100 + "line"), "faintfield: BadValue: " + "long " * 100 + "line\n"),
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


def test_a_bar_shows_its_label_as_it_is(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(console, "console", Console(file=screen, force_terminal=True, width=200))
    assert list(console.progress([1, 2], f"[bold]{HOSTILE}")) == [1, 2]
    assert f"[bold]{ESCAPED}" in screen.getvalue()


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
        (MemoryError(), "MemoryShort: the command needs more memory than there is (no size stated)"),
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


def test_main_exits_with_the_code() -> None:
    with pytest.raises(SystemExit) as ended:
        cli.main(["reconstruct", "nowhere", "--out", "nowhere", "--depth-mm", "500"])
    assert ended.value.code == 1
