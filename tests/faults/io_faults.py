"""Run commands in processes in which one call to the system fails, is cut short, kills, or interrupts.

`io_faults.c` stands between the program and the C library (LD_PRELOAD). `faulty_process` starts a process with it,
which loads the program and runs every command once; each trial is a fork of that process, so that it costs the command
alone.
"""

import ctypes
import errno
import hashlib
import importlib
import os
import pickle
import shutil
import subprocess
from collections.abc import Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from multiprocessing import get_context
from pathlib import Path
from typing import Literal, NamedTuple
from unittest import mock

import cv2
from matplotlib.figure import Figure

from faintfield.pipelines.cli import run
from tests.drawings import save_empty
from tests.faults.contained import ONE_THREAD, Ended, contained
from tests.patience import HANG_S

SOURCE = Path(__file__).with_suffix(".c")

# In the order of the enumeration in io_faults.c
KINDS = ("open", "create", "list", "status", "read", "write", "sync", "rename", "remove", "make", "lock", "allocate")
ACTIONS = ("count", "fail once", "fail from then on", "cut short", "kill", "interrupt")

type Action = Literal["count", "fail once", "fail from then on", "cut short", "kill", "interrupt"]


@dataclass(frozen=True)
class Fault:
    """The fate of the `nth` call of a kind, counted from 1, on files of the trial's folder.

    A write that kills has written half of its bytes; any other call that kills has done nothing.
    """

    kind: str = "open"
    action: Action = "count"
    nth: int = 0
    error: str = "EIO"

    def __str__(self) -> str:
        what = self.error if self.action.startswith("fail") else self.action
        return f"{what} at {self.kind} {self.nth}" + (" and after" if self.action == "fail from then on" else "")


class Outcome(NamedTuple):
    """End of a command, number of times that the fault struck, and a file changed outside the folder."""

    ended: Ended
    injected: int
    stray: str


# What takes long and touches no file. A trial takes its result from the commands that were run first, as long as the
# arguments are the same to the byte.
_WORKFLOWS = "faintfield.pipelines.workflows"
_COMPUTATIONS = (
    "faintfield.calib.detection.detect_boards",
    "faintfield.rig.simulation.lab.lab_experiment",
    *(f"{_WORKFLOWS}.geometry.{name}" for name in ("calibrate_geometry", "stage_report", "transfer_sigma_at")),
    *("faintfield.pipelines.calibration.noise.calibrate", f"{_WORKFLOWS}.noise.noise_page"),
    f"{_WORKFLOWS}.geometry.geometry_page",
    *(f"faintfield.pipelines.pages.calibration_pages.{name}" for name in ("node_drawing", "sigma_maps")),
)


def compiled(folder: Path) -> Path | None:
    """Compile `io_faults.c` into a folder, and return the library; None without a C compiler."""
    compiler = shutil.which("cc")
    if compiler is None:
        return None
    library = folder / "io_faults.so"
    command = [compiler, "-O1", "-Wall", "-shared", "-fPIC", "-o", str(library), str(SOURCE), "-ldl", "-lpthread"]
    subprocess.run(command, check=True)
    return library


@contextmanager
def faulty_process(library: Path, commands: Sequence[Sequence[str]]) -> Iterator[ProcessPoolExecutor]:
    """Start the process that forks, to which `try_command` can be submitted, and run some commands in it."""
    spawn = get_context("spawn")  # the library is loaded by a new process only
    with ProcessPoolExecutor(1, spawn, _warm_up, (commands,)) as process:
        with mock.patch.dict(os.environ, ONE_THREAD | {"LD_PRELOAD": str(library)}):
            process.submit(os.getpid).result()
        yield process


def try_command(words: list[str], folder: Path, fault: Fault, diary: Path | None = None) -> Outcome:
    """Run a command in a fork; one of its calls on files of a folder fails. `diary` lists them all."""
    library = ctypes.CDLL(None)
    library.faults_injected.restype = ctypes.c_long
    library.faults_stray.restype = ctypes.c_char_p
    report = os.memfd_create("report")

    def call() -> int:
        library.faults_arm(
            *(str(folder).encode(), KINDS.index(fault.kind), ACTIONS.index(fault.action), ctypes.c_long(fault.nth)),
            *(getattr(errno, fault.error), str(diary).encode() if diary else None),
        )
        code = run(words)
        library.faults_disarm()
        os.write(report, b"%d %s" % (library.faults_injected(), library.faults_stray()))
        return code

    ended = contained(call, Path.cwd(), seconds=HANG_S)
    injected, _, stray = os.pread(report, 1 << 16, 0).decode(errors="replace").partition(" ")
    os.close(report)
    return Outcome(ended, int(injected or 0), stray)


def _warm_up(commands: Sequence[Sequence[str]]) -> None:
    cv2.setNumThreads(1)
    mock.patch.object(Figure, "savefig", save_empty).start()
    for place in _COMPUTATIONS:
        _remember(*place.rsplit(".", 1))
    for words in commands:
        assert run(words) == 0, words


def _remember(module: str, name: str) -> None:
    """Replace a function by one that remembers its results."""
    owner = importlib.import_module(module)
    compute = getattr(owner, name)
    known: dict[bytes, bytes] = {}

    def remembered(*arguments: object, **named: object) -> object:
        key = hashlib.sha256(pickle.dumps((arguments, named))).digest()
        if key not in known:
            known[key] = pickle.dumps(compute(*arguments, **named))
        return pickle.loads(known[key])

    setattr(owner, name, remembered)
