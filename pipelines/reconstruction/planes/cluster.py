"""Tasks of a sweep in processes of this machine, or on dask.distributed by the workers of a scheduler."""

import tempfile
from collections.abc import Generator, Iterable, Iterator, Sequence
from concurrent.futures import CancelledError
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import DTypeLike, NDArray

from faintfield.calib.noise_model import NoiseModel
from faintfield.pipelines.errors import ClusterFailed, MissingPackage, WrongUsage
from faintfield.pipelines.formats.files import UNFINISHED, translated_write_errors
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.large_arrays import mapped
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import ChannelLayout, load_channel
from faintfield.pipelines.reconstruction.planes.processes import in_processes
from faintfield.pipelines.reconstruction.planes.sweep import Channel, PlaneTask, Runner, do_task, run_serially
from faintfield.recon.likelihood.images import ElementalImages

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
            if scheduler is None:
                jobs = list(_jobs(elemental_set, shared, tasks))
                for job, messages in in_processes(workers or 1, _do, jobs):
                    yield job.task, messages
            else:
                with _client(scheduler) as client:
                    yield from _as_done(client, _jobs(elemental_set, shared, tasks))

    return run


def _distributed() -> Any:
    """Return dask.distributed, an optional package that only this module needs."""
    try:
        import distributed
    except ImportError as failure:
        raise MissingPackage(
            "dask.distributed is not installed; it is an extra: pip install 'faintfield[cluster]', or leave out "
            "--scheduler"
        ) from failure
    return distributed


@contextmanager
def _client(scheduler: str) -> Iterator[Any]:
    """Connect to the workers of a scheduler."""
    distributed = _distributed()
    try:
        client = distributed.Client(scheduler)
    except (OSError, ValueError) as failure:
        raise ClusterFailed(
            f"no scheduler answers at {scheduler} ({failure}); start `dask scheduler`, or correct --scheduler"
        ) from failure
    with client:
        yield client


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
    """A colour as a task names it: by the path of its arrays, whose suffixes tell them apart.

    Attributes
    ----------
    path : Path
        Path of the arrays, without suffix.
    shape : tuple of int
        Of its electrons (view, row, column).
    elemental_set : ElementalSet
        The set without its maps and its noise: what a task says is small.
    layout : ChannelLayout
        Position of the colour in the frames.
    """

    path: Path
    shape: tuple[int, ...]
    elemental_set: ElementalSet = field(compare=False)
    layout: ChannelLayout = field(compare=False)

    @property
    def maps(self) -> Path:
        """Path of the maps of the detector."""
        return self.path.with_suffix(".npz")

    def pixels(self, dtype: DTypeLike) -> Path:
        """Return the path of the pixels of a data type: float32 electrons, or whether each is valid."""
        return self.path.with_suffix(f".{np.dtype(dtype).name}")


@dataclass(frozen=True)
class _Job:
    """A task with the files of its colours."""

    task: PlaneTask
    colours: tuple[_Colour, ...]


def _jobs(elemental_set: ElementalSet, shared: Path, tasks: Sequence[PlaneTask]) -> Iterator[_Job]:
    """Return what workers do for each task; the images of a colour are written when the first task needs them."""
    colours: dict[str, _Colour] = {}
    for task in tasks:
        for layout in task.layouts:
            if layout.name not in colours:
                colours[layout.name] = _share(elemental_set, layout, shared)
        elsewhere = tuple(replace(files, folder=files.folder.resolve()) for files in task.files)
        yield _Job(replace(task, files=elsewhere), tuple(colours[layout.name] for layout in task.layouts))


def _as_done(client: Any, jobs: Iterable[_Job]) -> Generator[tuple[PlaneTask, list[str]]]:
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


def _share(elemental_set: ElementalSet, layout: ChannelLayout, shared: Path) -> _Colour:
    """Read a colour into files that all workers map: its electrons, its valid pixels, and the maps of the detector."""
    plain = replace(elemental_set, noise=NoiseModel(0.0, 1.0, 0.0), flat=None, unusable=np.zeros((0, 0), bool))
    without_maps = replace(plain, read_frame=read_frame)
    shape = (len(elemental_set.settings.view) * len(layout.lattices), *layout.lattices[0].shape)
    colour = _Colour(shared / layout.name, shape, without_maps, layout)

    def allocate(shape: tuple[int, ...], dtype: DTypeLike) -> NDArray[Any]:
        with translated_write_errors(shared.parent), colour.pixels(dtype).open("wb+") as file:
            return mapped(file, shape, dtype)

    images = load_channel(elemental_set, layout, allocate)
    flat = {} if elemental_set.flat is None else {"flat": elemental_set.flat}
    with translated_write_errors(shared.parent):
        np.savez(
            colour.maps,
            allow_pickle=False,
            background_e=images.background_e,
            read_variance_e2=images.read_variance_e2,
            unusable=elemental_set.unusable,
            **flat,
        )
    return colour


@lru_cache(maxsize=1)
def _opened(colour: _Colour) -> Channel:
    """Return the colour of files of `_share`; a worker keeps the last one."""
    with np.load(colour.maps, allow_pickle=False) as file:
        maps: dict[str, Any] = {name: values if values.ndim else float(values) for name, values in file.items()}
    elemental_set = replace(colour.elemental_set, flat=maps.pop("flat", None), unusable=maps.pop("unusable"))
    electrons = np.asarray(np.memmap(colour.pixels(np.float32), np.float32, "r", shape=colour.shape))
    mask = colour.pixels(np.bool_)
    valid = np.asarray(np.memmap(mask, np.bool_, "r", shape=colour.shape)) if mask.is_file() else None
    return Channel(elemental_set, colour.layout, ElementalImages(electrons, valid=valid, **maps))


def _do(job: _Job) -> list[str]:
    """Do a task on a worker."""
    by_name = {colour.layout.name: colour for colour in job.colours}
    return do_task(job.task, lambda layout: _opened(by_name[layout.name]))
