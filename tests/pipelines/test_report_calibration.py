"""What a report says of light, noise and geometry, and of what it is worth to know the poses."""

import base64
import hashlib
import json
import re
import shutil
from pathlib import Path
from typing import Any

import cv2
import msgspec
import numpy as np
import pytest

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.image_files import write_png
from faintfield.pipelines.formats.results.geometry import GeometryRecord
from faintfield.pipelines.formats.results.overview import Brightness, Overview
from faintfield.pipelines.pages.geometry_page import holdout_rows
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.pages.report_calibration import find_beside
from faintfield.pipelines.pages.report_sets import photon_budget
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.conftest import Command

KNOWN = {"value": 3.4641, "se": 0.0022, "ci95": [3.4597, 3.4685]}
NOISE: dict[str, Any] = {
    "offset_dn": {"value": 100.0031, "se": 0.0029, "ci95": [99.9974, 100.0088]},
    "gain_dn_per_e": {"value": 2.00026, "se": 0.0012, "ci95": [1.9979, 2.0026]},
    "read_noise_e": KNOWN,
    "dark_current_e_per_s": {"value": None, "why": "all darks have one exposure time"},
    "likelihood": "marginal Gaussian",
    "frames": [{"file": "dark.tiff", "kind": "dark", "exposure_s": 0.1}] * 12,
    "hot_pixels": [[1, 2]],
    "temperature_c": {"mean": -20.0, "min": -20.1, "max": -19.9},
    "warnings": ["the darks drift"],
}


def _geometry() -> dict[str, Any]:
    figure = {"value": 50.0, "sigma": 0.01, "why": None}
    names = ("pitch_x_mm", "pitch_y_mm", "scale_x", "scale_y", "squareness_rad", "backlash_x_mm", "tilt_rad")
    stage: dict[str, Any] = dict.fromkeys((*names, "node_residual_rms_mm"), figure)
    stage["backlash_y_mm"] = {"value": None, "sigma": None, "why": "approached from one side"}
    stage["residuals_mm"] = [[0.1 * k, -0.1, 0.05] for k in range(9)]
    stage["doubts"] = []
    nodes = [
        {"node": [r, c], "rt_cam_ref": [0.0] * 6, "sigma_mm": 0.011 * (r + 1), "sigma_rad": 1e-4}
        for r in range(3)
        for c in range(3)
    ]
    lens = dict.fromkeys(("fx_px", "fy_px", "cx_px", "cy_px"), 400.0) | {"distortion": [0.0], "sigma": [0.1] * 5}
    known = dict.fromkeys(("rms_inlier_px", "rms_mrcal_px", "corner_sigma_px"), 0.018)
    return {
        "format": 1,
        "lens": {"model": "opencv4", **lens},
        "size_px": [800, 800],
        "reference_node": [1, 1],
        "nodes": nodes,
        **known,
        "corners": 5450,
        "outliers": 3,
        "holdout_ratio": None,
        "doubts": [],
        "transfer_sigma_px": {"500": 0.0134},
        "repeatability": None,
        "boards": [],
        "stage": stage,
        "command": "geometry",
        "options": {"lens": "opencv4", "depth_mm": [500.0], "limit_px": 0.5},
        "inputs": {},
        "versions": {},
    }


@pytest.fixture(scope="session")
def drawn(simulated_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One plane by one method; to be read only."""
    out = tmp_path_factory.mktemp("drawn") / "out"
    words = ["--depth-mm", "500", "--method", "backprojection"]
    assert run(["reconstruct", str(simulated_scene), "--out", str(out), *words]) == 0
    return out


@pytest.fixture
def session_to_draw(drawn: Path, tmp_path: Path) -> Path:
    """A folder as a session is: calibrations in it, planes two folders down."""
    shutil.copytree(drawn, tmp_path / "session" / "reconstructions" / "scene")
    (tmp_path / "session" / "noise.json").write_text(json.dumps(NOISE))
    (tmp_path / "session" / "geometry.json").write_text(json.dumps(_geometry()))
    return tmp_path / "session"


@pytest.fixture
def session(session_to_draw: Path, undrawn: None) -> Path:
    """The same, with empty drawings on its pages."""
    return session_to_draw


@pytest.mark.parametrize("place", ["", "reconstructions/scene"])
def test_session_shows_its_noise_and_geometry_wherever_page_stands(place: str, session: Path, done: Command) -> None:
    done("report", session / place)
    text = (session / place / "report.html").read_text()
    assert "3.464" in text
    assert "3.4597 … 3.4685" in text
    assert "all darks have one exposure time" in text
    assert "1 hot" in text
    assert "the darks drift" in text
    assert "−20.0 °C" in text
    assert "5450 corners" in text
    assert "approached from one side" in text
    assert text.count("<svg") == 3
    assert "http-equiv" in text


@pytest.mark.parametrize(
    ("ratio", "boards", "said"),
    [
        (1.25, 2, [("1.25", "limit 1.3"), ("0.00750", "px; up to 0.1 px is never refused")]),
        (10.0, 2, [("10.0", "waived"), ("0.0995", "px; up to 0.1 px")]),  # 0.01 √(10² − 1)
        (None, 1, [("–", "there is one only")]),
        (None, 2, [("–", "some node would see no other board")]),
    ],
)
def test_error_of_held_out_boards_has_its_limit(ratio: float | None, boards: int, said: list[tuple[str, str]]) -> None:
    printed = {"columns": 9, "rows": 7, "square_mm": 40.0, "marker_mm": 30.0, "dictionary": "d", "first_marker_id": 0}
    board = {"name": "b", **printed, "sweep": 0, "rt_ref_board": [0.0] * 6, "warp_mm": [0.0, 0.0]}
    content = _geometry() | {"holdout_ratio": ratio, "rms_inlier_px": 0.01, "boards": [board] * boards}
    for row, (value, why) in zip(holdout_rows(msgspec.convert(content, GeometryRecord)), said, strict=True):
        assert row.value == value
        assert why in row.why
        assert ("waived" in row.why) == (why == "waived")


def test_page_says_whether_its_planes_were_made_with_calibration(session: Path, done: Command) -> None:
    folder = session / "reconstructions" / "scene"
    done("report", folder)
    assert "It is not among the inputs of these planes" in (folder / "report.html").read_text()
    record = json.loads((folder / "reconstruction.json").read_text())
    for name in ("noise.json", "geometry.json"):
        record["inputs"][name] = hashlib.sha256((session / name).read_bytes()).hexdigest()
    write_by_hand(folder / "reconstruction.json", record)
    done("report", folder)
    assert "It is not among the inputs of these planes" not in (folder / "report.html").read_text()


def test_calibrations_can_be_named(drawn: Path, session: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(drawn, tmp_path / "elsewhere" / "a" / "b" / "c"))
    assert find_beside(folder, "noise.json") is None
    text = write_report(folder, noise=session / "noise.json").read_text()
    assert 'id="noise"' in text
    assert 'id="geometry"' not in text


@pytest.mark.parametrize("name", ["noise.json", "geometry.json"])
def test_damaged_calibration_is_named(name: str, session: Path, faintfield: Command) -> None:
    (session / name).write_text("{}")
    ended = faintfield("report", session)
    assert ended.returncode == 1
    assert "BadValue" in ended.stderr
    assert f"{name}: is not the result of `faintfield {name.removesuffix('.json')}`" in ended.stderr


def test_geometry_without_regular_grid_is_shown_all_same(session: Path, done: Command) -> None:
    content = _geometry()
    content["stage"] |= {"residuals_mm": [], "pitch_x_mm": {"value": None, "sigma": None, "why": "one column only"}}
    (session / "geometry.json").write_text(json.dumps(content))
    done("report", session)
    text = (session / "report.html").read_text()
    assert text.count("<svg") == 2
    assert "one column only" in text


def _overview(quantum_efficiency: float | None = 0.5, mean_signal_e: float = 0.96) -> Overview:
    light = Brightness(
        region="whole view",
        noise_from="noise model",
        snr=0.16,
        electrons_linear=1.92,
        electrons_from_moments=0.96,
        mean_signal_e=mean_signal_e,
        photons_linear=None,
        photons_from_moments=None,
    )
    return Overview(
        set="scene",
        views=49,
        grid=(7, 7),
        poses="stated",
        size_px=(640, 480),
        exposure_s=0.1,
        frames_per_view=1,
        read_noise_e=12**0.5,
        has_noise_reference=False,
        quantum_efficiency=quantum_efficiency,
        dark_e=0.02,
        grey_scale_dn=(0.0, 1.0),
        brightness=light,
    )


def test_photon_budget_is_that_of_papers_equations() -> None:
    budget = photon_budget(_overview())
    assert budget is not None
    linear, moments, counted = budget.light
    # Eq. (7): 0.16 · 12 / 0.5 photons; at 0.1 s ten times as many per second; 49 views see 49 times as many
    assert (linear.photons, linear.flux) == pytest.approx((0.16 * 12 / 0.5, 38.4))
    assert linear.all_views == pytest.approx(3.84 * 49)
    # (4) with a Poisson signal: μ² + μ = 0.16 · 12 e⁻², less the little that dark current does
    mu_e = moments.electrons
    assert mu_e**2 + mu_e == pytest.approx(0.16 * 12, rel=0.03)
    assert counted.photons == pytest.approx(0.96 / 0.5)
    # Eq. (6)
    assert budget.variance_e2 == pytest.approx(0.96 + 0.02 + 12)
    assert budget.shares == pytest.approx(
        {"read noise": 12 / 12.98, "light": 0.96 / 12.98, "dark current": 0.02 / 12.98}
    )


@pytest.mark.parametrize("mean_signal_e", [-0.1, 0.0])
def test_without_light_there_is_no_budget(mean_signal_e: float) -> None:
    assert photon_budget(_overview(mean_signal_e=mean_signal_e)) is None


def test_without_quantum_efficiency_budget_has_electrons_only() -> None:
    budget = photon_budget(_overview(quantum_efficiency=None))
    assert budget is not None
    assert [row.electrons for row in budget.light] == [1.92, 0.96, 0.96]
    assert {number for row in budget.light for number in (row.photons, row.flux, row.all_views)} == {None}
    assert budget.variance_e2 == pytest.approx(12.98)


def test_weights_tried_and_certificates_are_shown(session_to_draw: Path, done: Command) -> None:
    session = session_to_draw
    path = session / "reconstructions" / "scene" / "reconstruction.json"
    content = json.loads(path.read_text())
    done("report", session)
    assert 'id="weight"' not in (session / "report.html").read_text()
    curve = [{"weight": 0.1 * 2**k, "held_out": 50.0 + (k - 2) ** 2} for k in range(5)]
    certificate = {"kind": "bound", "value": 0.00823, "reached": False}
    content["planes"][0] |= {
        "penalty_weight_curve": curve,
        "penalty_weight": 0.4,
        "certificate": certificate,
        "name": "table",
    }
    write_by_hand(path, content)
    done("report", session)
    text = (session / "report.html").read_text()
    part = text[text.index('id="weight"') : text.index('id="noise"')]
    # Every word of the drawing, small ticks among them, is in the page's own ink
    for drawn_words in part.split('<g id="text_')[1:]:
        assert "fill: currentColor" in re.findall("<g ([^>]*)>", drawn_words)[0]
    assert "<!-- table -->" in part
    assert "table, 500.0 mm on the axis" in part
    assert part.count("<svg") == 1
    assert "0.823 %: stopped early" in part


def test_large_views_are_cropped_pixel_for_pixel(session: Path, done: Command) -> None:
    folder = session / "reconstructions" / "scene"
    picture = np.random.default_rng(1).integers(0, 256, (700, 900), np.uint8)
    write_png(folder / "reference_view.png", picture)
    done("report", folder)
    text = (folder / "report.html").read_text()
    before = 'class="pixels" src="data:image/webp;base64,'
    start = text.index(before) + len(before)
    shown = np.frombuffer(base64.b64decode(text[start : text.index('"', start)]), np.uint8)
    np.testing.assert_array_equal(cv2.imdecode(shown, cv2.IMREAD_GRAYSCALE), picture[80:620, 180:720])


def test_only_pages_that_are_there_are_linked(session: Path, done: Command) -> None:
    folder = session / "reconstructions" / "scene"
    done("report", folder)
    assert 'href="../../geometry.html"' not in (folder / "report.html").read_text()
    (session / "geometry.html").touch()
    done("report", folder)
    assert 'href="../../geometry.html"' in (folder / "report.html").read_text()
    done("report", session)
    text = (session / "report.html").read_text()
    assert 'href="geometry.html"' in text
    assert 'href="reconstructions/scene/report.html"' in text
