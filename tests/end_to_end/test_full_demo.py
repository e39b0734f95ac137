"""`faintfield demo` at full size, held to what the experiment promises; about a minute and a half."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

pytestmark = pytest.mark.slow

MOST_BYTES_OF_THE_REPORT = 5_000_000


@pytest.fixture(scope="module")
def demo(tmp_path_factory: pytest.TempPathFactory) -> Path:
    out = tmp_path_factory.mktemp("full") / "demo"
    call = "import sys; from faintfield.pipelines.cli import main; main(sys.argv[1:])"
    ended = subprocess.run([sys.executable, "-c", call, "demo", str(out)], capture_output=True, text=True, check=False)
    assert ended.returncode == 0, ended.stderr
    return out


@pytest.fixture(scope="module")
def metrics(demo: Path) -> dict[str, Any]:
    return dict(json.loads((demo / "metrics.json").read_text()))


def test_its_report_can_be_sent_by_mail(demo: Path) -> None:
    assert (demo / "report.html").stat().st_size <= MOST_BYTES_OF_THE_REPORT


def test_the_camera_was_found_where_it_was(metrics: dict[str, Any]) -> None:
    assert metrics["geometry"]["nodes"] == 49
    assert metrics["geometry"]["centre_rms_mm"] <= 0.05


@pytest.mark.parametrize("name", ["read_noise_e", "dark_current_e_per_s"])
def test_the_sensor_was_measured_as_it_is(name: str, metrics: dict[str, Any]) -> None:
    measured = metrics["noise"][name]
    assert abs(measured["value"] - measured["truth"]) <= 3 * measured["se"]


@pytest.mark.parametrize("depth_mm", [500.0, 700.0])
def test_planes_are_as_good_as_promised(depth_mm: float, metrics: dict[str, Any]) -> None:
    errors = {(row["method"], row["poses"], row["depth_mm"]): row["mse_bright"] for row in metrics["planes"]}
    measured, nominal, true = (errors["pmlem", poses, depth_mm] for poses in ("measured", "nominal", "true"))
    assert measured <= 0.012
    assert measured <= 0.5 * nominal
    assert measured <= 1.05 * true
