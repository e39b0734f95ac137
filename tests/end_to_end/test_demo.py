"""`faintfield demo`: small from capture to report; in deep the accuracy of `--quick` and of full size."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from matplotlib.figure import Figure

from faintfield.pipelines.cli import run
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.workflows import demo as workflow
from tests.drawings import save_empty

DEPTHS_MM = (500.0, 700.0)
MOST_BYTES_OF_THE_REPORT = 5_000_000
SNR = 0.16
_ROOT = Path(__file__).parents[2]
_MAIN = "from faintfield.pipelines.cli import main; main({words!r})"


def _run(*words: str) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-c", _MAIN.format(words=list(words))]
    return subprocess.run(command, capture_output=True, text=True, check=False, cwd=_ROOT)


def _metrics(out: Path) -> dict[str, Any]:
    return dict(json.loads((out / "metrics.json").read_text()))


def _check_sensor(metrics: dict[str, Any]) -> None:
    for name, truth in (("read_noise_e", 12**0.5), ("dark_current_e_per_s", 0.2), ("gain_dn_per_e", 2.0)):
        measured = metrics["noise"][name]
        assert measured["truth"] == pytest.approx(truth)
        assert abs(measured["value"] - truth) <= 3 * measured["se"]
        assert measured["se"] < 0.01 * truth


def _check_light(metrics: dict[str, Any], out: Path) -> None:
    assert metrics["snr"]["asked"] == pytest.approx(SNR, rel=1e-6)
    region = read_frame(out / "truth" / "object_region.png").pixels_dn > 127
    # A ratio of two means of squares of nearly normal numbers, each with √2 of its mean as standard deviation
    deviation = 1.16 * np.sqrt(2 / np.count_nonzero(region) + 2 / region.size)
    assert metrics["snr"]["measured"] == pytest.approx(SNR, abs=4 * deviation)
    assert metrics["photons_per_px"]["linear"] == pytest.approx(3.84)
    assert metrics["photons_per_px"]["from_moments"] == pytest.approx(1.92, abs=0.01)


def test_small_demo_from_capture_to_report(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nine nodes, two methods that are fast, and no surface."""
    methods = ["backprojection"]
    monkeypatch.setattr(workflow, "QUICK", workflow.DemoSize(3, 100.0, (288, 216), 3))
    monkeypatch.setattr(workflow, "_METHODS", methods)
    monkeypatch.setattr(workflow, "DEFAULT_METHOD", "pmlem-osl")
    monkeypatch.setattr(workflow, "select_surface", lambda _: None)
    monkeypatch.setattr(Figure, "savefig", save_empty)
    out = tmp_path / "demo"
    assert run(["demo", str(out), "--quick", "--json"]) == 0
    metrics = _metrics(out)
    printed = json.loads(capsys.readouterr().out)["metrics"]
    assert {**printed, "record_sha256": metrics["record_sha256"]} == metrics
    assert metrics["geometry"]["nodes"] == 9
    assert metrics["geometry"]["centre_rms_mm"] <= 0.05
    _check_sensor(metrics)
    _check_light(metrics, out)
    errors = {(row["method"], row["poses"], row["depth_mm"]): row["mse_bright"] for row in metrics["planes"]}
    assert set(errors) == {("backprojection", "measured", depth) for depth in DEPTHS_MM} | {
        ("pmlem-osl", poses, depth) for poses in ("measured", "nominal", "true") for depth in DEPTHS_MM
    }
    for depth in DEPTHS_MM:
        assert errors["pmlem-osl", "measured", depth] <= 1.1 * errors["pmlem-osl", "true", depth]
        assert errors["pmlem-osl", "measured", depth] <= errors["backprojection", "measured", depth] / 3
    shown = re.findall(r'<img [^>]*alt="([^"]*)"', (out / "report.html").read_text())
    for depth in DEPTHS_MM:
        assert f"noise-free set: back-projection at {depth:g} mm" in shown
        assert f"back-projection, measured poses at {depth:g} mm" in shown
        for poses in ("measured", "nominal", "true"):
            assert f"PMLEM (one-step-late, TV), {poses} poses at {depth:g} mm" in shown
    assert "The noise reference" in shown
    assert run(["verify", str(out / "session")]) == 0


@pytest.mark.deep
@pytest.mark.parametrize("size", ["--quick", "full"])
def test_demo_is_as_accurate_as_promised(size: str, tmp_path: Path) -> None:
    out = tmp_path / "demo"
    ended = _run("demo", str(out), *([size] if size == "--quick" else []))
    assert ended.returncode == 0, ended.stderr
    metrics = _metrics(out)
    assert metrics["geometry"]["nodes"] == (25 if size == "--quick" else 49)
    assert metrics["geometry"]["centre_rms_mm"] <= 0.05
    _check_sensor(metrics)
    _check_light(metrics, out)
    errors = {(row["method"], row["poses"], row["depth_mm"]): row["mse_bright"] for row in metrics["planes"]}
    assert {key[0] for key in errors} == {"backprojection", "pmlem-osl", "pmlem", "occlusion"}
    of_planes = {(row["method"], row["poses"], row["depth_mm"]): row for row in metrics["planes"]}
    for depth in DEPTHS_MM:
        alone, together = (of_planes[method, "measured", depth] for method in ("pmlem", "occlusion"))
        assert (alone["prior"], together["prior"]) == ("tv", "auto")
        if size == "full":
            assert together["mse_texture"] < 0.8 * alone["mse_texture"]
            assert together["mse_plane"] < 0.1 * alone["mse_plane"]
        measured, true, nominal = (errors["pmlem", poses, depth] for poses in ("measured", "true", "nominal"))
        assert measured <= errors["backprojection", "measured", depth] / 3
        if size == "--quick":
            assert measured <= 1.1 * true
            assert nominal > 1.3 * measured
        else:
            assert measured <= 0.012
            assert measured <= 1.05 * true
            assert nominal >= 2 * measured
    assert (out / "report.html").stat().st_size <= MOST_BYTES_OF_THE_REPORT


@pytest.mark.deep
@pytest.mark.parametrize(("prior", "more_bytes"), [("tv", 110e6), ("auto", 210e6)])
def test_memory_of_reconstruction_is_bounded_by_images(prior: str, more_bytes: float, tmp_path: Path) -> None:
    """At most 1.5 times the images as float32 and 200 MB, 100 more by a prior, with the kernels compiled already."""
    simulated = _run("simulate", str(tmp_path / "scene"))
    assert simulated.returncode == 0, simulated.stderr
    words = ["reconstruct", str(tmp_path / "scene"), "--out", str(tmp_path / "planes"), "--depth-mm", "500"]
    words += ["--prior", prior]
    # Of the 200 MB, 90 are library code, of which the page cache decides how much is resident: it is left out
    own_kb = (
        "from faintfield.pipelines.cli import run; assert run({words!r}) == 0; "
        "lines = dict(line.split(':') for line in open('/proc/self/status')); "
        "print(*(int(lines[key].split()[0]) for key in ('VmHWM', 'RssFile')))"
    )
    command = [sys.executable, "-c", own_kb.format(words=[*words, "--passes", "5"])]
    said = subprocess.run(command, capture_output=True, text=True, check=True, cwd=_ROOT).stdout
    peak_kb, files_kb = (int(word) for word in said.split()[-2:])
    images_bytes = 49 * 480 * 640 * 4
    assert (peak_kb - files_kb) * 1024 <= 1.5 * images_bytes + more_bytes


def test_foreign_folder_is_left_alone(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "thesis.tex").touch()
    assert run(["demo", str(tmp_path / "theirs")]) == 1
    assert capsys.readouterr().err.startswith("faintfield: OutputExists: ")
    assert os.listdir(tmp_path / "theirs") == ["thesis.tex"]
