"""Sessions of unusual rigs, from their frames to pictures that are compared with the truth."""

from pathlib import Path

import pytest

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.figures import Metrics
from faintfield.pipelines.formats.results.plane_files import plane_name
from faintfield.pipelines.formats.sets.session_set import load_session
from faintfield.pipelines.reconstruction.accuracy import assess
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.request import DEFAULT_METHOD, Request, select_planes
from faintfield.pipelines.reconstruction.run import reconstruct_set
from faintfield.pipelines.workflows.demo import true_set, write_truth
from faintfield.pipelines.workflows.session import run_steps, session_steps
from tests.pipelines.sessions import captured, rig_toml

_DEPTH_MM = 500.0
_BRIGHT_ENOUGH = "unlit_photons_per_s = 2000.0"

# By name: further lines of [camera] and of [checks]
RIGS = {
    "bent rails, 0.5 mm too long, 5 mrad askew": (
        "position_error_mm = 0.3\nrotation_error_mrad = 3.5\nscale_error = 0.0025\nsquareness_mrad = 5.0",
        "",
    ),
    "colour filters": ('position_error_mm = 0.3\nrotation_error_mrad = 3.5\nmosaic = ["RG", "GB"]', ""),
    "14 bits, 2 electrons": (
        "position_error_mm = 0.3\nread_noise_e = 2.0\ngain_dn_per_e = 0.8\nsaturation_dn = 16383",
        "saturation_dn = 16383.0",
    ),
}


@pytest.mark.deep
@pytest.mark.parametrize("name", RIGS)
def test_unusual_rig_gives_right_picture(name: str, tmp_path: Path) -> None:
    camera, checks = RIGS[name]
    session = captured(tmp_path, rig_toml(camera=f"{camera}\n{_BRIGHT_ENOUGH}", checks=checks))
    asked = Options(depth_mm=[_DEPTH_MM], solver=SolverOptions(prior="tv"))
    run_steps(session, session_steps(session, select_planes(asked)))
    truth = write_truth(tmp_path / "truth", session, 1.0)
    plane = session / "reconstructions" / f"{plane_name(_DEPTH_MM)}.tiff"
    measured = error(assess(load_session(session), {(DEFAULT_METHOD, _DEPTH_MM): plane}, [], truth))
    exact = reconstruct_set(true_set(session, truth), tmp_path / "true", Request([_DEPTH_MM], [DEFAULT_METHOD])).out
    best = error(assess(true_set(session, truth), {(DEFAULT_METHOD, _DEPTH_MM): Path(exact) / plane.name}, [], truth))
    # Of a mosaic, a quarter of the pixels see each of two colours
    assert measured < (0.04 if "mosaic" in camera else 0.02)
    assert measured < 1.2 * best
    assert read_frame(plane).pixels_dn.ndim == (3 if "mosaic" in camera else 2)


def error(metrics: Metrics | None) -> float:
    assert metrics is not None
    (row,) = metrics.planes
    return row.mse_bright
