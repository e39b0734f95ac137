"""Jobs in several processes of this machine, of one thread each; if a process dies, another does its job."""

import multiprocessing
import os
import signal
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from multiprocessing.reduction import ForkingPickler
from threading import Thread, current_thread, main_thread
from traceback import format_exc, format_exception
from typing import Any

import numba

from faintfield.pipelines.errors import ClusterFailed
from faintfield.recon.names import on_compiling

# Loads what takes longest before the first kernel runs.
_PRELOADED = "faintfield.pipelines.reconstruction.planes.preloaded"

# So many processes may die of the same job.
_MOST_DEATHS = 4

# Libraries of linear algebra start a thread per core as they are loaded, unless these say otherwise. And a process must
# not import modules that lie in the current folder, which may be a stranger's.
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}


@dataclass(frozen=True, eq=False)
class _Worker:
    """A process that waits for jobs, and our end of the line to it."""

    process: BaseProcess
    line: Connection


def in_processes[Job, Result](
    count: int, work: Callable[[Job], Result], jobs: Sequence[Job]
) -> Generator[tuple[Job, Result]]:
    """Do jobs in at most `count` processes; yield each with its result when it is done, in any order.

    Each process takes the next job when it is done with one, so jobs that share data should stand together. The
    processes end with the generator. A failure of `work` ends it, too.

    Parameters
    ----------
    count : int
        Number of processes; no more are started than there are jobs.
    work : callable
        A function of a module, which the processes import. Jobs, results and failures are pickled.
    jobs : sequence
        What `work` is called with.

    Raises
    ------
    ClusterFailed
        Four processes died of the same job, or none can be started.
    """
    left, deaths = deque(range(len(jobs))), Counter[int]()
    busy: dict[Connection, tuple[_Worker, int]] = {}
    workers: list[_Worker] = []
    announced = False

    def start() -> _Worker:
        workers.append(_started(work))
        return workers[-1]

    def begin(worker: _Worker) -> None:
        if left:
            busy[worker.line] = worker, left.popleft()
            with suppress(OSError):  # it is dead, which shows when it should answer
                worker.line.send(jobs[busy[worker.line][1]])

    try:
        for _ in range(min(count, len(jobs))):
            begin(start())
        while busy:
            for line in wait(list(busy)):
                assert isinstance(line, Connection)
                try:
                    answer = line.recv()
                except (EOFError, OSError):
                    _, index = busy.pop(line)
                    deaths[index] += 1
                    if deaths[index] == _MOST_DEATHS:
                        raise ClusterFailed(
                            f"{_MOST_DEATHS} processes died of the same plane, perhaps of short memory; give fewer "
                            "--workers: what is done is kept"
                        ) from None
                    left.appendleft(index)
                    begin(start())
                    continue
                if answer is None:
                    for announce in () if announced else on_compiling:
                        announce()
                    announced = True
                    continue
                worker, index = busy.pop(line)
                result, failure = answer
                if failure is not None:
                    raise failure
                begin(worker)
                yield jobs[index], result
    finally:
        for worker in workers:
            worker.process.kill()  # those without a job, too: nothing of theirs is left to be written
            worker.process.join()
            worker.line.close()


def _started(work: Callable[[Any], object]) -> _Worker:
    """Start a process that does jobs: a copy of one that has loaded all modules, which takes a second, once."""
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([_PRELOADED])
    ours, theirs = context.Pipe()
    process = context.Process(target=_serve, args=(work, theirs), daemon=True)
    before = {name: os.environ.get(name) for name in _ENVIRONMENT}
    os.environ.update(_ENVIRONMENT)
    try:
        with _interrupts_ignored():
            process.start()
    except (OSError, EOFError) as failure:
        ours.close()
        raise ClusterFailed(
            f"processes cannot be started ({failure or 'the first one ended'}); set TMPDIR to a folder with a short "
            "name on this computer, or leave out --workers"
        ) from failure
    finally:
        theirs.close()
        for name, value in before.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
    return _Worker(process, ours)


@contextmanager
def _interrupts_ignored() -> Iterator[None]:
    """Start processes that ignore Ctrl-C, which is for the command: it ends them."""
    if current_thread() is not main_thread():
        yield
        return
    before = signal.signal(signal.SIGINT, signal.SIG_IGN)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, before)


def _serve(work: Callable[[Any], object], line: Connection) -> None:
    """Do jobs as they come; answer with result and failure of each, and None when kernels begin to be compiled."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is for the command, which ends this process
    Thread(target=_end_with_command, daemon=True).start()
    numba.config.NUMBA_NUM_THREADS = 1
    on_compiling.append(lambda: line.send(None))
    with suppress(EOFError, BrokenPipeError):  # the command has ended
        while True:
            job = line.recv()
            try:
                answer = ForkingPickler.dumps((work(job), None))
            except Exception as failure:
                failure.add_note(f"in a process of --workers:\n{format_exc()}")
                answer = _pickled(failure)
            line.send_bytes(answer)


def _pickled(failure: Exception) -> memoryview:
    """Return a failure as it is sent; what it says, if it cannot be sent itself."""
    try:
        return ForkingPickler.dumps((None, failure))
    except Exception:
        return ForkingPickler.dumps((None, RuntimeError("".join(format_exception(failure)))))


def _end_with_command() -> None:
    """Wait for the end of the process that started this one, however it ended, and end, too."""
    command = multiprocessing.parent_process()
    assert command is not None
    command.join()
    os._exit(1)
