"""Work on large arrays by strips of rows, in threads: a strip stays in the cache, and no copy of the whole is made."""

import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor

# Pixels of a strip.
_STRIP_PX = 1 << 16


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    return len(os.sched_getaffinity(0))


def over_strips[T](work: Callable[[slice], T], shape: tuple[int, ...]) -> list[T]:
    """Return the results of `work` for the strips of an array (row, column), first to last.

    Parameters
    ----------
    work : callable
        Takes the rows of a strip; must not write outside of them.
    shape : tuple of int
        Rows and columns of the array.
    """
    step = max(_STRIP_PX // max(shape[1], 1), 1)
    strips = [slice(first, min(first + step, shape[0])) for first in range(0, shape[0], step)]
    if len(strips) == 1:
        return [work(strips[0])]
    with ThreadPoolExecutor(usable_cores()) as pool:
        return list(pool.map(work, strips))
