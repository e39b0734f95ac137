"""Messages and progress bars, always on standard error; standard output is for results only."""

import itertools
import logging
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sized
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass

from rich.console import Console
from rich.text import Text

console = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)

logger = logging.getLogger("faintfield")

# Wraps lines: messages in a frame would be cut off otherwise.
framed_console = Console(stderr=True, highlight=False, emoji=False)

# Off a terminal, seconds until the first line of what takes long, and from one line to the next: more of work that has
# taken long, by a share of its time.
_FIRST_LINE_S, _NEXT_LINE_S, _NEXT_LINE_SHARE = 2.0, 10.0, 0.1

# Reports of work under way, each part of the one before: one is silent while a part of it speaks for itself.
_reports: list["_Report"] = []

# What goes on within a step, the innermost last.
_stages: list[str] = []

# Labels of the bars that are drawn, and words that no log may hold.
_bars: list[str] = []
_secrets: set[str] = set()


def visible(text: str) -> str:
    r"""Return `text` with each character that cannot be seen as its escape, so that no name can forge or hide a line.

    >>> visible("name\n\x1b[2Kdone")
    'name\\n\\x1b[2Kdone'
    """
    return "".join(
        character if character.isprintable() else character.encode("unicode_escape").decode() for character in text
    )


def conceal(secret: str) -> None:
    """Keep a word out of the log from here on, wherever it is said."""
    _secrets.add(secret)


def without_secrets(text: str) -> str:
    """Return `text` with each concealed word replaced."""
    for secret in tuple(_secrets):
        text = text.replace(secret, "(concealed)")
    return text


def inform(text: str) -> None:
    """Print one line for people, and record it in the log if there is one."""
    line = visible(text)
    console.print(line, markup=False)
    logger.info(line)


def progress[T](
    items: Iterable[T],
    label: str,
    total: int | None = None,
    *,
    cost: Callable[[T], float] | None = None,
    total_cost: float | None = None,
) -> Generator[T]:
    """Yield `items`; draw a bar with the time left on a terminal, else say every 10 s or more how many are done.

    `total` is the number of items, if they have no length. Where items differ in what they cost, by a known `cost`, the
    time left follows from that and the `total_cost`.
    """
    report = _Report(label, len(items) if total is None and isinstance(items, Sized) else total, total_cost)
    # Redraw only on a terminal: the thread of a generator that its caller abandons would block the exit
    with _drawn(report) if console.is_terminal else _said_while(report):
        for item in items:
            yield item
            report.advance(cost(item) if cost else 1.0)


@contextmanager
def _drawn(report: "_Report") -> Iterator[None]:
    """Draw the bar of a report."""
    from rich import progress as parts  # help loads this module, and draws no bar
    from rich.table import Column

    class Label(parts.ProgressColumn):
        def render(self, task: parts.Task) -> Text:
            return Text(task.description, no_wrap=True, overflow="ellipsis")

    class State(parts.ProgressColumn):
        def render(self, task: parts.Task) -> Text:
            return Text(report.state(), no_wrap=True)

    # One line: where it is too long, the bar and the label are cut
    state = State(table_column=Column(no_wrap=True))
    columns = (Label(), parts.BarColumn(bar_width=None, table_column=Column(max_width=40)), state)
    with parts.Progress(*columns, console=console, transient=True) as bar:
        # A single step has no share that is done: its bar pulses
        task = bar.add_task(visible(report.label), total=None if report.total == 1 else report.total)
        report.on_advance = lambda: bar.advance(task)
        _bars.append(report.label)
        try:
            yield
        finally:
            _bars.remove(report.label)


@contextmanager
def working(label: str) -> Iterator[None]:
    """Say what is done while it takes long and nobody watches a bar: one long call, without steps to count."""
    if console.is_terminal:
        # Within a bar, which goes on, only one of the two could be drawn
        with nullcontext() if _bars else console.status(Text(visible(label))):
            yield
        return
    with _said_while(_Report(label)):
        yield


@contextmanager
def stage(name: str) -> Iterator[None]:
    """Name what goes on within a step, for the reports of the work that the step belongs to."""
    _stages.append(name)
    try:
        yield
    finally:
        _stages.pop()


@dataclass(eq=False)
class _Report:
    """Lines about work that takes long: after 2 s, then every 10 s or more, with the steps done if they count.

    `total_cost` is what all steps cost, by default one each.
    """

    label: str
    total: int | None = None
    total_cost: float | None = None
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self.spoke = False
        self.done = 0
        self.on_advance: Callable[[], object] = lambda: None
        self._started = self._advanced = self.clock()
        self._due = self._started + _FIRST_LINE_S
        self._cost_left = float(self.total or 0) if self.total_cost is None else self.total_cost
        self._cost_done = 0.0

    def advance(self, cost: float = 1.0) -> None:
        """Count one more step as done."""
        self._advanced = self.clock()
        self.done += 1
        self._cost_done += cost
        self._cost_left -= cost
        self.on_advance()

    def state(self) -> str:
        """Return the steps done, the time since the beginning, about how long the rest takes, and what goes on."""
        steps = "" if self.total in (None, 1) else f"{self.done} of {self.total}, "
        left_s = self.left_s()
        left = "" if left_s is None else f", about {duration_text(left_s)} to go"
        going_on = f" ({_stages[-1]})" if _stages else ""
        return f"{steps}{duration_text(self.clock() - self._started)}{left}{going_on}"

    def left_s(self) -> float | None:
        """Return about how long the remaining steps take, None before it can be known.

        While a step goes on, this falls by the time that passes, down to what the steps after it take.
        """
        if not self.total or not 0 < self.done < self.total:
            return None
        per_cost_s = (self._advanced - self._started) / self._cost_done
        left_s = per_cost_s * self._cost_left
        return left_s - min(self.clock() - self._advanced, left_s / (self.total - self.done))

    def wait_s(self) -> float:
        """Return the time until the next line."""
        return max(self._due - self.clock(), 0.0)

    def line(self) -> str | None:
        """Return the line that is due, if one is."""
        now = self.clock()
        if now < self._due:
            return None
        self._due = now + max(_NEXT_LINE_S, _NEXT_LINE_SHARE * (now - self._started))
        self.spoke = True
        return f"{self.label}: {self.state()}"


def duration_text(seconds: float) -> str:
    """Return a time in whole seconds, or in minutes if it is long."""
    return f"{seconds:.0f} s" if seconds < 120 else f"{seconds / 60:.0f} min"


@contextmanager
def _said_while(report: _Report) -> Iterator[None]:
    """Print the lines of a report from a thread, which a caller that never returns cannot keep from ending."""
    finished = threading.Event()

    def say() -> None:
        while not finished.wait(report.wait_s()):
            if (line := report.line()) is not None and not _parts_speak(report):
                inform(line)

    thread = threading.Thread(target=say, daemon=True, name="progress")
    _reports.append(report)
    thread.start()
    try:
        yield
    finally:
        finished.set()
        # The thread itself may close an abandoned generator: it ends after its line
        if thread is not threading.current_thread():
            thread.join()
        _reports.remove(report)


def _parts_speak(report: _Report) -> bool:
    parts = itertools.dropwhile(lambda other: other is not report, tuple(_reports))
    return any(part.spoke for part in parts if part is not report)
