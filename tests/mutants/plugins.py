"""Plugins of pytest: one notes which lines each test runs, two run some tests against a mutant."""

import importlib
import json
import os
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from functools import partial
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FunctionType
from typing import Any, Literal, NamedTuple

import pytest
from numba.core import event

from tests.mutants.changes import Mutant, mutated
from tests.mutants.processes import Processes, use_temporary_folder

type Verdict = Literal["killed", "timed out", "survived", "not run by any test"]
type Keep = Callable[[Mutant, Verdict, str], None]

_OPTIMIZED = 0x1  # the flag of functions' code: that of modules and classes runs once, in whichever test comes first
_TOOL = sys.monitoring.COVERAGE_ID
_NOT_IN_MEMORY = 71


class Task(NamedTuple):
    """A mutant, the tests that may find it, in order, and the CPU seconds after which it counts as hung."""

    mutant: Mutant
    tests: list[str]
    limit_s: float


def clear_caches(tree: Path) -> None:
    """Empty the caches of functions: what another test has computed, this one would not run."""
    for module in list(sys.modules.values()):
        if str(getattr(module, "__file__", None)).startswith(str(tree)):
            for value in list(vars(module).values()):
                getattr(value, "cache_clear", int)()


def verdict(status: int, hung: bool, failed: Path) -> tuple[Verdict, str]:
    """Return a verdict from how a process ended, and the test that failed."""
    by = failed.read_text() if failed.exists() else ""
    return "timed out" if hung else "killed" if status else "survived", by


class Recorder:
    """Notes the lines of the packages that each test runs, and the CPU time that it needs (s), compilation apart.

    Lines that a shared fixture runs count for every test that uses the fixture. Compiled functions have no lines.

    Parameters
    ----------
    tree : Path
        Top of the repository.
    out : Path
        File that gets, for each test that passes, its seconds and its lines by file.
    """

    def __init__(self, tree: Path, out: Path) -> None:
        self._tree, self._out = tree.resolve(), out
        self._files: dict[str, str | None] = {}
        self._lines: set[tuple[str, int]] = set()
        self._fixtures: dict[int, set[tuple[str, int]]] = {}
        self._failed: set[str] = set()
        self.tests: dict[str, dict[str, Any]] = {}

    def pytest_sessionstart(self) -> None:
        sys.monitoring.use_tool_id(_TOOL, "mutants")
        sys.monitoring.register_callback(_TOOL, sys.monitoring.events.LINE, self._line)
        sys.monitoring.set_events(_TOOL, sys.monitoring.events.LINE)

    def _line(self, code: CodeType, line: int) -> object:
        name = code.co_filename
        if name not in self._files:
            path = Path(name).resolve()
            self._files[name] = path.relative_to(self._tree).as_posix() if path.is_relative_to(self._tree) else None
        file = self._files[name]
        if file and code.co_flags & _OPTIMIZED:
            self._lines.add((file, line))
        return sys.monitoring.DISABLE

    @pytest.hookimpl(wrapper=True)
    def pytest_fixture_setup(self, fixturedef: pytest.FixtureDef[Any]) -> Iterator[Any]:
        if fixturedef.scope == "function":
            return (yield)
        outer, self._lines = self._lines, set()
        sys.monitoring.restart_events()
        try:
            return (yield)
        finally:
            self._fixtures.setdefault(id(fixturedef), set()).update(self._lines)
            self._lines = outer
            sys.monitoring.restart_events()

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Function) -> Iterator[Any]:
        self._lines = set()
        clear_caches(self._tree)
        sys.monitoring.restart_events()
        begin = time.process_time()
        with event.install_timer("numba:compile", lambda _: None) as compiling:
            result = yield
        seconds = time.process_time() - begin - (compiling.duration if compiling.done else 0.0)
        for definitions in item._fixtureinfo.name2fixturedefs.values():  # noqa: SLF001 - nothing public names them
            self._lines.update(*(self._fixtures.get(id(definition), ()) for definition in definitions))
        files: dict[str, list[int]] = {}
        for file, line in sorted(self._lines):
            files.setdefault(file, []).append(line)
        self.tests[item.nodeid] = {"seconds": max(seconds, 0.001), "lines": files}
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if not report.passed:
            self._failed.add(report.nodeid)

    def pytest_sessionfinish(self) -> None:
        sys.monitoring.free_tool_id(_TOOL)
        passed = {name: test for name, test in self.tests.items() if name not in self._failed}
        self._out.write_text(json.dumps(passed))


class Selection:
    """Runs the given tests in their order, and keeps the name of the one that failed.

    Parameters
    ----------
    tests : list of str
        Names of tests.
    out : Path
        File that gets the name of the failed test.
    """

    def __init__(self, tests: list[str], out: Path) -> None:
        self._order = {name: number for number, name in enumerate(tests)}
        self._out = out

    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = sorted((item for item in items if item.nodeid in self._order), key=lambda it: self._order[it.nodeid])

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._out.write_text(report.nodeid)


class InPlace:
    """Collects tests once, and then runs some against each mutant, in a process forked for it.

    The change is made in memory: the function gets the code that the changed file has for it. That saves the seconds
    for imports and collection.

    Parameters
    ----------
    tasks : list of Task
        Mutants of Python functions, with tests.
    jobs : int
        Most processes at a time.
    keep : callable
        Takes the verdicts.
    done : Path
        File that gets the names of the judged mutants; those are missing whose functions cannot be changed in memory.
    """

    def __init__(self, tasks: list[Task], jobs: int, keep: Keep, done: Path) -> None:
        self._tasks, self._keep, self._done = {task.mutant.name: task for task in tasks}, keep, done
        self._jobs = jobs
        self._judged: list[str] = []
        self._failed = Path()

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        clear_caches(Path.cwd())
        items = {item.nodeid: item for item in session.items}
        processes = Processes(self._jobs)
        for task in self._tasks.values():
            processes.start(task.mutant.name, partial(self._run, task, items), 2 + task.limit_s)
            for ended in processes.ended(wait_for_all=False):
                self._conclude(*ended)
        for ended in processes.ended():
            self._conclude(*ended)
        self._done.write_text(json.dumps(self._judged))
        return True

    def _run(self, task: Task, items: dict[str, pytest.Item]) -> int:
        """Run the tests of a mutant until one fails, in a process of its own."""
        use_temporary_folder(self._place(task.mutant.name))
        self._failed = self._place(task.mutant.name) / "failed"
        if not change_in_memory(task.mutant):
            return _NOT_IN_MEMORY
        chosen = [items[name] for name in task.tests if name in items]
        for item, following in zip_longest(chosen, chosen[1:]):
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following)
            if item.session.testsfailed:
                return 1
        return 0

    def _place(self, name: str) -> Path:
        """Return the temporary folder for a mutant."""
        return self._done.parent / f"temporary-{list(self._tasks).index(name)}"

    def _conclude(self, name: str, status: int, hung: bool) -> None:
        """Pass a verdict on."""
        if os.waitstatus_to_exitcode(status) != _NOT_IN_MEMORY:
            self._judged.append(name)
            self._keep(self._tasks[name].mutant, *verdict(status, hung, self._place(name) / "failed"))
        shutil.rmtree(self._place(name), ignore_errors=True)

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed.write_text(report.nodeid)


def change_in_memory(mutant: Mutant) -> bool:
    """Give the function of a mutant its changed code; return False if that cannot be done."""
    module = importlib.import_module(f"faintfield.{mutant.file.removesuffix('.py').replace('/', '.')}")
    file = str(module.__file__)
    code = compile(mutated(Path(file).read_text(), mutant.place), file, "exec")
    holder: object = module
    for depth, name in enumerate(mutant.function, start=1):
        holder = vars(holder).get(name)
        for wrapped in ("fget", "func", "__func__", "__wrapped__"):
            holder = getattr(holder, wrapped, holder)
        if isinstance(holder, FunctionType):
            changed = next((it for it in _codes(code) if it.co_qualname == ".".join(mutant.function[:depth])), None)
            if changed is None or changed.co_freevars != holder.__code__.co_freevars:
                return False
            holder.__code__ = changed
            return True
        if not isinstance(holder, type):
            return False
    return False


def _codes(code: CodeType) -> Iterator[CodeType]:
    """Yield a code object and all within it."""
    yield code
    for constant in code.co_consts:
        if isinstance(constant, CodeType):
            yield from _codes(constant)
