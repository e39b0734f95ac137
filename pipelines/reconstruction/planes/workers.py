"""Tasks of a sweep in processes of this machine, or on dask.distributed by the workers of a scheduler."""

import multiprocessing
import os
import signal
import sys
import tempfile
from collections import Counter, deque
from collections.abc import Callable, Generator, Iterable, Iterator, Sequence
from concurrent.futures import FIRST_COMPLETED, CancelledError, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field, replace
from functools import lru_cache
from multiprocessing import forkserver
from multiprocessing.reduction import ForkingPickler
from pathlib import Path
from threading import Thread, current_thread, main_thread
from traceback import format_exception
from typing import Any

import numba
import numpy as np
from numpy.typing import DTypeLike, NDArray

from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.errors import ClusterFailed, WrongUsage, import_optional
from faintfield.pipelines.formats.files import UNFINISHED, translated_write_errors
from faintfield.pipelines.formats.frames import ChannelLayout, read_frame
from faintfield.pipelines.formats.large_arrays import mapped
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import load_channel
from faintfield.pipelines.reconstruction.planes.sweep import Channel, PlaneTask, Runner, do_task, run_serially
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.names import on_compiling

# So many processes may die of the same job.
_MOST_DEATHS = 4

# Interval in s at which the command looks whether a process compiles kernels.
_POLL_S = 0.5

# Libraries of linear algebra start a thread per core as they are loaded, unless these say otherwise. And a process must
# not import modules that lie in the current folder, which may be a stranger's.
_ENVIRONMENT = {
    **dict.fromkeys(("OMP_NUM_THREADS", "MKL_NUM_THREADS", "OPENBLAS_NUM_THREADS"), "1"),
    "PYTHONSAFEPATH": "1",
}

_LOST = "run the same command again, and only what is missing is done; the logs of the workers say more"


def make_runner(workers: int | None, scheduler: str | None) -> Runner:
    """Return what runs the tasks: this process, `workers` processes of one thread, or the workers of a scheduler.

    Raises
    ------
    WrongUsage
        Both are given.
    MissingPackage
        dask.distributed is not installed.
    """
    if workers is None and scheduler is None:
        return run_serially
    if workers is not None and scheduler is not None:
        raise WrongUsage("--workers starts processes here, --scheduler names one that has its own; give one of them")
    if scheduler is not None:
        _distributed()

    def run(
        elemental_set: ElementalSet, out: Path, tasks: Sequence[PlaneTask]
    ) -> Generator[tuple[PlaneTask, list[str]]]:
        if not tasks:
            return
        with _shared_folder(out) as shared:
            jobs = _jobs(elemental_set, shared, tasks)
            if scheduler is None:
                for job, messages in in_processes(workers or 1, _do, list(jobs)):
                    yield job.task, messages
            else:
                with _client(scheduler) as client:
                    yield from _as_done(client, jobs)

    return run


def in_processes[Job, Result](
    count: int, work: Callable[[Job], Result], jobs: Sequence[Job]
) -> Generator[tuple[Job, Result]]:
    """Do jobs in at most `count` processes of one thread; yield each with its result when it is done, in any order.

    A process takes the next job when it is done with one, so jobs that share data should stand together. If a process
    dies, all are started anew, and what they were at is done again. They end with the generator. `work` is a function
    of a module, which the processes import; jobs, results and failures are pickled.

    Raises
    ------
    ClusterFailed
        A process died four times while the same job was done, or none can be started.
    """
    left, deaths, announcements = deque(range(len(jobs))), Counter[int](), [*on_compiling]

    def results(running: dict[Future[Result], int]) -> Generator[tuple[Job, Result]]:
        with _processes(min(count, len(left))) as (pool, compiles):

            def begin() -> None:
                while left and len(running) < count:
                    with _starting_processes():
                        running[pool.submit(_result_of, work, jobs[left[0]])] = left[0]
                    left.popleft()

            begin()
            while running:
                done, _ = wait(running, _POLL_S, FIRST_COMPLETED)
                while compiles.value and announcements:
                    announcements.pop(0)()
                for future in sorted(done, key=lambda future: future.exception() is not None):  # results first
                    result = future.result()
                    index = running.pop(future)
                    with suppress(BrokenProcessPool):  # which the others say, too
                        begin()
                    yield jobs[index], result

    while left:
        running: dict[Future[Result], int] = {}
        with suppress(BrokenProcessPool):
            yield from results(running)
        deaths.update(running.values())
        left.extendleft(sorted(running.values(), reverse=True))
        if max(deaths.values(), default=0) == _MOST_DEATHS:
            raise ClusterFailed(
                f"processes died {_MOST_DEATHS} times while the same plane was made, perhaps of short memory; give "
                "fewer --workers: what is done is kept"
            )


@contextmanager
def _processes(count: int) -> Iterator[tuple[ProcessPoolExecutor, Any]]:
    """Provide processes, and a flag that they set when they compile.

    On Linux they are copies of one that has loaded all modules. On macOS, whose libraries do not stand copying, and on
    Windows, which cannot copy processes, each loads them itself.
    """
    context = multiprocessing.get_context("forkserver" if sys.platform == "linux" else "spawn")
    before = set(multiprocessing.active_children())
    with _starting_processes():
        compiles = context.RawValue("b")
        if sys.platform == "linux":
            forkserver.set_forkserver_preload([__name__])
            forkserver.ensure_running()
    pool = ProcessPoolExecutor(count, context, _prepare, (compiles,))
    try:
        yield pool, compiles
    finally:
        for process in set(multiprocessing.active_children()) - before:
            process.kill()  # those at work, too: nothing of theirs is left to be written
        pool.shutdown(cancel_futures=True)


@contextmanager
def _starting_processes() -> Iterator[None]:
    """Give processes that are started within their environment, and name the failure if they cannot be.

    They ignore Ctrl-C, which is for the command: it ends them.
    """
    environment = {name: os.environ.get(name) for name in _ENVIRONMENT}
    handler = signal.signal(signal.SIGINT, signal.SIG_IGN) if current_thread() is main_thread() else None
    os.environ.update(_ENVIRONMENT)
    try:
        yield
    except (OSError, EOFError) as failure:
        raise ClusterFailed(
            f"processes cannot be started ({failure or 'the first one ended'}); set TMPDIR to a folder with a short "
            "name on this computer, or leave out --workers"
        ) from failure
    finally:
        for name, value in environment.items():
            os.environ.pop(name) if value is None else os.environ.update({name: value})
        if current_thread() is main_thread():
            signal.signal(signal.SIGINT, handler)


def _prepare(compiles: Any) -> None:
    """Make a process ready for its jobs: it has one thread, and ends with the command."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    Thread(target=_end_with_command, daemon=True).start()
    numba.config.NUMBA_NUM_THREADS = 1
    on_compiling.append(lambda: setattr(compiles, "value", 1))


def _end_with_command() -> None:
    """Wait for the end of the process that started this one, however it ended, and end, too."""
    command = multiprocessing.parent_process()
    assert command is not None
    command.join()
    os._exit(1)


def _result_of[Job, Result](work: Callable[[Job], Result], job: Job) -> Result:
    """Do a job; a failure that cannot be sent is sent in words."""
    try:
        return work(job)
    except Exception as failure:  # of any kind: it is raised again, by the command
        try:
            ForkingPickler.dumps(failure)
        except Exception:  # pickling calls the methods of the failure, and what it holds
            raise RuntimeError("".join(format_exception(failure))) from None
        raise


def _distributed() -> Any:
    return import_optional("distributed", "cluster", "leave out --scheduler")


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    try:
        client = _distributed().Client(scheduler)
    except (OSError, ValueError) as failure:
        raise ClusterFailed(
            f"no scheduler answers at {scheduler} ({failure}); start `dask scheduler`, or correct --scheduler"
        ) from failure
    with client:
        yield client


def _as_done(client: Any, jobs: "Iterable[_Job]") -> Generator[tuple[PlaneTask, list[str]]]:
    """Submit the jobs and yield the task of each when it is done; those of a worker that dies go to another."""
    distributed = _distributed()
    pending: dict[Any, PlaneTask] = {}
    try:
        for job in jobs:
            pending[client.submit(_do, job, pure=False)] = job.task
        for future in distributed.as_completed(list(pending)):
            messages = future.result()
            future.release()  # otherwise it would be computed again if its worker died
            yield pending.pop(future), messages
    except distributed.KilledWorker as failure:
        raise ClusterFailed(f"{failure.allowed_failures + 1} workers died of the same plane; {_LOST}") from failure
    except FileNotFoundError as failure:
        raise ClusterFailed(
            f"a worker does not find {failure.filename}; give --out a folder that all workers see under the same path"
        ) from failure
    except CancelledError as failure:
        raise ClusterFailed(f"the scheduler went away with {len(pending)} tasks to be done; {_LOST}") from failure
    finally:
        client.cancel(list(pending))
        if client.status == "running":
            client.run(_opened.cache_clear)


@contextmanager
def _shared_folder(out: Path) -> Iterator[Path]:
    """Make a folder in `out` for what the workers read, and remove it at the end."""
    with translated_write_errors(out):
        out.mkdir(parents=True, exist_ok=True)
        folder = tempfile.TemporaryDirectory(
            prefix=".shared.", suffix=UNFINISHED, dir=out.resolve(), ignore_cleanup_errors=True
        )
    with folder as name:
        yield Path(name)


@dataclass(frozen=True)
class _Colour:
    """A colour in files: `path`, whose suffixes tell its arrays apart, and the shape (view, row, column).

    The set is without its maps, so that a task is small; of its noise, it keeps what converts light to its unit.
    """

    path: Path
    shape: tuple[int, ...]
    elemental_set: ElementalSet = field(compare=False)
    layout: ChannelLayout = field(compare=False)

    def pixels(self, dtype: DTypeLike) -> Path:
        """Return the path of the pixels of a data type: float32 electrons, or whether each is valid."""
        return self.path.with_suffix(f".{np.dtype(dtype).name}")


@dataclass(frozen=True)
class _Job:
    """A task with the files of its colours, by name."""

    task: PlaneTask
    colours: dict[str, _Colour]


def _jobs(elemental_set: ElementalSet, shared: Path, tasks: Sequence[PlaneTask]) -> Iterator[_Job]:
    """Yield what workers do for each task; the images of a colour are written when the first task needs them."""
    colours: dict[str, _Colour] = {}
    for task in tasks:
        for layout in task.layouts:
            if layout.name not in colours:
                colours[layout.name] = _share(elemental_set, layout, shared)
        elsewhere = tuple(replace(files, folder=files.folder.resolve()) for files in task.files)
        yield _Job(replace(task, files=elsewhere), {layout.name: colours[layout.name] for layout in task.layouts})


def _share(elemental_set: ElementalSet, layout: ChannelLayout, shared: Path) -> _Colour:
    """Read a colour into files that all workers map: its electrons, its valid pixels, and the maps of the detector."""
    noise = elemental_set.noise
    means = NoiseModel(
        float(np.mean(noise.offset_dn)), float(np.mean(noise.gain_dn_per_e)), 0.0, saturation_dn=noise.saturation_dn
    )
    small = replace(elemental_set, noise=means, flat=None, unusable=np.zeros((0, 0), bool), read_frame=read_frame)
    shape = (len(elemental_set.settings.view) * len(layout.lattices), *layout.lattices[0].shape)
    colour = _Colour(shared / layout.name, shape, small, layout)

    def allocate(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        with translated_write_errors(shared.parent), colour.pixels(dtype).open("wb+") as file:
            return mapped(file, shape, dtype)

    images = load_channel(elemental_set, layout, allocate)
    flat = {} if elemental_set.flat is None else {"flat": elemental_set.flat}
    with translated_write_errors(shared.parent):
        np.savez(
            colour.path.with_suffix(".npz"),
            allow_pickle=False,
            background_e=images.background_e,
            read_variance_e2=images.read_variance_e2,
            unusable=elemental_set.unusable,
            **flat,
        )
    return colour


@lru_cache(maxsize=1)
def _opened(colour: _Colour) -> Channel:
    with np.load(colour.path.with_suffix(".npz"), allow_pickle=False) as file:
        maps: dict[str, Any] = {name: values if values.ndim else float(values) for name, values in file.items()}
    elemental_set = replace(colour.elemental_set, flat=maps.pop("flat", None), unusable=maps.pop("unusable"))
    electrons = np.asarray(np.memmap(colour.pixels(np.float32), np.float32, "r", shape=colour.shape))
    mask = colour.pixels(np.bool_)
    valid = np.asarray(np.memmap(mask, np.bool_, "r", shape=colour.shape)) if mask.is_file() else None
    return Channel(elemental_set, colour.layout, ElementalImages(electrons, valid=valid, **maps))


def _do(job: _Job) -> list[str]:
    return do_task(job.task, lambda layout: _opened(job.colours[layout.name]))
