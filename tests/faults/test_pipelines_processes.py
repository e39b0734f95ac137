"""Processes that are interrupted or killed, that meet a full disk, or that may not write."""

import os
import resource
import shutil
import signal
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from multiprocessing.context import ForkServerProcess
from pathlib import Path

import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.files import UNFINISHED
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.plane_files import PARTS
from faintfield.pipelines.formats.sets.elemental_set import load_set
from tests.faults.capturing import drop_rights, in_process
from tests.patience import HANG_S

SLOW = ("--size-px", 320, 240, "--rows", 5, "--columns", 5)  # long enough to be met on its way


def _run(words: Sequence[str], prepare: Callable[[], None], printed: Path) -> None:
    """Run a command in this process, with its output in `printed`/out and its messages in `printed`/err."""
    signal.signal(signal.SIGINT, signal.default_int_handler)  # which children of a background process ignore
    for stream, name in ((sys.stdout, "out"), (sys.stderr, "err")):
        os.dup2(os.open(printed / name, os.O_CREAT | os.O_WRONLY), stream.fileno())
    prepare()
    sys.exit(run(words))


def _nothing() -> None:
    pass


def _fill_disk() -> None:
    resource.setrlimit(resource.RLIMIT_FSIZE, (5000, 5000))


@contextmanager
def _started(
    words: Sequence[object], printed: Path, prepare: Callable[[], None] = _nothing
) -> Iterator[ForkServerProcess]:
    """Start a command, and end it whatever happens."""
    process = in_process(_run, [str(word) for word in words], prepare, printed)
    try:
        yield process
    finally:
        process.kill()
        process.join()


def _failure(process: ForkServerProcess, printed: Path) -> list[str]:
    """Return the lines that a command has printed before it failed, the last of which is the failure."""
    process.join(HANG_S)
    complaint = (printed / "err").read_text()
    assert (process.exitcode, (printed / "out").read_text()) == (1, ""), complaint
    assert "Traceback" not in complaint
    return complaint.splitlines()


def _wait_until(process: ForkServerProcess, condition: Callable[[], bool]) -> None:
    """Return as soon as a condition holds, or the process has ended."""
    deadline = time.monotonic() + HANG_S
    while process.is_alive() and not condition():
        assert time.monotonic() < deadline, "the process never came so far"
        time.sleep(0.002)


def _files(folder: Path) -> dict[str, bytes]:
    return {str(path.relative_to(folder)): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


@pytest.fixture(scope="session")
def small_set(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("small") / "set"
    assert run(["simulate", str(folder), "--size-px", "96", "72", "--rows", "3", "--columns", "3"]) == 0
    return folder


@pytest.fixture
def printed(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("printed")


@pytest.mark.deep
def test_interrupted_simulation_leaves_nothing(tmp_path: Path, printed: Path) -> None:
    with _started(["simulate", tmp_path / "set", *SLOW], printed) as process:
        _wait_until(process, lambda: any(tmp_path.glob(".set.*")))
        os.kill(process.pid or 0, signal.SIGINT)
        (failure,) = _failure(process, printed)
    assert failure.startswith("faintfield: Interrupted: ")
    assert not list(tmp_path.iterdir())


def test_interrupted_reconstruction_keeps_finished_planes(small_set: Path, tmp_path: Path, printed: Path) -> None:
    out = tmp_path / "out"
    words = ["reconstruct", small_set, "--out", out, "--sweep-mm", "400:900:500", "--prior", "tv"]
    with _started(words, printed) as process:
        _wait_until(process, lambda: (out / "plane_00401.0.tiff").exists())
        os.kill(process.pid or 0, signal.SIGINT)
        assert _failure(process, printed)[-1].startswith("faintfield: Interrupted: ")
    names = [path.name for path in out.iterdir()]
    # A colour that was just finished waits there for its plane; nothing is half-written
    assert {name for name in names if name.startswith(".")} <= {PARTS}
    assert not list(out.rglob(f"*{UNFINISHED}"))
    assert "report.html" not in names
    for path in out.glob("*.tiff"):
        assert read_frame(path).pixels_dn.shape == (72, 96)


@pytest.mark.parametrize(
    "stage", ["view_r0_c1.tiff", *(pytest.param(name, marks=pytest.mark.deep) for name in (".", "truth.json"))]
)
def test_killed_simulation_keeps_former_set(stage: str, small_set: Path, tmp_path: Path, printed: Path) -> None:
    out = Path(shutil.copytree(small_set, tmp_path / "set"))
    before = _files(out)
    with _started(["simulate", out, *SLOW, "--overwrite"], printed) as process:
        _wait_until(process, lambda: any(tmp_path.glob(f".set.*/{stage}")))
    if _files(out) != before:
        # Killed late, the simulation may have put the new set in place: then it must be whole
        assert stage == "truth.json"
        assert all(read_frame(path).pixels_dn.shape == (240, 320) for path in load_set(out).image_paths)


@pytest.mark.parametrize(
    ("prepare", "failure", "words"),
    [
        (_fill_disk, "DiskFull", "no space left on the disk"),
        (drop_rights, "CannotWrite", "Permission denied; name a place that can be written"),
    ],
)
def test_unwritable_place_is_named_and_left_empty(
    prepare: Callable[[], None], failure: str, words: str, small_set: Path, tmp_path: Path, printed: Path
) -> None:
    place = tmp_path / "place"
    place.mkdir(mode=0o555 if prepare is drop_rights else 0o777)
    with _started(["darken", small_set, place / "out"], printed, prepare) as process:
        complaint = _failure(process, printed)[-1]
    assert complaint.startswith(f"faintfield: {failure}: ")
    assert words in complaint
    assert not list(place.iterdir())
