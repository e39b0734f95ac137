"""The report by EMVA 1288 of a simulated sensor whose numbers are known."""

import re
from pathlib import Path
from typing import Any
from unittest import mock

import numpy as np
import pytest

from faintfield.pipelines.commands.noise import noise
from faintfield.pipelines.formats.results.noise import NoiseRecord
from faintfield.pipelines.formats.results.noise_emva import EmvaRecord
from faintfield.pipelines.pages import noise_page
from faintfield.pipelines.pages.emva_page import EMVA_PAGE, rounded
from tests.calib.noise.darkroom import specimen
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames

GAIN, READ_E, CURRENT, EFFICIENCY, TOP_DN = 0.5, 8.0, 0.2, 0.5, 4095


@pytest.fixture(scope="module")
def measured(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, NoiseRecord]:
    """A 12-bit sensor from darks to saturation, PRNU 2 %."""
    folder = tmp_path_factory.mktemp("emva")
    chip, rng = specimen(3, gain_dn_per_e=GAIN, read_noise_e=READ_E, prnu=0.02, hot_fraction=0.002)
    light = (500.0, 2000.0, 4000.0, 8000.0, 12000.0, 16200.0)
    frames = [(np.minimum(one, TOP_DN).astype(np.uint16), keys) for one, keys in take_set(chip, rng, photons=light)]
    write_frames(folder, frames, saturation_dn=float(TOP_DN))
    with mock.patch(f"{noise_page.__name__}.draw_page", return_value=b"page"):
        return folder, noise(folder)


def emva_of(record: NoiseRecord) -> EmvaRecord:
    assert isinstance(record.emva1288, EmvaRecord)
    return record.emva1288


def test_figures_of_merit_are_those_of_the_simulated_sensor(measured: tuple[Path, NoiseRecord]) -> None:
    """Six standard errors leave room for what the pixels of one chip happen to be."""
    record = emva_of(measured[1])
    full_e = (TOP_DN - 100) / GAIN
    least = np.sqrt(READ_E**2 + CURRENT * 0.1 + 1 / 12 / GAIN**2 + 0.25) + 0.5
    truth = {
        "dark_noise_e": np.sqrt(READ_E**2 + CURRENT * 0.1),
        "responsivity_dn_per_photon": GAIN * EFFICIENCY,
        "threshold_e": least,
        "threshold_photons": least / EFFICIENCY,
        "saturation_photons": full_e / EFFICIENCY,
        "snr_max": np.sqrt(full_e),
        "dynamic_range": full_e / least,
        "dsnu_pixel_e": 1.5,
        "prnu_pixel": 0.02,
    }
    for name, true in truth.items():
        found = getattr(record, name)
        chip = 0.002 if "photon" in name else 0.0  # mean response of 4096 pixels
        assert found.value == pytest.approx(true, abs=4 * found.se + chip * true), name
        assert found.se < 0.15 * true, name
    for name in ("dsnu_row_e", "dsnu_column_e", "prnu_row", "prnu_column"):
        assert getattr(record, name).ci95[0] == 0, name


def test_the_images_are_the_dark_of_the_flats_exposure_and_the_flat_at_half_of_saturation(
    measured: tuple[Path, NoiseRecord],
) -> None:
    record = emva_of(measured[1])
    assert record.dark_noise_exposure_s == 0.1
    assert record.dark_image is not None
    assert record.dark_image.exposure_s == 0.1
    assert record.bright_image is not None
    assert record.bright_image.level == 3
    assert record.bright_image.signal_dn == pytest.approx(8000 * EFFICIENCY * GAIN, rel=0.01)


def test_the_page_has_every_quantity_and_picture_and_loads_nothing(measured: tuple[Path, NoiseRecord]) -> None:
    page = (measured[0] / EMVA_PAGE).read_text()
    plain = ("η", "K", "1/K", "DR", "DSNU", "LE")
    low = ("σ_d", "μ_p.min", "μ_e.sat", "SNR_max", "DSNU_row", "PRNU_col", "μ_I", "T_d")
    for symbol in plain + tuple(it.replace("_", "<sub>") + "</sub>" for it in low):
        assert f'class="symbol">{symbol}</th>' in page, symbol
    assert not re.search(r"[μσ]_", re.sub(r'aria-label="[^"]*"|<!--.*?-->', "", page))
    assert page.count("<svg") == 9
    assert not re.search(r"""(src|href)=["'](?!#|data:)|url\((?!#)|@import""", page.replace('xlink:href="#', 'x="'))
    assert "differ by 0 K" in page
    assert "left out" in page


def test_without_flats_every_missing_number_has_its_reason(tmp_path: Path) -> None:
    chip, rng = specimen(5, dark_current_e_per_s=5.0)
    with mock.patch(f"{noise_page.__name__}.draw_page", return_value=b"page"):
        record = noise(write_frames(tmp_path, take_set(chip, rng, frames=6)))
    emva = emva_of(record)
    assert emva.dark_noise_exposure_s == 0
    for name in ("responsivity_dn_per_photon", "threshold_photons", "snr_max", "dynamic_range", "prnu_total"):
        found: Any = getattr(emva, name)
        assert found.value is None
        assert "flat" in found.why, name
    page = (tmp_path / EMVA_PAGE).read_text()
    assert page.count("Not shown: there are no flats") == 5
    assert page.count("<svg") == 4
    assert "as for" in page


def test_the_growth_of_dark_current_with_temperature_is_measured(tmp_path: Path) -> None:
    chip, rng = specimen(6, dark_current_e_per_s=5.0, dsnu_e=0.5)
    frames = []
    for warmth in (10.0, 18.0):
        chip.dark_current_e_per_s[...] = 5.0 * 2 ** ((warmth - 14) / 8)
        frames += [(one, keys | {"temperature_c": warmth}) for one, keys in take_set(chip, rng, (0.1, 1.0, 10.0))]
    found = emva_of(measure_sensor(write_frames(tmp_path, frames, dark_current_doubling_k=8.0))).dark_current_doubling_k
    assert found.se is not None
    assert found.se < 0.05
    assert found.value == pytest.approx(8.0, abs=4 * found.se)


def test_values_have_two_digits_of_their_interval() -> None:
    assert rounded(12.3456, (12.1, 12.6)) == ("12.35", "12.10 … 12.60")
    assert rounded(-1234.5, (-1300.0, -1150.0)) == ("−1234", "−1300 … −1150")
    assert rounded(38956.0, (38400.0, 39400.0)) == ("38960", "38400 … 39400")
    assert rounded(3.0, None) == ("3", "")
    assert rounded(0.05, (0.05, 0.05)) == ("0.0500000", "0.0500000 … 0.0500000")


def test_the_table_has_the_units_of_other_reports(measured: tuple[Path, NoiseRecord]) -> None:
    page, record = (measured[0] / EMVA_PAGE).read_text(), measured[1]
    value = record.gain_dn_per_e.value
    assert value is not None
    row = re.search(r'symbol">1/K</th>.*?number">([\d.]+)</td>.*?unit">(.*?)</td>', page, re.DOTALL)
    assert row is not None
    assert float(row[1]) == pytest.approx(1 / value, rel=2e-3)
    assert row[2] == "e⁻/DN"
    read = record.read_noise_dn.value
    assert read is not None
    row = re.search(r'symbol">σ<sub>y.dark</sub>\(0\)</th>.*?number">([\d.]+)</td>', page, re.DOTALL)
    assert row is not None
    assert float(row[1]) == pytest.approx(np.sqrt(read**2 + 1 / 12), rel=2e-3)
