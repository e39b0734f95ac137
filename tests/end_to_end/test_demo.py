"""`faintfield demo`, whole: the paper's experiment in the dark, and what its reconstruction takes."""

import json
import os
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any, get_args

import numpy as np
import pytest

from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.results.records import JOINT_METHODS, Method

METHODS = [method for method in get_args(Method.__value__) if method not in JOINT_METHODS]
_ROOT = Path(__file__).parents[2]
_MAIN = "from faintfield.pipelines.cli import main; main({words!r})"


def _run(words: list[str], **options: Any) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", _MAIN.format(words=words)],
        capture_output=True,
        text=True,
        check=False,
        cwd=_ROOT,
        **options,
    )


@pytest.fixture(scope="session")
def out(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return tmp_path_factory.mktemp("demo") / "demo"


@pytest.fixture(scope="session")
def ended(out: Path) -> subprocess.CompletedProcess[str]:
    return _run(["demo", str(out), "--quick", "--json"])


@pytest.fixture(scope="session")
def metrics(ended: subprocess.CompletedProcess[str], out: Path) -> dict[str, Any]:
    assert ended.returncode == 0, ended.stderr
    found = json.loads((out / "metrics.json").read_text())
    assert {**json.loads(ended.stdout)["metrics"], "record_sha256": found["record_sha256"]} == found
    return dict(found)


@pytest.fixture(scope="session")
def errors(metrics: dict[str, Any]) -> dict[tuple[str, str, float], float]:
    return {(row["method"], row["poses"], row["depth_mm"]): row["mse_bright"] for row in metrics["planes"]}


def test_the_camera_was_found_where_it_was(metrics: dict[str, Any]) -> None:
    assert metrics["geometry"]["nodes"] == 25
    assert metrics["geometry"]["centre_rms_mm"] <= 0.05


@pytest.mark.parametrize(("name", "truth"), [("read_noise_e", 12**0.5), ("dark_current_e_per_s", 0.2)])
def test_the_sensor_was_measured_as_it_is(name: str, truth: float, metrics: dict[str, Any]) -> None:
    measured = metrics["noise"][name]
    assert measured["truth"] == pytest.approx(truth)
    assert abs(measured["value"] - truth) <= 3 * measured["se"]
    assert measured["se"] < 0.01 * truth


@pytest.mark.parametrize("depth_mm", [500.0, 700.0])
def test_measured_poses_serve_as_well_as_true_ones_and_nominal_ones_do_not(
    depth_mm: float, errors: dict[tuple[str, str, float], float]
) -> None:
    measured, true, nominal = (errors["pmlem", poses, depth_mm] for poses in ("measured", "true", "nominal"))
    assert measured <= 1.1 * true
    assert nominal > 1.3 * measured  # on the small grid; twice as much on the full one, see test_full_demo.py
    assert measured <= errors["backprojection", "measured", depth_mm] / 3


def test_errors_are_told_of_every_plane_and_method(metrics: dict[str, Any]) -> None:
    depths = (500.0, 700.0)
    rows = {(row["method"], row["poses"], row["depth_mm"]) for row in metrics["planes"]}
    assert rows == {(method, "measured", depth) for method in METHODS for depth in depths} | {
        ("pmlem", poses, depth) for poses in ("nominal", "true") for depth in depths
    }
    for row in metrics["planes"]:
        assert {"mse_bright", "mse_texture", "psnr_db"} <= set(row)


def test_the_dark_views_have_the_papers_snr(metrics: dict[str, Any], out: Path) -> None:
    assert metrics["snr"]["asked"] == pytest.approx(0.16, rel=1e-6)
    region_px = np.count_nonzero(read_frame(out / "truth" / "object_region.png").pixels_dn > 127)
    # A ratio of two means of squares of nearly normal numbers, each with √2 of its mean as standard deviation
    deviation = 1.16 * np.sqrt(2 / region_px + 2 / (320 * 240))
    assert metrics["snr"]["measured"] == pytest.approx(0.16, abs=4 * deviation)
    assert metrics["photons_per_px"]["linear"] == pytest.approx(3.84)
    assert metrics["photons_per_px"]["from_moments"] == pytest.approx(1.92, abs=0.01)


def test_its_session_is_whole_and_has_nothing_left_to_do(metrics: dict[str, Any], out: Path) -> None:
    assert metrics
    assert _run(["verify", str(out / "session")]).returncode == 0
    methods = [word for name in METHODS for word in ("--method", name)]
    again = _run(["run", str(out / "session"), *methods, "--prior", "tv", "--json"])
    assert [step["ran"] for step in json.loads(again.stdout)["steps"]] == [False] * 4


class _Pictures(HTMLParser):
    def __init__(self, text: str) -> None:
        super().__init__()
        self.alternatives: list[str] = []
        self.feed(text)

    def handle_starttag(self, tag: str, attrs: list[tuple[str, str | None]]) -> None:
        if tag == "img":
            attributes = dict(attrs)
            assert (attributes["src"] or "").startswith("data:image/")
            self.alternatives.append(attributes["alt"] or "")


def test_the_report_shows_what_was_measured_and_what_it_is_compared_with(metrics: object, out: Path) -> None:
    assert metrics
    shown = _Pictures((out / "report.html").read_text()).alternatives
    for depth in ("500", "700"):
        assert f"noise-free set: back-projection at {depth} mm" in shown
        for method in ("back-projection", "MLEM", "PMLEM (one-step-late, TV)", "PMLEM"):
            assert f"{method}, measured poses at {depth} mm" in shown
        for poses in ("nominal", "true"):
            assert f"PMLEM, {poses} poses at {depth} mm" in shown
    assert "The noise reference" in shown


@pytest.mark.slow
@pytest.mark.parametrize(("prior", "beside"), [("tv", 110e6), ("auto", 210e6)])
def test_memory_of_a_reconstruction_is_bounded_by_its_images(prior: str, beside: float, tmp_path: Path) -> None:
    """At most 1.5 times the images as float32 and 200 MB, 100 more by a prior, with the kernels compiled already."""
    simulated = _run(["simulate", str(tmp_path / "scene")])
    assert simulated.returncode == 0, simulated.stderr
    words = ["reconstruct", str(tmp_path / "scene"), "--out", str(tmp_path / "planes"), "--depth-mm", "500"]
    words += ["--prior", prior]
    # Of the 200 MB, 90 are library code. How much of that is resident the page cache decides, not this program: what
    # is its own is the peak less the mapped files, and has the rest as its bound.
    own_kb = (
        "from faintfield.pipelines.cli import run; assert run({words!r}) == 0; "
        "lines = dict(line.split(':') for line in open('/proc/self/status')); "
        "print(*(int(lines[key].split()[0]) for key in ('VmHWM', 'RssFile')))"
    )
    said = subprocess.run(
        [sys.executable, "-c", own_kb.format(words=[*words, "--passes", "5"])],
        capture_output=True,
        text=True,
        check=True,
        cwd=_ROOT,
    ).stdout
    peak_kb, files_kb = (int(word) for word in said.split()[-2:])
    images_bytes = 49 * 480 * 640 * 4
    assert (peak_kb - files_kb) * 1024 <= 1.5 * images_bytes + beside


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "thesis.tex").touch()
    refused = _run(["demo", str(tmp_path / "theirs")])
    assert (refused.returncode, refused.stdout) == (1, "")
    assert refused.stderr.startswith("faintfield: OutputExists: ")
    assert os.listdir(tmp_path / "theirs") == ["thesis.tex"]
