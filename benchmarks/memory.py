"""The peak memory of a process that loads a problem and makes passes over it: `python -m benchmarks.memory SIZE_PX`."""

import json
import re
import sys
from pathlib import Path

import numpy as np

from benchmarks.problem import BenchmarkProblem

_MB = 1e6


def _peak_mb() -> float:
    """Return the peak memory of this process; that from `resource` would include the process that started it."""
    found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) * 1024 / _MB if found else float("nan")


def main() -> None:
    """Print the peak before the passes, and how much they add to it, in all and beyond six planes."""
    problem = BenchmarkProblem.of_size(int(sys.argv[1]))
    before = _peak_mb()
    operator, plane = problem.operator(), np.ones(problem.grid().shape, np.float32)
    for _ in range(3):
        plane *= operator.adjoint_of_ratio(plane, problem.images)
    grown = _peak_mb() - before
    print(
        json.dumps(
            {
                "images_mb": problem.images.electrons.nbytes / _MB,
                "process_with_images_mb": before,
                "passes_need_mb": grown,
                "six_planes_mb": 6 * plane.nbytes / _MB,
                "beyond_six_planes_mb": grown - 6 * plane.nbytes / _MB,
            }
        )
    )


main()
