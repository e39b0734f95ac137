"""What `--log FILE` records, and that nothing changes without it."""

import logging
import re
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest

from faintfield.pipelines import cli
from faintfield.pipelines.console import conceal, inform

type Command = Callable[..., CompletedProcess[str]]
_LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z (INFO|WARNING|ERROR) (.*)")


def _entries(log: Path) -> list[tuple[str, str]]:
    """Return level and words of each entry; lines of a traceback belong to none."""
    found = [_LINE.fullmatch(line) for line in log.read_text().splitlines()]
    return [(match[1], match[2]) for match in found if match]


def test_a_command_that_succeeds_and_one_that_fails_share_a_log(tmp_path: Path, faintfield: Command) -> None:
    log, rig = tmp_path / "day.log", tmp_path / "rig.toml"
    first = faintfield("init", rig, "--log", log)
    second = faintfield("--log", log, "init", rig)
    assert (first.returncode, second.returncode) == (0, 1)
    entries = _entries(log)
    assert len(entries) == len(log.read_text().splitlines()) == 7
    assert [level for level, _ in entries] == ["INFO"] * 6 + ["ERROR"]
    words = [said for _, said in entries]
    assert words[0].startswith(f"begins: faintfield init {rig} (in ")
    assert re.search(r"versions: python \S+, faintfield \S+, numpy ", words[1])
    assert words[2] == first.stderr.strip()
    assert re.fullmatch(r"done in \d+\.\d s", words[3])
    assert f"by OutputExists: {rig}: exists and is not overwritten" in words[6]


def test_wrong_usage_is_recorded_in_a_line(tmp_path: Path, faintfield: Command) -> None:
    log = tmp_path / "day.log"
    assert faintfield("--log", log, "verify", "session", "--nonsense").returncode == 2
    assert _entries(log)[-1][0] == "ERROR"
    assert "Unknown option: --nonsense" in log.read_text().splitlines()[-1]


def test_a_bug_leaves_its_traceback_and_a_warning_its_words(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        logging.getLogger("some.library").warning("the wind has turned")
        raise ZeroDivisionError("a bug")

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    log = tmp_path / "day.log"
    with pytest.raises(ZeroDivisionError):
        cli.run(["report", "folder", "--log", str(log)])
    assert ("WARNING", "the wind has turned") in _entries(log)
    assert _entries(log)[-1][1].endswith("by ZeroDivisionError: a bug")
    assert "Traceback (most recent call last)" in log.read_text()
    assert log.read_text().splitlines()[-1] == "  ZeroDivisionError: a bug"


def test_no_name_can_forge_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forged = "a\n2026-01-01T00:00:00.000Z INFO done in 1.0 s\x1b[2K\u2028\udcff"

    def fail(*_: object) -> None:
        logging.getLogger("some.library").warning(forged)
        raise ZeroDivisionError(forged)

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    # pytest keeps what is logged, and its workers cannot send what is not UTF-8
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    log = tmp_path / "day.log"
    with pytest.raises(ZeroDivisionError):
        cli.run(["report", forged, "--log", str(log)])
    escaped = r"a\n2026-01-01T00:00:00.000Z INFO done in 1.0 s\x1b[2K\u2028\udcff"
    levels, words = zip(*_entries(log), strict=True)
    assert levels == ("INFO", "INFO", "WARNING", "ERROR")
    assert words[0].startswith(f"begins: faintfield report {escaped} (in ")
    assert words[2] == escaped
    assert words[3].endswith(f"by ZeroDivisionError: {escaped}")
    assert all(line.isprintable() for line in log.read_text().split("\n"))


def test_a_secret_is_in_no_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def fail(*_: object) -> None:
        conceal("sesame")
        inform("the word is sesame")
        raise ZeroDivisionError("sesame")

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    log = tmp_path / "day.log"
    with pytest.raises(ZeroDivisionError):
        cli.run(["report", "folder", "--log", str(log)])
    assert "sesame" not in log.read_text()
    assert ("INFO", "the word is (concealed)") in _entries(log)


def test_the_log_is_closed_in_the_end(tmp_path: Path, faintfield: Command) -> None:
    before = list(logging.getLogger().handlers)
    assert faintfield("--log", tmp_path / "day.log", "verify", tmp_path).returncode == 1
    assert logging.getLogger().handlers == before


def test_a_log_that_cannot_be_written_is_refused_before_the_command_runs(tmp_path: Path, faintfield: Command) -> None:
    rig = tmp_path / "rig.toml"
    ended = faintfield("init", rig, "--log", tmp_path / "absent" / "day.log")
    assert ended.returncode == 1
    assert ended.stderr.startswith("faintfield: CannotWrite: --log ")
    assert "name a file that can be written" in ended.stderr
    assert not rig.exists()


def test_a_full_disk_ends_the_log_and_not_the_command(tmp_path: Path, faintfield: Command) -> None:
    rig = tmp_path / "rig.toml"
    ended = faintfield("--log", "/dev/full", "init", rig)
    assert ended.returncode == 0
    assert rig.is_file()
    warning, message = ended.stderr.splitlines()
    assert warning.startswith("warning: --log /dev/full: ")
    assert warning.endswith("No space left on device; the log is incomplete")
    assert message.startswith(f"wrote {rig}; ")
