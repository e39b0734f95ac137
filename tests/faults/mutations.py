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
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory, mkdtemp
from typing import Any

import cv2

from faintfield.pipelines import registry
from faintfield.pipelines.cli import run
from faintfield.recon import compile_kernels
from tests.faults import contained, mutation_operations
from tests.faults.mutation_kinds import KINDS
from tests.faults.mutation_operations import VICTIM

# Threads would not survive the fork, and their stacks count as memory; libraries read these as they are loaded.
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

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


@dataclass(frozen=True)
class Case:
    """One mutation: the kind of files, the words of the command, and what is done to which file."""

    kind: str
    call: str
    edits: tuple[tuple[str, str, list[Any]], ...]

    def __str__(self) -> str:
        edits = "; ".join(f"{file}: {name} {json.dumps(arguments):.300}" for file, name, arguments in self.edits)
        return f"{self.call}\n    {edits}"


class Bench:
    """The valid files of a kind, kept in a folder, where they are copied and mutated and the commands run."""

    def __init__(self, folder: Path, kind: str) -> None:
        self.ended: contained.Ended
        self.mutated = False
        self._name, self._kind = kind, KINDS[kind]
        self._valid, self._guard = folder / "valid", folder / "case"
        (self._valid / "beside").mkdir(parents=True)
        (self._valid / "beside" / "notes.txt").write_text("of someone else\n")
        (self._valid / VICTIM).write_text("of someone else\n")

        def seed() -> int:
            self._kind.seed(self._valid / "IN")
            return 0

        made = contained.contained(seed, folder, seconds=600.0)
        if made.code != 0:
            raise RuntimeError(f"{kind}: cannot be made: {made.err}")

    def draw(self, seed: int) -> Case:
        """Return the case of a seed."""
        rng = Random(f"{self._name} {seed}")
        self._lay_out()
        place = self._guard / "IN"
        call = rng.choice(self._kind.calls).words
        edits: list[tuple[str, str, list[Any]]] = []
        for _ in range(rng.choice([1, 1, 1, 1, 2, 3])):
            matching = [sorted(filter(mutation_operations.can_be_mutated, place.glob(it))) for it in self._kind.files]
            if not any(matching):
                break  # the operations before left none
            path = rng.choice(rng.choice([paths for paths in matching if paths]))
            name, arguments = mutation_operations.draw(rng, path)
            edits.append((str(path.relative_to(place)), name, arguments))
            mutation_operations.apply(path, name, arguments)
        if rng.random() < 0.4:
            edits += [(file, "sign", []) for file, *_ in edits if file.endswith(".json")]
        return Case(self._name, call, tuple(edits))

    def faults(self, case: Case) -> list[str]:
        """Return what is wrong with how a command ended on the files of a case; nothing if all is well."""
        self._lay_out()
        clean = contained.state_of(self._guard)
        call = next(call for call in self._kind.calls if call.words == case.call)
        for file, name, arguments in case.edits:
            mutation_operations.apply(self._guard / "IN" / file, name, arguments)
        before = contained.state_of(self._guard)
        self.mutated = before != clean
        self.ended = contained.contained(lambda: run(call.words.split()), self._guard)
        faults = contained.faults_of(self.ended, self._guard, before, call.may_change, call.copies)
        if self.ended.code == 0 and call.then:
            then = contained.contained(lambda: run(call.then.split()), self._guard)
            if then.code != 0:
                faults.append(f"ended well, and then `{call.then}` did not: {then.err[-300:]}")
        return faults

    def _lay_out(self) -> None:
        """Lay out the valid files in a folder that also holds files of another owner."""
        shutil.rmtree(self._guard, ignore_errors=True)
        shutil.copytree(self._valid, self._guard)


def warm_up() -> None:
    """Load what commands load when they are first used, so that children inherit it."""
    cv2.setNumThreads(1)
    # A mutation of a huge file must fail here, not take the memory of all
    resource.setrlimit(resource.RLIMIT_DATA, (2 * contained.MAX_EXTRA_BYTES, resource.RLIM_INFINITY))
    folder = Path(registry.__file__).parent / "commands"
    for path in folder.rglob("*.py"):
        module = ".".join(path.relative_to(folder).with_suffix("").parts)
        if path.stem not in ("__init__", "view"):
            import_module(f"faintfield.pipelines.commands.{module}")
    with TemporaryDirectory() as place, open(os.devnull, "w") as null, redirect_stderr(null), redirect_stdout(null):
        for words in _EACH_COMMAND:
            run([word.replace("@", f"{place}/") for word in words.split()])
    for module in ("matplotlib.figure", "matplotlib.backends.backend_agg", "skimage.filters", "mrcal", "zarr", "rawpy"):
        import_module(module)
    compile_kernels()
    if len(os.listdir("/proc/self/task")) > 1:
        raise RuntimeError("this process has threads, which would not survive a fork")


def _described(bench: Bench, name: str, case: Case) -> list[str]:
    """Run a case; return its description and its faults as one text, if it has faults."""
    faults = bench.faults(case)
    if not case.edits and bench.ended.code != 0:
        faults.append(f"cannot read valid files: {bench.ended.err}")
    if case.edits and not (bench.mutated or name.isdecimal()):
        faults.append("nothing was mutated: this case is of an earlier format")
    kept = json.dumps({"kind": case.kind, "call": case.call, "edits": case.edits})
    words = kept if len(kept) < 2000 else ""
    return ["\n    ".join([f"{case.kind} {name}: {case}", words, *faults])] if faults else []


def _known(kind: str) -> Iterator[tuple[str, Case]]:
    """Yield a case of valid files for each command, and the kept cases of a kind, each with its name."""
    for call in KINDS[kind].calls:
        yield "valid", Case(kind, call.words, ())
    for line in CASES.read_text().splitlines():
        kept = json.loads(line)
        if kept["kind"] == kind:
            yield kept["name"], Case(kind, kept["call"], tuple(kept["edits"]))


def main(arguments: Sequence[str]) -> int:
    """Run the cases of a kind that are asked for, and return the exit code."""
    kind, seeds = arguments
    first, _, last = seeds.partition(":")
    failed = []
    warm_up()
    # Not TemporaryDirectory: a child, which runs what Python does at its end, would remove it
    folder = Path(mkdtemp(prefix="mutations-"))
    try:
        bench = Bench(folder, kind)
        for name, case in _known(kind) if last else ():
            failed += _described(bench, name, case)
        for seed in range(int(first), int(last or int(first) + 1)):
            case = bench.draw(seed)
            failed += _described(bench, str(seed), case)
        if not last:
            ended = bench.ended
            sys.stdout.write(f"{case}\n    exit code {ended.code}, {ended.seconds:.2f} s\n{ended.out}{ended.err}")
    finally:
        shutil.rmtree(folder)
    sys.stdout.write("".join(f"{text}\n" for text in failed))
    return 1 if failed else 0


if __name__ == "__main__":
    if not os.environ.items() >= ONE_THREAD.items():
        words = [sys.executable, "-m", "tests.faults.mutations", *sys.argv[1:]]
        os.execve(sys.executable, words, os.environ | ONE_THREAD)
    sys.exit(main(sys.argv[1:]))
