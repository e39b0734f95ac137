"""The peak memory of a process that loads a problem and works on it: `python -m benchmarks.speed.memory SIZE_PX TASK`.

Tasks are "passes" over the data of one plane, and "joint" and "occlusion", which solve two planes together.
"""

import json
import re
import sys
from itertools import islice
from pathlib import Path

import numpy as np

from benchmarks.speed.problem import BenchmarkProblem
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.pmlem import pmlem

_MB = 1e6

_DEPTHS_MM = (480.0, 520.0)


def _peak_mb() -> float:
    """Return the peak memory of this process; that from `resource` would include the process that started it."""
    found = re.search(r"VmHWM:\s*(\d+) kB", Path("/proc/self/status").read_text())
    return int(found[1]) * 1024 / _MB if found else float("nan")


def _make_passes(problem: BenchmarkProblem) -> None:
    """Make three passes over the data of one plane."""
    operator, plane = problem.operator(), np.ones(problem.grid().shape, np.float32)
    for _ in range(3):
        plane *= operator.adjoint_of_ratio(plane, problem.images)


def _solve(problem: BenchmarkProblem, *, occluded: bool) -> None:
    """Make three passes of PMLEM for two planes together, of which the nearer may hide the other."""
    opacities = [np.full(problem.grid().shape, 0.5, np.float32)] * 2 if occluded else None
    posed = SceneProblem(problem.scene(_DEPTHS_MM, opacities), problem.images)
    start = posed.start()
    for _ in islice(pmlem(posed.fit(1.0), start, penalty_weight=1.0, dual=posed.dual()), 3):
        pass


def main() -> None:
    """Print what the task adds to the peak of a process that has loaded the problem."""
    problem, task = BenchmarkProblem.of_size(int(sys.argv[1])), sys.argv[2]
    before = _peak_mb()
    if task == "passes":
        _make_passes(problem)
    else:
        _solve(problem, occluded=task == "occlusion")
    grown, images_mb = _peak_mb() - before, problem.images.electrons.nbytes / _MB
    plane_mb = problem.flat.nbytes / _MB
    figures = {
        "passes": {
            "images_mb": images_mb,
            "process_with_images_mb": before,
            "passes_need_mb": grown,
            "six_planes_mb": 6 * plane_mb,
            "beyond_six_planes_mb": grown - 6 * plane_mb,
        },
        "joint": {"two_planes_mb": 2 * plane_mb, "joint_needs_mb": grown, "joint_over_images": grown / images_mb},
        "occlusion": {"occlusion_needs_mb": grown, "occlusion_over_images": grown / images_mb},
    }
    print(json.dumps(figures[task]))


main()
