"""Callbacks that run before kernels are compiled; importing this loads no compiler."""

from collections.abc import Callable

# Called before the first kernel of a process is compiled, which takes seconds; not if numba's cache holds all of them.
on_compiling: list[Callable[[], object]] = []
