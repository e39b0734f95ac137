"""One pass of eq. (2) against the same pass made with other tools, interleaved in one run.

The machine may be busy: only ratios of times taken in turns are reported, as medians over rounds.
"""

import argparse
import json
import statistics
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass

import cv2
import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from calib.homography import fronto_parallel_rt_ref_plane, plane_from_ray
from calib.lens import Lens
from recon.images import ElementalImages
from recon.operator import PlaneOperator
from recon.plane import PlaneGrid
from rig.grid import nominal_poses_rt_cam_ref

_DEPTH_MM, _READ_VARIANCE_E2 = 500.0, 12.0


@dataclass(frozen=True)
class Problem:
    """49 views of a detector, a plane that overlays its reference view, and dark data."""

    lens: Lens
    homographies: NDArray[np.float64]
    grid: PlaneGrid
    images: NDArray[np.float32]

    @classmethod
    def of_size(cls, size_px: int) -> "Problem":
        """Return the problem for a square detector with a distorted lens and pose errors."""
        f_px = 1.25 * size_px
        generator = np.random.default_rng(1)
        poses = nominal_poses_rt_cam_ref(7, 7, 50.0) + generator.normal(size=(49, 6)) * np.repeat([0.0035, 0.3], 3)
        lens = Lens((size_px, size_px), f_px, f_px, size_px / 2, size_px / 2, (-0.08, 0.02))
        pitch_mm = _DEPTH_MM / f_px
        grid = PlaneGrid((size_px, size_px), pitch_mm, (-size_px / 2 * pitch_mm, -size_px / 2 * pitch_mm))
        homographies = plane_from_ray(poses, fronto_parallel_rt_ref_plane(_DEPTH_MM))
        images = generator.normal(1.0, 3.6, (49, size_px, size_px)).astype(np.float32)
        return cls(lens, homographies, grid, images)


def fused_pass(problem: Problem) -> Callable[[], object]:
    """Return our own pass: gather, ratio and scatter in one sweep."""
    operator = PlaneOperator(problem.homographies, problem.lens.rays(), problem.grid)
    data = ElementalImages(problem.images, 0.02, _READ_VARIANCE_E2)
    plane = np.ones(problem.grid.shape, np.float32)
    return lambda: operator.adjoint_of_ratio(plane, data)


def sparse_pass(problem: Problem) -> Callable[[], object]:
    """Return the pass with one scipy CSR matrix per view and its transpose."""
    matrices = [_bilinear_matrix(problem, view) for view in range(len(problem.homographies))]
    transposes = [matrix.T.tocsr() for matrix in matrices]
    plane = np.ones(problem.grid.shape, np.float32).ravel()

    def run() -> NDArray[np.float32]:
        total = np.zeros_like(plane)
        for matrix, transpose, image in zip(matrices, transposes, problem.images, strict=True):
            total += transpose @ _ratio(image.ravel(), matrix @ plane)
        return total

    return run


def warp_pass(problem: Problem) -> Callable[[], object]:
    """Return the pass with OpenCV's warps, whose second is not the adjoint of the first; the lens is left out."""
    index_from_pixel = [
        problem.grid.index_from_plane() @ homography @ np.linalg.inv(problem.lens.camera_matrix())
        for homography in problem.homographies
    ]
    size = problem.grid.shape[::-1]
    plane = np.ones(problem.grid.shape, np.float32)

    def run() -> NDArray[np.float32]:
        total = np.zeros_like(plane)
        for matrix, image in zip(index_from_pixel, problem.images, strict=True):
            seen = cv2.warpPerspective(plane, matrix, size, flags=cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP)
            total += cv2.warpPerspective(_ratio(image, seen), matrix, size, flags=cv2.INTER_LINEAR)
        return total

    return run


def floor(problem: Problem) -> Callable[[], object]:
    """Return the least that any pass must do: read the images once."""
    return problem.images.sum


def _ratio(image: NDArray[np.float32], seen: NDArray[np.float32]) -> NDArray[np.float32]:
    shifted: NDArray[np.float32] = np.maximum(image + np.float32(_READ_VARIANCE_E2), np.float32(0))
    shifted /= seen + np.float32(0.02 + _READ_VARIANCE_E2)
    return shifted


def _bilinear_matrix(problem: Problem, view: int) -> scipy.sparse.csr_array:
    """Return H of one view, built from the rays without the operator."""
    rays = problem.lens.rays().reshape(-1, 2)
    homogeneous = np.column_stack([rays, np.ones(len(rays))])
    x, y, scale = problem.grid.index_from_plane() @ problem.homographies[view] @ homogeneous.T
    column, row = x / scale, y / scale
    rows, columns = problem.grid.shape
    inside = np.flatnonzero((column >= 0) & (column <= columns - 1) & (row >= 0) & (row <= rows - 1))
    left = np.minimum(column[inside].astype(int), columns - 2)
    top = np.minimum(row[inside].astype(int), rows - 2)
    right, down = column[inside] - left, row[inside] - top
    weights = [(1 - down) * (1 - right), (1 - down) * right, down * (1 - right), down * right]
    samples = [top * columns + left + offset for offset in (0, 1, columns, columns + 1)]
    entries = np.concatenate(weights).astype(np.float32)
    matrix = scipy.sparse.coo_array(
        (entries, (np.tile(inside, 4), np.concatenate(samples))), shape=(len(rays), rows * columns)
    )
    return scipy.sparse.csr_array(matrix)


def measure(size_px: int, rounds: int) -> dict[str, float]:
    """Return how many times longer than ours each peer takes, and ours over the floor."""
    problem = Problem.of_size(size_px)
    contenders = {make.__name__: make(problem) for make in (fused_pass, sparse_pass, warp_pass, floor)}
    seconds: dict[str, list[float]] = {name: [] for name in contenders}
    for _ in range(rounds + 1):  # the first round compiles and warms up
        for name, run in contenders.items():
            started = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - started)
    typical = {name: statistics.median(times[1:]) for name, times in seconds.items()}
    ours = typical["fused_pass"]
    return {
        "size_px": size_px,
        "views": len(problem.homographies),
        "pass_s": ours,
        "scipy_csr_over_ours": typical["sparse_pass"] / ours,
        "cv2_warp_pair_over_ours": typical["warp_pass"] / ours,
        "ours_over_reading_the_images": ours / typical["floor"],
    }


def main() -> None:
    """Print the ratios as a table, or with --json as one object."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--size-px", type=int, default=512, help="width and height of the detector")
    parser.add_argument("--rounds", type=int, default=7, help="rounds to take medians over")
    arguments = parser.parse_args()
    ratios = measure(arguments.size_px, arguments.rounds)
    if arguments.json:
        sys.stdout.write(json.dumps(ratios) + "\n")
        return
    for name, value in ratios.items():
        print(f"{name:32} {value:10.3g}")


main()
