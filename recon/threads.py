"""Threads that are kept between calls: starting one takes as long as a step on a small plane."""

import sys
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from multiprocessing.util import register_after_fork
from threading import Lock

from threadpoolctl import ThreadpoolController


@cache
def _pool(threads: int) -> ThreadPoolExecutor:
    return ThreadPoolExecutor(threads, "recon")


class _OneBlasThread:
    """A context in which BLAS takes one thread; the last of several that overlap ends it."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget all users, as a forked process has to."""
        self._lock, self._users, self._modules = Lock(), 0, 0

    def __enter__(self) -> None:
        with self._lock:
            if self._users == 0:
                # A new module may have brought a BLAS, and finding it takes milliseconds
                if self._modules != len(sys.modules):
                    self._modules, self._controller = len(sys.modules), ThreadpoolController()
                self._limit = self._controller.limit(limits=1, user_api="blas")
            self._users += 1

    def __exit__(self, *_: object) -> None:
        with self._lock:
            self._users -= 1
            if self._users == 0:
                self._limit.restore_original_limits()


_one_blas_thread = _OneBlasThread()


# A forked process inherits the pools, but not their threads
register_after_fork(_pool, lambda pools: pools.cache_clear())
register_after_fork(_one_blas_thread, lambda context: context.reset())


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


def map_in_threads[Item, Result](work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Call `work` on each item, in as many threads as numba takes; return the results in order.

    BLAS takes one thread meanwhile: many times as many threads as cores would wait for one another.
    No more items than threads are worked on at a time. After a failure or an interrupt no further item is begun, and no
    thread is left working. Of several failures, that of the first item is raised.

    `work` must not call the functions of this module: it would wait for threads that wait for it.
    """
    from numba import config  # slow to load

    results: dict[int, Result] = {}
    failures: dict[int, Exception] = {}
    left = deque(enumerate(items))

    def take() -> None:
        while left and not failures:
            try:
                index, item = left.popleft()
            except IndexError:  # another thread took the last
                return
            try:
                results[index] = work(item)
            except Exception as failure:
                failures[index] = failure

    count = min(int(config.NUMBA_NUM_THREADS), len(items)) - 1
    others: list[Future[None]] = []
    try:
        with _one_blas_thread:
            others.extend(_pool(count).submit(take) for _ in range(count))
            take()
            wait(others)
    except BaseException:
        left.clear()
        wait(others)  # no thread may still be writing when an interrupt is handled
        raise
    if failures:
        raise failures[min(failures)]
    for other in others:
        other.result()  # of what is not a failure, such as an exit
    return [results[index] for index in range(len(items))]
