"""Storage for maps of large sensors: in files, so that memory holds only the strips that are worked on."""

import mmap
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from typing import Any
from weakref import WeakSet

import numpy as np
from numpy.typing import DTypeLike, NDArray

# Makes an uninitialised array, given its shape and dtype; one in a file is memory-mapped and shared.
type Allocate = Callable[[tuple[int, ...], DTypeLike], NDArray[Any]]

_allocate: ContextVar[Allocate] = ContextVar("allocate", default=np.empty)
_mapped: WeakSet[mmap.mmap] = WeakSet()


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
    """Take out of memory what the files of all maps hold; it is read again when it is needed."""
    for mapping in list(_mapped):
        mapping.madvise(mmap.MADV_DONTNEED)
