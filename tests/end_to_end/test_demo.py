"""`faintfield demo`, whole: the paper's experiment in the dark, and what its reconstruction takes."""

import json
import os
import subprocess
import sys
from html.parser import HTMLParser
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from pipelines.frames import read_frame

_ROOT = Path(__file__).parents[2]
_MAIN = "from pipelines.cli import main; main({words!r})"


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
    return _run(["demo", str(out)])


@pytest.fixture(scope="session")
def errors(ended: subprocess.CompletedProcess[str], out: Path) -> dict[tuple[str, float], dict[str, Any]]:
    assert ended.returncode == 0, ended.stderr
    metrics = json.loads((out / "metrics.json").read_text())
    return {(row["method"], row["depth_mm"]): row for row in metrics["planes"]}


def test_the_last_line_is_the_path_of_the_report(ended: subprocess.CompletedProcess[str], out: Path) -> None:
    assert ended.returncode == 0, ended.stderr
    assert ended.stdout.splitlines()[-1] == str(out / "report.html")
    assert (out / "report.html").is_file()


@pytest.mark.parametrize("depth_mm", [500.0, 700.0])
def test_penalised_planes_are_nearly_what_more_light_would_have_shown(
    depth_mm: float, errors: dict[tuple[str, float], dict[str, Any]]
) -> None:
    penalised = errors["pmlem-osl", depth_mm]["mse_bright"]
    assert penalised <= 0.02
    assert penalised <= errors["backprojection", depth_mm]["mse_bright"] / 3


def test_errors_are_told_of_every_plane_and_method(errors: dict[tuple[str, float], dict[str, Any]]) -> None:
    methods, depths = ("backprojection", "mlem", "pmlem-osl"), (500.0, 700.0)
    assert set(errors) == {(method, depth) for method in methods for depth in depths}
    for row in errors.values():
        assert {"depth_mm", "method", "poses", "mse_bright", "mse_texture", "psnr_db"} <= set(row)


def test_the_dark_views_have_the_papers_snr(errors: object, out: Path) -> None:
    assert errors
    figures = json.loads((out / "metrics.json").read_text())
    assert figures["snr"]["asked"] == pytest.approx(0.16, rel=1e-6)
    region_px = np.count_nonzero(read_frame(out / "dark-scene" / "object_region.png").pixels_dn > 127)
    # A ratio of two means of squares of nearly normal numbers, each with √2 of its mean as standard deviation
    deviation = 1.16 * np.sqrt(2 / region_px + 2 / (640 * 480))
    assert figures["snr"]["measured"] == pytest.approx(0.16, abs=4 * deviation)
    assert figures["photons_per_px"]["linear"] == pytest.approx(3.84)
    assert figures["photons_per_px"]["from_moments"] == pytest.approx(1.92, abs=0.01)


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


def test_the_report_shows_the_dark_and_the_noise_free_set(errors: object, out: Path) -> None:
    assert errors
    shown = _Pictures((out / "report.html").read_text()).alternatives
    for depth in ("500.0", "700.0"):
        assert f"noise-free set: back-projection at {depth} mm" in shown
        for method in ("back-projection", "MLEM", "PMLEM (one-step-late, TV)"):
            assert f"dark set: {method} at {depth} mm" in shown
    assert "The noise reference" in shown


def test_memory_of_a_reconstruction_is_bounded_by_its_images(errors: object, out: Path, tmp_path: Path) -> None:
    """At most 1.5 times the images as float32 and 200 MB, with the kernels compiled already."""
    assert errors
    words = ["reconstruct", str(out / "dark-scene"), "--out", str(tmp_path / "planes"), "--depth-mm", "500"]
    # Of the 200 MB, 90 are library code. How much of that is resident the page cache decides, not this program: what
    # is its own is the peak less the mapped files, and has the rest as its bound.
    own_kb = (
        "from pipelines.cli import run; assert run({words!r}) == 0; "
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
    assert (peak_kb - files_kb) * 1024 <= 1.5 * images_bytes + 110e6


def test_a_folder_of_something_else_is_left_alone(tmp_path: Path) -> None:
    (tmp_path / "theirs").mkdir()
    (tmp_path / "theirs" / "thesis.tex").touch()
    refused = _run(["demo", str(tmp_path / "theirs")])
    assert (refused.returncode, refused.stdout) == (1, "")
    assert refused.stderr.startswith("faintfield: OutputExists: ")
    assert os.listdir(tmp_path / "theirs") == ["thesis.tex"]
