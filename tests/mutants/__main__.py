"""Makes wrong changes in the sources and counts how many the tests notice; `make mutants`, docs/mutants.md."""

import argparse
import contextlib
import hashlib
import json
import math
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import tomllib
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import NamedTuple

from tests.mutants.changes import Mutant, mutants_of, mutated

_ROOT = Path(__file__).parents[2]
_WORK = _ROOT / "build" / "mutants"
_MODULES = ("recon", "calib", "rig/session", "rig/capture", "rig/stages")
# Quick tests of each package; those of whole commands are too slow.
_TESTS = {
    "recon": ("tests/recon/**/test_*.py",),
    "calib": ("tests/calib/**/test_*.py",),
    "rig": ("tests/rig/**/test_*.py", "tests/faults/test_capture_faults.py", "tests/faults/test_stage_faults.py"),
}
_NOT_COPIED = shutil.ignore_patterns(".*", "build", "demo", "dist", "shared")
_PYTEST = ["-m", "pytest", "-q", "-x", "-p", "no:randomly", "-p", "no:xdist", "-p", "no:cacheprovider"]
# CPU seconds of the tests that a mutant meets, as the unchanged files need them.
_BUDGET_S = 30.0
# A mutant hangs when its tests need five times as long as usual, and this for imports or for compiling.
_SLOWER, _IMPORTS_S, _COMPILING_S = 5, 30, 300
_MEMORY_KB = 8 << 20
_NO_TESTS = 5  # pytest's status where all tests of a file are deep


class TestFile(NamedTuple):
    """A file of tests that pass: CPU seconds, and lines of functions that run, by source file."""

    path: str
    seconds: float
    lines: dict[str, set[int]]


def all_mutants(modules: Iterable[str]) -> list[Mutant]:
    """Return the mutants of modules, given as folders or files, without the equivalent ones."""
    files = {path for name in modules for path in [_ROOT / name, *(_ROOT / name).rglob("*.py")] if path.is_file()}
    mutants = [
        mutant for path in sorted(files) for mutant in mutants_of(path.relative_to(_ROOT).as_posix(), path.read_text())
    ]
    entries = tomllib.loads((Path(__file__).parent / "equivalent.toml").read_text())["mutant"]
    equivalent = tuple(entry["name"] for entry in entries)
    for name in equivalent:
        if _ROOT / name.partition(" ")[0] in files and not any(mutant.name.startswith(name) for mutant in mutants):
            print(f"equivalent.toml: no such mutant: {name}")
    return [mutant for mutant in mutants if not mutant.name.startswith(equivalent)]


def sample_of(mutants: Iterable[Mutant], size: int, seed: int) -> list[Mutant]:
    """Return a random sample that a change of one file changes little."""
    return sorted(mutants, key=lambda mutant: hashlib.sha256(f"{seed} {mutant.name}".encode()).digest())[:size]


def wilson(count: int, total: int) -> tuple[float, float]:
    """Return the 95 % interval of a share (Wilson 1927)."""
    z2 = 1.96**2
    centre = (count + z2 / 2) / (total + z2)
    half = math.sqrt(z2 * (count * (total - count) / total + z2 / 4)) / (total + z2)
    return centre - half, centre + half


class Laboratory:
    """Copies of the repository, one for each process at a time."""

    def __init__(self, jobs: int) -> None:
        self.pool = ThreadPoolExecutor(jobs)
        self._copies: queue.Queue[Path] = queue.Queue()
        for number in range(jobs):
            copy = _WORK / f"copy-{number}"
            shutil.rmtree(copy, ignore_errors=True)
            shutil.copytree(_ROOT, copy, symlinks=True, ignore=_NOT_COPIED)
            self._copies.put(copy)

    def records(self, package: str) -> list[TestFile]:
        """Return the test files of a package, the fastest first; files that have not changed keep their records."""
        paths = sorted(path for pattern in _TESTS[package] for path in _ROOT.glob(pattern))
        sources = sorted((_ROOT / package).rglob("*.py"))
        records = list(self.pool.map(lambda path: self._record(path, [*sources, path]), paths))
        return sorted((record for record in records if record), key=lambda record: record.seconds)

    def _record(self, path: Path, contents: Iterable[Path]) -> TestFile | None:
        digest = hashlib.sha256(b"".join(file.read_bytes() for file in contents)).hexdigest()
        out = _WORK / f"lines-{digest[:24]}.json"
        name = path.relative_to(_ROOT).as_posix()
        if not out.exists():
            status = self._run(["-p", "tests.mutants.lines", name], 3600.0, MUTANTS_LINES=str(out))
            if status not in (0, _NO_TESTS):
                print(f"{name} fails without any change and is left out", flush=True)
            if status:
                return None
        record = json.loads(out.read_text())
        return TestFile(name, record["seconds"], {file: set(lines) for file, lines in record["lines"].items()})

    def is_noticed(self, mutant: Mutant, records: list[TestFile]) -> bool:
        """Return whether tests fail, crash or hang with a mutant."""
        tests, compiled = _tests_of(mutant, records)
        limit_s = _SLOWER * sum(test.seconds for test in tests) + (_COMPILING_S if _has_numba(mutant) else _IMPORTS_S)
        with tempfile.TemporaryDirectory(dir=_WORK) as cache:
            # numba does not notice a change in a function that a compiled one calls
            variables = {"NUMBA_CACHE_DIR": cache} if compiled else {}
            return bool(tests) and self._run([test.path for test in tests], limit_s, mutant, **variables) != 0

    def _run(self, arguments: list[str], cpu_s: float, mutant: Mutant | None = None, **variables: str) -> int:
        """Run tests in a copy, with a mutant if there is one, and return pytest's status."""
        copy = self._copies.get()
        path = copy / (mutant.file if mutant else "pyproject.toml")
        original = path.with_suffix(".original")
        shutil.copy2(path, original)
        try:
            if mutant:
                path.write_text(mutated(path.read_text(), mutant.number))
            return _run_limited(copy, arguments, cpu_s, variables)
        finally:
            original.replace(path)
            self._copies.put(copy)


def _run_limited(copy: Path, arguments: list[str], cpu_s: float, variables: dict[str, str]) -> int:
    """Run pytest within limits of CPU time and memory, end all that it started, and return its status."""
    limits = f'ulimit -t {int(cpu_s)} -v {_MEMORY_KB} && exec "$@"'
    with tempfile.TemporaryDirectory(dir=_WORK) as temporary:
        places = {"PYTHONPATH": str(copy), "TMPDIR": temporary, "PYTHONDONTWRITEBYTECODE": "1"}
        with subprocess.Popen(
            ["bash", "-c", limits, "bash", sys.executable, *_PYTEST, *arguments],
            cwd=copy,
            env={**os.environ, **places, **variables},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        ) as process:
            try:
                # Other work on the machine slows a process down but costs no CPU time
                return process.wait(2 * cpu_s)
            except subprocess.TimeoutExpired:
                return 1
            finally:
                with contextlib.suppress(ProcessLookupError):
                    os.killpg(process.pid, signal.SIGKILL)


def _has_numba(mutant: Mutant) -> bool:
    return mutant.file.startswith("recon/") and "numba" in (_ROOT / mutant.file).read_text()


def _tests_of(mutant: Mutant, records: list[TestFile]) -> tuple[list[TestFile], bool]:
    """Return the test files that may notice a mutant, the fastest first, and whether functions are compiled anew.

    They run the changed lines; if no test does, because numba compiles them, anything in the same folder; for constants
    of modules, anything in the same file.
    """
    folder = mutant.file.rpartition("/")[0]
    exact = [test for test in records if not test.lines.get(mutant.file, set()).isdisjoint(mutant.lines)]
    compiled = not exact and _has_numba(mutant)
    if compiled:
        exact = [test for test in records if any(file.startswith(folder) for file in test.lines)]
    elif not mutant.lines:
        exact = [test for test in records if mutant.file in test.lines]
    within: list[TestFile] = []
    total_s = 0.0
    for test in exact:
        total_s += test.seconds
        if within and total_s > _BUDGET_S:
            break
        within.append(test)
    return within, compiled


def main() -> int:
    """Try a sample of mutants and print the shares."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutants", description=(__doc__ or "").splitlines()[0])
    parser.add_argument("modules", nargs="*", default=_MODULES, help="folders or files; default: %(default)s")
    parser.add_argument("--sample", type=int, default=300, help="mutants to draw at random; default: %(default)s")
    parser.add_argument("--seed", type=int, default=1, help="seed of the sample")
    parser.add_argument("--jobs", type=int, default=os.cpu_count() or 1, help="processes at a time")
    parser.add_argument("--least", type=float, default=0.0, help="exit with 1 if a smaller share (%%) is noticed")
    options = parser.parse_args()
    unknown = [name for name in options.modules if name.partition("/")[0] not in _TESTS or not (_ROOT / name).exists()]
    if unknown:
        parser.error(f"{unknown[0]}: is no folder or file of recon, calib or rig")
    _WORK.mkdir(parents=True, exist_ok=True)
    mutants = sample_of(all_mutants(options.modules), options.sample, options.seed)
    laboratory = Laboratory(options.jobs)
    records = {
        package: laboratory.records(package)
        for package in sorted({mutant.file.partition("/")[0] for mutant in mutants})
    }

    def try_one(mutant: Mutant) -> bool:
        noticed = laboratory.is_noticed(mutant, records[mutant.file.partition("/")[0]])
        if not noticed:
            print(f"not noticed: {mutant.name}", flush=True)
        return noticed

    noticed = list(laboratory.pool.map(try_one, mutants))
    count, total = sum(noticed), len(noticed)
    low, high = wilson(count, total)
    print(f"noticed {count} of {total}: {count / total:.0%}, 95 % interval {low:.0%} to {high:.0%}")
    if count < total:
        print("docs/mutants.md says what to do with the others")
    share = 100 * count / total
    if share < options.least:
        print(f"the tests notice {share:.0f} % of the wrong changes, fewer than {options.least:.0f} %")
    return int(share < options.least)


if __name__ == "__main__":
    sys.exit(main())
