"""A reconstruction with the noise model that was fitted is as good as one with the true model."""

import json
import tomllib
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import tomli_w

from faintfield.pipelines.commands.noise import noise
from faintfield.pipelines.commands.reconstruct import reconstruct
from faintfield.pipelines.commands.simulate import simulate
from faintfield.pipelines.reconstruction.options import Options
from faintfield.rig.simulation.sensor import SimulatedSensor
from tests.pipelines.noise_sets import write_frames


def texture_errors(elemental_set: Path, out: Path) -> dict[float, float]:
    reconstruct(elemental_set, options=Options(depth_mm=[500.0, 700.0], method=["pmlem-osl"]), out=out)
    rows = json.loads((out / "metrics.json").read_text())["planes"]
    return {row["depth_mm"]: float(np.sqrt(row["mse_texture"])) for row in rows}


@pytest.mark.deep
def test_fitted_noise_model_equals_true_one(tmp_path: Path) -> None:
    size_px = (192, 144)
    simulate(tmp_path / "set", size_px=size_px, seed=4)
    truth = texture_errors(tmp_path / "set", tmp_path / "with_truth")
    generator, sensor = np.random.default_rng(5), SimulatedSensor()
    darks: list[tuple[Any, dict[str, Any]]] = [
        (sensor.expose(np.zeros(size_px[::-1]), t, generator), {"kind": "dark", "exposure_s": t})
        for t in (0.1, 1.0, 10.0, 60.0)
        for _ in range(10)
    ]
    noise(write_frames(tmp_path / "darks", darks), out=tmp_path / "set")
    path = tmp_path / "set" / "elemental.toml"
    path.write_text(tomli_w.dumps(tomllib.loads(path.read_text()) | {"noise": "noise.json"}))
    fitted = texture_errors(tmp_path / "set", tmp_path / "with_fit")
    assert truth.keys() == fitted.keys() == {500.0, 700.0}
    for depth in truth:
        assert abs(fitted[depth] / truth[depth] - 1) < 0.01, (depth, fitted, truth)
