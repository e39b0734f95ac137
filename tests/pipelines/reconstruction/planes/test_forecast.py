"""The forecast of a sweep: in proportion to what is missing, and nothing written."""

import json
from pathlib import Path

import pytest

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.reconstruction.planes import forecast as forecast_module
from tests.pipelines.conftest import Command

SWEEP = ("--sweep-mm", "500:700:3", "--method", "backprojection")


def _forecast(done: Command, *arguments: object) -> dict[str, float]:
    found: dict[str, float] = json.loads(done("reconstruct", *arguments, "--dry-run", "--json").stdout)
    return found


def test_forecast_is_of_missing_planes(
    colour_set: Path, tmp_path: Path, done: Command, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(forecast_module, "_times", lambda *_: (2.0, 0.5))
    monkeypatch.setattr(forecast_module, "_reading_s", lambda *_: 3.0)
    out = tmp_path / "out"
    whole, part = (_forecast(done, colour_set, "--out", out, *SWEEP, *of) for of in ((), ("--part", "1/2")))
    assert not out.exists()
    assert (whole["planes"], part["planes"]) == (3, 2)
    # A plane takes so many passes over green, which has two of four pixels: two passes over all pixels for each
    passes = (whole["seconds"] - part["seconds"]) / (2 * 2.0)
    assert passes == pytest.approx((part["seconds"] - 6.0) / (2 * 2 * 2.0))
    assert passes >= 1
    done("reconstruct", colour_set, "--out", out, *SWEEP, "--part", "1/2")
    assert _forecast(done, colour_set, "--out", out, *SWEEP)["seconds"] == pytest.approx(6.0 + 2 * 2.0 * passes)
    done("reconstruct", colour_set, "--out", out, *SWEEP)
    assert _forecast(done, colour_set, "--out", out, *SWEEP)["planes"] == 0


def test_prior_takes_more_time_and_memory(scene: Path, tmp_path: Path, done: Command) -> None:
    """Times are of this computer, and compared by their number of steps alone: all are positive."""
    without, with_prior = (
        _forecast(done, scene, "--out", tmp_path / "out", "--depth-mm", "500", "--prior", prior)
        for prior in ("tv", "auto")
    )
    assert with_prior["memory_mb"] > without["memory_mb"] > 0
    assert min(without["seconds"], with_prior["seconds"]) > 0
    solvers = SolverOptions(prior="tv"), SolverOptions(prior="tv", uncertainty=True), SolverOptions(prior="auto")
    works = [forecast_module._work("pmlem", solver, 10**6) for solver in solvers]  # noqa: SLF001
    assert works == sorted(works)


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        (("--surface",), "knows no time of --surface"),
        ((*SWEEP, "--workers", "2"), "knows no time of --workers"),
        (("--depth-mm", "auto"), "does not search depths"),
        (("--depth-mm", "500", "--depth-mm", "700", "--joint"), "solved together"),
    ],
)
def test_what_has_no_forecast_is_refused(
    options: tuple[str, ...], reason: str, scene: Path, tmp_path: Path, faintfield: Command
) -> None:
    ended = faintfield("reconstruct", scene, "--out", tmp_path / "out", *options, "--dry-run")
    assert ended.returncode == 2
    assert reason in ended.stderr
    assert not (tmp_path / "out").exists()
