"""Passes and seconds until the plane stays close to the optimum: PMLEM, one-step-late PMLEM, and a library's solver.

The criterion is that of the PETRIC challenge: the whole plane within 1 % (root of the mean square, relative) and the
mean of a region within 0.5 % of the converged solution, ten checks in a row; the first of the ten counts.
"""

import itertools
import time
from collections.abc import Callable, Iterable, Iterator

import numpy as np
from numpy.typing import NDArray

from benchmarks.speed.library_solver import LibraryProblem, installed_solvers, iterates_of
from benchmarks.speed.problem import BenchmarkProblem
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import smooth_start
from faintfield.recon.solver.one_step_late import pmlem_one_step_late
from faintfield.recon.solver.penalty_weight import universal_penalty_weight
from faintfield.recon.solver.pmlem import pmlem

# Consecutive checks that must hold, and the time after which a solver is given up.
_IN_A_ROW = 10
_LIMIT_S = 15.0


def compare_solvers(size_px: int) -> dict[str, float | None]:
    """Return passes and seconds to the criterion, and the time of the others relative to PMLEM."""
    problem, ours = solved_scene(size_px)
    operator, images, start, weight = problem.operator, problem.images, problem.start, problem.weight
    epsilon = 0.005 * float(np.quantile(start, 0.99)) ** 2

    def late() -> Iterator[Image]:
        steps = pmlem_one_step_late(operator, images, start, penalty_weight=weight, epsilon=epsilon)
        return (iterate.plane for iterate in steps)

    settled = _last(itertools.islice(late(), 200))  # its own limit: its penalty is smoothed
    found = {
        "pmlem": seconds_to_criterion(ours, problem.optimum),
        "one_step_late": seconds_to_criterion(late, settled),
        "pyproximal": _of_library(problem),
    }
    result: dict[str, float | None] = {}
    for name, (passes, seconds) in found.items():
        result |= {f"{name}_passes": passes, f"{name}_s": seconds}
    for name in ("one_step_late", "pyproximal"):
        theirs, own = result[f"{name}_s"], result["pmlem_s"]
        result[f"{name}_over_pmlem"] = theirs / own if theirs and own else None
    return result


def solved_scene(size_px: int) -> tuple[LibraryProblem, Callable[[], Iterator[Image]]]:
    """Return dark views with the optimum of total variation, and what yields PMLEM's planes from its start."""
    operator, images = _dark_scene(size_px)
    start = smooth_start(operator, images)
    weight = universal_penalty_weight(operator, images, start)
    fit = DataFit(operator, images, float(start.mean()))

    def ours() -> Iterator[Image]:
        return (iterate.plane for iterate in pmlem(fit, start, penalty_weight=weight, tolerance=1e-3))

    optimum = _last(itertools.islice(ours(), 60))
    return LibraryProblem(operator, images, start, weight, optimum), ours


def _dark_scene(size_px: int) -> tuple[PlaneOperator, ElementalImages]:
    """Return dark views (one electron per pixel, read noise 3.5) of rectangles of several levels."""
    problem, generator = BenchmarkProblem.of_size(size_px), np.random.default_rng(4)
    operator, truth = problem.operator(), np.full(problem.grid().shape, 0.3)
    for _ in range(25):
        top, left = generator.integers(0, size_px, 2)
        high, wide = generator.integers(size_px // 16, size_px // 3, 2)
        truth[top : top + high, left : left + wide] = generator.uniform(0.1, 2.0)
    light = operator.forward(truth) + np.asarray(problem.images.background_e)
    noise = np.sqrt(np.asarray(problem.images.read_variance_e2))
    electrons = (generator.poisson(light) + noise * generator.normal(size=light.shape)).astype(np.float32)
    known = problem.images
    return operator, ElementalImages(electrons, known.background_e, known.read_variance_e2, known.valid)


def _of_library(problem: LibraryProblem) -> tuple[float | None, float | None]:
    """Return the passes and seconds of pyproximal, None if it is not installed."""
    solver = installed_solvers()["pyproximal"]
    if solver is None:
        return None, None
    return seconds_to_criterion(lambda: iterates_of(solver, problem), problem.optimum)


def seconds_to_criterion(
    iterate: Callable[[], Iterable[Image]], converged: Image, limit_s: float = _LIMIT_S
) -> tuple[float | None, float | None]:
    """Return the passes and seconds until the criterion holds; None if it does not within the limit."""
    planes = iterate()
    rows, columns = converged.shape
    region = np.s_[rows // 3 : 2 * rows // 3, columns // 3 : 2 * columns // 3]
    held: list[tuple[float, float]] = []
    checking, started = 0.0, time.perf_counter()
    for passes, plane in enumerate(planes, 1):
        now = time.perf_counter()
        error = np.linalg.norm(plane - converged) / np.linalg.norm(converged)
        close = error <= 0.01 and abs(_mean(plane[region]) / _mean(converged[region]) - 1) <= 0.005
        held = [*held, (passes, now - started - checking)] if close else []
        checking += time.perf_counter() - now
        if len(held) == _IN_A_ROW:
            return held[0]
        if now - started > limit_s:
            break
    return None, None


def _mean(part: NDArray[np.floating]) -> float:
    return float(part.mean(dtype=np.float64))


def _last[Item](items: Iterable[Item]) -> Item:
    """Return the last of some items, of which there is at least one."""
    for item in items:
        last = item
    return last
