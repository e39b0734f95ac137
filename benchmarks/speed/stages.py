"""Seconds and CPU seconds of the stages of a command: `python -m benchmarks.speed.stages FILE reconstruct SET …`.

Functions that do a stage's work are replaced by timed ones, then the command runs as `faintfield` would. A stage within
another counts for itself alone, except within those that choose weights: their time is all theirs. FILE is JSON, with
the largest resident memory, also of each stage.
"""

import importlib
import json
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from faintfield.pipelines.cli import main as faintfield

_PLANES = "faintfield.pipelines.reconstruction.planes."

# Stages that have no stages within: weights are chosen from windows in several threads.
_WHOLE = ("weight of the penalty", "weights of candidates")

_FUNCTIONS = {
    "read frames": ["faintfield.pipelines.reconstruction.channels:load_channel"],
    "operator, start": [_PLANES + "sweep:Channel._operator", _PLANES + "penalised:Objective.of"],
    _WHOLE[0]: ["faintfield.recon.solver.penalty_weight:cross_validated_weight"],
    _WHOLE[1]: ["faintfield.recon.prior.proposal:_judged"],
    "inner problem": ["faintfield.recon.solver.pmlem:_Pmlem._minimum"],
    "passes": ["faintfield.recon.solver.data_fit:DataFit.value_and_gradient"],
    "metric, certificate": [
        "faintfield.recon.solver.data_fit:DataFit.metric",
        "faintfield.recon.solver.pmlem:_Pmlem._certificate",
    ],
    "evidence, misfit": [
        "faintfield.recon.prior.evidence:evidence_of_planes",
        "faintfield.recon.prior.evidence:misfits",
        "faintfield.recon.prior.proposal:regions_of_planes",
    ],
    "patches": ["faintfield.recon.prior.collaborative:patch_candidates"],
    "network": [_PLANES + "learned_prior:learned_estimate"],
    "save planes": [_PLANES + "sweep:Channel._save", _PLANES + "sweep:Sweep._write_complete"],
    "report": ["faintfield.pipelines.pages.report:write_report"],
}


@dataclass
class Stage:
    """Time of a stage: elapsed, and of all threads; number of calls; largest resident memory while it ran."""

    name: str
    seconds: float = 0.0
    cpu_seconds: float = 0.0
    calls: int = 0
    peak_mb: float = 0.0


class Stages:
    """The stages of one process. Its threads enter stages by turns, except within those of `_WHOLE`."""

    def __init__(self) -> None:
        self.stages = {name: Stage(name) for name in _FUNCTIONS}
        # Stages that have begun, the innermost last: name, and seconds and CPU seconds of stages within
        self._begun: list[tuple[str, float, float]] = []
        self._whole = False
        self.peak_mb = 0.0

    def timed(self, name: str, function: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that does the same, and adds what it takes to a stage."""

        def run(*arguments: Any, **options: Any) -> Any:
            if self._whole:
                return function(*arguments, **options)
            self._whole = name in _WHOLE
            self.measure_memory()
            started = _clocks()
            self._begun.append((name, 0.0, 0.0))
            try:
                return function(*arguments, **options)
            finally:
                self._whole = False
                self._add(*(stop - start for stop, start in zip(_clocks(), started, strict=True)))

        return run

    def _add(self, seconds: float, cpu_seconds: float) -> None:
        """End the innermost stage, which took so long with those within."""
        self.measure_memory()
        name, seconds_within, cpu_seconds_within = self._begun.pop()
        stage = self.stages[name]
        stage.seconds += seconds - seconds_within
        stage.cpu_seconds += cpu_seconds - cpu_seconds_within
        stage.calls += 1
        if self._begun:
            outer, *within = self._begun[-1]
            self._begun[-1] = outer, within[0] + seconds, within[1] + cpu_seconds

    def measure_memory(self) -> None:
        """Note the largest memory since the last call for the stage in work, and forget it."""
        peak_mb = _peak_mb()
        self.peak_mb = max(self.peak_mb, peak_mb)
        if self._begun:
            stage = self.stages[self._begun[-1][0]]
            stage.peak_mb = max(stage.peak_mb, peak_mb)
        Path("/proc/self/clear_refs").write_text("5", encoding="utf-8")

    def replace_functions(self) -> None:
        """Time all functions of stages, wherever they were imported to."""
        for name, places in _FUNCTIONS.items():
            for place in places:
                module, _, path = place.partition(":")
                *owners, attribute = path.split(".")
                owner = importlib.import_module(module)
                for part in owners:
                    owner = getattr(owner, part)
                original = vars(owner)[attribute]
                if isinstance(original, classmethod):
                    setattr(owner, attribute, classmethod(self.timed(name, original.__func__)))
                    continue
                timed = self.timed(name, original)
                ours = [module for module in sys.modules.values() if module.__name__.startswith("faintfield")]
                for holder in [owner] if owners else ours:
                    if vars(holder).get(attribute) is original:
                        setattr(holder, attribute, timed)


def _clocks() -> tuple[float, float]:
    usage = resource.getrusage(resource.RUSAGE_SELF)
    return time.perf_counter(), usage.ru_utime + usage.ru_stime


def _peak_mb() -> float:
    """Return the largest resident memory of this process since that was forgotten."""
    status = Path("/proc/self/status").read_text(encoding="utf-8")
    (kib,) = (line.split()[1] for line in status.splitlines() if line.startswith("VmHWM:"))
    return int(kib) * 1024 / 1e6


def main() -> None:
    """Run a command, and write what its stages took."""
    out, sys.argv[1:] = Path(sys.argv[1]), sys.argv[2:]
    for module in ("planes.sweep", "planes.prior", "run"):  # whatever they import is there before it is replaced
        importlib.import_module("faintfield.pipelines.reconstruction." + module)
    stages = Stages()
    stages.replace_functions()
    try:
        faintfield()
    finally:
        stages.measure_memory()
        found = [asdict(stage) for stage in stages.stages.values() if stage.calls]
        out.write_text(json.dumps({"peak_mb": stages.peak_mb, "stages": found}), encoding="utf-8")


if __name__ == "__main__":
    main()
