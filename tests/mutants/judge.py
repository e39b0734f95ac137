"""Runs tests against wrong changes: each in a process of its own, in a copy of the repository."""

import ast
import contextlib
import hashlib
import importlib
import json
import os
import shutil
from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path

from tests.mutants.changes import Mutant, mutated
from tests.mutants.plugins import InPlace, Keep, Recorder, Selection, Task, verdict
from tests.mutants.processes import Processes, run_pytest

ROOT = Path(__file__).parents[2]
WORK = ROOT / "build" / "mutants"
# Where the tests of a package are.
_TESTS = {
    "recon": ("tests/recon",),
    "calib": ("tests/calib",),
    "rig": ("tests/rig", "tests/faults/test_capture_faults.py", "tests/faults/test_stage_faults.py"),
}
PACKAGES = tuple(_TESTS)
_COPIED = (
    *(*PACKAGES, "pipelines", "testing", "faintfield", "benchmarks"),
    *("tests", "docs/plugins.md", "pyproject.toml"),
)
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
_BUDGET_S = 20.0
# A mutant counts as hung when it needs ten times as long as the unchanged file, and this for imports or compiling.
_SLOWER, _IMPORTS_S, _COMPILING_S = 10, 30, 150
_NOT_LINKED = shutil.ignore_patterns(".hypothesis", "output-*", "temporary-*")


@dataclass(frozen=True)
class Known:
    """The tests that pass with the unchanged files: seconds, and lines that they run, by file."""

    seconds: dict[str, float]
    lines: dict[str, dict[str, frozenset[int]]]

    def runs(self, mutant: Mutant) -> set[str]:
        """Return the tests that run the lines of a mutant; none for what only runs while numba compiles."""
        if runs_in_the_compiler(mutant.file):
            return set()
        return {name for name, lines in self.lines.items() if lines.get(mutant.file, frozenset()) & {*mutant.lines}}

    def tests_of(self, mutant: Mutant) -> list[str]:
        """Return the tests that may see a change, file by file, the fastest first."""
        files, running = {mutant.file}, self.runs(mutant)
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
    """Return the tests of packages; those of a file are recorded anew where it or its package has changed."""
    tree, store = refresh_tree(), WORK / "recorded"
    store.mkdir(parents=True, exist_ok=True)
    seconds, lines, waiting, records = {}, {}, {}, []
    for package in packages:
        sources = digest(sorted((tree / package).rglob("*.py")))
        tops = [tree / top for top in _TESTS[package]]
        for path in sorted(path for top in tops for path in [top, *top.rglob("test_*.py")] if path.is_file()):
            record = store / f"{digest([path])[:16]}-{sources[:16]}.json"
            records.append(record)
            if not record.exists():
                waiting[record] = path.relative_to(tree)
    processes = Processes(jobs)
    for record, path in waiting.items():
        processes.start(
            path.as_posix(), partial(run_pytest, tree, [path.as_posix()], partial(Recorder, tree, record)), 3600
        )
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
def runs_in_the_compiler(file: str) -> bool:
    """Return whether a file extends numba: its functions run only where nothing compiled is in the cache."""
    return "numba.extending" in (ROOT / file).read_text()


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


def judge(mutants: Iterable[Mutant], known: Known, jobs: int, keep: Keep) -> None:
    """Have each mutant judged, and `keep` called with its verdict.

    A change of a Python function is made in a process that has loaded everything. Any other needs a copy of the tree.
    """
    waiting: dict[str, Task] = {}
    for mutant in mutants:
        tests = known.tests_of(mutant)
        if tests:
            limit_s = _SLOWER * sum(known.seconds[name] for name in tests)
            waiting[mutant.name] = Task(mutant, tests, limit_s)
        else:
            keep(mutant, "not run by any test", "")
    tree = WORK / "tree"
    in_place = [task for task in waiting.values() if task.mutant.lines and known.runs(task.mutant)]
    if in_place:
        files = sorted({name.partition("::")[0] for task in in_place for name in task.tests})
        done = WORK / "done"
        done.unlink(missing_ok=True)
        for left in [*WORK.glob("temporary-*"), *tree.glob("temporary-*")]:
            shutil.rmtree(left, ignore_errors=True)
        alone = Processes(1)
        alone.start("functions", partial(run_pytest, tree, files, partial(InPlace, in_place, jobs, keep, done)), 1e6)
        list(alone.ended())
        for name in json.loads(done.read_text()):
            del waiting[name]
    _judge_in_copies(list(waiting.values()), tree, jobs, keep)


def _judge_in_copies(tasks: Iterable[Task], tree: Path, jobs: int, keep: Keep) -> None:
    """Judge mutants one by one in copies of the tree."""
    copies = WORK / "copies"
    shutil.rmtree(copies, ignore_errors=True)
    processes = Processes(jobs)
    running: dict[str, tuple[Task, Path]] = {}

    def conclude(name: str, status: int, hung: bool) -> None:
        task, place = running.pop(name)
        keep(task.mutant, *verdict(status, hung, place / "failed"))
        shutil.rmtree(place, ignore_errors=True)

    for task in tasks:
        place = copies / hashlib.sha256(task.mutant.name.encode()).hexdigest()[:16]
        _copy_with(task.mutant, tree, place)
        limit_s = task.limit_s + (_COMPILING_S if is_compiled(task.mutant.file) else _IMPORTS_S)
        files = list(dict.fromkeys(name.partition("::")[0] for name in task.tests))
        running[task.mutant.name] = task, place
        plugin = partial(Selection, task.tests, place / "failed")
        processes.start(task.mutant.name, partial(run_pytest, place, ["-x", *files], plugin), limit_s)
        for ended in processes.ended(wait_for_all=False):
            conclude(*ended)
    for ended in processes.ended():
        conclude(*ended)


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
