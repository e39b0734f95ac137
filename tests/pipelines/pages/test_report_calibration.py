"""Sections of a report about light, noise and geometry, and about the value of known poses."""

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
from msgspec import structs

from faintfield.calib.geometry import GeometrySettings
from faintfield.pipelines.formats.image_files import write_png
from faintfield.pipelines.formats.results.figures import Overview
from faintfield.pipelines.formats.results.geometry import GeometryRecord
from faintfield.pipelines.pages.calibration_pages import find_calibration, holdout_rows
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.pages.report_sets import photon_budget
from tests.pipelines.by_hand import write_by_hand
from tests.pipelines.conftest import Command, assert_refused, run_undrawn
from tests.pipelines.forms import GOLDEN

NOISE = json.loads((GOLDEN / "noise.json").read_bytes()) | {
    "read_noise_e": {"value": 3.4641, "se": 0.0022, "ci95": [3.4597, 3.4685]},
    "dark_current_e_per_s": {"value": None, "why": "all darks have one exposure time"},
    "hot_pixels": [[1, 2]],
    "temperature_c": {"mean": -20.0, "min": -20.1, "max": -19.9},
    "warnings": ["the darks drift"],
}


def _geometry() -> dict[str, Any]:
    geometry: dict[str, Any] = json.loads((GOLDEN / "geometry.json").read_bytes())
    geometry["stage"]["backlash_y_mm"] = {"value": None, "sigma": None, "why": "approached from one side"}
    return geometry


@pytest.fixture(scope="module")
def drawn(simulated_scene: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """One plane by one method; to be read only."""
    out = tmp_path_factory.mktemp("drawn") / "out"
    run_undrawn("reconstruct", simulated_scene, "--out", out, "--depth-mm", 500, "--method", "backprojection")
    return out


@pytest.fixture
def session(drawn: Path, tmp_path: Path) -> Path:
    """A folder as a session is: calibrations in it, planes two folders down."""
    shutil.copytree(drawn, tmp_path / "session" / "reconstructions" / "scene")
    (tmp_path / "session" / "noise.json").write_text(json.dumps(NOISE))
    (tmp_path / "session" / "geometry.json").write_text(json.dumps(_geometry()))
    return tmp_path / "session"


@pytest.mark.parametrize(
    ("ratio", "boards", "rows"),
    [
        (1.25, 2, [("1.25", "limit 1.3"), ("0.00750", "px; up to 0.1 px is never refused")]),
        (10.0, 2, [("10.0", "waived"), ("0.0995", "px; up to 0.1 px")]),  # 0.01 √(10² − 1)
        (None, 1, [("–", "there is one only")]),
        (None, 2, [("–", "some node would see no other board")]),
    ],
)
def test_error_of_held_out_boards_has_its_limit(ratio: float | None, boards: int, rows: list[tuple[str, str]]) -> None:
    content = _geometry() | {"holdout_ratio": ratio, "rms_inlier_px": 0.01}
    content["boards"] = content["boards"][:boards]
    found = holdout_rows(msgspec.convert(content, GeometryRecord), GeometrySettings())
    for row, (value, why) in zip(found, rows, strict=True):
        assert row.value == value
        assert why in row.why
        assert ("waived" in row.why) == (why == "waived")


def test_pages_show_link_and_compare_calibrations(session: Path, done: Command) -> None:
    folder = session / "reconstructions" / "scene"
    of_noise = (
        "read noise, σ<sub>d</sub>", "3.464", "3.4597 … 3.4685", "all darks have one exposure time", "1 hot",
        "the darks drift", "−20.0 °C",
    )  # fmt: skip

    def page(folder: Path) -> str:
        done("report", folder)
        text = (folder / "report.html").read_text()
        for words in (*of_noise, "768 corners", "approached from one side", "http-equiv"):
            assert words in text
        assert text.count("<svg") == 3
        assert 'id="weight"' not in text
        return text

    text = page(folder)
    assert "It is not among the inputs of these planes" in text
    assert 'href="../../geometry.html"' not in text
    pages = ("geometry.html", "noise.html", "emva1288_report.html", "noise_page.png")  # the last two of old sessions
    for name in pages:
        (session / name).touch()
    record = json.loads((folder / "reconstruction.json").read_text())
    for name in ("noise.json", "geometry.json"):
        record["inputs"][name] = hashlib.sha256((session / name).read_bytes()).hexdigest()
    write_by_hand(folder / "reconstruction.json", record)
    text = page(folder)
    assert "It is not among the inputs of these planes" not in text
    for name in pages:
        assert f'href="../../{name}"' in text
    text = page(session)
    assert 'href="geometry.html"' in text
    assert 'href="reconstructions/scene/report.html"' in text


def test_calibrations_can_be_named(drawn: Path, session: Path, tmp_path: Path) -> None:
    folder = Path(shutil.copytree(drawn, tmp_path / "elsewhere" / "a" / "b" / "c"))
    assert find_calibration(folder, "noise.json") is None
    text = write_report(folder, noise=session / "noise.json").read_text()
    assert 'id="noise"' in text
    assert 'id="geometry"' not in text


@pytest.mark.parametrize(
    ("poses", "noise", "says"),
    [
        ("measured", "noise.json", ["measured", "in the noise.json that was used, which is not here"]),
        ("nominal", "noise.json", ["nominal", "where the stage was sent"]),
        ("stated", "elemental.toml", ["as stated", "not measured", "as the set states it"]),
    ],
)
def test_page_away_from_session_says_what_record_says(
    poses: str, noise: str, says: list[str], drawn: Path, tmp_path: Path
) -> None:
    folder = Path(shutil.copytree(drawn, tmp_path / "elsewhere" / "a" / "b" / "c"))
    record = json.loads((folder / "reconstruction.json").read_text())
    record["options"]["poses"] = poses
    record["inputs"][noise] = "0" * 64
    write_by_hand(folder / "reconstruction.json", record)
    facts = write_report(folder).read_text().partition('<dl class="facts">')[2].partition("</dl>")[0]
    for words in says:
        assert words in facts
    assert ("as stated" in facts) == (poses == "stated")
    assert ("as the set states it" in facts) == (noise != "noise.json")


def test_damaged_calibration_is_named(session: Path, faintfield: Command) -> None:
    for name in ("noise", "geometry"):
        before = (session / f"{name}.json").read_bytes()
        (session / f"{name}.json").write_text("{}")
        assert_refused(faintfield("report", session), "BadValue", f"{name}.json: is not the result of `faintfield ")
        (session / f"{name}.json").write_bytes(before)


def test_geometry_without_regular_grid_is_shown(session: Path, done: Command) -> None:
    content = _geometry()
    content["stage"] |= {"residuals_mm": [], "pitch_x_mm": {"value": None, "sigma": None, "why": "one column only"}}
    (session / "geometry.json").write_text(json.dumps(content))
    done("report", session)
    text = (session / "report.html").read_text()
    assert text.count("<svg") == 2
    assert "one column only" in text


def _overview(quantum_efficiency: float | None = 0.5, mean_signal_e: float = 0.96) -> Overview:
    overview = msgspec.json.decode((GOLDEN / "overview_set.json").read_bytes(), type=Overview)
    light: dict[str, float | None] = {"snr": 0.16, "electrons_linear": 1.92, "electrons_from_moments": 0.96}
    light["mean_signal_e"] = mean_signal_e
    light["photons_linear"] = light["photons_from_moments"] = None
    camera = {"exposure_s": 0.1, "read_noise_e": 12**0.5, "dark_e": 0.02, "quantum_efficiency": quantum_efficiency}
    return structs.replace(overview, views=49, brightness=structs.replace(overview.brightness, **light), **camera)


def test_photon_budget_is_that_of_papers_equations() -> None:
    budget = photon_budget(_overview())
    assert budget is not None
    linear, moments, counted = budget.light
    # Eq. (7): 0.16 · 12 / 0.5 photons; at 0.1 s ten times as many per second; 49 views see 49 times as many
    assert (linear.photons, linear.flux) == pytest.approx((0.16 * 12 / 0.5, 38.4))
    assert linear.all_views == pytest.approx(3.84 * 49)
    # (4) with a Poisson signal: μ² + μ = 0.16 · 12 (e⁻)², less the little that dark current does
    mu_e = moments.electrons
    assert mu_e**2 + mu_e == pytest.approx(0.16 * 12, rel=0.03)
    assert counted.photons == pytest.approx(0.96 / 0.5)
    # Eq. (6)
    assert budget.variance_e2 == pytest.approx(0.96 + 0.02 + 12)
    parts = {"read noise": 12, "light": 0.96, "dark current": 0.02}
    assert budget.shares == pytest.approx({name: part / 12.98 for name, part in parts.items()})
    assert photon_budget(_overview(mean_signal_e=0.0)) is None
    budget = photon_budget(_overview(quantum_efficiency=None))
    assert budget is not None
    assert [row.electrons for row in budget.light] == [1.92, 0.96, 0.96]
    assert {number for row in budget.light for number in (row.photons, row.flux, row.all_views)} == {None}


def test_weights_tried_and_certificates_are_shown(session: Path, done: Command, undrawn: pytest.MonkeyPatch) -> None:
    undrawn.undo()
    path = session / "reconstructions" / "scene" / "reconstruction.json"
    content = json.loads(path.read_text())
    curve = [{"weight": 0.1 * 2**k, "held_out": 50.0 + (k - 2) ** 2} for k in range(5)]
    certificate = {"kind": "bound", "value": 0.00823, "reached": False}
    weight = {"penalty_weight_curve": curve, "penalty_weight": 0.4}
    content["planes"][0] |= {**weight, "certificate": certificate, "name": "table"}
    write_by_hand(path, content)
    done("report", session)
    text = (session / "report.html").read_text()
    part = text[text.index('id="weight"') : text.index('id="noise"')]
    # Every word of the drawing, small ticks among them, is in the page's own ink
    drawn_words = re.findall("<(?:text|tspan) ([^>]*)>", part)
    assert drawn_words
    assert all("fill: currentColor" in style for style in drawn_words)
    assert ">table</text>" in part
    assert "table, 500.0 mm on the axis" in part
    assert part.count("<svg") == 1
    assert "0.823 %: stopped early" in part


def test_large_views_are_cropped_pixel_for_pixel(session: Path, done: Command, undrawn: pytest.MonkeyPatch) -> None:
    undrawn.undo()
    folder = session / "reconstructions" / "scene"
    picture = np.random.default_rng(1).integers(0, 256, (700, 900), np.uint8)
    write_png(folder / "reference_view.png", picture)
    done("report", folder)
    text = (folder / "report.html").read_text()
    before = 'class="pixels" src="data:image/webp;base64,'
    start = text.index(before) + len(before)
    shown = np.frombuffer(base64.b64decode(text[start : text.index('"', start)]), np.uint8)
    np.testing.assert_array_equal(cv2.imdecode(shown, cv2.IMREAD_GRAYSCALE), picture[80:620, 180:720])
