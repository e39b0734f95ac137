"""Start of commands: modules that `--version` and help load, and the announcement of compiled kernels."""

import os
import subprocess
import sys
from collections.abc import Iterator
from importlib.util import find_spec
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

# Prints --version and each command with the modules that its help loads besides those of the commands before it.
_LOADED_BY_EACH = """
import sys
before = set(sys.modules)
from faintfield.pipelines.cli import run
for command in ["--version", *sys.argv[1:]]:
    code = run([command] if command == "--version" else [*command.split(), "--help"])
    print(command, code, *(set(sys.modules) - before), sep=",", file=sys.stderr)
    before = set(sys.modules)
"""

# A file with two kernels, and a command that calls both.
_KERNELS = """
from faintfield.recon.numba_tools import compiled
@compiled
def double(x): return x + x
@compiled
def square(x): return x * x
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


def _complaint(program: str, *words: str, cwd: Path | None = None, **environment: str) -> str:
    """Return the standard error of a program in a process of its own."""
    command = [sys.executable, "-c", program, *words]
    environ = os.environ | environment
    return subprocess.run(command, capture_output=True, text=True, check=True, cwd=cwd, env=environ).stderr


def _commands(parent: App, before: str = "") -> Iterator[str]:
    """Yield every command and group of commands."""
    for name in parent:
        if not name.startswith("-"):
            yield f"{before}{name}"
            yield from _commands(parent[name], f"{before}{name} ")


def test_version_and_help_load_nothing_heavy() -> None:
    assert {name for name in HEAVY if find_spec(name) is None} <= {"napari"}  # all names are those of packages
    commands = list(_commands(app))
    assert {"run", "demo", "stage test", "import grid", "export zarr"} <= {*commands}
    lines = _complaint(_LOADED_BY_EACH, *commands).split("\n")[:-1]
    modules_of = {name: {*modules} for name, *modules in (line.split(",") for line in lines)}
    assert modules_of.keys() == {"--version", *commands}
    assert "faintfield.pipelines.cli" in modules_of["--version"]
    assert not modules_of["--version"] & {"cyclopts", "rich", "msgspec", "logging"}
    for command, modules in modules_of.items():
        assert "0" in modules
        assert not modules & HEAVY, command


@pytest.mark.deep
def test_compiling_is_announced_once_unless_cached(tmp_path: Path) -> None:
    (tmp_path / "kernels.py").write_text(_KERNELS)
    cached = {"NUMBA_CACHE_DIR": str(tmp_path / "cache")}
    complaint = _complaint(_COMMAND, cwd=tmp_path, **cached)
    assert complaint.startswith("compiling kernels, ")
    assert len(complaint.splitlines()) == 1
    assert _complaint(_COMMAND, cwd=tmp_path, **cached) == ""
    assert _complaint(_COMMAND, cwd=tmp_path, **cached, NUMBA_CPU_NAME="generic") == complaint
