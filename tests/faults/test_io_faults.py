"""Any call to the system may fail: the command fails by name or succeeds, and afterwards gives the same bytes."""

import os
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from faintfield.pipelines.formats.files import UNFINISHED
from tests.faults.command_trials import COMMANDS, Bench, assert_survives, faults_of
from tests.faults.io_faults import CRASHED, KINDS, ROOT, Ended, Fault, Trial, compiled
from tests.patience import HANG_S

# How many trials `make test` makes of each command; the longer it takes, the fewer.
_SAMPLE = {"capture": 20, "noise": 15, "geometry": 15, "reconstruct": 12, "run": 6}

# Of the faults that can meet a command, the slow test takes every one of this many: all would take hours. Primes: each
# kind of call is met by each of its two to four errors.
_STRIDE = {"capture": 7, "noise": 5, "geometry": 7, "reconstruct": 11, "run": 89}


def assert_all_survived(bench: Bench, name: str, faults: list[Fault]) -> None:
    """Try a command with each fault; name all those that it does not survive."""
    wrong, struck = {}, 0
    for fault in faults:
        try:
            struck += assert_survives(bench, name, fault)
        except AssertionError as failure:
            wrong[str(fault)] = str(failure)
    assert wrong == {}, f"{len(wrong)} of {len(faults)}"
    assert struck > 0.9 * len(faults)  # a run with other times may make a call less


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_survives_faults_of_the_system(bench: Bench, name: str) -> None:
    faults = faults_of(bench.calls(name))
    chosen = np.random.default_rng(15).choice(len(faults), _SAMPLE[name], replace=False)
    assert_all_survived(bench, name, [faults[index] for index in sorted(chosen)])


@pytest.mark.campaign
@pytest.mark.timeout(10 * HANG_S)
@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_survives_many_faults_of_the_system(bench: Bench, name: str) -> None:
    assert_all_survived(bench, name, faults_of(bench.calls(name))[:: _STRIDE[name]])


# What a program sees of a fault: an operation on the file `a` in a folder, the fault, and what comes of it
_PROBE = """
import errno, fcntl, os, sqlite3, sys
from tests.faults.io_faults import Fault, arm, loaded
os.chdir(sys.argv[1])
descriptor = os.open("a", os.O_RDWR)
arm(loaded(), sys.argv[1], Fault({fault}))
try:
    print({operation})
except OSError as failure:
    print(errno.errorcode[failure.errno])
except sqlite3.Error as failure:
    print(failure.sqlite_errorname)
"""
_SEEN = [
    ("'write', 'fail once', 1, 'ENOSPC'", "os.write(descriptor, b'x')", "ENOSPC"),
    ("'write', 'fail once', 2, 'ENOSPC'", "os.write(descriptor, b'x')", "1"),
    ("'write', 'fail once', 1, 'EINTR'", "os.write(descriptor, b'x')", "1"),  # Python tries again
    ("'write', 'cut short', 1", "os.write(descriptor, b'four')", "2"),
    ("'write', 'fail from then on', 2, 'ENOSPC'", "[os.write(descriptor, b'x') for _ in range(3)]", "ENOSPC"),
    ("'read', 'fail once', 1, 'EIO'", "open('a', 'rb').read()", "EIO"),
    ("'read', 'cut short', 1", "os.read(descriptor, 4)", "b'12'"),
    ("'open', 'fail once', 1, 'EACCES'", "open('a')", "EACCES"),
    ("'create', 'fail once', 1, 'ENOSPC'", "open('b', 'x')", "ENOSPC"),
    ("'list', 'fail once', 1, 'EIO'", "os.listdir(os.getcwd())", "EIO"),
    ("'status', 'fail once', 1, 'EIO'", "os.stat(os.path.abspath('a'))", "EIO"),
    ("'sync', 'fail once', 1, 'EIO'", "os.fsync(descriptor)", "EIO"),
    ("'rename', 'fail once', 1, 'EACCES'", "os.rename('a', 'b')", "EACCES"),
    ("'remove', 'fail once', 1, 'EACCES'", "os.unlink('a')", "EACCES"),
    ("'make', 'fail once', 1, 'ENOSPC'", "os.mkdir('b')", "ENOSPC"),
    ("'lock', 'fail once', 1, 'ENOLCK'", "fcntl.flock(descriptor, fcntl.LOCK_EX)", "ENOLCK"),
    ("'allocate', 'fail once', 1, 'ENOSPC'", "os.posix_fallocate(descriptor, 0, 100)", "ENOSPC"),
    ("'write', 'fail once', 1, 'EIO'", "sqlite3.connect('b').execute('CREATE TABLE c (d)')", "SQLITE_IOERR_WRITE"),
    ("'sync', 'fail once', 1, 'EIO'", "sqlite3.connect('b').execute('CREATE TABLE c (d)')", "SQLITE_IOERR_FSYNC"),
]


@pytest.fixture(scope="module")
def library(tmp_path_factory: pytest.TempPathFactory) -> Path:
    made = compiled(tmp_path_factory.mktemp("library"))
    if made is None:
        pytest.skip("there is no C compiler, cc, to compile io_faults.c with")
    return made


@pytest.mark.parametrize(("fault", "operation", "seen"), _SEEN)
def test_a_program_sees_the_fault(library: Path, fault: str, operation: str, seen: str, tmp_path: Path) -> None:
    (tmp_path / "a").write_bytes(b"1234")
    probe = [sys.executable, "-c", _PROBE.format(fault=fault, operation=operation), str(tmp_path)]
    environment = {**os.environ, "LD_PRELOAD": str(library), "PYTHONPATH": str(ROOT)}
    ended = subprocess.run(probe, capture_output=True, text=True, env=environment, timeout=HANG_S, check=True)
    assert ended.stdout.strip() == seen


class Careless:
    """Stands in for the process of the trials: a command that writes one file, and treats faults in a careless way."""

    def __init__(self, careless: Callable[[Path], Ended]) -> None:
        self._careless = careless

    def run(self, trial: Trial) -> Ended:
        out = Path(trial.folder) / "out"
        out.mkdir(exist_ok=True)
        if trial.diary is not None:
            Path(trial.diary).write_text("5 write /out/noise.json\n")
        if trial.fault.action != "count":
            return self._careless(out)
        if not (out / "noise.json").exists():
            (out / "noise.json").write_text("whole")
        return Ended(0, "", "")


def _named(out: Path, *, stray: str = "", words: str = "faintfield: DiskFull: no room; make room") -> Ended:
    return Ended(1, "", words + "\n", 1, stray)


def _written(out: Path, name: str, content: str, ended: Ended) -> Ended:
    (out / name).write_text(content)
    return ended


@pytest.mark.parametrize(
    ("careless", "found"),
    [
        (lambda out: Ended(CRASHED, "", "Traceback"), "Traceback"),
        (lambda out: _named(out, words="OSError"), "OSError"),
        (lambda out: _named(out, words="faintfield: DiskFull: no room"), "no room"),
        (lambda out: _named(out, stray="write /etc/passwd"), "/etc/passwd"),
        (lambda out: _written(out, "noise.json", "wh", _named(out)), "differs: out/noise.json"),
        (lambda out: _written(out, ".noise.json.1234.unfinished", "wh", _named(out)), "left: "),
        (lambda out: _written(out, "noise.json", "wh", Ended(0, "", "")), "differs: out/noise.json"),
        (lambda out: Ended(0, "", ""), "not both there"),
        (lambda out: _written(out.parent / "session", "plan.json", "", _named(out)), "differs: session/plan.json"),
    ],
)
def test_a_careless_command_is_found(careless: Callable[[Path], Ended], found: str, tmp_path: Path) -> None:
    (tmp_path / "inputs" / "noise" / "session").mkdir(parents=True)
    (tmp_path / "inputs" / "noise" / "session" / "plan.json").write_text("planned")
    bench = Bench(tmp_path, Careless(careless))
    bench.undisturbed("noise")
    with pytest.raises(AssertionError, match=found):
        assert_survives(bench, "noise", Fault("write", "fail once", 1, "ENOSPC"))


def test_a_careful_command_is_not_blamed(tmp_path: Path) -> None:
    (tmp_path / "inputs" / "noise").mkdir(parents=True)
    bench = Bench(tmp_path, Careless(_named))
    assert bench.calls("noise") == ["write"]
    assert assert_survives(bench, "noise", Fault("write", "fail once", 1, "ENOSPC"))


def calls_on(bench: Bench, name: str, kind: str, words: str) -> list[int]:
    """Return which of the calls of a kind, counted from 1, an undisturbed run makes on files with these words."""
    bench.undisturbed(name)
    diary = bench.folder(name).with_suffix(".calls").read_text().splitlines()
    of_kind = [line for line in diary if line.split()[0] == str(KINDS.index(kind))]
    found = [nth for nth, line in enumerate(of_kind, 1) if words in line and not line.endswith(UNFINISHED)]
    assert found
    return found


@pytest.mark.parametrize("error", ["EACCES", "EIO"])
@pytest.mark.parametrize(
    ("kind", "words"),
    [("open", "/.parts/"), ("status", "/noise_reference.tiff")],
    ids=["a colour that was just written", "a frame that a set may lack"],
)
def test_what_cannot_be_read_is_not_taken_for_absent(bench: Bench, kind: str, words: str, error: str) -> None:
    for nth in calls_on(bench, "reconstruct", kind, words):
        assert_survives(bench, "reconstruct", Fault(kind, "fail once", nth, error))
