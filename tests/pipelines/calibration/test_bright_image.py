"""The image whose spread is the report's PRNU, of flats whose light falls off to the corners."""

from dataclasses import replace

import numpy as np

from faintfield.calib.noise import calibrate
from faintfield.pipelines.calibration.noise_emva import measure_emva
from tests.calib.noise.darkroom import specimen, with_flats


def test_vignetting_makes_no_lack_of_scatter() -> None:
    """Shot noise is lower where less light falls, so that vignetting raises it less than it would an even noise."""
    chip, rng = specimen(7, shape=(160, 160))
    rows, columns = np.indices(chip.response.shape) / 79.5 - 1
    chip = replace(chip, response=chip.response * (1.2 - 0.3 * (rows**2 + columns**2)))
    series = with_flats(chip, rng, photons=(8000.0, 16000.0), exposures_s=(0.1, 1.0), dark_frames=4)
    calibration = calibrate(series)
    emva = measure_emva("", series, calibration, {}).estimates
    for prnu in (emva["prnu_pixel"], emva["prnu_total"], calibration.estimates["prnu"]):
        assert prnu.value is not None, prnu.why
        assert prnu.value < 2e-3
