"""The command line: exit codes, which words go where, and the examples of the help."""

import json
import os
import re
import shlex
import tomllib
from pathlib import Path

import pytest

from faintfield.pipelines import cli, launcher
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.launcher import COMMANDS, EXPORTS, IMPORTS
from faintfield.recon.errors import NotConverged
from tests.pipelines.conftest import Command, assert_refused


def test_version_is_printed(done: Command) -> None:
    project = tomllib.loads((Path(__file__).parents[2] / "pyproject.toml").read_text())["project"]
    assert done("--version").stdout == done("--json", "--version").stdout == f"{project['version']}\n"


@pytest.mark.parametrize(
    ("words", "message"),
    [
        (("nonsense",), 'Unknown command "nonsense"'),
        (("simulate", "OUT", "--seeds", "3"), "Did you mean --seed?"),
        (("simulate", "OUT", "--snr", "nan"), "got nan."),
        (("reconstruct", "SET", "--depth-mm", "500", "700", "--out", "OUT"), "--depth-mm 500 --depth-mm 700"),
        (("reconstruct", "SET", "--depth=3", "4", "5"), "repeat it for several: --depth 3 --depth 4 --depth 5"),
        (("reconstruct", "SET", "--depth", "500,700"), "repeat it for several: --depth 500 --depth 700"),
        (
            ("reconstruct", "SET", "--depth-mm", "50cm"),
            "--depth-mm 50cm: is no number; give digits alone in mm, such as 500 or 0.5, or auto",
        ),
        (
            ("verify", "a", "b"),
            "b: no place for this; put a name with spaces in quotes",
        ),
        (("darken", "SET", "OUT", "--quantum-efficiency", "1.5"), "at most 1, got 1.5."),
    ],
)
def test_wrong_usage_ends_with_code_2(
    words: tuple[str, ...], message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = faintfield(*words)
    assert ended.returncode == 2
    assert ended.stdout == ""
    assert message in " ".join(ended.stderr.replace("│", " ").split())
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize(
    ("words", "message"),
    [
        ("noise absent", "noise.toml: no such file; name a session, or a folder with noise.toml"),
        ("geometry absent", "charuco.toml: no such file; name a session with charuco frames"),
        ("check absent.toml", "absent.toml: no such file; name a rig.toml; `faintfield init` writes one"),
        ("capture absent.toml session", "absent.toml: no such file; name a rig.toml"),
    ],
)
def test_missing_files_are_named_with_their_kind(
    words: str, message: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    monkeypatch.chdir(tmp_path)
    assert_refused(faintfield(*words.split()), "MissingFile", message)


def test_output_is_a_report_or_one_json(scene: Path, tmp_path: Path, done: Command) -> None:
    out = tmp_path / "out"
    words = ("reconstruct", scene, "--out", out, "--depth-mm", 500, "--method", "backprojection")
    ended = done(*words)
    assert ended.stdout == f"{out / 'report.html'}\n"
    assert "1 plane(s) in " in ended.stderr
    ended = done("--json", *words)
    assert len(ended.stdout.splitlines()) == 1
    result = json.loads(ended.stdout)
    assert result["report"] == str(out / "report.html")
    assert [plane["depth_mm"] for plane in result["planes"]] == [500.0]
    assert {row["depth_mm"] for row in result["metrics"]["planes"]} == {500.0}
    assert json.loads(done("report", out, "--json").stdout) == {"report": str(out / "report.html")}
    again = done("report", out)
    assert (again.stdout, again.stderr) == (f"{out / 'report.html'}\n", "")


# Each begins a line of its own, hides what follows, or turns its direction
HOSTILE = "\n\r\t\a\b\x1b\x7f\x85\x9b\u200f\u2028\u2029\u202a\u202e\u2066\u2069\ufeff\udcff"

ESCAPED = r"\n\r\t\x07\x08\x1b\x7f\x85\x9b\u200f\u2028\u2029\u202a\u202e\u2066\u2069\ufeff\udcff"


@pytest.mark.parametrize(
    ("failure", "line"),
    [
        (NotConverged("[bold]a:100:b[/bold]"), "NotConverged: [bold]a:100:b[/bold]\n"),
        (BadValue(f"{HOSTILE}é…[red]: 1 plane(s) in 3.0 s"), f"BadValue: {ESCAPED}é…[red]: 1 plane(s) in 3.0 s\n"),
        (KeyboardInterrupt(), "Interrupted: "),
        (MemoryError("Unable to allocate 8 TiB"), "MemoryShort: the command needs more memory"),
        (OSError(5, "Input/output error", "/mnt/x"), "FileFailed: /mnt/x: Input/output error"),
    ],
)
def test_failures_are_one_escaped_line(
    failure: BaseException, line: str, monkeypatch: pytest.MonkeyPatch, faintfield: Command
) -> None:
    def fail(*_: object, **__: object) -> None:
        raise failure

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    ended = faintfield("report", "folder")
    assert (ended.returncode, ended.stdout) == (1, "")
    assert ended.stderr.startswith(f"faintfield: {line}")
    assert len(ended.stderr.splitlines()) == 1


def test_words_are_escaped_in_wrong_usage(faintfield: Command) -> None:
    for words in ((HOSTILE,), ("verify", f"--{HOSTILE}"), ("simulate", "OUT", "--seed", HOSTILE)):
        ended = faintfield(*words)
        assert ended.returncode == 2
        assert ended.stderr.replace("\n", "").isprintable()
        assert r"\x1b" in ended.stderr
        assert all(line[0] in "╭│╰" for line in ended.stderr.splitlines())


@pytest.mark.parametrize("json_wanted", [False, True])
def test_path_beyond_utf_8_is_printed(
    json_wanted: bool, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    report = os.fsdecode(b"out \xff/report.html")
    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", lambda folder: Path(report))
    assert cli.run(["report", "folder", *(["--json"] if json_wanted else [])]) == 0
    output = capfdbinary.readouterr().out
    assert json.loads(output)["report"] == report if json_wanted else output == b"out \xff/report.html\n"


EXAMPLES = [*(example for examples in COMMANDS.values() for example in examples), *IMPORTS, *EXPORTS]


@pytest.mark.parametrize("example", EXAMPLES)
def test_examples_are_calls_of_their_commands(example: str) -> None:
    words = shlex.split(example)
    function, bound, _ = launcher.app.parse_args(words, print_error=False, exit_on_error=False)
    path = words[: 2 if words[0] in ("import", "export") else 1]
    assert function.__module__.startswith("faintfield.pipelines.commands.")
    assert function.__name__ == "_".join(path)
    assert bound.arguments


def test_completion_knows_commands_and_options(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    script = tmp_path / "completion.bash"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("HOME", str(tmp_path))
        assert cli.run(["--install-completion", "--shell", "bash", "--output", str(script)]) == 0
    assert str(script) in capsys.readouterr().out
    written = script.read_text()
    assert all(word in written for word in ("reconstruct", "--depth-mm", "colmap", "goto"))
    assert str(script) in (tmp_path / ".bashrc").read_text()


def test_defaults_in_help_have_few_digits(done: Command) -> None:
    assert "[default: 3.464]" in done("darken", "--help").stdout


@pytest.mark.parametrize("command", ["reconstruct", "run"])
def test_help_groups_options_by_purpose(command: str, done: Command) -> None:
    panels = re.findall(r"^╭─ (.*?) ─+╮$", done(command, "--help").stdout, re.MULTILINE)
    depths, picture = "Depths of planes", "Method, and what is expected of a picture"
    assert panels == ["Input", depths, "Surface", picture, "Output", "Machine", "Every command"]
