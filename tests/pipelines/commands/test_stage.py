"""`faintfield stage` on simulated stages: results on standard output, words on standard error, exit codes."""

import json
from pathlib import Path
from typing import Any

import pytest

from faintfield.pipelines import cli
from faintfield.rig.stages.conformance import Check

RIG = """
[stage]
protocol = "grbl"
port = "simulated:grbl"
[stage.travel_mm]
x_mm = [-300, 0]
y_mm = [-300, 0]
[[stage.keep_out]]
x_mm = [-110, -90]
y_mm = [-110, -90]
[camera]
backend = "simulated"
"""


class Shell:
    """Runs commands and keeps what they printed."""

    def __init__(self, capsys: pytest.CaptureFixture[str]) -> None:
        self._capsys = capsys
        self.words = ""

    def run(self, *arguments: str) -> int:
        code = cli.run(["stage", *arguments])
        self.output, self.words = self._capsys.readouterr()
        return code

    def result(self, *arguments: str) -> Any:
        assert self.run(*arguments, "--json") == 0
        return json.loads(self.output)


@pytest.fixture
def shell(capsys: pytest.CaptureFixture[str]) -> Shell:
    return Shell(capsys)


@pytest.mark.parametrize("stage", ["grbl", "marlin"])
def test_info_names_the_firmware(shell: Shell, stage: str) -> None:
    identity = shell.result("info", "--port", f"simulated:{stage}")
    assert stage in identity["firmware"].lower()
    assert identity["settings"]
    assert shell.run("info", "--port", f"simulated:{stage}") == 0
    assert shell.output == ""
    assert "travel [" in shell.words


def test_goto_needs_homing(shell: Shell) -> None:
    assert shell.run("goto", "-100", "-100", "--port", "simulated:grbl") == 1
    assert "NotHomed" in shell.words
    position = shell.result("goto", "-100", "-120.5", "--home", "--port", "simulated:grbl")
    assert position["point"] == [-100.0, -120.5]
    assert shell.result("home", "--port", "simulated:marlin")["trusted"] is True
    position = shell.result("jog", "-1", "-2", "--unlock", "--port", "simulated:grbl")
    assert (position["point"], position["trusted"]) == ([-1.0, -2.0], False)


@pytest.mark.parametrize(
    ("arguments", "named"),
    [
        (("goto", "5", "5", "--home"), "OutsideTravel"),
        (("jog", "1", "1"), "StageAlarm"),
        (("home", "--port", "/dev/no-such-port"), "StageLost"),
    ],
)
def test_failures_are_one_line_with_a_name(shell: Shell, arguments: tuple[str, ...], named: str) -> None:
    port = () if {"--port", "--rig"} & set(arguments) else ("--port", "simulated:grbl")
    assert shell.run(*arguments, *port) == 1
    assert shell.words.count("\n") == 1
    assert shell.words.startswith(f"faintfield: {named}: ")
    assert "; " in shell.words


@pytest.mark.parametrize("stage", ["grbl", "marlin"])
def test_conformance_checks_are_listed(shell: Shell, stage: str) -> None:
    checks = shell.result("test", "--port", f"simulated:{stage}")
    assert [check["name"] for check in checks] == [
        "settings", "homing", "limits", "speed", "arrival", "report rate", "repeatability",
    ]  # fmt: skip
    assert all(check["passed"] for check in checks)
    assert "repeatability" in shell.words


def test_unfit_stage_is_a_named_failure(shell: Shell, monkeypatch: pytest.MonkeyPatch) -> None:
    checks = [Check("homing", True, "2 s", "60 s"), Check("speed", False, "3 mm/s", "at least 50 mm/s")]
    monkeypatch.setattr("faintfield.pipelines.commands.stage.check_conformance", lambda stage: iter(checks))
    assert shell.run("test", "--port", "simulated:grbl") == 1
    assert "StageUnfit: speed: 3 mm/s, and at least 50 mm/s is asked for" in shell.words


def test_rig_file_brings_its_limits(shell: Shell, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    assert shell.run("goto", "-350", "-50", "--home", "--rig", str(rig)) == 1
    assert "OutsideTravel" in shell.words
    assert shell.run("goto", "-150", "-150", "--home", "--rig", str(rig)) == 1
    assert "KeepOutCrossed" in shell.words
    assert shell.run("goto", "-50", "-150", "--home", "--rig", str(rig)) == 0


def test_mistake_in_rig_file_is_named(shell: Shell, tmp_path: Path) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG.replace("port =", "prot =", 1))
    assert shell.run("info", "--rig", str(rig)) == 1
    assert "UnknownKey" in shell.words
    assert str(rig) in shell.words
