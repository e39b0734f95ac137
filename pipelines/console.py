"""Words and progress for people, always on standard error; standard output is for results alone."""

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

# A message in a frame needs its lines broken, or the frame cuts them off.
framed_console = Console(stderr=True, highlight=False, emoji=False)


def inform(text: str) -> None:
    """Print one line of human words, and record it where a log is kept."""
    console.print(text, markup=False)
    logger.info(text)


def progress[T](items: Iterable[T], label: str, total: int | None = None) -> Generator[T]:
    """Yield `items`, drawing a bar with a time to go on a terminal and nothing elsewhere.

    Parameters
    ----------
    items : iterable
        What to go through; the bar advances as each is taken.
    label : str
        What is being done, in a few words.
    total : int, optional
        How many items there are, when `items` has no length.
    """
    columns = (
        TextColumn("{task.description}"),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TextColumn("to go"),
        TimeRemainingColumn(),
    )
    # Only a terminal gets the thread that redraws: one that a caller leaves behind could not be joined at exit
    drawn = console.is_terminal
    with Progress(*columns, console=console, transient=True, disable=not drawn, auto_refresh=drawn) as bar:
        yield from bar.track(items, description=label, total=total)
