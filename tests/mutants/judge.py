"""Runs tests against wrong changes: each in a process of its own, in a copy of the repository."""

import ast
import contextlib
import hashlib
import importlib
import json
import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Any, Literal

import pytest

from tests.mutants.changes import Mutant, mutated
from tests.mutants.plugins import Recorder, Selection

type Verdict = Literal["killed", "timed out", "survived", "not run by any test"]

ROOT = Path(__file__).parents[2]
WORK = ROOT / "build" / "mutants"
# Where the tests of a package are.
_TESTS = {
    "recon": ("tests/recon",),
    "calib": ("tests/calib",),
    "rig": ("tests/rig", "tests/faults/test_capture_faults.py", "tests/faults/test_stage_faults.py"),
}
PACKAGES = tuple(_TESTS)
_COPIED = (*PACKAGES, "pipelines", "faintfield", "tests", "pyproject.toml")
# Loaded once, before the forks; each process would spend seconds on them.
_PRELOADED = (
    *("cv2", "hypothesis", "msgspec", "numba", "numpy.testing", "rich.console", "scipy.ndimage", "scipy.optimize"),
    *("scipy.signal", "scipy.sparse.linalg", "scipy.stats", "serial", "tifffile", "mrcal", "casadi"),
)
_PYTEST = (
    "-q",
    "-x",
    "-p",
    "no:randomly",
    "-p",
    "no:xdist",
    "-p",
    "no:cacheprovider",
    "--assert=plain",
    "-o",
    "timeout=0",
)
# CPU seconds of the tests that a mutant may take, those of the unchanged files; tests are taken from the fastest on.
_BUDGET_S = 15.0
# A mutant counts as hung when it needs ten times as long as the unchanged file, and this for imports or compiling.
_SLOWER, _IMPORTS_S, _COMPILING_S = 10, 30, 150
_MEMORY_BYTES = 8 << 30
_NOT_LINKED = shutil.ignore_patterns(".hypothesis", "output-*", "temporary-*")


@dataclass(frozen=True)
class Known:
    """The tests that pass with the unchanged files: seconds, and lines that they run, by file."""

    seconds: dict[str, float]
    lines: dict[str, dict[str, frozenset[int]]]

    def tests_of(self, mutant: Mutant) -> list[str]:
        """Return the tests that may see a change, file by file, the fastest first."""
        files = {mutant.file}
        running = {name for name, lines in self.lines.items() if lines.get(mutant.file, frozenset()) & {*mutant.lines}}
        if is_compiled(mutant.file) and not running:
            files |= importers(mutant.file)
        if not running and (not mutant.lines or is_compiled(mutant.file)):
            running = {name for name, lines in self.lines.items() if files & lines.keys()}
        chosen: dict[str, list[str]] = {}
        total_s = 0.0
        for name in sorted(running, key=lambda it: (self.seconds[it], it)):
            total_s += self.seconds[name]
            if total_s > _BUDGET_S and chosen:
                break
            chosen.setdefault(name.partition("::")[0], []).append(name)
        in_order = sorted(chosen.values(), key=lambda names: (sum(self.seconds[name] for name in names), names))
        return [name for names in in_order for name in names]


def preload() -> None:
    """Load the libraries that most tests use."""
    for name in _PRELOADED:
        with contextlib.suppress(ImportError):
            importlib.import_module(name)


def refresh_tree() -> Path:
    """Return a copy of the repository with unchanged files; its compiled code is kept as long as it is valid."""
    tree = WORK / "tree"
    sources = {path.relative_to(ROOT) for top in _COPIED for path in _files(ROOT / top)}
    present = {path.relative_to(tree) for top in _COPIED for path in _files(tree / top)}
    changed = {name for name in sources if not _same(ROOT / name, tree / name)}
    if any(name.parts[0] == "recon" and name.suffix == ".py" for name in changed):
        shutil.rmtree(tree / "recon", ignore_errors=True)
        changed |= {name for name in sources if name.parts[0] == "recon"}
    for name in present - sources:
        (tree / name).unlink(missing_ok=True)
    for name in changed:
        (tree / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy2(ROOT / name, tree / name, follow_symlinks=False)
    return tree


def _files(top: Path) -> Iterator[Path]:
    """Yield the files and links of a folder, without what Python made of them."""
    if top.is_dir() and not top.is_symlink():
        for path in top.iterdir():
            if path.name != "__pycache__":
                yield from _files(path)
    elif top.exists():
        yield top


def _same(one: Path, other: Path) -> bool:
    """Return whether two files are copies of each other, by size and time."""
    if not os.path.lexists(other):
        return False
    a, b = one.lstat(), other.lstat()
    return one.is_symlink() or (a.st_size, a.st_mtime_ns) == (b.st_size, b.st_mtime_ns)


def recorded(packages: Iterable[str], jobs: int) -> Known:
    """Return the tests of packages; those of a file are recorded anew where it or any source has changed."""
    tree, store = refresh_tree(), WORK / "recorded"
    store.mkdir(parents=True, exist_ok=True)
    sources = digest(path for package in PACKAGES for path in sorted((tree / package).rglob("*.py")))
    seconds, lines, waiting, records = {}, {}, {}, []
    tops = [tree / top for package in packages for top in _TESTS[package]]
    for path in sorted(path for top in tops for path in [top, *top.rglob("test_*.py")] if path.is_file()):
        record = store / f"{digest([path])[:16]}-{sources[:16]}.json"
        records.append(record)
        if not record.exists():
            waiting[record] = path.relative_to(tree)
    processes = Processes(jobs)
    for record, path in waiting.items():
        processes.start(path.as_posix(), tree, [path.as_posix()], partial(Recorder, tree, record), 3600)
    for name, status, _ in processes.ended():
        if status:
            print(f"{name}: tests fail without any change; they are left out")
    for record in records:
        if record.exists():
            for name, test in json.loads(record.read_text()).items():
                seconds[name] = test["seconds"]
                lines[name] = {file: frozenset(run) for file, run in test["lines"].items()}
    return Known(seconds, lines)


def tests_digest(package: str) -> str:
    """Return the SHA-256 of a package's tests."""
    tops = [ROOT / top for top in _TESTS[package]]
    return digest(sorted(path for top in tops for path in [top, *top.rglob("*.py")] if path.is_file()))


def digest(paths: Iterable[Path]) -> str:
    """Return the SHA-256 of files' contents."""
    total = hashlib.sha256()
    for path in paths:
        total.update(path.read_bytes())
    return total.hexdigest()


@cache
def is_compiled(file: str) -> bool:
    """Return whether numba compiles functions of a file."""
    return file.startswith("recon/") and "numba" in (ROOT / file).read_text()


@cache
def importers(file: str) -> frozenset[str]:
    """Return the files of the same package that import a file, directly or through others."""
    found = {file}
    while True:
        more = {path for path, imported in _imports(file.partition("/")[0]).items() if imported & found} - found
        if not more:
            return frozenset(found - {file})
        found |= more


@cache
def _imports(package: str) -> dict[str, set[str]]:
    """Return what each file of a package imports of the repository, as paths."""
    found = {}
    for path in sorted((ROOT / package).rglob("*.py")):
        names = set()
        for node in ast.walk(ast.parse(path.read_text())):
            if isinstance(node, ast.ImportFrom) and node.module:
                module = node.module.removeprefix("faintfield.").replace(".", "/")
                names |= {f"{module}.py", *(f"{module}/{alias.name}.py" for alias in node.names)}
        found[path.relative_to(ROOT).as_posix()] = names
    return found


def judged(mutants: Iterable[Mutant], known: Known, jobs: int) -> Iterator[tuple[Mutant, Verdict, str]]:
    """Yield each mutant with its verdict and the test that found it."""
    shutil.rmtree(WORK / "copies", ignore_errors=True)
    tree, processes, running = WORK / "tree", Processes(jobs), {}
    for mutant in mutants:
        tests = known.tests_of(mutant)
        if not tests:
            yield mutant, "not run by any test", ""
            continue
        place = WORK / "copies" / hashlib.sha256(mutant.name.encode()).hexdigest()[:16]
        _copy_with(mutant, tree, place)
        limit_s = _SLOWER * sum(known.seconds[name] for name in tests) + _IMPORTS_S
        limit_s += _COMPILING_S if is_compiled(mutant.file) else 0
        files = list(dict.fromkeys(name.partition("::")[0] for name in tests))
        running[mutant.name] = mutant, place
        processes.start(mutant.name, place, ["-x", *files], partial(Selection, tests, place / "failed"), limit_s)
        yield from (_verdict(ended, running) for ended in processes.ended(wait_for_all=False))
    yield from (_verdict(ended, running) for ended in processes.ended())


def _verdict(ended: tuple[str, int, bool], running: dict[str, tuple[Mutant, Path]]) -> tuple[Mutant, Verdict, str]:
    """Return a verdict from how a process ended, and remove its copy."""
    name, status, hung = ended
    mutant, place = running.pop(name)
    failed = place / "failed"
    by = failed.read_text() if failed.exists() else ""
    shutil.rmtree(place, ignore_errors=True)
    return mutant, "timed out" if hung else "killed" if status else "survived", by


def _copy_with(mutant: Mutant, tree: Path, place: Path) -> None:
    """Make a copy of the tree with a mutant, and without what was compiled from the changed file.

    numba compiles a file again when it has changed, but not when a file has changed from which it imports functions.
    """
    shutil.rmtree(place, ignore_errors=True)
    shutil.copytree(tree, place, symlinks=True, copy_function=os.link, ignore=_NOT_LINKED)
    path = place / mutant.file
    source = path.read_text()
    path.unlink()
    path.write_text(mutated(source, mutant.place))
    for file in importers(mutant.file) | {mutant.file}:
        for stale in (place / file).parent.glob(f"__pycache__/{Path(file).stem}.*.nb[ci]"):
            stale.unlink()


class Processes:
    """Runs pytest in forked processes, a few at a time.

    Parameters
    ----------
    jobs : int
        Most processes at a time.
    """

    def __init__(self, jobs: int) -> None:
        self._jobs = jobs
        self._running: dict[int, tuple[str, float]] = {}
        self._done: list[tuple[str, int, bool]] = []

    def start(self, name: str, tree: Path, arguments: list[str], plugin: Callable[[], Any], cpu_s: float) -> None:
        """Start pytest in a tree, once fewer than `jobs` processes run."""
        while len(self._running) >= self._jobs:
            self._reap()
        sys.stdout.flush()
        pid = os.fork()
        if not pid:
            _run_tests(tree, arguments, plugin, cpu_s)
        # Other work on the machine slows a process down but costs it no CPU time.
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
        time.sleep(0.02)
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


def _run_tests(tree: Path, arguments: list[str], plugin: Callable[[], Any], cpu_s: float) -> None:
    """Run tests of a tree in this process, and end it."""
    code = 70
    try:
        os.setsid()
        os.chdir(tree)
        output = os.open(f"output-{os.getpid()}", os.O_WRONLY | os.O_CREAT)
        for stream in (1, 2):
            os.dup2(output, stream)
        resource.setrlimit(resource.RLIMIT_CPU, (int(cpu_s), int(cpu_s) + 5))
        resource.setrlimit(resource.RLIMIT_AS, (_MEMORY_BYTES, _MEMORY_BYTES))
        os.environ["PYTHONPATH"] = str(tree)
        sys.path[:] = [str(tree), *(entry for entry in sys.path if entry not in ("", str(ROOT)))]
        made = plugin()
        for name in [name for name in sys.modules if name.partition(".")[0] == "tests"]:
            del sys.modules[name]
        code = pytest.main([*_PYTEST, f"--basetemp={tree / f'temporary-{os.getpid()}'}", *arguments], plugins=[made])
        if not str(sys.modules["faintfield"].__file__).startswith(str(tree)):
            code = 70
    finally:
        os._exit(code)
