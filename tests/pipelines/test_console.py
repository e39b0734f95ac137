"""What commands say: bars and lines on a terminal or off one, and the log of `--log FILE`."""

import io
import logging
import re
import threading
import time
from collections.abc import Callable
from pathlib import Path
from subprocess import CompletedProcess

import pytest
from rich.console import Console

from faintfield.pipelines import cli, console
from faintfield.pipelines.console import _Report, _reports, conceal, inform, progress, working


class Clock:
    """A clock that a test sets."""

    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def test_the_first_line_is_due_after_two_seconds_and_the_next_after_ten_more() -> None:
    clock = Clock()
    report = _Report("solving", clock=clock)
    said = {}
    for tenth in range(250):
        clock.now = 100 + tenth / 10
        if (line := report.line()) is not None:
            said[tenth / 10] = line
    assert said == {2.0: "solving: 2 s", 12.0: "solving: 12 s", 22.0: "solving: 22 s"}
    assert report.wait_s() == pytest.approx(32 - 24.9)


def test_a_line_counts_steps_and_the_time_left() -> None:
    clock = Clock()
    report = _Report("planes", total=8, done=2, clock=clock)
    clock.now += 20
    assert report.line() == "planes: 2 of 8, 20 s, about 60 s to go"


@pytest.fixture
def hurried(monkeypatch: pytest.MonkeyPatch) -> None:
    """Lines after 0.05 s instead of 2 s, and as often."""
    monkeypatch.setattr(console, "_FIRST_LINE_S", 0.05)
    monkeypatch.setattr(console, "_NEXT_LINE_S", 0.05)


@pytest.mark.usefixtures("hurried")
def test_a_part_speaks_for_the_whole(capfd: pytest.CaptureFixture[str]) -> None:
    for _ in progress([1], "whole"):
        with working("part"):
            time.sleep(0.5)
    said = capfd.readouterr().err.splitlines()
    parts = [line for line in said if line.startswith("part: ")]
    assert len(parts) >= 2
    assert len(said) - len(parts) <= 1  # before the part has spoken


@pytest.mark.usefixtures("hurried")
def test_the_whole_speaks_while_its_parts_are_short(capfd: pytest.CaptureFixture[str]) -> None:
    for _ in progress(range(60), "whole"):
        with working("part"):
            time.sleep(0.005)
    assert "whole: " in capfd.readouterr().err


def test_short_work_is_silent_and_ends_at_once(capfd: pytest.CaptureFixture[str]) -> None:
    started = time.monotonic()
    with working("short"):
        pass
    assert time.monotonic() - started < 1
    assert capfd.readouterr().err == ""


def test_work_that_fails_ends_its_report() -> None:
    with pytest.raises(ZeroDivisionError), working("failing"):
        raise ZeroDivisionError
    assert _reports == []


def test_a_bar_that_is_drawn_goes_on_while_a_part_works(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(console, "console", Console(file=screen, force_terminal=True, width=80))
    taken = []
    for item in progress([1, 2], "whole"):
        with working("[part]"):
            taken.append(item)
    with working("[alone]"):
        pass
    assert taken == [1, 2]
    assert "[alone]" in screen.getvalue()
    assert "[part]" not in screen.getvalue()


def test_a_line_that_falls_due_as_the_work_ends_disturbs_nothing(monkeypatch: pytest.MonkeyPatch) -> None:
    speaking, removed = threading.Event(), threading.Event()

    class Reports(list[_Report]):
        def remove(self, report: _Report, /) -> None:
            super().remove(report)
            removed.set()

    def line(_: _Report) -> str:
        speaking.set()
        removed.wait(0.2)  # for ever, if the thread is waited for before its report is removed
        return "late"

    failures: list[threading.ExceptHookArgs] = []
    monkeypatch.setattr(threading, "excepthook", failures.append)
    monkeypatch.setattr(console, "_reports", Reports())
    monkeypatch.setattr(console, "_FIRST_LINE_S", 0.0)
    monkeypatch.setattr(_Report, "line", line)
    with working("ending"):
        speaking.wait()
    assert failures == []
    assert removed.is_set()


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


def test_the_log_is_closed_in_the_end(tmp_path: Path, faintfield: Command) -> None:
    before = list(logging.getLogger().handlers)
    assert faintfield("--log", tmp_path / "day.log", "verify", tmp_path).returncode == 1
    assert logging.getLogger().handlers == before
