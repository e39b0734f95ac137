"""Run a call in a child process with little memory and time, and judge how it ended and what it touched.

The child is forked, so that nothing is imported again: this process must have no threads.
"""

import atexit
import json
import math
import os
import re
import resource
import select
import signal
import sys
import threading
import time
import traceback
import zipfile
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass
from fnmatch import fnmatchcase
from hashlib import blake2b
from pathlib import Path
from stat import S_ISDIR, S_ISREG

# Threads would not survive the fork, and their stacks count as memory; libraries read these as they are loaded.
ONE_THREAD = dict.fromkeys(("NUMBA_NUM_THREADS", "OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1")

# What a child may use beyond the memory that this process has already when it is forked.
MAX_EXTRA_BYTES = 2 << 30
MAX_FILE_BYTES = 1 << 30
MAX_SECONDS = 30.0

# A child may wait for so many times longer than it may compute: the machine may be busy.
_PATIENCE = 10

# Begins a line that only a name in a file can have brought about, and a script that must never reach a page as such.
FORGED = "faintfield-forged:"
SCRIPT = "<script>forged()</script>"

# Files up to this size are compared by their content, others by their times.
_MAX_DIGESTED = 1 << 16
_UNFINISHED = ("*.unfinished", "*.part", ".*.????????")
_FAILURE = re.compile(r"faintfield: [A-Za-z ]+: .")
_PYTHON_WARNING = re.compile(r":\d+: \w*Warning: |^\w*Warning: ", re.MULTILINE)
_CONTROL = re.compile(r"[\x00-\x08\x0b-\x1f\x7f\x80-\x9f\u202a-\u202e\u2066-\u2069\u2028\u2029]")

type State = Mapping[str, tuple[object, ...]]


@dataclass(frozen=True)
class Ended:
    """End of a child: its exit code, negative for a signal, its output, and whether it left no process behind."""

    code: int
    out: str
    err: str
    alone: bool
    seconds: float


def contained(call: Callable[[], int], place: Path, *, seconds: float = MAX_SECONDS) -> Ended:
    """Run `call` in a child whose working folder is `place`; its result is the exit code.

    The child may compute for `seconds`, and wait ten times as long.
    """
    files = os.memfd_create("out"), os.memfd_create("err")
    begun = time.monotonic()
    child = os.fork()
    if child == 0:
        _be_child(call, place, files, seconds)
    status = _wait(child, seconds)
    try:
        os.killpg(child, signal.SIGKILL)
        alone = False
    except ProcessLookupError:
        alone = True
    out, err = (_content(file) for file in files)
    return Ended(os.waitstatus_to_exitcode(status), out, err, alone, time.monotonic() - begun)


def _wait(child: int, seconds: float) -> int:
    """Return the status of a child at its end; end it if it waits for something that never comes."""
    watched = os.pidfd_open(child)
    if not select.select([watched], [], [], _PATIENCE * seconds)[0]:
        os.kill(child, signal.SIGALRM)
    os.close(watched)
    return os.waitpid(child, 0)[1]


def _be_child(call: Callable[[], int], place: Path, files: tuple[int, int], seconds: float) -> None:
    code = 1
    try:
        os.setsid()
        with suppress(OSError):
            os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
        os.dup2(files[0], 1)
        os.dup2(files[1], 2)
        # pytest and others put other objects in their places
        sys.stdout, sys.stderr = open(1, "w", closefd=False), open(2, "w", closefd=False)
        os.chdir(place)
        resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
        limit = _data_bytes() + MAX_EXTRA_BYTES
        resource.setrlimit(resource.RLIMIT_DATA, (limit, limit))
        resource.setrlimit(resource.RLIMIT_FSIZE, (MAX_FILE_BYTES, MAX_FILE_BYTES))
        whole_seconds = math.ceil(seconds)
        resource.setrlimit(resource.RLIMIT_CPU, (whole_seconds, whole_seconds + 1))
        for number in (signal.SIGALRM, signal.SIGTERM, signal.SIGXCPU):
            signal.signal(number, signal.SIG_DFL)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        code = call()
        # What Python does at its end: it waits for threads, and lets libraries clean up
        threading._shutdown()  # type: ignore[attr-defined]  # noqa: SLF001
        atexit._run_exitfuncs()  # noqa: SLF001
    except BaseException:
        traceback.print_exc()
        code = 1
    finally:
        with suppress(BaseException):
            sys.stdout.flush()
        with suppress(BaseException):
            sys.stderr.flush()
        os._exit(code)


def _content(file: int) -> str:
    os.lseek(file, 0, os.SEEK_SET)
    with open(file, "rb") as opened:
        return opened.read(1 << 20).decode(errors="replace")


def _data_bytes() -> int:
    """Return the private memory that this process has mapped, as RLIMIT_DATA counts it."""
    lines = dict(line.split(":", 1) for line in Path("/proc/self/status").read_text().splitlines())
    return int(lines["VmData"].split()[0]) * 1024


def state_of(folder: Path) -> State:
    """Return kind, size, times, and the content of small files, of everything below a folder."""
    state: dict[str, tuple[object, ...]] = {}
    for inside, folders, files in os.walk(folder):
        for name in (*folders, *files):
            path = Path(inside, name)
            stat = path.lstat()
            own: tuple[object, ...] = (stat.st_mode,)
            if not S_ISDIR(stat.st_mode):
                small = S_ISREG(stat.st_mode) and stat.st_size <= _MAX_DIGESTED
                content = blake2b(path.read_bytes()).digest() if small else b""
                own = (stat.st_mode, stat.st_ino, stat.st_size, stat.st_mtime_ns, content)
            state[os.path.relpath(path, folder)] = own
    return state


def faults_of(
    ended: Ended, folder: Path, before: State, may_change: tuple[str, ...], copies: tuple[str, ...] = ()
) -> list[str]:
    """Return what is wrong with how a child ended, and with what it left in the folder around all of its files.

    `before` is the state of the folder before the child was started, `may_change` are patterns of the files that it may
    change, add or remove, and `copies` of those that it copies as they are, as damaged as their originals.
    """
    after = state_of(folder)
    changed = {name for name in before.keys() | after.keys() if before.get(name) != after.get(name)}
    faults = faults_of_end(ended)
    for name in sorted(changed):
        if not any(fnmatchcase(name, pattern) for pattern in may_change):
            what = "made" if name not in before else "removed" if name not in after else "changed"
            faults.append(f"outside its folder: {name!r} was {what}")
        elif name not in after:
            continue
        elif any(fnmatchcase(os.path.basename(name), pattern) for pattern in _UNFINISHED):
            faults.append(f"half-written: {name!r} was left")
        elif not any(fnmatchcase(name, pattern) for pattern in copies) and (flaw := _flaw(folder / name)):
            faults.append(f"half-written: {name!r} {flaw}")
    return faults


def faults_of_end(ended: Ended) -> list[str]:
    """Return what is wrong with how a command in a child ended."""
    faults = []
    lines = ended.err.splitlines()
    said = [line for line in lines if _FAILURE.match(line)]
    if ended.code in (-signal.SIGALRM, -signal.SIGXCPU):
        faults.append(f"hang: {'waited' if ended.code == -signal.SIGALRM else 'ran'} too long")
    elif ended.code < 0:
        faults.append(f"died by signal {signal.Signals(-ended.code).name}")
    elif "Traceback (most recent call last)" in ended.err:
        faults.append(f"traceback: {lines[-1][:300]}")
    elif ended.code not in (0, 1, 2):
        faults.append(f"exit code {ended.code}")
    elif ended.code == 0 and said:
        faults.append(f"exit code 0 after a failure: {said[0][:300]}")
    elif ended.code and (len(said) != 1 or lines[-1:] != said):
        faults.append(f"exit code {ended.code} without one line of failure at the end: {ended.err[-300:]!r}")
    if ended.code and ended.out:
        faults.append(f"printed a result and failed: {ended.out[:100]!r}")
    if any(line.lstrip().startswith(FORGED) for line in [*lines, *ended.out.splitlines()]):
        faults.append("a name made a line of its own")
    if found := _CONTROL.search(ended.err):
        faults.append(f"the control character {found[0]!r} reached the terminal")
    if found := _PYTHON_WARNING.search(ended.err):
        faults.append(f"a warning of Python: {ended.err[found.start() : found.start() + 200]!r}")
    if not ended.alone:
        faults.append("left a process running")
    return faults


def _flaw(path: Path) -> str | None:
    """Return why a written file is not whole, None if it is."""
    if path.is_symlink() or not path.is_file():
        return None
    content = path.read_bytes()
    match path.suffix:
        case ".json":
            try:
                json.loads(content)
            except ValueError as failure:
                return f"is no JSON ({failure})"
        case ".npz" if not zipfile.is_zipfile(path):
            return "is no archive"
        case ".html" if SCRIPT.encode() in content:
            return "holds a script that came in a name"
        case ".html" if not content.rstrip().endswith(b"</html>"):
            return "has no end"
        case ".png" if b"IEND\xaeB`\x82" not in content:  # a copied one may have more after it
            return "has no end"
        case ".tiff" if content[:4] not in (b"II*\0", b"II+\0"):
            return "is no TIFF"
    return None
