"""What happens to real processes: interrupts, kills, full disks, places where nothing may be written."""

import contextlib
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.files import UNFINISHED
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.plane_files import PARTS
from faintfield.pipelines.formats.sets.elemental_set import load_set
from tests.patience import HANG_S

# A test may run in the background, where interrupts are ignored and stay so in children
_LAUNCH = "import signal; signal.signal(signal.SIGINT, signal.default_int_handler); {before}; " + (
    "from faintfield.pipelines.cli import main; main({words!r})"
)

# Permissions do not apply to root unless it gives up its capabilities (Linux: capset of version 3, none of them)
_WITHOUT_PRIVILEGES = (
    "import ctypes; version = (ctypes.c_uint32 * 2)(0x20080522, 0); none = (ctypes.c_uint32 * 6)(); "
    "assert ctypes.CDLL(None).capset(version, none) == 0"
)

# Long enough to be met on its way
SLOW = ["--size-px", "320", "240", "--rows", "5", "--columns", "5"]


def _python(words: Sequence[object], before: str = "pass") -> list[str]:
    return [sys.executable, "-c", _LAUNCH.format(before=before, words=[str(word) for word in words])]


def _finished(words: Sequence[object], before: str = "pass") -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        _python(words, before), capture_output=True, text=True, timeout=HANG_S, check=False, cwd=_root()
    )


def _root() -> Path:
    return Path(__file__).parents[2]


@contextlib.contextmanager
def _started(words: Sequence[object]) -> Iterator[subprocess.Popen[str]]:
    """Start a command, and end it whatever happens."""
    with subprocess.Popen(
        _python(words), stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True, cwd=_root()
    ) as process:
        try:
            yield process
        finally:
            process.kill()


def _wait_until(process: subprocess.Popen[str], condition: Callable[[], bool]) -> None:
    """Return as soon as a condition holds, or the process has ended."""
    deadline = time.monotonic() + HANG_S
    while process.poll() is None and not condition():
        assert time.monotonic() < deadline, "the process never came so far"
        time.sleep(0.002)


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def _is_whole(folder: Path) -> bool:
    """Return whether every file that a set names can be read."""
    loaded = load_set(folder)
    return all(read_frame(path).pixels_dn.size > 0 for path in loaded.image_paths)


@pytest.fixture(scope="session")
def small_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "set"
    assert run(["simulate", str(folder), "--size-px", "96", "72", "--rows", "3", "--columns", "3"]) == 0
    return folder


@pytest.mark.deep
def test_interrupted_simulation_leaves_nothing(tmp_path: Path) -> None:
    with _started(["simulate", tmp_path / "set", *SLOW]) as process:
        _wait_until(process, lambda: any(tmp_path.glob(".set.*")))
        process.send_signal(signal.SIGINT)
        said, complaint = process.communicate(timeout=HANG_S)
    assert (process.returncode, said) == (1, "")
    assert complaint.startswith("faintfield: Interrupted: ")
    assert len(complaint.splitlines()) == 1
    assert not list(tmp_path.iterdir())


def test_interrupted_reconstruction_keeps_finished_planes(small_set: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    with _started(["reconstruct", small_set, "--out", out, "--sweep-mm", "400:900:500", "--prior", "tv"]) as process:
        _wait_until(process, lambda: (out / "plane_00401.0.tiff").exists())
        process.send_signal(signal.SIGINT)
        said, complaint = process.communicate(timeout=HANG_S)
    assert (process.returncode, said) == (1, "")
    assert "Traceback" not in complaint
    assert complaint.splitlines()[-1].startswith("faintfield: Interrupted: ")  # after progress
    names = [path.name for path in out.iterdir()]
    # A colour that was just finished waits there for its plane; nothing is half-written
    assert {name for name in names if name.startswith(".")} <= {PARTS}
    assert not list(out.rglob(f"*{UNFINISHED}"))
    assert "report.html" not in names
    for path in out.glob("*.tiff"):
        assert read_frame(path).pixels_dn.shape == (72, 96)


@pytest.mark.parametrize(
    "reached", ["view_r0_c1.tiff", *(pytest.param(name, marks=pytest.mark.deep) for name in (".", "truth.json"))]
)
def test_killed_simulation_keeps_the_former_set(reached: str, small_set: Path, tmp_path: Path) -> None:
    out = Path(shutil.copytree(small_set, tmp_path / "set"))
    before = _files(out)
    with _started(["simulate", out, *SLOW, "--overwrite"]) as process:
        _wait_until(process, lambda: any(tmp_path.glob(f".set.*/{reached}")))
        process.kill()
        process.communicate(timeout=HANG_S)
    # Killed late, the simulation may have put the new set in place: then it must be whole
    assert _files(out) == before or (reached == "truth.json" and _is_whole(out))


COMMANDS: dict[str, Callable[[Path, Path], list[object]]] = {
    "darken": lambda small, out: ["darken", small, out],
    "simulate": lambda _, out: ["simulate", out, "--size-px", "96", "72"],
}


@pytest.mark.parametrize("command", COMMANDS)
def test_full_disk_is_named_and_leaves_nothing(command: str, small_set: Path, tmp_path: Path) -> None:
    limit = "import resource; resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))"
    ended = _finished(COMMANDS[command](small_set, tmp_path / "out"), before=limit)
    assert (ended.returncode, ended.stdout) == (1, ""), ended.stderr
    complaint = ended.stderr.splitlines()[-1]
    assert complaint.startswith("faintfield: DiskFull: ")
    assert "no space left on the disk" in complaint
    assert "Traceback" not in ended.stderr
    assert _files(tmp_path) == {}


def test_read_only_folder_is_named(small_set: Path, tmp_path: Path) -> None:
    (tmp_path / "locked").mkdir(mode=0o555)
    ended = _finished(COMMANDS["darken"](small_set, tmp_path / "locked" / "out"), before=_WITHOUT_PRIVILEGES)
    assert (ended.returncode, ended.stdout) == (1, ""), ended.stderr
    complaint = ended.stderr.splitlines()[-1]
    assert complaint.startswith("faintfield: CannotWrite: ")
    assert "Permission denied; name a place that can be written" in complaint
    assert not list((tmp_path / "locked").iterdir())
