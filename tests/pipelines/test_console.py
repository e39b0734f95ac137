"""What takes long says so off a terminal: lines by a clock of its own, and none for what is short."""

import io
import threading
import time

import pytest
from rich.console import Console

from faintfield.pipelines import console
from faintfield.pipelines.console import _Report, _reports, progress, working


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
