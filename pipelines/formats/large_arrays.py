"""Arrays that are too large for memory: memory-mapped files."""

import os
import re
import sys
import tempfile
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from shutil import disk_usage
from typing import IO, Any

import numpy as np
import psutil
from numpy.typing import DTypeLike, NDArray

from faintfield.pipelines.errors import CannotWrite, DiskFull
from faintfield.pipelines.formats.files import translated_write_errors

# Makes an uninitialised array, given its shape and dtype.
type Allocate = Callable[[tuple[int, ...], DTypeLike], NDArray[Any]]

# Share of the free memory that one array may take; the rest is for planes, other programs, and other arrays.
SHARE_OF_MEMORY = 0.5

# Arrays below are kept in memory by `maps_in_files`, whose files take at most a share of the free disk: results follow.
_MIN_FILE_BYTES, _SHARE_OF_DISK = 2_000_000, 0.5

# Bytes written at a time to allocate a file.
_BLOCK_BYTES = 1 << 22

_PROC, _CGROUPS = Path("/proc"), Path("/sys/fs/cgroup")


def memory_or_file(folder: Path) -> Allocate:
    """Return a function that makes arrays in memory, or in a file in `folder` if they exceed half of the free memory.

    The file has no name: it disappears with the array, however the process ends.
    """

    def allocate(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        if _bytes(shape, dtype) <= SHARE_OF_MEMORY * available_bytes():
            return np.empty(shape, dtype)
        with translated_write_errors(folder):
            return _in_nameless_file(folder, shape, dtype)

    return allocate


def maps_in_files(folder: Path) -> Allocate:
    """Return a function that makes large arrays in files in `folder`, small ones, and what finds no room, in memory.

    The files have no names, as those of `memory_or_file`, and take at most half of the free disk.
    """
    left_bytes: list[float] = []

    def allocate(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        if _bytes(shape, dtype) >= _MIN_FILE_BYTES:
            with suppress(DiskFull, CannotWrite), translated_write_errors(folder):
                folder.mkdir(parents=True, exist_ok=True)
                free_bytes = disk_usage(folder).free
                left_bytes[:] = left_bytes or [(1 - _SHARE_OF_DISK) * free_bytes]
                if free_bytes - _bytes(shape, dtype) >= left_bytes[0]:
                    return _in_nameless_file(folder, shape, dtype)
        return np.empty(shape, dtype)

    return allocate


def _in_nameless_file(folder: Path, shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    folder.mkdir(parents=True, exist_ok=True)
    with tempfile.TemporaryFile(dir=folder) as file:
        return mapped(file, shape, dtype)


def mapped(file: IO[bytes], shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
    """Return an array in a new file, which may be closed, and even removed.

    Its space is allocated at once: if the disk filled up later, the process would be killed without a message.
    """
    _allocate(file, _bytes(shape, dtype))
    return np.asarray(np.memmap(file, dtype, "r+", shape=shape))


def _allocate(file: IO[bytes], size: int) -> None:
    """Allocate the space of a new file; where the system has no call for that, by writing zeros."""
    if sys.platform == "linux":
        os.posix_fallocate(file.fileno(), 0, size)
        return
    for start in range(0, size, _BLOCK_BYTES):
        file.write(bytes(min(_BLOCK_BYTES, size - start)))
    file.flush()


def available_bytes() -> int:
    """Return the memory that this process can take: the free memory, within the limits of its control groups.

    Only Linux has control groups.
    """
    group = re.search(r"^0::/(.*)$", _read(_PROC / "self" / "cgroup"), re.MULTILINE)
    own = _CGROUPS / (group[1] if group else "")
    groups = [folder for folder in (own, *own.parents) if folder.is_relative_to(_CGROUPS)]
    return min(int(psutil.virtual_memory().available), *(_left_of_group(folder) for folder in groups))


def _left_of_group(folder: Path) -> int:
    """Return the memory that a control group leaves to its processes; its file cache counts as free."""
    limit = _read(folder / "memory.max").strip()
    if not limit.isdigit():
        return 1 << 62
    taken = re.search(r"^anon (\d+)$", _read(folder / "memory.stat"), re.MULTILINE)
    return int(limit) - (int(taken[1]) if taken else 0)


def _read(path: Path) -> str:
    try:
        return path.read_text("utf-8")
    except OSError:  # no such file: no such limit
        return ""


def _bytes(shape: tuple[int, ...], dtype: DTypeLike) -> int:
    return int(np.prod(shape, dtype=np.int64)) * np.dtype(dtype).itemsize
