"""Messages and progress bars, always on standard error; standard output is for results only."""

import logging
from collections.abc import Generator, Iterable

from rich.console import Console
from rich.progress import (
    BarColumn,
    MofNCompleteColumn,
    Progress,
    TextColumn,
    TimeElapsedColumn,
    TimeRemainingColumn,
)

console = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)

logger = logging.getLogger("faintfield")

# Wraps lines: messages in a frame would be cut off otherwise.
framed_console = Console(stderr=True, highlight=False, emoji=False)


# Words that no log may hold.
_secrets: set[str] = set()


def visible(text: str) -> str:
    r"""Return `text` with each character that cannot be seen as its escape, so that no name can forge or hide a line.

    >>> visible("name\n\x1b[2Kdone")
    'name\\n\\x1b[2Kdone'
    """
    return "".join(it if it.isprintable() else it.encode("unicode_escape").decode() for it in text)


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
    """Yield `items`; on a terminal, draw a bar with the time left.

    Parameters
    ----------
    items : iterable
        The bar advances as each item is taken.
    label : str
        The work in a few words.
    total : int, optional
        The number of items, if `items` has no length.
    """
    columns = (
        TextColumn("{task.description}", markup=False),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("to go"),
        TimeRemainingColumn(),
    )
    # Redraw only on a terminal: the thread of a generator that its caller abandons would block the exit
    drawn = console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=not drawn, auto_refresh=drawn) as bar:
        yield from bar.track(items, description=visible(label), total=total)
