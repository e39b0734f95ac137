"""Plugin of pytest: writes which lines of functions the tests run, and their CPU time, to the file $MUTANTS_LINES.

Compiled functions run no lines.
"""

import json
import os
import sys
from pathlib import Path
from types import CodeType

import pytest

_IN_FUNCTION = 0x1  # CO_OPTIMIZED: code of modules and classes runs at import
_ROOT = Path(__file__).resolve().parents[2]
_paths: dict[str, str] = {}
_lines: dict[str, set[int]] = {}
_begin_s: list[float] = []


def _add_line(code: CodeType, line: int) -> object:
    if code.co_flags & _IN_FUNCTION:
        name = code.co_filename
        if name not in _paths:
            path = Path(name).resolve()
            _paths[name] = path.relative_to(_ROOT).as_posix() if path.is_relative_to(_ROOT) else ""
        _lines.setdefault(_paths[name], set()).add(line)
    return sys.monitoring.DISABLE


def pytest_configure() -> None:
    sys.monitoring.use_tool_id(sys.monitoring.COVERAGE_ID, "mutants")
    sys.monitoring.register_callback(sys.monitoring.COVERAGE_ID, sys.monitoring.events.LINE, _add_line)
    sys.monitoring.set_events(sys.monitoring.COVERAGE_ID, sys.monitoring.events.LINE)


def pytest_collection_finish() -> None:
    _begin_s.append(sum(os.times()[:4]))


def pytest_sessionfinish(session: pytest.Session) -> None:
    if session.testscollected and not session.testsfailed:
        lines = {path: sorted(_lines[path]) for path in sorted(_lines) if path}
        record = {"seconds": sum(os.times()[:4]) - _begin_s[0], "lines": lines}
        Path(os.environ["MUTANTS_LINES"]).write_text(json.dumps(record))
