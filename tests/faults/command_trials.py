"""Commands on small inputs, each tried with a fault and without; what its results must be, to the byte.

What may differ between two runs: the times that `reconstruction.json` and `report.html` state, and hence the digests of
records; the hidden cache of hashes, which holds times; in a captured session the journal and the lock (times, process
number) and the sum of the journal. A frame that is exposed again has another number in its name, and another noise.
"""

import re
import shutil
from collections.abc import Callable, Iterable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from pathlib import Path

import msgspec
import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.files import CACHE_FILE, UNFINISHED
from faintfield.pipelines.formats.provenance import DIGEST_KEY
from faintfield.pipelines.formats.results.plane_files import PARTS
from faintfield.pipelines.formats.toml_files import write_toml
from faintfield.rig.cameras.settings import SimulatedSettings
from faintfield.rig.plan import Grid
from faintfield.rig.session.disk import PART
from faintfield.rig.session.journal import Journal
from faintfield.rig.session.session import JOURNAL, SUMS
from faintfield.rig.session.verify import verify
from faintfield.rig.settings import BoardSettings, StepSettings
from faintfield.rig.stages.protocol import Point
from tests.faults.capturing import SMALL_RIG
from tests.faults.contained import faults_of_end
from tests.faults.io_faults import KINDS, Action, Fault, Outcome, compiled, faulty_process, try_command

_FEW = msgspec.structs.replace(
    SMALL_RIG,
    grid=Grid(1, 2, 100.0, Point(-350.0, -350.0)),
    step=(StepSettings("dark_scene", 0.1), StepSettings("dark", 0.1)),
)
_ENOUGH = msgspec.structs.replace(
    SMALL_RIG,
    camera=SimulatedSettings(size_px=(240, 180)),
    grid=Grid(2, 2, 100.0, Point(-350.0, -350.0)),
    board=(BoardSettings("large", 9, 7, 40.0, 30.0, "DICT_4X4_50"),),
    step=(
        *(StepSettings("charuco", 0.05),) * 3,
        *(StepSettings("dark_scene", 0.1), StepSettings("dark", (0.1, 60.0), 2), StepSettings("flat", 0.1, 2)),
    ),
)
_SMALL = ["--size-px", "48", "36", "--rows", "2", "--columns", "2"]
_PLANE = ["--depth-mm", "500", "--passes", "1", "--penalty-weight", "0.1", "--prior", "tv"]

_TIMES = re.compile(
    rb'"wall_time_s": [^,\n]+|<th scope="row">(?:written|wall time, s)</th><td>[^<]*</td>|'
    rb'"%s": "\w+"' % DIGEST_KEY.encode()
)
_EXPOSURE = re.compile(r"_x\d+")

# Names of what is not finished: files, and folders
_TEMPORARY = re.compile(rf"{re.escape(UNFINISHED)}$|{re.escape(PART)}$|^\.\w+\.\w{{8}}$")


# The words of each command, given the folder that holds its inputs and will hold its results
COMMANDS: dict[str, Callable[[Path], list[str]]] = {
    "capture": lambda at: ["capture", str(at / "rig.toml"), str(at / "out"), "--yes"],
    "simulate": lambda at: ["simulate", str(at / "set"), *_SMALL, "--seed", "2", "--overwrite"],
    "noise": lambda at: ["noise", str(at / "session"), "--out", str(at / "out")],
    "geometry": lambda at: ["geometry", str(at / "session"), "--out", str(at / "out")],
    "reconstruct": lambda at: ["reconstruct", str(at / "set"), "--out", str(at / "out"), *_PLANE],
    "run": lambda at: ["run", str(at / "session"), *_PLANE],
}


def prepare_inputs(folder: Path, names: Iterable[str]) -> None:
    """Write the inputs of commands, each into a folder of the command's name."""
    for name in names:
        (folder / name).mkdir(parents=True)
        if name == "capture":
            write_toml(folder / name / "rig.toml", _FEW)
        elif name in ("reconstruct", "simulate"):
            assert run(["simulate", str(folder / name / "set"), *_SMALL]) == 0
        else:
            if not (folder / "session").exists():
                write_toml(folder / "rig.toml", _ENOUGH)
                assert run(["capture", str(folder / "rig.toml"), str(folder / "session"), "--yes"]) == 0
            shutil.copytree(folder / "session", folder / name / "session")


def results(folder: Path) -> dict[str, bytes]:
    """Return the content of all files within a folder by name, without what may differ between two runs."""
    present = {}
    for path in sorted(folder.rglob("*")):
        name = str(path.relative_to(folder))
        if path.is_file() and path.name != CACHE_FILE:
            content = path.read_bytes()
            present[name] = _TIMES.sub(b"", content) if path.suffix in (".json", ".html") else content
    return present


def _frames(present: dict[str, bytes]) -> set[str]:
    return {_EXPOSURE.sub("", name) for name in present if name.startswith("out/frames/")}


class Bench:
    """Folders in which commands are tried: each finds its own untouched inputs at the same place every time."""

    def __init__(self, folder: Path, process: ProcessPoolExecutor) -> None:
        self._inputs, self._trials, self._process = folder / "inputs", folder / "trials", process
        self._undisturbed: dict[str, dict[str, bytes]] = {}
        self._calls: dict[str, list[str]] = {}

    def folder(self, name: str) -> Path:
        """Return the folder in which a command is tried."""
        return self._trials / name

    def renew(self, name: str) -> Path:
        """Put the inputs of a command in place anew, and return the folder."""
        shutil.rmtree(self.folder(name), ignore_errors=True)
        return Path(shutil.copytree(self._inputs / name, self.folder(name)))

    def run(self, name: str, fault: Fault | None = None, diary: Path | None = None) -> Outcome:
        """Run a command, perhaps with a fault, on what is in its folder."""
        folder = self.folder(name)
        return self._process.submit(try_command, COMMANDS[name](folder), folder, fault or Fault(), diary).result()

    def assert_ends_well(self, name: str) -> None:
        """Assert that a command ends well on what is in its folder, as if nothing had happened before."""
        outcome = self.run(name)
        assert (outcome.ended.code, outcome.stray) == (0, ""), outcome
        self.assert_finished(name)

    def undisturbed(self, name: str) -> dict[str, bytes]:
        """Return inputs and results of a command after an undisturbed run."""
        if name not in self._undisturbed:
            diary = self.renew(name).with_suffix(".calls")
            outcome = self.run(name, diary=diary)
            assert (outcome.ended.code, outcome.stray) == (0, ""), outcome
            self._calls[name] = [KINDS[int(line.split(maxsplit=1)[0])] for line in diary.read_text().splitlines()]
            self._undisturbed[name] = results(self.folder(name))
        return self._undisturbed[name]

    def calls(self, name: str) -> list[str]:
        """Return the kinds of all calls that an undisturbed run makes, in order."""
        self.undisturbed(name)
        return self._calls[name]

    def assert_finished(self, name: str) -> None:
        """Assert that inputs and results are those of an undisturbed run, and that nothing else is left."""
        wanted, present = self.undisturbed(name), results(self.folder(name))
        names, wanted_names = set(present), set(wanted)
        if name == "simulate":  # its folder has a new name in every run, so that what a kill left stays
            names = {file for file in names if not _is_temporary(file)}
        if name == "capture":
            verdict = verify(self.folder(name) / "out")
            assert (verdict.problems, verdict.missing, verdict.superseded, verdict.sealed) == ((), (), 0, True), verdict
            with Journal(self.folder(name) / "out" / JOURNAL, read_only=True) as journal:
                assert len(journal.uncommitted()) <= 1  # a failure or a kill costs one exposure at most
            names, wanted_names = _frames(present), _frames(wanted)
        assert names == wanted_names, f"not both there: {names ^ wanted_names}"
        self._assert_none_differs(name, {file: present[file] for file in present if not _is_temporary(file)})

    def assert_nothing_half_written(self, name: str, *, leftovers: bool) -> None:
        """Assert that each file is as an undisturbed run leaves it; `leftovers`: or has a temporary name."""
        present = results(self.folder(name))
        if not leftovers:
            temporary = [file for file in present if _is_temporary(file)]
            assert temporary == [], f"left: {temporary}"
        finished = {file: content for file, content in present.items() if not (_is_temporary(file) or PARTS in file)}
        if name == "simulate":  # the former set, or the new one, or none while the former has a temporary name
            former = results(self._inputs / name)
            aside = {("set/" + file.partition("/")[2], present[file]) for file in present.keys() - finished.keys()}
            assert finished in (former, self.undisturbed(name)) or (not finished and former.items() <= aside)
        else:
            self._assert_none_differs(name, finished)

    def _assert_none_differs(self, name: str, present: dict[str, bytes]) -> None:
        wanted = self.undisturbed(name)
        changing = {
            f"out/{file}" for file in ("lock", SUMS, JOURNAL, f"{JOURNAL}-wal", f"{JOURNAL}-shm", f"{JOURNAL}-journal")
        }
        for file, content in present.items():
            if name == "capture" and (file in changing or file not in wanted):
                assert file in changing or _EXPOSURE.search(file), f"unknown file: {file}"
                continue
            assert wanted.get(file) == content, f"differs: {file}"


def _is_temporary(file: str) -> bool:
    return any(_TEMPORARY.search(part) for part in file.split("/"))


@contextmanager
def bench_in(folder: Path, names: Sequence[str]) -> Iterator[Bench]:
    """Prepare the inputs, and start the process that runs the trials."""
    library = compiled(folder)
    if library is None:
        pytest.skip("there is no C compiler, cc, to compile io_faults.c with")
    prepare_inputs(folder / "inputs", names)
    shutil.copytree(folder / "inputs", folder / "trials")
    warm_up = [COMMANDS[name](folder / "trials" / name) for name in names]
    with faulty_process(library, warm_up) as process:
        yield Bench(folder, process)


# What each kind of call may meet: an error once, as of a cable or a signal, or from then on, as of a full disk
_ONCE: Action = "fail once"
_ON: Action = "fail from then on"
FAULTS: dict[str, tuple[tuple[Action, str], ...]] = {
    "open": ((_ONCE, "EACCES"), (_ONCE, "EIO"), (_ONCE, "EINTR")),
    "create": ((_ON, "ENOSPC"), (_ONCE, "EACCES"), (_ONCE, "EINTR")),
    "list": ((_ONCE, "EACCES"), (_ONCE, "EIO")),
    "status": ((_ONCE, "EACCES"), (_ONCE, "EIO")),
    "read": ((_ONCE, "EIO"), (_ONCE, "EINTR"), ("cut short", "EIO")),
    "write": ((_ON, "ENOSPC"), (_ONCE, "EIO"), (_ONCE, "EINTR"), ("cut short", "ENOSPC"), ("interrupt", "EINTR")),
    "sync": ((_ONCE, "EIO"), (_ON, "ENOSPC"), (_ONCE, "EINTR")),
    "rename": ((_ONCE, "EIO"), (_ONCE, "EACCES"), (_ON, "ENOSPC"), ("interrupt", "EINTR")),
    "remove": ((_ONCE, "EACCES"), (_ONCE, "EIO")),
    "make": ((_ON, "ENOSPC"), (_ONCE, "EACCES")),
    "lock": ((_ON, "ENOLCK"), (_ONCE, "EIO"), (_ONCE, "EINTR")),
    "allocate": ((_ON, "ENOSPC"), (_ONCE, "EIO"), (_ONCE, "EINTR")),
}


def faults_of(calls: list[str]) -> list[Fault]:
    """Return every fault that can meet a run which makes these kinds of calls."""
    return [
        Fault(kind, action, nth, error)
        for kind in KINDS
        for nth in range(1, calls.count(kind) + 1)
        for action, error in FAULTS[kind]
    ]


def assert_survives(bench: Bench, name: str, fault: Fault) -> bool:
    """Assert that a command with a fault succeeds, or fails by name and then succeeds; return whether it struck."""
    bench.renew(name)
    ended, injected, stray = bench.run(name, fault)
    assert (faults_of_end(ended), stray) == ([], "")
    if ended.code == 0:
        bench.assert_finished(name)
    else:
        assert ended.code == 1
        assert "; " in ended.err.splitlines()[-1], ended.err
        # A capture that is interrupted leaves a part of a file, which it takes away when it goes on
        interrupted_capture = name == "capture" and fault.action == "interrupt"
        bench.assert_nothing_half_written(name, leftovers=fault.kind == "remove" or interrupted_capture)
        bench.assert_ends_well(name)
    return injected > 0
