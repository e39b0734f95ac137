"""EMVA 1288 data as the standard has them, up to saturation: imported whole and measured without a step by hand."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.pipelines.calibration.noise import calibrate_sensor, noise_record
from faintfield.pipelines.commands.imports.emva1288 import import_emva1288
from faintfield.pipelines.formats.results.noise import NoiseRecord
from faintfield.pipelines.formats.results.noise_fit import Measured
from faintfield.pipelines.formats.sets.noise_set import load_noise_set
from tests.pipelines.emva_sets import EmvaCamera, write_emva_set


def measure(tmp_path: Path, camera: EmvaCamera, seed: int, **how: Any) -> NoiseRecord:
    """Import and measure a simulated set."""
    import_emva1288(write_emva_set(tmp_path / "data", camera, np.random.default_rng(seed), **how), tmp_path / "set")
    return noise_record(calibrate_sensor(*load_noise_set(tmp_path / "set")))


def holds(found: Measured, truth: float) -> bool:
    """Return whether the interval of a quantity holds the truth, or there is none and a reason instead."""
    if found.value is None:
        return bool(found.why)
    assert found.ci95 is not None
    return found.ci95[0] <= truth <= found.ci95[1]


def test_a_series_up_to_saturation_gives_gain_and_read_noise_of_a_camera_that_bends(tmp_path: Path) -> None:
    camera = EmvaCamera()
    found = measure(tmp_path, camera, 1)
    for name, truth in (("gain_dn_per_e", 0.1), ("read_noise_e", 30.0)):
        measured: Measured = getattr(found, name)
        assert measured.value == pytest.approx(truth, rel=0.003), name
        assert holds(measured, truth), name
    assert holds(found.dark_current_e_per_s, camera.dark_current_e_per_s)
    assert found.fit
    assert found.fit.saturation.limit == "ADC"
    assert found.saturation_dn == 4095
    assert sum(one.left_out is not None for one in found.fit.series) == 5
    light_e = np.linspace(0.02, 1.1, 50)[2:44] * camera.full_e
    signal = 0.1 * light_e * (1 + camera.bend * light_e / camera.full_e)
    line = np.polyval(np.polyfit(light_e, signal, 1, w=1 / signal), light_e)
    assert found.fit.linearity_error.value == pytest.approx(np.mean(np.abs(signal / line - 1)), rel=0.02)
    capacity = found.fit.saturation_e.value
    assert capacity is not None
    assert 0.1 * capacity * (1 + camera.bend * capacity / camera.full_e) == pytest.approx(4095 - 60, rel=0.005)


@pytest.mark.parametrize("off", [None, 8])
def test_eight_bits_whose_offset_drifts_hold_the_truth_or_are_refused_by_name(tmp_path: Path, off: int | None) -> None:
    camera = EmvaCamera(0.0125, 40.0, 6.0, 18_000.0, bits=8, dsnu_e=10.0, drift_dn=0.03, shape=(48, 48))
    found = measure(tmp_path, camera, 3, levels=20, many=30, off=off)
    assert holds(found.gain_dn_per_e, 0.0125)
    assert holds(found.read_noise_e, 40.0)
    assert holds(found.dark_current_e_per_s, 1000.0)
    if off is not None:
        assert found.gain_dn_per_e.value is None
        assert "at level 8 is +" in str(found.gain_dn_per_e.why)
