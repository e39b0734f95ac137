"""Messages and progress bars, always on standard error; standard output is for results only."""

import itertools
import logging
import threading
import time
from collections.abc import Callable, Generator, Iterable, Iterator, Sized
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rich.console import Console
from rich.text import Text

if TYPE_CHECKING:
    from rich.progress import Progress

console = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)

logger = logging.getLogger("faintfield")

# Wraps lines: messages in a frame would be cut off otherwise.
framed_console = Console(stderr=True, highlight=False, emoji=False)

# Off a terminal, seconds until the first line of what takes long, and from one line to the next.
_FIRST_LINE_S, _NEXT_LINE_S = 2.0, 10.0

# Reports of work under way, each part of the one before: one is silent while a part of it speaks for itself.
_reports: list["_Report"] = []

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


def progress[T](items: Iterable[T], label: str, total: int | None = None) -> Generator[T]:
    """Yield `items`; draw a bar with the time left on a terminal, else say every 10 s how many are done.

    `total` is the number of items, if they have no length.
    """
    # Redraw only on a terminal: the thread of a generator that its caller abandons would block the exit
    if not console.is_terminal:
        report = _Report(label, len(items) if total is None and isinstance(items, Sized) else total)
        with _said_while(report):
            for item in items:
                yield item
                report.done += 1
        return
    with _bar() as bar:
        _bars.append(label)
        try:
            yield from bar.track(items, description=visible(label), total=total)
        finally:
            _bars.remove(label)


def _bar() -> "Progress":
    from rich import progress as parts  # help loads this module, and draws no bar

    columns = (
        parts.TextColumn("{task.description}", markup=False),
        *(parts.BarColumn(), parts.MofNCompleteColumn(), parts.TimeElapsedColumn()),
        *(parts.TextColumn("to go"), parts.TimeRemainingColumn()),
    )
    return parts.Progress(*columns, console=console, transient=True)


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


@dataclass(eq=False)
class _Report:
    """Lines about work that takes long: the first after 2 s, then one every 10 s, with the steps done if they count."""

    label: str
    total: int | None = None
    done: int = 0
    clock: Callable[[], float] = time.monotonic

    def __post_init__(self) -> None:
        self.spoke = False
        self._started = self.clock()
        self._due = self._started + _FIRST_LINE_S

    def wait_s(self) -> float:
        """Return the time until the next line."""
        return max(self._due - self.clock(), 0.0)

    def line(self) -> str | None:
        """Return the line that is due, if one is."""
        now = self.clock()
        if now < self._due:
            return None
        self._due = now + _NEXT_LINE_S
        self.spoke = True
        passed_s = now - self._started
        steps = "" if self.total is None else f"{self.done} of {self.total}, "
        left = ""
        if self.total and self.done:
            left = f", about {_duration(passed_s * (self.total - self.done) / self.done)} to go"
        return f"{self.label}: {steps}{_duration(passed_s)}{left}"


def _duration(seconds: float) -> str:
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
