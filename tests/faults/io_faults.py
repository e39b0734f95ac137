"""Run commands in processes in which one call to the system fails, is cut short, or kills.

`io_faults.c` stands between the program and the C library (LD_PRELOAD). `faults` starts a process with it, which loads
the program and runs every command once; each trial is a fork of that process, so that it costs the command alone.
"""

import ctypes
import errno
import hashlib
import importlib
import os
import pickle
import shutil
import subprocess
import sys
import traceback
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from multiprocessing import get_context
from pathlib import Path
from types import CodeType
from typing import IO, Any, Literal

import jinja2
import msgspec

from tests.patience import HANG_S

ROOT = Path(__file__).parents[2]
SOURCE = Path(__file__).with_suffix(".c")

# In the order of the enumeration in io_faults.c
KINDS = ("open", "create", "list", "status", "read", "write", "sync", "rename", "remove", "make", "lock", "allocate")
ACTIONS = ("count", "fail once", "fail from then on", "cut short", "kill")

# Exit codes of a command that ended by an exception, and of one that was killed after its time
CRASHED, TIME_OVER = 70, 71

type Action = Literal["count", "fail once", "fail from then on", "cut short", "kill"]


class Fault(msgspec.Struct, frozen=True):
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


class Trial(msgspec.Struct, frozen=True):
    """A command that is tried on the files of a folder, all whose calls are listed in the file `diary`."""

    words: list[str]
    folder: str
    fault: Fault = Fault()
    diary: str | None = None
    limit_s: float = HANG_S


class Ended(msgspec.Struct, frozen=True):
    """How a command ended: its exit code, what it printed, how often the fault struck, and a file changed elsewhere."""

    code: int
    said: str
    complaint: str
    injected: int = 0
    stray: str = ""


# What takes long and touches no file. A trial takes its result from the commands that were run first, as long as the
# arguments are the same to the byte.
_CALIBRATION, _PAGES = "faintfield.pipelines.calibration", "faintfield.pipelines.pages"
_COMPUTATIONS = (
    "faintfield.calib.detection.detect_boards",
    "faintfield.rig.simulation.lab.lab_experiment",
    *(f"{_CALIBRATION}.geometry.{name}" for name in ("calibrate_geometry", "stage_report", "transfer_sigma_at")),
    *(f"{_CALIBRATION}.noise.calibrate", f"{_PAGES}.emva_page.emva_page", f"{_PAGES}.noise_page.draw_page"),
    *(f"{_PAGES}.geometry_page.{name}" for name in ("geometry_page", "node_drawing", "sigma_maps")),
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


class Faults:
    """A process under the library, which forks one process per trial."""

    def __init__(self, process: subprocess.Popen[bytes]) -> None:
        self._process = process

    def run(self, trial: Trial) -> Ended:
        to, answers = self._process.stdin, self._process.stdout
        assert to is not None
        assert answers is not None
        to.write(msgspec.json.encode(trial) + b"\n")
        to.flush()
        return msgspec.json.decode(answers.readline(), type=Ended)


@contextmanager
def faults(library: Path, warm_up: Sequence[Sequence[str]] = ()) -> Iterator[Faults]:
    """Start the process that forks, having run some commands in it, which loads what they need."""
    one_thread = dict.fromkeys(("OPENBLAS_NUM_THREADS", "OMP_NUM_THREADS", "NUMBA_NUM_THREADS"), "1")
    with subprocess.Popen(
        [sys.executable, "-m", "tests.faults.io_faults", msgspec.json.encode(warm_up).decode()],
        stdin=subprocess.PIPE,
        stdout=subprocess.PIPE,
        cwd=ROOT,
        env={**os.environ, **one_thread, "LD_PRELOAD": str(library)},
    ) as process:
        try:
            server = Faults(process)
            assert server.run(Trial(["--help"], "/none")).code == 0
            yield server
        finally:
            process.kill()


def elemental_set() -> ctypes.CDLL:
    """Return the library that stands between this process and the C library."""
    library = ctypes.CDLL(None)
    library.faults_arm.argtypes = (
        *(ctypes.c_char_p, ctypes.c_int, ctypes.c_int, ctypes.c_long, ctypes.c_int, ctypes.c_char_p),
    )
    library.faults_injected.restype = ctypes.c_long
    library.faults_stray.restype = ctypes.c_char_p
    return library


def arm(library: ctypes.CDLL, folder: str, fault: Fault, diary: str | None = None) -> None:
    """Count the calls of this process on the files in a folder from now on, and let one of them fail."""
    library.faults_arm(
        *(folder.encode(), KINDS.index(fault.kind), ACTIONS.index(fault.action), fault.nth),
        getattr(errno, fault.error),
        None if diary is None else diary.encode(),
    )


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


def _keep_templates() -> None:
    """Let templates be compiled once only."""
    compile_once = jinja2.Environment.compile
    known: dict[object, CodeType] = {}

    def kept(environment: jinja2.Environment, source: Any, *rest: Any, **named: Any) -> CodeType:
        key = (source, rest, tuple(named.items()))
        if key not in known:
            known[key] = compile_once(environment, source, *rest, **named)
        return known[key]

    jinja2.Environment.compile = kept  # type: ignore[method-assign, assignment]


def _serve(warm_up: list[list[str]]) -> None:
    """Run the commands, then one trial per line of standard input, each in a fork."""
    import cv2

    from faintfield.pipelines.cli import run

    cv2.setNumThreads(1)
    for place in _COMPUTATIONS:
        _remember(*place.rsplit(".", 1))
    _keep_templates()
    answers = os.fdopen(os.dup(1), "wb", buffering=0)
    os.dup2(2, 1)
    for words in warm_up:
        assert run(words) == 0, words
    library = elemental_set()
    for line in sys.stdin.buffer:
        answers.write(msgspec.json.encode(_tried(msgspec.json.decode(line, type=Trial), library)) + b"\n")


def _tried(trial: Trial, library: ctypes.CDLL) -> Ended:
    """Fork a process that runs a trial, and return how it ended."""
    said, complaint, report = (os.fdopen(os.memfd_create(name), "w+b") for name in ("said", "complaint", "report"))
    with said, complaint, report:
        process = get_context("fork").Process(target=_child, args=(trial, library, said, complaint, report))
        process.start()
        process.join(trial.limit_s)
        if process.exitcode is None:
            process.kill()
            process.join()
            code = TIME_OVER
        else:
            code = process.exitcode
        injected, _, stray = _content(report).partition(" ")
        return Ended(code, _content(said), _content(complaint), int(injected or 0), stray)


def _child(trial: Trial, library: ctypes.CDLL, said: IO[bytes], complaint: IO[bytes], report: IO[bytes]) -> None:
    """Run a trial in this process, and end it."""
    from faintfield.pipelines.cli import run

    os.dup2(said.fileno(), 1)
    os.dup2(complaint.fileno(), 2)
    arm(library, trial.folder, trial.fault, trial.diary)
    try:
        code = run(trial.words)
    except BaseException:
        traceback.print_exc()
        code = CRASHED
    sys.stdout.flush()
    sys.stderr.flush()
    library.faults_disarm()
    report.write(b"%d " % library.faults_injected() + library.faults_stray())
    report.flush()
    os._exit(code)


def _content(file: IO[bytes]) -> str:
    file.seek(0)
    return file.read().decode(errors="replace")


if __name__ == "__main__":
    _serve(msgspec.json.decode(sys.argv[1], type=list[list[str]]))
