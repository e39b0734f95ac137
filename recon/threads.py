"""Threads that are kept between calls: starting one takes as long as a step on a small plane.

What a thread of this module calls does not take further ones: functions of this module do its work one by one.
"""

import sys
from collections import deque
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor, wait
from functools import cache
from itertools import pairwise
from multiprocessing.util import register_after_fork
from threading import Lock, local
from typing import Any

import numpy as np
from numpy.typing import NDArray
from threadpoolctl import ThreadpoolController

# Elements of the parts of large arrays: several of them stay in the cache of a core.
_PART = 2**15

_of_thread = local()


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
    """Call `work` on all parts in parallel, on the first in the caller's own thread; return the results in order."""
    if len(parts) == 1 or _is_busy():
        return [work(part) for part in parts]
    others = [_pool(len(parts) - 1).submit(_busily, work, part) for part in parts[1:]]
    try:
        first = _busily(work, parts[0])
    finally:
        wait(others)  # no thread may still be writing when an interrupt is handled
    return [first, *(other.result() for other in others)]


def map_in_threads[Item, Result](work: Callable[[Item], Result], items: Sequence[Item]) -> list[Result]:
    """Call `work` on each item, in as many threads as numba takes; return the results in order.

    BLAS takes one thread meanwhile: many times as many threads as cores would wait for one another.
    No more items than threads are worked on at a time. After a failure or an interrupt no further item is begun, and no
    thread is left working. Of several failures, that of the first item is raised.
    """
    if _is_busy():
        return [work(item) for item in items]
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
                results[index] = _busily(work, item)
            except Exception as failure:
                failures[index] = failure

    count = min(_threads(), len(items)) - 1
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


def elementwise[Number: np.generic](
    function: Callable[..., NDArray[Any]],
    first: NDArray[Number],
    *more: NDArray[Any],
    out: NDArray[Number] | None = None,
) -> NDArray[Number]:
    """Return an elementwise function of arrays of one shape, computed part by part, in threads.

    The function's temporaries stay in the cache. The result has the type of the first array.
    """
    result = np.empty_like(first) if out is None else out

    def work(part: slice) -> None:
        result[part] = function(*(array[part] for array in (first, *more)))

    _on_parts(work, first)
    return result


def summed(function: Callable[..., Any], *arrays: NDArray[Any]) -> Any:
    """Return the sum of what a function returns for the parts of arrays of one length, computed in threads."""
    return sum(_on_parts(lambda part: function(*(array[part] for array in arrays)), arrays[0]))


def _on_parts[Result](work: Callable[[slice], Result], array: NDArray[Any]) -> list[Result]:
    """Call `work` on slices of the first axis of an array, in threads; return the results in order."""
    length = len(array)
    step = max(_PART * length // max(array.size, 1), 1)
    parts = [slice(first, first + step) for first in range(0, length, step)]
    workers = max(min(_threads(), len(parts)), 1)
    found = run_in_threads(lambda worker: [work(part) for part in parts[worker::workers]], range(workers))
    return [found[number % workers][number // workers] for number in range(len(parts))]


def strips(array: NDArray[Any]) -> list[tuple[int, int]]:
    """Return the first and the past-the-last row of strips of an array: one for each thread if it is large."""
    count = max(min(_threads(), array.size // (2 * _PART), len(array)), 1)
    return list(pairwise(strip * len(array) // count for strip in range(count + 1)))


def _threads() -> int:
    from numba import config  # slow to load

    return int(config.NUMBA_NUM_THREADS)


def _is_busy() -> bool:
    """Return whether this thread works for one of the functions of this module."""
    return getattr(_of_thread, "busy", False)


def _busily[Part, Result](work: Callable[[Part], Result], part: Part) -> Result:
    _of_thread.busy = True
    try:
        return work(part)
    finally:
        _of_thread.busy = False
