"""The surface of a session: a step of `faintfield run`, and the same by `reconstruct`."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from unittest import mock

import numpy as np
import pytest
import tifffile

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.commands.capture import verify
from faintfield.pipelines.commands.reconstruction import reconstruct
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.reconstruction.options import Options
from faintfield.recon.errors import NothingInFocus
from tests.pipelines.sessions import steps_run
from tests.pipelines.surfaces import FOUND_MM, Searches

ASKED = Options(surface=True, depth_range_mm="400:900", solver=SolverOptions(penalty_weight=0.5, passes=2))
WITH_PLANE = replace(ASKED, depth_mm=[700.0], method=["backprojection"], pitch_mm=16.0)
OTHER_PLANE = replace(WITH_PLANE, depth_mm=[500.0])
OTHER_RANGE = replace(ASKED, depth_range_mm="400:1000")


def test_only_outdated_surface_is_made_again(seen: Searches, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = session / "reconstructions"
    with monkeypatch.context() as patch:
        pages = mock.Mock(wraps=write_report)
        patch.setattr("faintfield.pipelines.pages.report.write_report", pages)
        assert steps_run(session, WITH_PLANE) == ["reconstruct", "surface"]
    pages.assert_called_once()
    page = (out / "report.html").read_text()
    assert 'id="surface"' in page
    assert "700 mm" in page
    np.testing.assert_allclose(tifffile.imread(out / "surface" / "depth_mm.tiff"), FOUND_MM, rtol=1e-6)
    record = json.loads((out / "surface" / "surface.json").read_bytes())
    assert (record["command"], record["options"]["poses"]) == ("reconstruct", "measured")
    assert verify(session).results is not None
    assert steps_run(session, WITH_PLANE) == []
    assert steps_run(session, replace(WITH_PLANE, depth_range_mm="900:400")) == []
    assert steps_run(session, OTHER_PLANE) == ["reconstruct", "report"]
    assert len(seen) == 1
    (out / "surface" / "visibility.tiff").unlink()
    assert steps_run(session, OTHER_PLANE) == ["surface"]


def test_run_keeps_surface_of_reconstruct(seen: Searches, session: Path) -> None:
    shutil.rmtree(session / "reconstructions")
    reconstruct(session, options=ASKED)
    assert steps_run(session, ASKED) == []
    assert {path.name for path in (session / "reconstructions").iterdir()} == {"surface", "report.html"}
    assert not (session / "reconstructions" / "surface" / "report.html").exists()
    (session / "reconstructions" / "report.html").unlink()
    assert steps_run(session, ASKED) == ["report"]


@pytest.mark.deep
def test_interrupt_leaves_no_page_of_earlier_surface(
    seen: Searches, session: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    steps_run(session, ASKED)

    with monkeypatch.context() as patch:
        interrupt = mock.Mock(side_effect=KeyboardInterrupt)
        patch.setattr("faintfield.pipelines.pages.report.write_report", interrupt)
        with pytest.raises(KeyboardInterrupt):
            steps_run(session, OTHER_RANGE)
    assert not (session / "reconstructions" / "report.html").exists()
    (session / "reconstructions" / "surface" / ".picture.tiff.0123abcd.unfinished").touch()
    assert steps_run(session, OTHER_RANGE) == ["report"]
    assert not list((session / "reconstructions" / "surface").glob(".*"))


def test_failed_surface_leaves_planes(seen: Searches, session: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    nothing = mock.Mock(side_effect=NothingInFocus("nothing there; use more light"))
    monkeypatch.setattr("faintfield.pipelines.reconstruction.depth.search.estimate_surface", nothing)
    with pytest.raises(NothingInFocus, match=r"use more light; .* mend that .* still to be done: surface$"):
        steps_run(session, OTHER_PLANE)
    assert "500 mm" in (session / "reconstructions" / "report.html").read_text()
    assert not (session / "reconstructions" / "surface").exists()
