"""The page noise.html, and its report by EMVA 1288, of a simulated sensor whose numbers are known."""

import re
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from faintfield.calib.estimate import Estimate
from faintfield.pipelines.commands.calibration import noise
from faintfield.pipelines.formats.results.noise import NOISE_PAGE, EmvaRecord, NoiseRecord
from tests.calib.noise.darkroom import specimen
from tests.pipelines.conftest import drawing_nothing
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames

GAIN, READ_E, CURRENT, EFFICIENCY, TOP_DN = 0.5, 8.0, 0.2, 0.5, 4095


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NoiseRecord]:
    """A 12-bit sensor from darks to saturation, PRNU 2 %."""
    folder = tmp_path_factory.mktemp("emva")
    chip, rng = specimen(3, gain_dn_per_e=GAIN, read_noise_e=READ_E, prnu=0.02, hot_fraction=0.002)
    light = (500.0, 2000.0, 4000.0, 8000.0, 12000.0, 16200.0)
    frames = [
        (np.minimum(pixels, TOP_DN).astype(np.uint16), keys) for pixels, keys in take_set(chip, rng, photons=light)
    ]
    write_frames(folder, frames, saturation_dn=float(TOP_DN))
    with drawing_nothing():  # tests/pipelines/pages/test_noise_plots.py draws
        return folder, noise(folder)


def emva_of(record: NoiseRecord) -> EmvaRecord:
    assert isinstance(record.emva1288, EmvaRecord)
    return record.emva1288


def test_figures_of_merit_are_true(measured: tuple[Path, NoiseRecord]) -> None:
    """Six standard errors leave room for what the pixels of one chip happen to be."""
    record = emva_of(measured[1])
    truth = {
        "dark_noise_e": np.sqrt(READ_E**2 + CURRENT * 0.1),
        "responsivity_dn_per_photon": GAIN * EFFICIENCY,
        "snr_max": np.sqrt((TOP_DN - 100) / GAIN),
        "dsnu_pixel_e": 1.5,
        "prnu_pixel": 0.02,
    }
    for name, true in truth.items():
        quantity = getattr(record, name)
        chip = 0.002 if "photon" in name else 0.0  # mean response of 4096 pixels
        assert quantity.value == pytest.approx(true, abs=4 * quantity.se + chip * true), name
        assert quantity.se < 0.15 * true, name
    for name in ("dsnu_row_e", "dsnu_column_e", "prnu_row", "prnu_column"):
        assert getattr(record, name).ci95[0] == 0, name
    assert record.dark_image is not None
    assert record.bright_image is not None
    assert (record.dark_noise_exposure_s, record.dark_image.exposure_s, record.bright_image.level) == (0.1, 0.1, 3)
    assert record.bright_image.signal_dn == pytest.approx(8000 * EFFICIENCY * GAIN, rel=0.01)  # half of saturation


def test_page_shows_quantities_and_loads_nothing(measured: tuple[Path, NoiseRecord]) -> None:
    page, record = (measured[0] / NOISE_PAGE).read_text(), measured[1]
    assert page.count("<svg") == len(re.findall(r'role="img" aria-label="[^"]{20}', page)) == 15
    assert not re.search(r"""(src|href)=["'](?!#|data:)|url\((?!#)|@import""", page.replace('xlink:href="#', 'x="'))
    assert len(page.encode()) < 2_000_000
    assert "differ by 0 K" in page
    assert page.count(record.provenance.inputs["noise.toml"] if record.provenance else "none") == 1
    # Units of other reports: the inverse gain, and noise that the rounding is part of
    for words, unit, value in (
        ("inverse of the gain", "e⁻/DN", 1 / (record.gain_dn_per_e.value or 0)),
        ("read noise, with rounding", "DN", np.hypot(record.read_noise_dn.value or 0, np.sqrt(1 / 12))),
    ):
        row = re.search(rf'row">{words} .*?</th><td class="unit">(.*?)</td>\s*<td class="number">([\d.]+)</td>', page)
        assert row is not None
        assert row[1] == unit
        assert float(row[2]) == pytest.approx(value, rel=2e-3)


def test_without_flats_missing_numbers_have_reasons(tmp_path: Path) -> None:
    chip, rng = specimen(5, dark_current_e_per_s=5.0)
    record = noise(write_frames(tmp_path, take_set(chip, rng, frames=6)))
    emva = emva_of(record)
    assert emva.dark_noise_exposure_s == 0
    for name in ("responsivity_dn_per_photon", "threshold_photons", "snr_max", "dynamic_range", "prnu_total"):
        measured: Any = getattr(emva, name)
        assert measured.value is None
        assert "flat" in measured.why, name
    page = (tmp_path / NOISE_PAGE).read_text()
    assert page.count(": there are no flats<") == 4
    assert page.count("<svg") == 7
    assert "as for" in page


def test_efficiency_above_one_is_refused_with_reason(tmp_path: Path) -> None:
    """The flats state all of their photons, so that the efficiency is 1 within its error, and then a quarter."""
    chip, rng = specimen(32)
    chip = replace(chip, sensor=replace(chip.sensor, quantum_efficiency=1.0))
    frames = take_set(chip, rng, (0.1, 10.0), 2, (2000.0, 6000.0))
    measured = measure_sensor(write_frames(tmp_path / "all", frames)).quantum_efficiency
    assert isinstance(measured, Estimate)
    assert measured.value == pytest.approx(1.0, rel=0.1)
    for _, keys in frames[-4:]:
        keys["photons"] /= 4
    result = measure_sensor(write_frames(tmp_path / "quarter", frames))
    measured = result.quantum_efficiency
    assert isinstance(measured, Estimate)
    assert measured.value is None
    assert "the flats hold " in str(measured.why)
    assert [warning for warning in result.warnings if "the flats hold " in warning]
    emva = emva_of(result)
    assert emva.threshold_e.value is not None
    for name in ("threshold_photons", "responsivity_dn_per_photon", "saturation_photons"):
        assert getattr(emva, name).value is None
