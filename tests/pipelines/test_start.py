"""How commands start: what `--version` and help load, and that compiling kernels is not done in silence."""

import os
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from cyclopts import App

from faintfield.pipelines.launcher import app

# What commands compute, draw, read and serve with.
HEAVY = {
    *("numpy", "scipy", "numba", "llvmlite", "cv2", "casadi", "mrcal", "skimage", "matplotlib", "PIL", "jinja2"),
    *("tifffile", "rawpy", "exifread", "tomli_w", "sqlite3", "serial", "uvicorn", "starlette", "asyncio", "napari"),
    *("zarr", "distributed", "multiprocessing", "rich.progress"),
}

# Prints the exit code of some words, and the modules that they load, to standard error.
_LOADED = """
import sys
before = set(sys.modules)
from faintfield.pipelines.cli import run
code = run(sys.argv[1:])
print(code, *sorted(set(sys.modules) - before), file=sys.stderr)
"""

# Prints each command with the modules that its help loads besides those of the commands before it.
_LOADED_BY_EACH = """
import sys
from faintfield.pipelines.cli import run
for command in sys.argv[1:]:
    before = set(sys.modules)
    code = run([*command.split(), "--help"])
    print(command, code, *(set(sys.modules) - before), sep=",", file=sys.stderr)
"""

# A file with two kernels, and a command that calls both.
_KERNELS = """
from faintfield.recon.numba_tools import compiled

@compiled
def double(x):
    return x + x

@compiled
def square(x):
    return x * x
"""
_COMMAND = """
from faintfield.pipelines import cli, launcher
def launch(words):
    from kernels import double, square
    assert (double(3.0), square(3.0)) == (6.0, 9.0)
    return 0
launcher.launch = launch
cli.main([])
"""


def _said(program: str, *words: str, cwd: Path | None = None, **environment: str) -> str:
    """Return what a program says on standard error, in a process of its own."""
    ended = subprocess.run(
        [sys.executable, "-c", program, *words],
        capture_output=True,
        text=True,
        check=True,
        cwd=cwd,
        env=os.environ | environment,
    )
    return ended.stderr


@pytest.mark.parametrize(
    ("words", "not_even"),
    [
        ("--version", {"cyclopts", "rich", "msgspec", "logging"}),
    ],
)
def test_nothing_is_loaded_that_is_not_shown(words: str, not_even: set[str]) -> None:
    code, *loaded = _said(_LOADED, *words.split()).split()
    assert code == "0"
    assert "faintfield.pipelines.cli" in loaded
    assert not {*loaded} & (HEAVY | not_even)


def _commands(parent: App, before: str = "") -> Iterator[str]:
    """Yield every command and group of commands."""
    for name in parent:
        if not name.startswith("-"):
            yield f"{before}{name}"
            yield from _commands(parent[name], f"{before}{name} ")


def test_the_help_of_no_command_loads_what_it_computes_with() -> None:
    commands = list(_commands(app))
    assert {"run", "demo", "stage test", "import grid", "export zarr"} <= {*commands}
    loaded = {
        name: {*rest}
        for name, *rest in (line.split(",") for line in _said(_LOADED_BY_EACH, *commands).split("\n")[:-1])
    }
    assert loaded.keys() == {*commands}
    for command, modules in loaded.items():
        assert "0" in modules
        assert not modules & HEAVY, command


@pytest.mark.deep
def test_compiling_is_said_once_unless_the_cache_holds_all(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(_KERNELS)
    cached = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    said = _said(_COMMAND, cwd=tmp_path, **cached)
    assert said.startswith("compiling kernels, ")
    assert len(said.splitlines()) == 1
    assert _said(_COMMAND, cwd=tmp_path, **cached) == ""
    assert _said(_COMMAND, cwd=tmp_path, **cached, NUMBA_CPU_NAME="generic") == said
