"""Two plugins of pytest: one notes which lines each test runs, the other runs some tests in a given order."""

import json
import sys
import time
from collections.abc import Iterator
from pathlib import Path
from types import CodeType
from typing import Any

import pytest
from numba.core import event

_OPTIMIZED = 0x1  # the flag of functions' code: that of modules and classes runs once, in whichever test comes first
_TOOL = sys.monitoring.COVERAGE_ID


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
        self._clear_caches()
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

    def _clear_caches(self) -> None:
        """Empty the caches of functions: what another test has computed, this one would not run."""
        for module in list(sys.modules.values()):
            if str(getattr(module, "__file__", None)).startswith(str(self._tree)):
                for value in list(vars(module).values()):
                    getattr(value, "cache_clear", int)()

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
