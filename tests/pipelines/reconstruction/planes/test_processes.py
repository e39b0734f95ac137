"""Jobs in processes of this machine: as many as asked for, each job done once, and nothing left over."""

import multiprocessing
import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from functools import partial
from multiprocessing.context import ForkServerProcess
from multiprocessing.process import BaseProcess
from pathlib import Path

import pytest

from faintfield.pipelines.errors import ClusterFailed
from faintfield.pipelines.reconstruction.planes.workers import in_processes
from faintfield.recon import names
from tests.patience import HANG_S


def _wait_until(reached: Callable[[], bool]) -> None:
    """Poll, for things that another process does."""
    give_up = time.monotonic() + HANG_S
    while not reached():
        assert time.monotonic() < give_up
        time.sleep(0.01)


def _alive(process: int) -> bool:
    return Path(f"/proc/{process}").exists()


def _workers() -> list[BaseProcess]:
    """Return the processes as `in_processes` starts them; other tests may keep a process of another kind."""
    return [process for process in multiprocessing.active_children() if isinstance(process, ForkServerProcess)]


def _own_id(_: object) -> int:
    return os.getpid()


def _meet(folder: Path, name: str) -> int:
    """Return when another process is at a job, too."""
    (folder / name).touch()
    _wait_until(lambda: len([*folder.iterdir()]) == 2)
    return os.getpid()


def _die(folder: Path, times: int, job: int) -> int:
    """Die at job 1, as nothing can be caught; the first times only."""
    if job == 1 and len(deaths := [*folder.iterdir()]) < times:
        (folder / str(len(deaths))).touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return job**2


class _UnsendableError(Exception):
    """A failure that cannot be pickled."""


def _fail(job: int) -> int:
    if job == 1:
        raise ValueError(f"no {job}")
    if job == 2:
        raise _UnsendableError(lambda: None)
    return job


def _announce(_: object) -> None:
    for announce in names.on_compiling:
        announce()


def _sleep_for_good(folder: Path, _: object) -> None:
    (folder / str(os.getpid())).touch()
    signal.pause()


def test_as_many_processes_as_useful(tmp_path: Path) -> None:
    results = list(in_processes(1, _own_id, range(5)))
    assert [job for job, _ in results] == [0, 1, 2, 3, 4]
    assert len({process for _, process in results} | {os.getpid()}) == 2
    assert len({process for _, process in in_processes(2, partial(_meet, tmp_path), ["one", "other"])}) == 2
    assert list(in_processes(2, _own_id, [])) == []
    many = in_processes(64, _own_id, range(2))
    _, process = next(many)
    assert len(_workers()) <= 2
    many.close()  # abandoned
    assert not _workers()
    assert not _alive(process)


def test_job_outlives_three_processes_but_not_four(tmp_path: Path) -> None:
    assert sorted(in_processes(2, partial(_die, tmp_path, 3), range(6))) == [(job, job**2) for job in range(6)]
    assert len([*tmp_path.iterdir()]) == 3
    with pytest.raises(ClusterFailed, match="processes died 4 times while the same plane was made"):
        list(in_processes(2, partial(_die, tmp_path, 100), range(3)))
    assert len([*tmp_path.iterdir()]) == 3 + 4


@pytest.mark.parametrize(("job", "failure"), [(1, ValueError), (2, RuntimeError)])
def test_failure_comes_with_traceback_and_ends_processes(job: int, failure: type[Exception]) -> None:
    with pytest.raises(failure, match=r"no 1|_UnsendableError") as raised:
        list(in_processes(1, _fail, [0, job, 3]))
    if job == 1:
        assert "in _fail" in str(raised.value.__cause__)
    assert not _workers()


def test_compiling_is_announced_once_for_all_processes(monkeypatch: pytest.MonkeyPatch) -> None:
    announced: list[str] = []
    monkeypatch.setattr(names, "on_compiling", [lambda: announced.append("compiling")])
    monkeypatch.setattr("faintfield.pipelines.reconstruction.planes.workers.on_compiling", names.on_compiling)
    assert len(list(in_processes(2, _announce, range(4)))) == 4
    assert announced == ["compiling"]


@pytest.mark.deep
def test_processes_end_with_command_that_is_killed(tmp_path: Path) -> None:
    script = (
        "from functools import partial; from pathlib import Path\n"
        "from tests.pipelines.reconstruction.planes import test_processes as t\n"
        f"if __name__ == '__main__': list(t.in_processes(2, partial(t._sleep_for_good, Path({str(tmp_path)!r})), 'ab'))"
    )
    command = subprocess.Popen([sys.executable, "-c", script])
    try:
        _wait_until(lambda: len([*tmp_path.iterdir()]) == 2)
    finally:
        command.kill()
        command.wait()
    processes = [int(path.name) for path in tmp_path.iterdir()]
    _wait_until(lambda: not any(_alive(process) for process in processes))


@pytest.mark.deep
def test_process_has_one_thread_and_trusted_modules(tmp_path: Path) -> None:
    """In an interpreter of its own, since it has one process that all others are copied from, with its environment."""
    (tmp_path / "numba.py").write_text("open('run', 'w')")
    code = (
        "import sys; sys.path[:] = [path for path in sys.path if path]\n"
        "import os, numba\n"
        "from faintfield.pipelines.reconstruction.planes.workers import in_processes\n"
        "before = dict(os.environ), numba.config.NUMBA_NUM_THREADS\n"
        "asked = \"__import__('numba').config.NUMBA_NUM_THREADS\", "
        "\"__import__('os').environ['OPENBLAS_NUM_THREADS']\"\n"
        "if __name__ == '__main__': print([result for _, result in in_processes(1, eval, asked)])\n"
        "assert (dict(os.environ), numba.config.NUMBA_NUM_THREADS) == before"
    )
    paths = os.pathsep.join(path for path in sys.path if path)
    environment = {**os.environ, "PYTHONPATH": paths, "OPENBLAS_NUM_THREADS": "2"}
    command = [sys.executable, "-c", code]
    ended = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, timeout=HANG_S)
    assert ended.stdout == "[1, '1']\n", ended.stderr
    assert not (tmp_path / "run").exists()
