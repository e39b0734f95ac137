"""Large arrays, worked on by strips of rows in threads: a strip stays in the cache, no copy of the whole is made.

Maps of large sensors may lie in files, so that memory holds only the strips that are worked on.
"""

import mmap
import operator
import os
import sys
from collections.abc import Callable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from contextvars import ContextVar
from functools import reduce
from typing import Any
from weakref import WeakSet

import numba
import numpy as np
from numpy.typing import DTypeLike, NDArray

# Numbers; quantity of every pixel (row, column); pixels (row, column) that are in use, or of one kind.
type Array = NDArray[np.float64]
type Map = NDArray[np.floating]
type Mask = NDArray[np.bool_]

# Pixels of a strip, and strips after which maps in files are taken out of memory.
_STRIP_PX, _RELEASE = 1 << 16, 32

# Pixels that tell a median or a quantile well enough where nothing but a start or a scale depends on it.
_ENOUGH_PX = 1 << 22


# Makes an uninitialised array, given its shape and dtype; one in a file is memory-mapped and shared.
type Allocate = Callable[[tuple[int, ...], DTypeLike], NDArray[Any]]

_allocate: ContextVar[Allocate] = ContextVar("allocate", default=np.empty)
_mapped: WeakSet[mmap.mmap] = WeakSet()

# Sums may be reordered, but infinities and NaN keep their meaning.
_OPTIONS: dict[str, Any] = {"error_model": "numpy", "fastmath": {"contract", "nsz", "arcp", "reassoc"}, "nogil": True}


def compiled(function: Any) -> Any:
    """Return a function that is compiled at its first call with new types, or found in numba's cache."""
    try:
        return numba.njit(cache=True, **_OPTIONS)(function)
    except RuntimeError:  # numba has no folder for its cache that can be written
        return numba.njit(**_OPTIONS)(function)


@contextmanager
def maps_by(allocate: Allocate) -> Iterator[None]:
    """Have the maps made by `allocate` while the block runs, instead of in memory."""
    token = _allocate.set(allocate)
    try:
        yield
    finally:
        _allocate.reset(token)


def new_map(shape: tuple[int, ...], dtype: DTypeLike = np.float32) -> NDArray[Any]:
    """Return an uninitialised map (row, column)."""
    made: Any = _allocate.get()(shape, dtype)
    holder = made
    while holder is not None:
        if isinstance(holder, mmap.mmap):
            _mapped.add(holder)
        holder = getattr(holder, "base", None)
    return np.asarray(made)


def release() -> None:
    """Take out of memory what the files of all maps hold; it is read again when it is needed.

    On Windows this is left to the system, which takes it when memory is short.
    """
    if sys.platform == "win32":
        return
    for mapping in list(_mapped):
        mapping.madvise(mmap.MADV_DONTNEED)


def usable_cores() -> int:
    """Return the number of processor cores that this process may use."""
    if sys.platform == "linux":
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1


def over_strips[T](work: Callable[[slice], T], shape: tuple[int, ...], parts: int | None = None) -> list[T]:
    """Return the results of `work` for the strips of an array (row, column), first to last.

    Parameters
    ----------
    work : callable
        Takes the rows of a strip; must not write outside of them.
    shape : tuple of int
        Rows and columns of the array.
    parts : int, optional
        Number of strips, at most; without it they are small.
    """
    step = max(_STRIP_PX // max(shape[1], 1), 1) if parts is None else -(-shape[0] // parts)
    strips = [slice(first, min(first + step, shape[0])) for first in range(0, shape[0], step)]
    if len(strips) == 1:
        return [work(strips[0])]
    results: list[T] = []
    with ThreadPoolExecutor(usable_cores()) as pool:
        for first in range(0, len(strips), _RELEASE):
            results += pool.map(work, strips[first : first + _RELEASE])
            release()
    return results


def map_of(
    work: Callable[[slice], NDArray[Any]], shape: tuple[int, ...], dtype: DTypeLike = np.float32
) -> NDArray[Any]:
    """Return a map (row, column) of what `work` returns for the rows of each strip."""
    return maps_of(lambda rows: (work(rows),), shape, (dtype,))[0]


def maps_of(
    work: Callable[[slice], tuple[NDArray[Any], ...]], shape: tuple[int, ...], dtypes: tuple[DTypeLike, ...]
) -> tuple[NDArray[Any], ...]:
    """Return several maps (row, column) of what `work` returns for the rows of each strip."""
    maps = tuple(new_map(shape, dtype) for dtype in dtypes)

    def fill(rows: slice) -> None:
        for target, values in zip(maps, work(rows), strict=True):
            target[rows] = values

    over_strips(fill, shape)
    return maps


def total_of[T](work: Callable[[slice], T], shape: tuple[int, ...], parts: int | None = None) -> T:
    """Return the sum, from the first strip to the last, of what `work` returns for the rows of each."""
    return reduce(operator.add, over_strips(work, shape, parts))


def thinned(values: Map, usable: Mask, scale: Callable[[slice], NDArray[Any]] | None = None) -> Map:
    """Return the values of usable pixels (pixel,), over their scale if given; of large arrays those of some rows."""
    every = max(values.size // _ENOUGH_PX, 1) | 1  # odd, so that even and odd rows have their share

    def work(rows: slice) -> Map:
        some = slice(-rows.start % every, None, every)
        chosen = values[rows][some] if scale is None else values[rows][some] / scale(rows)[some]
        return np.asarray(chosen[usable[rows][some]])

    return np.concatenate(over_strips(work, values.shape))


def mean_over(values_of: Callable[[slice], NDArray[Any]], usable: Mask) -> float:
    """Return the mean over the usable pixels of what a function returns for the rows of each strip."""

    def work(rows: slice) -> float:
        return float(values_of(rows).sum(where=usable[rows], dtype=np.float64))

    return total_of(work, usable.shape) / float(usable.sum())


def variance_over(values_of: Callable[[slice], NDArray[Any]], usable: Mask) -> float:
    """Return the variance over the usable pixels, likewise."""
    mean = mean_over(values_of, usable)
    return mean_over(lambda rows: np.square(values_of(rows) - mean), usable)
