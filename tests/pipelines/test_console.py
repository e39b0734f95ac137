"""Output of commands: bars and lines on a terminal or off one, and the log of `--log FILE`."""

import io
import itertools
import logging
import re
from pathlib import Path
from queue import Queue

import pytest
from rich.console import Console

from faintfield.pipelines import cli, console
from faintfield.pipelines.console import _Report, _reports, conceal, inform, progress, stage, working
from tests.patience import HANG_S
from tests.pipelines.conftest import Command, assert_refused


def test_lines_are_due_after_2_and_12_s() -> None:
    now = 100.0
    report = _Report("solving", total=8, clock=lambda: now)
    lines = {}
    for tenth in range(250):
        now = 100 + tenth / 10
        if tenth in (50, 100):
            report.advance()
        if (line := report.line()) is not None:
            lines[tenth / 10] = line
    assert list(lines) == [2.0, 12.0, 22.0]
    assert lines[2.0] == "solving: 0 of 8, 2 s"
    assert lines[12.0] == "solving: 2 of 8, 12 s, about 28 s to go"
    assert lines[22.0] == "solving: 2 of 8, 22 s, about 25 s to go"
    assert report.wait_s() == pytest.approx(32 - 24.9)
    now = 300.0
    with stage("step"), stage("part of a step"):
        assert report.line() == "solving: 2 of 8, 3 min, about 25 s to go (part of a step)"
    assert report.wait_s() == pytest.approx(20.0)


@pytest.mark.parametrize("costs", [[1.0] * 6, [1.0, 1.0, 2.0, 2.0, 1.0, 1.0]])
def test_time_to_go_never_grows(costs: list[float]) -> None:
    now = 0.0
    report = _Report("solving", total=len(costs), total_cost=sum(costs), clock=lambda: now)
    left = []
    for cost in costs:
        for _ in range(int(40 * cost)):
            now += 1
            left.append(report.left_s())
        report.advance(cost)
    known = [seconds for seconds in left if seconds is not None]
    assert left[:40] == [None] * 40
    assert known == sorted(known, reverse=True)
    assert known[0] == 40 * (sum(costs) - 1) - 1
    assert report.left_s() is None


def test_part_speaks_for_whole_unless_short(monkeypatch: pytest.MonkeyPatch) -> None:
    lines, seconds = Queue[str](), itertools.count(0.0, 20.0)  # each reading of the clock is 20 s after the last

    def report(label: str, total: int | None = None, total_cost: float | None = None) -> _Report:
        return _Report(label, total, total_cost, clock=lambda: 0.0 if label == "short" else next(seconds))

    monkeypatch.setattr(console, "inform", lines.put)
    monkeypatch.setattr(console, "_Report", report)
    for _ in progress([1], "whole"):
        with working("short"):
            assert re.fullmatch(r"whole: \d+ s", lines.get(timeout=HANG_S))  # one step needs no count
        with working("part"):
            while not lines.get(timeout=HANG_S).startswith("part: "):
                pass
            lines.get(timeout=HANG_S)  # a line of the whole may have been on its way
            assert all(lines.get(timeout=HANG_S).startswith("part: ") for _ in range(5))
    with pytest.raises(ZeroDivisionError), working("failing"):
        raise ZeroDivisionError
    assert _reports == []


def test_bar_goes_on_while_a_part_works(monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(console, "console", Console(file=screen, force_terminal=True, width=80))
    for _ in progress([1, 2], "whole"):
        with working("[part]"):
            pass
    with working("[alone]"):
        pass
    assert "[alone]" in screen.getvalue()
    assert "[part]" not in screen.getvalue()


@pytest.mark.parametrize("label", ["planes", "comparing the views of all colours"])
def test_bar_fits_on_one_line(label: str, monkeypatch: pytest.MonkeyPatch) -> None:
    screen = io.StringIO()
    monkeypatch.setattr(console, "console", Console(file=screen, force_terminal=True, width=50, color_system=None))
    with stage("penalty weight"):
        list(progress([1, 2], label))
    frames = re.split(r"\r\x1b\[2K|\n", re.sub(r"\x1b\[\?25[lh]", "", screen.getvalue()))
    drawn = [frame for frame in frames if frame.strip("\r\x1b[1A2K")]
    assert drawn
    assert all(frame.startswith(label[:6]) and frame.endswith("0 s (penalty weight)") for frame in drawn), drawn


_LINE = re.compile(r"\d{4}-\d\d-\d\dT\d\d:\d\d:\d\d\.\d{3}Z (INFO|WARNING|ERROR) (.*)")


def _entries(log: Path) -> list[tuple[str, str]]:
    """Return level and words of each entry; lines of a traceback belong to none."""
    matches = [_LINE.fullmatch(line) for line in log.read_text().splitlines()]
    return [(match[1], match[2]) for match in matches if match]


def test_success_and_failure_share_a_log(tmp_path: Path, faintfield: Command) -> None:
    log, rig = tmp_path / "day.log", tmp_path / "rig.toml"
    first = faintfield("init", rig, "--log", log)
    second = faintfield("--log", log, "init", rig)
    assert (first.returncode, second.returncode) == (0, 1)
    entries = _entries(log)
    assert len(entries) == len(log.read_text().splitlines()) == 7
    assert [level for level, _ in entries] == ["INFO"] * 6 + ["ERROR"]
    words = [message for _, message in entries]
    assert words[0].startswith(f"begins: faintfield init {rig} (in ")
    assert re.search(r"versions: python \S+, faintfield \S+, numpy ", words[1])
    assert words[2] == first.stderr.strip()
    assert re.fullmatch(r"done in \d+\.\d s", words[3])
    assert f"by OutputExists: {rig}: exists and is not overwritten" in words[6]


def test_log_keeps_tracebacks_without_secrets_or_forged_lines(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    forged = "a\n2026-01-01T00:00:00.000Z INFO done in 1.0 s\x1b[2K\u2028\udcff"

    def fail(*_: object) -> None:
        logging.getLogger("some.library").warning(forged)
        conceal("sesame")
        inform("the word is sesame")
        raise ZeroDivisionError(f"sesame {forged}")

    monkeypatch.setattr("faintfield.pipelines.pages.report.write_report", fail)
    # pytest keeps what is logged, and its workers cannot send what is not UTF-8
    monkeypatch.setattr(logging.getLogger(), "handlers", [])
    log = tmp_path / "day.log"
    with pytest.raises(ZeroDivisionError):
        cli.run(["report", forged, "--log", str(log)])
    escaped = r"a\n2026-01-01T00:00:00.000Z INFO done in 1.0 s\x1b[2K\u2028\udcff"
    levels, words = zip(*_entries(log), strict=True)
    assert levels == ("INFO", "INFO", "WARNING", "INFO", "ERROR")
    assert words[0].startswith(f"begins: faintfield report {escaped} (in ")
    assert words[2:4] == (escaped, "the word is (concealed)")
    assert words[4].endswith(f"by ZeroDivisionError: (concealed) {escaped}")
    assert "Traceback (most recent call last)" in log.read_text()
    assert "sesame" not in log.read_text()
    assert all(line.isprintable() for line in log.read_text().split("\n"))


def test_unwritable_log_is_refused_but_full_disk_tolerated(tmp_path: Path, faintfield: Command) -> None:
    ended = faintfield("init", tmp_path / "rig.toml", "--log", tmp_path / "absent" / "day.log")
    assert_refused(ended, "CannotWrite", "--log ")
    assert not (tmp_path / "rig.toml").exists()
    before = list(logging.getLogger().handlers)
    ended = faintfield("--log", "/dev/full", "init", tmp_path / "rig.toml")
    assert ended.returncode == 0
    assert (tmp_path / "rig.toml").is_file()
    warning, _ = ended.stderr.splitlines()
    assert warning.startswith("warning: --log /dev/full: ")
    assert warning.endswith("No space left on device; the log is incomplete")
    assert faintfield("--log", tmp_path / "day.log", "verify", tmp_path).returncode == 1
    assert logging.getLogger().handlers == before
