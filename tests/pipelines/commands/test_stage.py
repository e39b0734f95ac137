"""`faintfield stage` on simulated stages: results on standard output, words on standard error, exit codes."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from faintfield.pipelines.commands.stage import app
from faintfield.rig.stages.conformance import Check
from tests.pipelines.conftest import Command, assert_refused

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


GRBL, MARLIN = ("--port", "simulated:grbl"), ("--port", "simulated:marlin")


@pytest.fixture
def result(done: Command) -> Callable[..., Any]:
    return lambda *words: json.loads(done("--json", "stage", *words).stdout)


@pytest.mark.parametrize("stage", ["grbl", "marlin"])
def test_info_and_conformance_are_printed(stage: str, result: Callable[..., Any], done: Command) -> None:
    port = ("--port", f"simulated:{stage}")
    identity = result("info", *port)
    assert stage in identity["firmware"].lower()
    assert identity["settings"]
    ended = done("stage", "info", *port)
    assert ended.stdout == ""
    assert "travel [" in ended.stderr
    names = ["settings", "homing", "limits", "speed", "arrival", "report rate", "repeatability"]
    assert [(check["name"], check["passed"]) for check in result("test", *port)] == [(name, True) for name in names]


def test_goto_needs_homing(result: Callable[..., Any], faintfield: Command) -> None:
    assert_refused(faintfield("stage", "goto", "-100", "-100", *GRBL), "NotHomed", "; give --home")
    assert result("goto", "-100", "-120.5", "--home", *GRBL)["point"] == [-100.0, -120.5]
    assert result("home", *MARLIN)["trusted"] is True
    position = result("jog", "-1", "-2", "--unlock", *GRBL)
    assert (position["point"], position["trusted"]) == ([-1.0, -2.0], False)


@pytest.mark.parametrize("name", ["goto", "jog"])
def test_example_of_help_works(name: str, faintfield: Command) -> None:
    ended = faintfield(*str(app[name].help_epilogue).removeprefix("Example: faintfield ").split())
    assert ended.returncode == 0, ended.stderr


@pytest.mark.parametrize(
    ("arguments", "named", "remedy"),
    [
        (("goto", "5", "5", "--home", *GRBL), "OutsideTravel", "choose one inside"),
        (("jog", "1", "1", *GRBL), "StageAlarm", "or give --unlock"),
        (("jog", "1", "0", "--unlock", *GRBL), "StageRejected", "jog the other way"),
        (("home", "--port", "/dev/no-such-port"), "StageLost", "check"),
    ],
)
def test_failures_are_one_line_with_a_name(
    arguments: tuple[str, ...], named: str, remedy: str, faintfield: Command
) -> None:
    ended = faintfield("stage", *arguments)
    assert_refused(ended, named, "; ", remedy)
    assert ended.stderr.count("\n") == 1


def test_unfit_stage_is_a_named_failure(faintfield: Command, monkeypatch: pytest.MonkeyPatch) -> None:
    checks = [Check("homing", True, "2 s", "60 s"), Check("speed", False, "3 mm/s", "at least 50 mm/s")]
    monkeypatch.setattr("faintfield.pipelines.workflows.stage.check_conformance", lambda stage: iter(checks))
    words = "speed: 3 mm/s, and at least 50 mm/s is asked for"
    assert_refused(faintfield("stage", "test", *GRBL), "StageUnfit", words)


def test_rig_file_brings_its_limits(tmp_path: Path, faintfield: Command) -> None:
    rig = tmp_path / "rig.toml"
    rig.write_text(RIG)
    goto = ("stage", "goto", "--home", "--rig", rig)
    assert_refused(faintfield(*goto, "-350", "-50"), "OutsideTravel")
    assert_refused(faintfield(*goto, "-150", "-150"), "KeepOutCrossed")
    assert faintfield(*goto, "-50", "-150").returncode == 0
    rig.write_text(RIG.replace("port =", "prot =", 1))
    assert_refused(faintfield("stage", "info", "--rig", rig), "UnknownKey", str(rig))
