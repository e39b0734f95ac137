"""Threads that are kept between calls: starting one takes as long as a step on a small plane."""

from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor, wait
from functools import cache
from multiprocessing.util import register_after_fork


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "recon")


# A forked process inherits the pools, but not their threads
register_after_fork(_pool, lambda pools: pools.cache_clear())


def run_in_threads[Part, Result](work: Callable[[Part], Result], parts: Sequence[Part]) -> list[Result]:
    """Call `work` on all parts in parallel, on the first in the caller's own thread; return the results in order.

    `work` must not call this function: it would wait for threads that wait for it.
    """
    if len(parts) == 1:
        return [work(parts[0])]
    others = [_pool(len(parts) - 1).submit(work, part) for part in parts[1:]]
    try:
        first = work(parts[0])
    finally:
        wait(others)  # no thread may still be writing when an interrupt is handled
    return [first, *(other.result() for other in others)]
