"""Mutate the files that commands read, and judge how the commands end; all of a case follows from its kind and seed.

    python -m tests.faults.mutations KIND SEED          one case: print what it did and what came of it
    python -m tests.faults.mutations KIND FIRST:LAST    many cases: print those that failed

A case copies a small valid folder, does one to three operations to its files (tests/faults/mutation_operations.py) and
runs one command that reads them (tests/faults/mutation_kinds.py) in a child process with 2 GB and 30 s. The command
must end with exit code 0, or with 1 or 2 and one line. It must change no file outside its own folder, leave nothing
half-written, and leave nothing running.
"""

import fcntl
import json
import os
import resource
import shutil
import sqlite3
import sys
import tempfile
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import closing, redirect_stderr, redirect_stdout
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from random import Random
from tempfile import TemporaryDirectory
from typing import Any

import cv2

from faintfield.pipelines import registry
from faintfield.pipelines.cli import run
from faintfield.recon import compile_kernels
from tests.faults import contained, mutation_operations
from tests.faults.mutation_kinds import KINDS

# Threads would not survive the fork, and their stacks count as memory; libraries read these as they are loaded.
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

# A call of most commands, so that what they keep in memory is there before the fork.
_EACH_COMMAND = (
    "simulate @set --rows 3 --columns 3 --size-px 24 18",
    "darken @set @dark",
    "reconstruct @set --out @planes --depth-mm 500 --depth-mm 600 --passes 2 --penalty-weight 1",
    "report @planes",
    "verify @planes",
    "export mrcal @set @cameras",
    "export colmap @set @model",
    "import mrcal @cameras @set1 --images @set",
    "import colmap @model @set2 --images @set",
    "import grid @set/noise_free @set3",
    "export nerfstudio @set @transforms",
    "import nerfstudio @transforms @set5 --images @set",
    "import poses @none @set6 --fx-px 100",
    "import emva1288 @none @set4",
    "init @rig.toml",
    "check @rig.toml",
    "noise @set",
    "geometry @set",
    "run @set",
    "export zarr @none @out",
    "capture @none @session --yes",
)

CASES = Path(__file__).parent / "mutation_cases" / "cases.jsonl"


@dataclass(frozen=True)
class Case:
    """One mutation: the kind of files, the words of the command, and what is done to which file."""

    kind: str
    call: str
    edits: tuple[tuple[str, str, list[Any]], ...]

    def __str__(self) -> str:
        done = "; ".join(f"{file}: {name} {_short(arguments)}" for file, name, arguments in self.edits)
        return f"{self.call}\n    {done}"


def _short(arguments: Sequence[Any]) -> str:
    words = json.dumps(arguments)
    return words if len(words) < 300 else f"{words[:200]} … {words[-50:]}"


class Bench:
    """Makes valid folders once, copies and mutates them, and runs the commands.

    Parameters
    ----------
    folder : Path
        Where the valid folders are kept, which several benches may share, and where the cases run.
    """

    def __init__(self, folder: Path) -> None:
        self.ended: contained.Ended
        self._made: dict[str, Path] = {}
        self.mutated = False
        self._kind = ""
        self._clean: contained.State = {}
        self._valid = folder / "valid"
        self._valid.mkdir(parents=True, exist_ok=True)
        self._guard = Path(tempfile.mkdtemp(prefix="case-", dir=folder))

    def draw(self, kind: str, seed: int) -> Case:
        """Return the case of a seed."""
        rng = Random(f"{kind} {seed}")
        self.lay_out(kind)
        place = self._guard / "IN"
        call = rng.choice(KINDS[kind].calls).words
        edits: list[tuple[str, str, list[Any]]] = []
        for _ in range(rng.choice([1, 1, 1, 1, 2, 3])):
            found = [sorted(filter(mutation_operations.can_be_mutated, place.glob(it))) for it in KINDS[kind].files]
            if not any(found):
                break  # the operations before left none
            files = rng.choice([it for it in found if it])
            path = rng.choice(files)
            name, arguments = mutation_operations.draw(rng, path)
            edits.append((str(path.relative_to(place)), name, arguments))
            mutation_operations.apply(path, name, arguments)
        if rng.random() < 0.4:
            edits += [(file, "sign", []) for file, *_ in edits]
        return Case(kind, call, tuple(edits))

    def faults(self, case: Case) -> list[str]:
        """Return what is wrong with how a command ended on the files of a case; nothing if all is well."""
        self.lay_out(case.kind)
        call = next(it for it in KINDS[case.kind].calls if it.words == case.call)
        for file, name, arguments in case.edits:
            mutation_operations.apply(self._guard / "IN" / file, name, arguments)
        self.mutated = contained.state_of(self._guard) != self._clean
        changed = sorted(self._changed(case.kind, call.notices))
        if any(file not in changed or name == "sign" for file, name, _ in case.edits):
            changed = []  # what vouches for them was changed, too
        faults = self.faults_of(lambda: run(call.words.split()), may_change=call.may_change, copies=call.copies)
        if self.ended.code == 0 and changed:
            faults.append(f"did not notice that {', '.join(changed)} changed")
        if self.ended.code == 0 and call.then:
            ended, self.ended = self.ended, contained.contained(lambda: run(call.then.split()), self._guard)
            if self.ended.code != 0:
                faults.append(f"ended well, and then `{call.then}` did not: {self.ended.err[-300:]}")
            self.ended = ended
        return faults

    def faults_of(
        self,
        call: Callable[[], int],
        seconds: float = contained.MAX_SECONDS,
        may_change: tuple[str, ...] = ("OUT", "OUT/*"),
        copies: tuple[str, ...] = (),
    ) -> list[str]:
        """Run a call among the files that are laid out, and return what is wrong with how it ended."""
        before = contained.state_of(self._guard)
        self.ended = contained.contained(call, self._guard, seconds=seconds)
        return contained.faults_of(self.ended, self._guard, before, may_change, copies)

    def _changed(self, kind: str, patterns: Iterable[str]) -> Iterator[str]:
        """Yield the names of the files whose content is not that of the valid ones."""
        valid, place = self._valid_folder(kind) / "IN", self._guard / "IN"
        for pattern in patterns:
            for path in valid.glob(pattern):
                name = path.relative_to(valid)
                if _content(path) != _content(place / name):
                    yield str(name)

    def close(self) -> None:
        """Remove the files of the last case."""
        shutil.rmtree(self._guard, ignore_errors=True)

    def lay_out(self, kind: str) -> None:
        """Lay out the valid files of a kind in a folder that also holds files of other people.

        Only what has changed since the last time is laid out again.
        """
        valid = self._valid_folder(kind)
        if kind != self._kind:
            self._kind, self._clean = kind, {}
        now = contained.state_of(self._guard)
        if self._clean and now == self._clean:
            return
        for name in sorted(name for name in now if now[name] != self._clean.get(name)):
            path = self._guard / name
            if path.is_symlink() or not path.is_dir():
                path.unlink(missing_ok=True)
            else:
                shutil.rmtree(path)
        for path in sorted(valid.rglob("*")):
            laid_out = self._guard / path.relative_to(valid)
            if path.is_dir():
                laid_out.mkdir(exist_ok=True)
            elif not os.path.lexists(laid_out):
                shutil.copy2(path, laid_out)
        self._clean = contained.state_of(self._guard)

    def _valid_folder(self, kind: str) -> Path:
        """Return a folder that holds the valid files of a kind, made by a child, by one bench for all."""
        if kind in self._made:
            return self._made[kind]
        seed = KINDS[kind].seed
        folder = self._valid / kind
        with (self._valid / f"{kind}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not folder.exists():
                building = self._valid / f"{kind} unfinished"
                shutil.rmtree(building, ignore_errors=True)
                (building / "beside").mkdir(parents=True)
                (building / "beside" / "notes.txt").write_text("of someone else\n")
                (building / mutation_operations.VICTIM).write_text("of someone else\n")
                ended = contained.contained(lambda: seed(building / "IN") or 0, self._valid, seconds=600.0)
                if ended.code != 0:
                    raise RuntimeError(f"{kind}: cannot be made: {ended.err}")
                building.rename(folder)
        self._made[kind] = folder
        return folder


def _content(path: Path) -> object:
    """Return what a file holds: of a database its rows, of any other its bytes, None if neither can be read."""
    if not path.is_file() or not mutation_operations.can_be_mutated(path.resolve()):
        return None
    try:
        if path.suffix != ".sqlite":
            return path.read_bytes()
        with closing(sqlite3.connect(f"file:{path}?immutable=1", uri=True)) as db:
            db.text_factory = bytes
            tables = [row[0].decode() for row in db.execute("SELECT name FROM sqlite_master WHERE type = 'table'")]
            kept = sorted(name for name in tables if not name.startswith("sqlite_"))
            return [db.execute(f'SELECT * FROM "{name}" ORDER BY rowid').fetchall() for name in kept]
    except (sqlite3.Error, OSError, ValueError):
        return None


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


def serve(folder: Path) -> None:
    """Answer requests on standard input, one line of JSON each, by the faults that were found.

    A request names a kind and the first and last seed, or a case, or a function to run in the place of a command.
    """
    warm_up()
    bench = Bench(folder)
    for line in sys.stdin:
        request = json.loads(line)
        if "function" in request:
            bench.lay_out("elemental set")
            found = bench.faults_of(named(request["function"]), request["seconds"])
        elif "edits" in request:
            found = _described(bench, "kept", Case(request["kind"], request["call"], request["edits"]))
            if not request["edits"] and bench.ended.code != 0:
                found.append(f"cannot read valid files: {bench.ended.err}")
            if request["edits"] and not bench.mutated:
                found.append("nothing was mutated: this case is of an earlier format")
        else:
            seeds = range(request["first"], request["last"])
            found = [it for seed in seeds for it in _described(bench, seed, bench.draw(request["kind"], seed))]
        sys.stdout.write(json.dumps(found) + "\n")
        sys.stdout.flush()
    bench.close()


def named(name: str) -> Callable[[], int]:
    """Return the function of a name such as `tests.faults.broken_commands:hang`."""
    module, _, function = name.partition(":")
    found: Callable[[], int] = getattr(import_module(module), function)
    return found


def _described(bench: Bench, seed: int | str, case: Case) -> list[str]:
    """Run a case; return its description and its faults as one text, if it has faults."""
    faults = bench.faults(case)
    kept = json.dumps({"kind": case.kind, "call": case.call, "edits": case.edits})
    words = kept if len(kept) < 2000 else ""
    return ["\n    ".join([f"{case.kind} {seed}: {case}", words, *faults])] if faults else []


def main(arguments: Sequence[str]) -> int:
    """Run the cases that are asked for, or serve."""
    if arguments[0] == "--serve":
        serve(Path(arguments[1]))
        return 0
    first, _, last = arguments[1].partition(":")
    folder = Path(tempfile.mkdtemp(prefix="mutations-"))
    warm_up()
    bench = Bench(folder)
    failed = 0
    try:
        for seed in range(int(first), int(last or int(first) + 1)):
            case = bench.draw(arguments[0], seed)
            found = _described(bench, seed, case)
            failed += bool(found)
            if found or not last:
                sys.stdout.write("\n".join(found or [f"{arguments[0]} {seed}: {case}"]) + "\n")
            if not last:
                ended = bench.ended
                sys.stdout.write(f"    exit code {ended.code}, {ended.seconds:.2f} s\n{ended.out}{ended.err}")
    finally:
        shutil.rmtree(folder)
    return 1 if failed else 0


if __name__ == "__main__":
    if not os.environ.items() >= ONE_THREAD.items():
        words = [sys.executable, "-m", "tests.faults.mutations", *sys.argv[1:]]
        os.execve(sys.executable, words, os.environ | ONE_THREAD)
    sys.exit(main(sys.argv[1:]))
