"""Mutate the files that commands read, and judge how the commands end; all of a case follows from its kind and seed.

    python -m tests.faults.mutations KIND SEED          one case: print what it did and what came of it
    python -m tests.faults.mutations KIND FIRST:LAST    the valid files, the kept cases, many cases: print what failed

A case copies a small valid folder, does one to three operations to its files (tests/faults/mutation_operations.py) and
runs one command that reads them (tests/faults/mutation_kinds.py) in a child process with 2 GB and 30 s. The command
must end with exit code 0, or with 1 or 2 and one line. It must change no file outside its own folder, leave nothing
half-written, and leave nothing running.
"""

import json
import os
import resource
import shutil
import sys
from collections.abc import Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from importlib import import_module
from itertools import chain
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any, NamedTuple

import cv2

from faintfield.pipelines import launcher
from faintfield.pipelines.cli import run
from faintfield.recon import compile_kernels
from tests.faults import mutation_operations
from tests.faults.contained import MAX_EXTRA_BYTES, ONE_THREAD, Ended, contained, faults_of, state_of
from tests.faults.mutation_kinds import KINDS
from tests.faults.mutation_operations import VICTIM

# A call of most commands, so that what they keep in memory is there before the fork.
_EACH_COMMAND = (
    "simulate @set --rows 3 --columns 3 --size-px 24 18",
    "reconstruct @set --out @planes --depth-mm 500 --depth-mm 600 --passes 2 --penalty-weight 1",
    "report @planes",
    "export mrcal @set @cameras",
    "import mrcal @cameras @set1 --images @set",
    "import grid @set/noise_free @set3",
    "init @rig.toml",
    "check @rig.toml",
    *("noise @set", "geometry @set", "run @set", "export zarr @none @out", "capture @none @session --yes"),
)

CASES = Path(__file__).parent / "mutation_cases" / "cases.jsonl"


class Case(NamedTuple):
    """One mutation: its name or seed, the words of the command, and what is done to which file."""

    name: str
    call: str
    edits: Sequence[tuple[str, str, list[Any]]]


class Bench:
    """The valid files of a kind, kept in a folder, where they are copied and mutated and the commands run."""

    def __init__(self, folder: Path, name: str) -> None:
        self._name, self._kind = name, KINDS[name]
        self._valid, self._guard = folder / "valid", folder / "case"
        (self._valid / "beside").mkdir(parents=True)
        (self._valid / "beside" / "notes.txt").write_text("of someone else\n")
        (self._valid / VICTIM).write_text("of someone else\n")

        def seed() -> int:
            self._kind.seed(self._valid / "IN")
            return 0

        made = contained(seed, folder, seconds=600.0)
        if made.code != 0:
            raise RuntimeError(f"{name}: cannot be made: {made.err}")

    def draw(self, seed: int) -> Case:
        """Return the case of a seed."""
        rng = Random(f"{self._name} {seed}")
        self._lay_out()
        place = self._guard / "IN"
        call = rng.choice(self._kind.calls).words
        edits: list[tuple[str, str, list[Any]]] = []
        for _ in range(rng.choice([1, 1, 1, 1, 2, 3])):
            candidates = (place.glob(pattern) for pattern in self._kind.files)
            matching = [sorted(filter(mutation_operations.can_be_mutated, paths)) for paths in candidates]
            if not any(matching):
                break  # the operations before left none
            path = rng.choice(rng.choice([paths for paths in matching if paths]))
            name, arguments = mutation_operations.draw(rng, path)
            edits.append((str(path.relative_to(place)), name, arguments))
            mutation_operations.apply(path, name, arguments)
        if rng.random() < 0.4:
            edits += [(file, "sign", []) for file, *_ in edits if file.endswith(".json")]
        return Case(str(seed), call, edits)

    def known(self) -> Iterator[Case]:
        """Yield a case of valid files for each command, and the kept cases."""
        yield from (Case("valid", call.words, ()) for call in self._kind.calls)
        for kept in map(json.loads, CASES.read_text().splitlines()):
            if kept["kind"] == self._name:
                yield Case(kept["name"], kept["call"], kept["edits"])

    def run(self, case: Case) -> tuple[Ended, list[str]]:
        """Return how the command of a case ended, and what is wrong with that."""
        self._lay_out()
        clean = state_of(self._guard)
        for file, name, arguments in case.edits:
            mutation_operations.apply(self._guard / "IN" / file, name, arguments)
        before = state_of(self._guard)
        call = next(call for call in self._kind.calls if call.words == case.call)
        ended = contained(lambda: run(call.words.split()), self._guard)
        faults = faults_of(ended, self._guard, before, call.may_change, call.copies)
        if ended.code == 0 and call.then:
            then = contained(lambda: run(call.then.split()), self._guard)
            if then.code != 0:
                faults.append(f"ended well, and then `{call.then}` did not: {then.err[-300:]}")
        if not case.edits and ended.code != 0:
            faults.append(f"cannot read valid files: {ended.err}")
        if case.edits and before == clean and not case.name.isdecimal():
            faults.append("nothing was mutated: this case is of an earlier format")
        return ended, faults

    def _lay_out(self) -> None:
        """Lay out the valid files in a folder that also holds files of another owner."""
        shutil.rmtree(self._guard, ignore_errors=True)
        shutil.copytree(self._valid, self._guard)


def warm_up() -> None:
    """Load what commands load when they are first used, so that children inherit it."""
    cv2.setNumThreads(1)
    # A mutation of a huge file must fail here, not take the memory of all
    resource.setrlimit(resource.RLIMIT_DATA, (2 * MAX_EXTRA_BYTES, resource.RLIM_INFINITY))
    folder = Path(launcher.__file__).parent / "commands"
    for path in folder.rglob("*.py"):
        module = ".".join(path.relative_to(folder).with_suffix("").parts)
        if path.stem != "__init__":
            import_module(f"faintfield.pipelines.commands.{module}")
    with TemporaryDirectory() as place, open(os.devnull, "w") as null, redirect_stderr(null), redirect_stdout(null):
        for words in _EACH_COMMAND:
            run([word.replace("@", f"{place}/") for word in words.split()])
    for module in ("matplotlib.figure", "matplotlib.backends.backend_agg", "skimage.filters", "mrcal", "zarr", "rawpy"):
        import_module(module)
    compile_kernels()
    if len(os.listdir("/proc/self/task")) > 1:
        raise RuntimeError("this process has threads, which would not survive a fork")


def main(kind: str, seeds: str) -> int:
    """Run the cases of a kind that are asked for, and return the exit code."""
    first, _, last = seeds.partition(":")
    failures = 0
    warm_up()
    # Not TemporaryDirectory: a child, which runs what Python does at its end, would remove it
    folder = Path(mkdtemp(prefix="mutations-"))
    try:
        bench = Bench(folder, kind)
        drawn = (bench.draw(seed) for seed in range(int(first), int(last or int(first) + 1)))
        for case in chain(bench.known() if last else (), drawn):
            ended, faults = bench.run(case)
            failures += bool(faults)
            if faults or not last:
                words = json.dumps({"kind": kind} | case._asdict())
                result = f"exit code {ended.code}, {ended.seconds:.2f} s\n{ended.out}{ended.err}"
                sys.stdout.write("\n    ".join([f"{words:.3000}", *faults, result]))
    finally:
        shutil.rmtree(folder)
    return 1 if failures else 0


if __name__ == "__main__":
    if len(sys.argv) != 3 or sys.argv[1] not in KINDS:
        sys.exit(f"usage: python -m tests.faults.mutations KIND SEED|FIRST:LAST; the kinds are {', '.join(KINDS)}")
    if not os.environ.items() >= ONE_THREAD.items():
        words = [sys.executable, "-m", "tests.faults.mutations", *sys.argv[1:]]
        os.execve(sys.executable, words, os.environ | ONE_THREAD)
    sys.exit(main(*sys.argv[1:]))
