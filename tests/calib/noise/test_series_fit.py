"""The choice of a likelihood, and noise that pixels share."""

import numpy as np
import pytest

from faintfield.calib.noise import Conditions, calibrate, measure_series
from faintfield.calib.noise.fit.series_fit import NoiseLikelihood, _shared_noise_dn2, choose_likelihood
from faintfield.calib.noise.likelihood.marginal import Counts
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from tests.calib.noise.darkroom import dark_series, darks, flat_series, specimen
from tests.calib.noise.test_estimates import fit

GAUSSIAN, EXACT = NoiseLikelihood.GAUSSIAN, NoiseLikelihood.EXACT

# A tenth of an electron of read noise leaves the electrons apart; ln r = 2 ln(0.2 DN)
SHARP = {"log_read_dn2": 2 * np.log(0.2)}

# Half an electron of many DN: only where the gain is known, and there is dark current
MANY_DN = {"log_gain": np.log(20.0), "log_read_dn2": 2 * np.log(8.0)}


@pytest.mark.parametrize(
    ("fitted", "shared_dn2", "floor_dn", "highest_dn", "likelihood"),
    [
        (fit(), 0.0, None, 150, GAUSSIAN),
        (fit(), 0.0, 90, 150, NoiseLikelihood.CENSORED),
        (fit(**SHARP), 0.0, None, 150, EXACT),
        (fit(**SHARP), 0.2**2, None, 150, GAUSSIAN),  # shared noise blurs electrons
        (fit(**SHARP), 0.0, None, 1_000_000, GAUSSIAN),
        (fit(**MANY_DN), 0.0, None, 150, EXACT),
        (fit({"log_gain": 0.6}, **MANY_DN), 0.0, None, 150, GAUSSIAN),
        (fit(**MANY_DN, dark_signal_dn_per_s=-0.1), 0.0, None, 150, GAUSSIAN),
    ],
)
def test_simplest_likelihood_that_holds_is_chosen(
    fitted: NoiseFit, shared_dn2: float, floor_dn: int | None, highest_dn: int, likelihood: NoiseLikelihood
) -> None:
    values = (np.array([[90, 110]], np.int32), np.array([[90, highest_dn]], np.int32))
    assert choose_likelihood(Counts((1.0, 60.0), values, floor_dn), fitted, shared_dn2) is likelihood


@pytest.mark.parametrize("banding_dn", [0.0, 0.6])
def test_shared_noise_is_jitter_and_banding(banding_dn: float) -> None:
    chip, rng = specimen(3, banding_dn=banding_dn)
    values = {"offset_dn": 100.0, "log_read_dn2": np.log(48.0), "dsnu_dn2": 9.0, "jitter_dn2": 0.3}
    dark = measure_series(darks(chip, [0.1], 60, rng)[0.1], Conditions("dark", 0.1))
    assert _shared_noise_dn2([dark], NoiseFit(values, np.eye(4), 0.0)) == pytest.approx(0.3 + banding_dn**2, abs=0.12)


def test_flats_sharpen_the_gain_of_single_electrons() -> None:
    chip, rng = specimen(5, read_noise_e=0.3, shape=(32, 32))
    series = dark_series(chip, (0.1, 10.0, 60.0), 6, rng)
    flats = [flat_series(chip, photons, 6, rng, level=k, exposure_s=1.0) for k, photons in enumerate((2000.0, 6000.0))]
    alone, both = calibrate(series), calibrate([*series, *flats])
    assert alone.likelihood is both.likelihood is NoiseLikelihood.EXACT
    before, after = (result.estimates["gain_dn_per_e"] for result in (alone, both))
    assert after.value == pytest.approx(2.0, rel=0.02)
    assert before.se is not None
    assert after.se is not None
    assert after.se < before.se
    assert abs((after.value or 0.0) - 2.0) < 4 * after.se
