"""A pass over the data (H, ratio, Hᵀ) compared with other libraries, its scaling, and its memory."""

import json
import statistics
import subprocess
import sys
import time
from collections.abc import Callable, Mapping
from concurrent.futures import ThreadPoolExecutor

import cv2
import numba
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from benchmarks.speed.problem import BenchmarkProblem

type Run = Callable[[], object]


def compare_passes(problem: BenchmarkProblem, rounds: int) -> dict[str, float]:
    """Return the time of our pass, that of other libraries relative to it, and its own relative to reading the data."""
    # The matrices of all views take 3 GB and two minutes to build; their time is proportional to the views within 5 %
    few = np.arange(0, len(problem.poses), 4)
    all_over_few = len(problem.poses) / len(few)
    operator, plane = problem.operator(), np.ones(problem.grid().shape, np.float32)
    contenders: dict[str, Run] = {
        "ours": fused_pass(problem),
        "with_value": lambda: operator.value_and_ratio(plane, problem.images),
        "csr_of_few": sparse_pass(problem, few),
        "warp": warp_pass(problem),
        "floor": reading(problem.images.electrons),
    }
    seconds, computed = interleaved(contenders, rounds), interleaved(contenders, rounds, time.process_time)
    return {
        "pass_s": seconds["ours"],
        "scipy_csr_over_ours": all_over_few * seconds["csr_of_few"] / seconds["ours"],
        "cv2_warp_pair_over_ours": seconds["warp"] / seconds["ours"],
        "scipy_csr_over_ours_computing": all_over_few * computed["csr_of_few"] / computed["ours"],
        "cv2_warp_pair_over_ours_computing": computed["warp"] / computed["ours"],
        "ours_over_reading_the_images": seconds["ours"] / seconds["floor"],
        "with_likelihood_over_pass": seconds["with_value"] / seconds["ours"],
        "bandwidth_gb_per_s": problem.images.electrons.nbytes / seconds["floor"] / 1e9,
    }


def scaling(problem: BenchmarkProblem, rounds: int) -> dict[str, float]:
    """Return how the time of a pass grows with threads, views, pixels and planes, relative to proportional growth."""
    operator, plane = problem.operator(), np.ones(problem.grid().shape, np.float32)
    single, few = problem.operator(workers=1), np.arange(0, len(problem.poses), 4)
    half = BenchmarkProblem.of_size(problem.lens.size_px[0] // 2)
    seconds = interleaved(
        {
            "all": lambda: operator.adjoint_of_ratio(plane, problem.images),
            "one_thread": lambda: single.adjoint_of_ratio(plane, problem.images),
            "few_views": lambda: operator.adjoint_of_ratio(plane, problem.images, few),
            "half_size": fused_pass(half),
            "three_planes": _scene_pass(problem, (480.0, 500.0, 520.0)),
        },
        rounds,
    )
    return {
        "one_thread_over_all_threads": seconds["one_thread"] / seconds["all"],
        "four_times_the_views_over_proportion": seconds["all"] / seconds["few_views"] * len(few) / len(problem.poses),
        "four_times_the_pixels_over_proportion": seconds["all"] / seconds["half_size"] / 4,
        "three_planes_over_proportion": seconds["three_planes"] / seconds["all"] / 3,
    }


def interleaved(
    contenders: Mapping[str, Run], rounds: int, clock: Callable[[], float] = time.perf_counter
) -> dict[str, float]:
    """Return the median seconds of each contender; they run in turns, so that other load affects all of them alike."""
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):  # the first round compiles and warms up
        for name, run in contenders.items():
            started = clock()
            run()
            seconds[name].append(clock() - started)
    return {name: statistics.median(times[1:]) for name, times in seconds.items()}


def fused_pass(problem: BenchmarkProblem) -> Run:
    """Return our own pass: gather, ratio and scatter in one sweep."""
    operator, plane = problem.operator(), np.ones(problem.grid().shape, np.float32)
    return lambda: operator.adjoint_of_ratio(plane, problem.images)


def _scene_pass(problem: BenchmarkProblem, depths_mm: tuple[float, ...]) -> Run:
    scene = problem.scene(depths_mm)
    samples = np.ones(scene.samples_shape, np.float32)
    return lambda: scene.adjoint_of_ratio(samples, problem.images)


def sparse_pass(problem: BenchmarkProblem, views: NDArray[np.intp]) -> Run:
    """Return the pass over some views with a scipy CSR matrix of each, response and mask in it, and its transpose."""
    matrices = [_bilinear_matrix(problem, view) for view in views]
    transposes = [matrix.T.tocsr() for matrix in matrices]
    plane = np.ones(problem.grid().shape, np.float32).ravel()

    def run() -> NDArray[np.float32]:
        total = np.zeros_like(plane)
        for view, matrix, transpose in zip(views, matrices, transposes, strict=True):
            total += transpose @ _ratio(problem, view, (matrix @ plane).reshape(problem.flat.shape)).ravel()
        return total

    return run


def warp_pass(problem: BenchmarkProblem) -> Run:
    """Return the pass with OpenCV's warps, whose second is not the adjoint of the first; lens and mask are left out."""
    camera = np.linalg.inv(problem.lens.camera_matrix())
    index_from_pixel = [problem.grid().index_from_plane() @ h @ camera for h in problem.homographies()]
    size = problem.grid().shape[::-1]
    plane = np.ones(problem.grid().shape, np.float32)

    def run() -> NDArray[np.float32]:
        total = np.zeros_like(plane)
        for view, matrix in enumerate(index_from_pixel):
            seen = cv2.warpPerspective(plane, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            seen *= problem.flat
            ratio = _ratio(problem, view, seen)
            ratio *= problem.flat
            total += cv2.warpPerspective(ratio, matrix, size, flags=cv2.INTER_LINEAR)
        return total

    return run


def reading(images: NDArray[np.float32]) -> Run:
    """Return the lower bound of any pass: reading the images once, with as many threads as a pass has."""
    parts = np.array_split(images.reshape(-1), int(numba.config.NUMBA_NUM_THREADS))

    def run() -> list[float]:
        with ThreadPoolExecutor(len(parts)) as pool:
            return list(pool.map(_sum, parts))

    return run


@numba.njit(nogil=True, fastmath=True)  # type: ignore[untyped-decorator]
def _sum(part: NDArray[np.float32]) -> float:
    total = np.float32(0)
    for number in part:
        total += number
    return float(total)


def _ratio(problem: BenchmarkProblem, view: int, mean_e: NDArray[np.float32]) -> NDArray[np.float32]:
    images = problem.images
    shifted: NDArray[np.float32] = np.maximum(images.electrons[view] + images.read_variance_e2, np.float32(0))
    mean_e = mean_e + images.background_e
    mean_e += images.read_variance_e2
    shifted /= mean_e
    return shifted


def _bilinear_matrix(problem: BenchmarkProblem, view: int) -> scipy.sparse.csr_array:
    """Return H of one view, built from the rays without the operator."""
    rays = problem.lens.rays().reshape(-1, 2)
    homogeneous = np.column_stack([rays, np.ones(len(rays))])
    x, y, scale = problem.grid().index_from_plane() @ problem.homographies()[view] @ homogeneous.T
    column, row = x / scale, y / scale
    rows, columns = problem.grid().shape
    counts = (column >= 0) & (column <= columns - 1) & (row >= 0) & (row <= rows - 1)
    if problem.images.valid is not None:
        counts &= problem.images.valid[view].ravel()
    inside = np.flatnonzero(counts)
    left = np.minimum(column[inside].astype(int), columns - 2)
    top = np.minimum(row[inside].astype(int), rows - 2)
    right, down, response = column[inside] - left, row[inside] - top, problem.flat.ravel()[inside]
    weights = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    samples = [top * columns + left + offset for offset in (0, 1, columns, columns + 1)]
    entries = np.concatenate([response * weight for weight in weights]).astype(np.float32)
    matrix = scipy.sparse.coo_array(
        (entries, (np.tile(inside, 4), np.concatenate(samples))), shape=(len(rays), rows * columns)
    )
    return scipy.sparse.csr_array(matrix)


def memory(size_px: int) -> dict[str, float]:
    """Return the memory that passes and solvers need beside the data, each measured in a process of its own."""
    command = [sys.executable, "-m", "benchmarks.speed.memory", str(size_px)]
    figures: dict[str, float] = {}
    for what in ("passes", "joint", "occlusion"):
        figures |= json.loads(subprocess.run([*command, what], check=True, capture_output=True, text=True).stdout)
    return figures
