"""Forked processes that end by themselves or are ended: a wrong change may hang, crash or take all memory."""

import contextlib
import os
import resource
import signal
import sys
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

_MEMORY_BYTES = 8 << 30
_PYTEST = "-q -p no:randomly -p no:xdist -p no:cacheprovider --assert=plain -o timeout=0".split()
# The status of a process whose action raised, or whose tests were not those of the tree.
_BROKEN = 70


class Processes:
    """Runs functions in forked processes, a few at a time.

    Parameters
    ----------
    jobs : int
        Most processes at a time.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._running: dict[int, tuple[str, float]] = {}
        self._done: list[tuple[str, int, bool]] = []

    def start(self, name: str, action: Callable[[], int], cpu_s: float) -> None:
        """Start a function that returns an exit status, once fewer than `jobs` processes run."""
        while len(self._running) >= self._jobs:
            self._reap()
        sys.stdout.flush()
        pid = os.fork()
        if not pid:
            _run(action, cpu_s)
        # Other work on the machine slows a process down but costs it no CPU time
        self._running[pid] = name, time.monotonic() + 8 * cpu_s + 120

    def ended(self, wait_for_all: bool = True) -> Iterator[tuple[str, int, bool]]:
        """Yield name, exit status, and whether it was stopped, of every process that has ended."""
        while wait_for_all and self._running:
            self._reap()
            yield from self._taken()
        yield from self._taken()

    def _taken(self) -> list[tuple[str, int, bool]]:
        done, self._done = self._done, []
        return done

    def _reap(self) -> None:
        """Wait a little for processes to end, and end those that hang, with all that they started."""
        time.sleep(0.01)
        for pid, (name, end) in list(self._running.items()):
            hung = time.monotonic() > end
            if hung:
                os.kill(pid, signal.SIGKILL)
            gone, status = os.waitpid(pid, 0 if hung else os.WNOHANG)
            if gone:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(pid, signal.SIGKILL)
                del self._running[pid]
                by_limit = os.WIFSIGNALED(status) and os.WTERMSIG(status) == signal.SIGXCPU
                self._done.append((name, status, hung or by_limit))


def _run(action: Callable[[], int], cpu_s: float) -> None:
    """Run a function within limits, and end this process with its status."""
    status = _BROKEN
    try:
        os.setsid()
        _, most = resource.getrlimit(resource.RLIMIT_CPU)
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s), most))
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
        status = action()
    finally:
        os._exit(status)


def run_pytest(tree: Path, arguments: list[str], make_plugin: Callable[[], object]) -> int:
    """Run tests of a tree with a plugin in this process, and return pytest's status."""
    os.chdir(tree)
    output = os.open(f"output-{os.getpid()}", os.O_WRONLY | os.O_CREAT)
    for stream in (1, 2):
        os.dup2(output, stream)
    os.environ["PYTHONPATH"] = str(tree)
    root = str(Path(__file__).parents[2])
    sys.path[:] = [str(tree), *(entry for entry in sys.path if entry not in ("", root))]
    plugin = make_plugin()
    for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
        del sys.modules[name]
    use_temporary_folder(tree / f"temporary-{os.getpid()}")
    status = pytest.main([*_PYTEST, *arguments], plugins=[plugin])
    if not str(sys.modules["faintfield"].__file__).startswith(str(tree)):
        return _BROKEN
    return int(status)


def use_temporary_folder(folder: Path) -> None:
    """Make a folder, and have what tests write go there."""
    folder.mkdir()
    os.environ["PYTEST_DEBUG_TEMPROOT"] = os.environ["TMPDIR"] = str(folder)
