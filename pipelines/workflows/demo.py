"""The whole experiment on a simulated rig, from a capture to the report with its errors: `faintfield demo`."""

import shutil
from pathlib import Path
from typing import get_args

import msgspec

from faintfield.pipelines.arguments import Method
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.files import check_free, write_json, write_record
from faintfield.pipelines.formats.results.records import JOINT_METHODS, METRICS_FILE, Metrics
from faintfield.pipelines.formats.sets.elemental_set import load_set
from faintfield.pipelines.formats.sets.session_set import nominal_session
from faintfield.pipelines.formats.toml_files import write_toml
from faintfield.pipelines.live.guided import capture_session
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.paper.demo import FULL, QUICK, demo_metrics, demo_rig, true_set, write_truth
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.request import DEFAULT_METHOD, Request, select_planes
from faintfield.pipelines.simulation.synthetic_set import NOISE_FREE
from faintfield.pipelines.workflows.reconstruct import reconstruct_and_report
from faintfield.pipelines.workflows.session import run_steps, session_steps

# The file that marks a folder as made by a demo; the next demo may replace such a folder.
_MARK = "demo.json"

# The methods that reconstruct each plane by itself; those of all planes together would take too long.
_METHODS: list[Method] = [method for method in get_args(Method.__value__) if method not in JOINT_METHODS]


class DemoResult(msgspec.Struct, frozen=True):
    """The result of `faintfield demo`."""

    out: str
    report: str
    metrics: Metrics


def run_demo(out: Path, quick: bool, snr: float, seed: int) -> DemoResult:
    """Capture the demo's scene, measure and reconstruct it, and compare the results with the truth."""
    _make_free(out)
    settings = demo_rig(QUICK if quick else FULL, snr, seed)
    write_toml(out / "rig.toml", settings)
    session = out / "session"
    inform(
        "capturing: boards, a toy truck at 500 mm and a toy airplane at 700 mm, almost dark, then dark and flat frames"
    )
    capture_session(settings, session, unattended=True, page=False)
    depths = list(settings.scene.depth_mm)
    asked = Options(depth_mm=[*depths], method=_METHODS, prior="tv")
    run_steps(session, session_steps(session, select_planes(asked)))
    inform("looking up the truth, and reconstructing with it and without any measured poses, for comparison")
    truth = write_truth(out / "truth", session, snr)
    reconstruct_and_report(load_set(truth / NOISE_FREE), out / "noise-free", Request(depths, ["backprojection"]))
    alone = Request(depths, [DEFAULT_METHOD])
    reconstruct_and_report(nominal_session(session), out / "nominal", alone)
    reconstruct_and_report(true_set(session, truth), out / "true", alone)
    metrics = demo_metrics(out, session, truth, _METHODS, DEFAULT_METHOD)
    write_record(out / METRICS_FILE, metrics)
    return DemoResult(str(out), str(write_report(out)), metrics)


def _make_free(out: Path) -> None:
    """Remove what an earlier demo left, and nothing else."""
    check_free(out, replace_if=_MARK)
    for name in ("session", "truth", "noise-free", "nominal", "true"):
        shutil.rmtree(out / name, ignore_errors=True)
    write_json(out / _MARK, {"format": 1, "made_by": "faintfield demo"})
