"""Speed against other libraries, as ratios within one run: a pass over the data, its scaling, memory, and solvers.

The machine may be busy, so contenders run in turns, and medians over rounds are reported.
"""

import argparse
import importlib.util
import json
import os
import platform
import re
import sys
from pathlib import Path
from typing import Any

from benchmarks.speed.passes import compare_passes, memory, scaling
from benchmarks.speed.problem import BenchmarkProblem
from benchmarks.speed.solvers import compare_solvers

_MEANING = {
    "size_px": "width and height of the detector and of the plane",
    "views": "elemental images",
    "pass_s": "one pass over the data: H, ratio, Hᵀ (s)",
    "scipy_csr_over_ours": "scipy CSR matrices over ours",
    "cv2_warp_pair_over_ours": "a pair of OpenCV warps (no lens, no mask, no adjoint) over ours",
    "scipy_csr_over_ours_computing": "scipy CSR over ours, in CPU seconds of all threads",
    "cv2_warp_pair_over_ours_computing": "a pair of OpenCV warps over ours, likewise",
    "ours_over_reading_the_images": "ours over the floor: reading the images once with all threads",
    "with_likelihood_over_pass": "a pass that also returns the likelihood, as PMLEM's do, over one that does not",
    "bandwidth_gb_per_s": "memory bandwidth of that reading (GB/s)",
    "one_thread_over_all_threads": "one thread over all threads",
    "four_times_the_views_over_proportion": "time for four times the views, over four times the time",
    "four_times_the_pixels_over_proportion": "time for four times the pixels, over four times the time",
    "three_planes_over_proportion": "time for three planes at once, over three times the time of one",
    "images_mb": "the images (MB)",
    "process_with_images_mb": "peak of a process that has loaded the problem (MB)",
    "passes_need_mb": "what passes add to that (MB)",
    "six_planes_mb": "six planes (MB)",
    "beyond_six_planes_mb": "what passes add beyond six planes (MB)",
    "two_planes_mb": "two planes (MB)",
    "joint_needs_mb": "what solving two planes together adds to the process (MB)",
    "joint_over_images": "the same over the images",
    "occlusion_needs_mb": "what it adds where the planes hide one another (MB)",
    "occlusion_over_images": "the same over the images",
    "solvers_size_px": "size of the problem for solvers",
    "pmlem_passes": "PMLEM: passes to the criterion",
    "pmlem_s": "PMLEM: seconds to the criterion",
    "one_step_late_passes": "one-step-late: passes to the criterion, against its own limit",
    "one_step_late_s": "one-step-late: seconds",
    "pyproximal_passes": "pyproximal's primal-dual: passes to the criterion",
    "pyproximal_s": "pyproximal's primal-dual: seconds",
    "one_step_late_over_pmlem": "one-step-late over PMLEM, in seconds",
    "pyproximal_over_pmlem": "pyproximal's primal-dual over PMLEM, in seconds",
}


def measure(size_px: int, solvers_size_px: int, rounds: int) -> dict[str, Any]:
    """Return all figures."""
    problem = BenchmarkProblem.of_size(size_px)
    return {
        "size_px": size_px,
        "views": len(problem.poses),
        **compare_passes(problem, rounds),
        **scaling(problem, rounds),
        **memory(size_px),
        "solvers_size_px": solvers_size_px,
        **compare_solvers(solvers_size_px),
    }


def machine() -> str:
    """Describe the machine, without its name."""
    information = Path("/proc/cpuinfo")
    found = re.search(r"model name\s*:\s*(.*)", information.read_text()) if information.exists() else None
    model = found[1] if found else platform.machine()
    load = os.getloadavg()[0]
    return f"{os.cpu_count()} cores, {model}, Python {platform.python_version()}; load average {load:.1f}"


def table(figures: dict[str, Any]) -> str:
    """Return the figures as a table in Markdown."""
    lines = ["| figure | value |", "|---|---|"]
    for name, value in figures.items():
        lines.append(f"| {_MEANING[name]} | {_shown(name, value)} |")
    return "\n".join(lines) + "\n"


def _shown(name: str, value: float | None) -> str:
    """Return a figure as text, and why there is none."""
    if value is not None:
        return f"{value:.4g}"
    missing = "pyproximal" in name and importlib.util.find_spec("pyproximal") is None
    return "pyproximal is not installed" if missing else "not reached within the limit"


def main() -> None:
    """Print the figures as a table, or with --json as one object."""
    parser = argparse.ArgumentParser(prog="python -m benchmarks", description=__doc__)
    parser.add_argument("--json", action="store_true", help="print one JSON object")
    parser.add_argument("--keep", type=Path, metavar="FILE", help="write the table to this file; its sections stay")
    parser.add_argument("--size-px", type=int, default=1024, help="width and height of the detector")
    parser.add_argument("--solvers-size-px", type=int, default=256, help="the same for the comparison of solvers")
    parser.add_argument("--rounds", type=int, default=5, help="rounds to take medians over")
    arguments = parser.parse_args()
    figures = measure(arguments.size_px, arguments.solvers_size_px, arguments.rounds)
    shown = json.dumps(figures) + "\n" if arguments.json else table(figures)
    sys.stdout.write(shown)
    if arguments.keep:
        title = "# Benchmarks\n\nMade by `make bench`; each figure is explained in `benchmarks/`."
        before = arguments.keep.read_text() if arguments.keep.exists() else ""
        _, heading, others = before.partition("\n## ")  # sections that other benchmarks made
        arguments.keep.write_text(f"{title}\nTaken on {machine()}.\n\n{table(figures)}{heading}{others}")


main()
