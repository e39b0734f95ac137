"""Solutions by libraries on the same operator, the inner problem alone by scikit-image, and filters of a picture.

    python -m benchmarks.speed.peers [--size-px 1024] [--bm3d PYTHON]

Solvers are compared at one criterion, filters by their errors, too. Libraries that are not installed are left out;
PYTHON is one that has the package `bm3d`. Contenders take turns in one run; times are of the wall clock.
"""

import argparse
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import cv2
import numpy as np
from skimage import data
from skimage.restoration import denoise_nl_means, denoise_tv_chambolle

from benchmarks.imaging.bm3d_peer import Bm3d
from benchmarks.speed.library_solver import installed_solvers, iterates_of
from benchmarks.speed.solvers import seconds_to_criterion, solved_scene
from faintfield.recon.likelihood.images import Image
from faintfield.recon.prior.collaborative import patch_candidates
from faintfield.recon.prior.evidence import Evidence, Noise
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField

# Seconds after which a solver is given up, and excess of the inner objective over its minimum that must be reached.
_LIMIT_S = 400.0
_EXCESS = 1e-4

_MAX_STEPS = 20_000

# Noise of the picture that is filtered, relative to white, and calls of a filter of which the fastest counts.
_SIGMA, _TIMES = 0.2, 3

# Levels of 16-bit pictures for OpenCV, black and white; strengths of non-local means, relative to σ.
_BLACK, _WHITE = 20_000.0, 40_000.0
_STRENGTHS = (0.4, 0.6, 0.8, 1.0, 1.5, 2.0, 3.0)


def compare_solutions(size_px: int) -> dict[str, tuple[float | None, float | None]]:
    """Return passes and seconds of PMLEM and of each library until the plane stays close to the optimum."""
    problem, ours = solved_scene(size_px)
    _ = problem.norm  # found before the clock starts
    found = {"faintfield, PMLEM": seconds_to_criterion(ours, problem.optimum, _LIMIT_S)}
    for name, solver in installed_solvers().items():
        if solver is not None:
            found[f"{name}, primal-dual"] = seconds_to_criterion(
                partial(iterates_of, solver, problem), problem.optimum, _LIMIT_S
            )
    return found


def compare_inner(size_px: int) -> dict[str, tuple[float, float]]:
    """Return steps and seconds of the inner problem in a metric of ones, by our iteration and by scikit-image's.

    The point is a picture of rectangles plus noise of σ 0.3, and β is σ: a usual denoising.
    """
    generator = np.random.default_rng(3)
    truth = np.full((size_px, size_px), 1.5)
    for _ in range(25):
        top, left = generator.integers(0, size_px, 2)
        high, wide = generator.integers(size_px // 16, size_px // 3, 2)
        truth[top : top + high, left : left + wide] = generator.uniform(1.0, 3.0)
    noisy, beta = (truth + 0.3 * generator.normal(size=truth.shape)).astype(np.float32), 0.3
    ones, point = np.ones_like(noisy), noisy

    def ours(relative_gap: float) -> tuple[Image, float, float]:
        started = time.perf_counter()
        bound = relative_gap * _objective(np.full_like(point, point.mean()), point, beta)
        solved = DualField.zero([point.shape], point.dtype).prox(
            point, ones, beta, Penalty(), lambda _: bound, _MAX_STEPS
        )
        return solved.plane, solved.steps, time.perf_counter() - started

    def theirs(steps: int) -> tuple[Image, float, float]:
        started = time.perf_counter()
        plane = denoise_tv_chambolle(point, weight=beta, eps=0.0, max_num_iter=steps)
        return plane, steps, time.perf_counter() - started

    ours(1e-2)  # compiled before anything is timed
    least = _objective(ours(1e-7)[0], point, beta)
    found = {}
    for name, tries in (
        ("faintfield, certified gap", (ours(10.0**-exponent) for exponent in np.arange(2, 7, 0.25))),
        ("scikit-image, denoise_tv_chambolle", (theirs(steps) for steps in (25, 50, 100, 200, 400, 800, 1600, 3200))),
    ):
        for plane, steps, seconds in tries:
            if _objective(plane, point, beta) <= (1 + _EXCESS) * least:
                found[name] = steps, seconds
                break
    return found


def compare_filters(size_px: int, python: Path | None) -> dict[str, tuple[float, float]]:
    """Return the errors, as root mean squares over σ, and seconds of filters of a photograph with white noise.

    Ours begins with total variation and makes the candidates of `patches`, of which the last counts. BM3D is given σ,
    its time that of the call within its process; means of alike patches have the strength that the truth shows best.
    """
    truth = cv2.resize(data.camera(), (size_px, size_px), interpolation=cv2.INTER_AREA).astype(np.float32) / 255
    noise = np.random.default_rng(5).normal(scale=_SIGMA, size=truth.shape).astype(np.float32)
    noisy = truth + noise
    levels = np.clip(noisy * (_WHITE - _BLACK) + _BLACK, 0, 65535).astype(np.uint16)

    def ours() -> Image:
        field = DualField.zero([noisy.shape], noisy.dtype)
        pilot = field.prox(
            noisy, np.ones_like(noisy), _SIGMA, Penalty(), lambda x: 1e-4 * float(np.vdot(x, x)), 400
        ).plane
        white = Noise(np.full_like(noisy, _SIGMA**2), np.outer([0, 1, 0], [0, 1, 0]).astype(float))
        return patch_candidates(Evidence(noisy, pilot, white, np.ones_like(noisy)))["twice"]

    def opencv(strength: float) -> Image:
        h = [strength * _SIGMA * (_WHITE - _BLACK)]
        smooth = np.asarray(cv2.fastNlMeansDenoising(levels, h, None, 7, 21, cv2.NORM_L1), np.float32)
        return (smooth - np.float32(_BLACK)) / np.float32(_WHITE - _BLACK)

    def scikit_image(strength: float) -> Image:
        return np.asarray(denoise_nl_means(noisy, 7, 10, strength * _SIGMA, fast_mode=True, sigma=_SIGMA))

    def error(plane: Image) -> float:
        return float(np.sqrt(np.square(plane - truth).mean()) / _SIGMA)

    def best(means: Callable[[float], Image]) -> Callable[[], Image]:
        return partial(means, min(_STRENGTHS, key=lambda strength: error(means(strength))))

    found = {
        name: _fastest(work, error)
        for name, work in {
            "faintfield, total variation and patches twice": ours,
            "OpenCV, fastNlMeansDenoising": best(opencv),
            "scikit-image, denoise_nl_means": best(scikit_image),
        }.items()
    }
    if python is not None:
        tries = [Bm3d(python).timed(noisy, _SIGMA) for _ in range(_TIMES)]
        found["BM3D, σ known"] = error(tries[0][0]), min(seconds for _, seconds in tries)
    return found


def _fastest(work: Callable[[], Image], error: Callable[[Image], float]) -> tuple[float, float]:
    seconds = []
    for _ in range(_TIMES):
        started = time.perf_counter()
        plane = work()
        seconds.append(time.perf_counter() - started)
    return error(plane), min(seconds)


def _objective(plane: Image, point: Image, beta: float) -> float:
    """Return ½‖x − v‖² + β TV(x), by numpy in float64."""
    x = plane.astype(np.float64)
    down, right = np.zeros((2, *x.shape))
    down[:-1], right[:, :-1] = np.diff(x, axis=0), np.diff(x, axis=1)
    return float(0.5 * np.square(x - point).sum() + beta * np.hypot(down, right).sum())


def main() -> None:
    """Print the comparisons as tables in Markdown."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks.speed.peers", description=__doc__)
    parser.add_argument("--size-px", type=int, default=1024, help="width and height of the detector and the plane")
    parser.add_argument("--bm3d", metavar="PYTHON", type=Path, help="a Python that has the package bm3d")
    arguments = parser.parse_args()
    size_px = arguments.size_px
    for title, unit, found in (
        ("a photograph with noise of 0.2 of white", "error over σ", compare_filters(size_px, arguments.bm3d)),
        ("49 views and total variation, to the criterion", "passes", compare_solutions(size_px)),
        (f"the inner problem alone, to {_EXCESS:g} above its minimum", "steps", compare_inner(size_px)),
    ):
        first = next(iter(found.values()))[1]
        sys.stdout.write(f"\n| {title} ({size_px} x {size_px}) | {unit} | seconds | over ours |\n|---|---|---|---|\n")
        for name, (count, seconds) in found.items():
            shown = [f"more than {_LIMIT_S:g} s", "", ""]
            if count is not None and seconds is not None:
                shown = [f"{count:.3g}", f"{seconds:.2f}", f"{seconds / first:.1f}" if first else ""]
            sys.stdout.write(f"| {name} | {' | '.join(shown)} |\n")
        sys.stdout.flush()


if __name__ == "__main__":
    main()
