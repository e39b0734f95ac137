"""Noise that pixels share, and flats beside the exact likelihood, on sensors of known noise."""

import numpy as np
import pytest

from faintfield.calib.noise import Conditions, calibrate, measure_series
from faintfield.calib.noise.fitting import NoiseLikelihood, _shared_noise_dn2
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from tests.calib.noise.darkroom import darks, expose, specimen


@pytest.mark.parametrize("banding_dn", [0.0, 0.6])
def test_shared_noise_is_jitter_and_banding_without_what_pixels_leave_in_rows_and_columns(banding_dn: float) -> None:
    chip, rng = specimen(3, banding_dn=banding_dn)
    values = {"offset_dn": 100.0, "log_read_dn2": np.log(48.0), "dsnu_dn2": 9.0, "jitter_dn2": 0.3}
    fit = NoiseFit(values, np.eye(4), 0.0)
    dark = measure_series(darks(chip, [0.1], 60, rng)[0.1], Conditions("dark", 0.1))
    assert _shared_noise_dn2([dark], fit) == pytest.approx(0.3 + banding_dn**2, abs=0.12)


def test_flats_fix_the_gain_of_a_sensor_that_shows_single_electrons() -> None:
    chip, rng = specimen(5, read_noise_e=0.3, shape=(32, 32))
    taken = [
        measure_series(frames, Conditions("dark", t)) for t, frames in darks(chip, (0.1, 10.0, 60.0), 6, rng).items()
    ]
    alone = calibrate(taken)
    for level, photons in enumerate((2000.0, 6000.0)):
        frames = [(f"flat_{level}_{k}", expose(chip, 1.0, rng, photons)) for k in range(6)]
        taken.append(measure_series(frames, Conditions("flat", 1.0, level=level)))
    found = calibrate(taken)
    assert alone.likelihood is found.likelihood is NoiseLikelihood.EXACT
    before, after = (one.estimates["gain_dn_per_e"] for one in (alone, found))
    assert before.value is not None
    assert after.value is not None
    assert after.value == pytest.approx(2.0, rel=0.02)
    assert before.se is not None
    assert after.se is not None
    assert after.se < before.se
    assert abs(after.value - 2.0) < 4 * after.se
