"""`faintfield run` takes the options of `reconstruct`, and does again only what they change."""

from dataclasses import replace
from pathlib import Path
from unittest import mock

import pytest

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.launcher import app
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.request import select_planes
from faintfield.pipelines.reconstruction.surface.request import select_surface
from faintfield.recon.errors import NothingInFocus
from tests.pipelines.conftest import Command
from tests.pipelines.forms import read_record
from tests.pipelines.sessions import steps_run
from tests.pipelines.surfaces import Searches

_SEARCHED_MM = (400.0, 900.0)
_FAIL = mock.Mock(side_effect=NothingInFocus("begun"))
_FAST = Options(method=["backprojection"], pitch_mm=16.0)


def test_only_options_of_sets_are_missing_from_run() -> None:
    options = {
        command: {name for argument in app[command].assemble_argument_collection() for name in argument.names}
        for command in ("run", "reconstruct")
    }
    only_of_sets = {"SESSION|SET", "--out", "--geometry", "--scene", "--part", "--dry-run", "--no-dry-run"}
    assert options["reconstruct"] - options["run"] == only_of_sets
    assert options["run"] - options["reconstruct"] == {"SESSION", "--lens", "--limit-px"}


EXCLUDED = [
    ("run", "--depth-mm auto --depth-mm 500", "--depth auto finds all depths; give others in a call of their"),
    ("run", "--depth-mm auto --sweep auto", "--sweep auto makes all planes of a range, and --depth auto leaves"),
    ("run", "--depth-mm 500 --depth 700 --depth-map", "--depth-map compares depths, and 2 are given; give at"),
    ("run", "--depth-mm 500 --method mlem --uncertainty", "--uncertainty is for pmlem, joint and occlusion, not"),
    ("run", "--depth-mm 500 --joint --penalty none --prior auto", "--prior auto starts from total variation"),
    ("run", "--depth-mm 500 --prior tv --proposal", "--proposal saves what a prior proposes, and tv proposes"),
    ("run", "--surface --depth-range-mm 4:9 --disparity-range-px 1:2", "--depth-range-mm and --disparity-range-px"),
    ("run", "--depth-mm 500 --workers 2 --scheduler here", "--workers starts processes here, --scheduler names"),
    ("run", "--sweep-mm 400:900", "--sweep-mm 400:900: is no sweep; give FIRST:LAST:COUNT"),
    ("reconstruct", "--surface --depth-range-mm 4:9 --disparity-range-px 1:2", "--depth-range-mm and --disparity"),
]


def test_options_that_exclude_each_other_are_refused(recorded_session: Path, faintfield: Command) -> None:
    for command, words, message in EXCLUDED:
        ended = faintfield(command, recorded_session, *words.split())
        assert ended.returncode == 2
        assert ended.stderr.startswith(f"faintfield: wrong usage: {message}")
        assert len(ended.stderr.splitlines()) == 1


def test_planes_solved_together_are_made_once(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    solver = SolverOptions(prior="tv", penalty_weight=0.1, passes=3, uncertainty=True)
    asked = Options(depth_mm=[500.0, 700.0], pitch_mm=16.0, joint=True, solver=solver)
    assert steps_run(session, asked) == ["reconstruct"]
    record = read_record(session / "reconstructions")
    assert {plane["method"] for plane in record["planes"]} == {"joint"}
    assert all((session / "reconstructions" / plane["sigma_file"]).is_file() for plane in record["planes"])
    assert steps_run(session, asked) == []
    monkeypatch.setattr("faintfield.pipelines.reconstruction.planes.sweep.solve_together", _FAIL)
    with pytest.raises(NothingInFocus, match="begun"):
        steps_run(session, replace(asked, solver=replace(solver, uncertainty=False, likelihood="poisson")))


def test_depths_are_searched_only_once(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    for module in ("depth.autofocus", "request"):
        monkeypatch.setattr(f"faintfield.pipelines.reconstruction.{module}.searched_range_mm", lambda _: _SEARCHED_MM)
    asked = replace(_FAST, depth_mm=["auto"])
    assert steps_run(session, asked) == ["reconstruct"]
    record = read_record(session / "reconstructions")
    depth_mm = record["best_focus"]["depth_mm"]
    assert record["options"]["depth_mm"] == depth_mm
    assert depth_mm == pytest.approx([500.0, 700.0], rel=0.01)
    assert record["best_focus"]["searched_mm"] == [[*_SEARCHED_MM]]
    monkeypatch.setattr("faintfield.pipelines.reconstruction.request.best_focus", _FAIL)
    assert steps_run(session, asked) == []
    assert steps_run(session, replace(_FAST, depth=["auto"])) == []
    for other in (replace(asked, sweep_mm="450:900:3"), replace(asked, solver=SolverOptions(passes=7))):
        with pytest.raises(NothingInFocus, match="begun"):
            steps_run(session, other)


@pytest.mark.deep
def test_range_of_sweep_is_searched_only_once(session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    range_found = "faintfield.pipelines.reconstruction.request.found_range_mm"
    monkeypatch.setattr(range_found, lambda *_: (497.0, 503.0))
    asked = replace(_FAST, sweep="auto")
    assert steps_run(session, asked) == ["reconstruct"]
    options = read_record(session / "reconstructions")["options"]
    depths = options["depth_mm"]
    assert options["auto_sweep"] == len(depths)
    assert (depths[0], depths[-1]) == (497.0, 503.0)
    monkeypatch.setattr(range_found, _FAIL)
    assert steps_run(session, asked) == []
    assert steps_run(session, replace(_FAST, depth_mm=depths)) == ["reconstruct"]
    assert "auto_sweep" not in read_record(session / "reconstructions")["options"]


@pytest.mark.deep
def test_depth_map_of_disparities_is_made_once(seen: Searches, session: Path) -> None:
    asked = replace(_FAST, sweep_px="-60:-50:5", depth_map=True)
    assert steps_run(session, asked) == ["reconstruct"]
    assert len(read_record(session / "reconstructions")["planes"]) == 5
    assert steps_run(session, asked) == []
    (session / "reconstructions" / "disparity_px.tiff").unlink()
    assert steps_run(session, asked) == ["reconstruct"]


def test_prior_applies_to_planes_and_surface() -> None:
    given = Options(depth_mm=[500.0], surface=True, solver=SolverOptions(prior="patches", uncertainty=True))
    surface = select_surface(given)
    assert surface is not None
    assert (surface.solver.prior, surface.solver.uncertainty) == ("patches", False)
    planes = select_planes(given)
    assert (planes.options.solver.prior, planes.options.solver.uncertainty) == ("patches", True)
    by_default = Options(depth_mm=[500.0], surface=True)
    surface = select_surface(by_default)
    assert surface is not None
    assert surface.solver.prior is None
    assert select_planes(by_default).options.solver.prior == "auto"
    assert select_planes(Options(depth_mm=[500.0], method=["mlem"])).options.solver.prior == "tv"
    assert select_planes(Options(sweep_mm="480:520:2")).options.solver.prior == "tv"
