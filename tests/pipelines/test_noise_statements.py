"""`faintfield noise`: statements about the frames that their values contradict."""

from dataclasses import replace
from pathlib import Path

import pytest

from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.results.noise import NoiseRecord
from faintfield.pipelines.formats.results.noise_emva import EmvaRecord
from faintfield.pipelines.formats.results.noise_fit import Measured
from tests.calib.noise.darkroom import specimen
from tests.pipelines.noise_sets import measure_sensor, take_set, write_frames


def efficiency_of(record: NoiseRecord) -> Measured:
    assert isinstance(record.quantum_efficiency, Measured)
    return record.quantum_efficiency


def test_more_electrons_than_photons_are_no_efficiency(tmp_path: Path) -> None:
    chip, rng = specimen(31)
    frames = take_set(chip, rng, (0.1, 10.0), 2, (2000.0, 6000.0))
    stated = [(it, keys | ({"photons": keys["photons"] / 4} if "photons" in keys else {})) for it, keys in frames]
    result = measure_sensor(write_frames(tmp_path, stated))
    why = "the flats hold 2"
    assert efficiency_of(result).value is None
    assert why in str(efficiency_of(result).why)
    assert "limit 1" in str(efficiency_of(result).why)
    assert isinstance(result.emva1288, EmvaRecord)
    assert [warning for warning in result.warnings if why in warning]
    assert result.gain_dn_per_e.value == pytest.approx(2.0, rel=0.1)
    for name in ("threshold_photons", "responsivity_dn_per_photon", "saturation_photons"):
        assert getattr(result.emva1288, name).value is None
    assert result.emva1288.threshold_e.value is not None


def test_an_efficiency_that_may_be_one_is_kept(tmp_path: Path) -> None:
    chip, rng = specimen(32)
    chip = replace(chip, sensor=replace(chip.sensor, quantum_efficiency=1.0))
    result = measure_sensor(write_frames(tmp_path, take_set(chip, rng, (0.1, 10.0), 2, (2000.0, 6000.0))))
    assert efficiency_of(result).value == pytest.approx(1.0, rel=0.1)


def test_a_saturation_beyond_the_values_of_the_files_is_refused(tmp_path: Path) -> None:
    chip, rng = specimen(33)
    folder = write_frames(tmp_path, take_set(chip, rng, (0.1, 10.0), 2), saturation_dn=70000)
    with pytest.raises(BadValue, match=r"saturation_dn = 70000; the uint16 values of .* end at 65535"):
        measure_sensor(folder)
