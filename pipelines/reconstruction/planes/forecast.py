"""Predicted time and memory of planes, before they are made: from a few timed steps on this computer, in proportion."""

import time
from collections.abc import Callable, Sequence
from functools import partial

import msgspec
import numba
import numpy as np

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.console import duration_text
from faintfield.pipelines.formats.frames import ChannelLayout
from faintfield.pipelines.formats.plane_poses import Place
from faintfield.pipelines.formats.results.records import JOINT_METHODS, Method
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import view_electrons
from faintfield.pipelines.reconstruction.operators import OperatorFactory
from faintfield.pipelines.reconstruction.planes.sweep import Sweep
from faintfield.recon.likelihood.images import ElementalImages
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.penalty_weight import WINDOW_SAMPLES
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.solver.uncertainty import DRAWS

# Views of the timed pass, steps of the timed inner problem; the least of so many times counts.
_VIEWS, _STEPS, _TIMES = 8, 40, 3

# Time and memory of a process without data, and arrays of a plane's samples at the peak, without and with a prior.
_PROCESS_S, _PROCESS_MB, _ARRAYS, _ARRAYS_WITH_PRIOR = 3.0, 350, 16, 35

# Passes of methods that make no inner steps.
_PASSES = {"backprojection": 3.0, "mlem": 22.0, "pmlem-osl": 40.0}


class Forecast(msgspec.Struct, frozen=True, kw_only=True):
    """Predicted cost of the planes of a command on this computer; the noise of a scene changes it by up to a third.

    Attributes
    ----------
    planes : int
        Planes that are to be made, all methods together; those that are there are kept.
    seconds, memory_mb, disk_mb : float
        Time without the report; largest memory of the process, the images of one colour included; files written.
    """

    planes: int
    seconds: float
    memory_mb: float
    disk_mb: float

    def __str__(self) -> str:
        threads = int(numba.config.NUMBA_NUM_THREADS)
        return (
            f"{self.planes} plane(s), about {duration_text(self.seconds)} with {threads} threads of this computer, "
            f"{self.memory_mb / 1e3:.1f} GB of memory, {self.disk_mb / 1e3:.2g} GB on the disk"
        )


def forecast(sweep: Sweep) -> Forecast:
    """Return the predicted cost of the planes of a sweep that are missing, none of them solved together."""
    plan, elemental_set = sweep.plan, sweep.elemental_set
    missing = [files for files in plan.files if (files.method, files.place) not in sweep.finished]
    disk_mb = sweep.needed_bytes() / 1e6
    if not missing:
        return Forecast(planes=0, seconds=0.0, memory_mb=_PROCESS_MB, disk_mb=disk_mb)
    layout = max(plan.layouts, key=lambda layout: len(layout.lattices))
    place = max(plan.grids, key=lambda place: _samples(plan.grids[place]))
    grid = plan.grids[place]
    pass_s, step_s = _times(elemental_set, layout, place, grid)
    colours_of_plane = sum(len(other.lattices) for other in plan.layouts) / len(layout.lattices)
    seconds = _PROCESS_S + _reading_s(elemental_set, plan.layouts) * (2 if plan.solver.has_prior else 1)
    for files in missing:
        passes, steps = _work(files.method, plan.solver, _samples(grid))
        share = _samples(plan.grids[files.place]) / _samples(grid)
        seconds += passes * colours_of_plane * pass_s + share * steps * len(plan.layouts) * step_s
    pixels = len(layout.lattices) * layout.lattices[0].shape[0] * layout.lattices[0].shape[1]
    arrays = _ARRAYS_WITH_PRIOR if plan.solver.has_prior else _ARRAYS
    of_images, of_arrays = len(elemental_set.settings.view) * pixels, arrays * _samples(grid)
    memory_mb = _PROCESS_MB + (of_images + of_arrays) * np.dtype(np.float32).itemsize / 1e6
    return Forecast(planes=len(missing), seconds=seconds, memory_mb=memory_mb, disk_mb=disk_mb)


def has_forecast(methods: Sequence[Method]) -> bool:
    """Return whether planes of these methods are each made alone: their time is in proportion to their number."""
    return not set(methods).intersection(JOINT_METHODS)


def _samples(grid: PlaneGrid) -> int:
    return grid.shape[0] * grid.shape[1]


def _work(method: Method, solver: SolverOptions, samples: int) -> tuple[float, float]:
    """Return about how many passes, and inner steps or what takes as long, a plane of one colour takes."""
    if method != "pmlem":
        return _PASSES[method], 0.0
    of_weight = _share(samples, WINDOW_SAMPLES)
    passes, steps, answer = 9 + 9 * of_weight, 650 + of_weight * (2000 if of_weight == 1 else 5000), 1600
    if solver.has_prior:
        candidates = 3500 if of_weight == 1 else 1000  # of large planes mostly means of samples
        passes, answer = passes + 8, 2 * answer + candidates
        steps += 100 + candidates + of_weight * 8000
    return passes, steps + DRAWS * answer * solver.uncertainty


def _share(samples: int, of_windows: int) -> float:
    """Return the share of a plane that is reconstructed for a choice: windows of large planes, else all."""
    return of_windows / samples if samples >= 2 * of_windows else 1.0


def _reading_s(elemental_set: ElementalSet, layouts: Sequence[ChannelLayout]) -> float:
    """Return the time in which all threads read the frames, once for each colour, from that of one frame."""
    frames = sum(map(len, elemental_set.frame_paths))
    first = [elemental_set.frame_paths[0][0]]
    one_s = sum(_least_s(partial(view_electrons, elemental_set, layout, first)) for layout in layouts)
    return frames * one_s / int(numba.config.NUMBA_NUM_THREADS)


def _times(elemental_set: ElementalSet, layout: ChannelLayout, place: Place, grid: PlaneGrid) -> tuple[float, float]:
    """Return the times of a pass over all views and of a step of the inner problem, for one colour of a plane."""
    views, factory = len(elemental_set.settings.view), OperatorFactory(elemental_set, layout, None)
    seeing = np.unique(factory.at(place, grid).seeing_views // len(layout.lattices))
    few = seeing[max((seeing.size - _VIEWS) // 2, 0) :][:_VIEWS]
    operator = factory.at(place, grid, few.tolist())
    images = ElementalImages(np.zeros(operator.images_shape, np.float32), read_variance_e2=1.0)
    samples = np.ones(grid.shape, np.float32)
    dual = DualField.zero([grid.shape], samples.dtype)

    def steps() -> None:
        dual.prox(samples, samples, 1.0, Penalty(), lambda _: -1.0, _STEPS)

    pass_s = _least_s(lambda: operator.value_and_ratio(samples, images)) * views / few.size
    return pass_s, _least_s(steps) / _STEPS


def _least_s(work: Callable[[], object]) -> float:
    times = []
    for _ in range(_TIMES):  # the first compiles
        started = time.perf_counter()
        work()
        times.append(time.perf_counter() - started)
    return min(times)
