"""False alarms about simulated sensors that are as the model states."""

from dataclasses import replace

import numpy as np

from faintfield.calib.noise import Estimate, Series, calibrate
from faintfield.pipelines.calibration.noise_emva import measure_emva
from tests.calib.noise.darkroom import dark_series, flat_series, specimen

PRNU, SHAPE, SESSIONS = 0.005, (64, 64), 20


def session(seed: int) -> list[Series]:
    """Record a session under a lens that leaves half of the light in the corners of the frame."""
    chip, rng = specimen(seed, shape=SHAPE, prnu=PRNU, gain_dn_per_e=0.5)
    rows, columns = (np.linspace(-1, 1, size) for size in SHAPE)
    light = 1 - 0.25 * np.add.outer(rows**2, columns**2)
    chip = replace(chip, response=chip.response * light / light.mean())
    flats = [flat_series(chip, photons, 3, rng, level=level) for level, photons in enumerate((3000.0, 6000.0, 12000.0))]
    return [*dark_series(chip, (0.1, 10.0), 6, rng), *flats]


def normalised(prnu: Estimate) -> float:
    """Return the error of PRNU² in standard errors."""
    assert prnu.value is not None, prnu.why
    low, high = prnu.ci95 or (np.nan, np.nan)
    return (prnu.value**2 - PRNU**2) / ((high**2 - low**2) / 3.92)


def test_vignetting_hides_no_prnu_and_raises_no_alarm() -> None:
    errors, warnings = [], list[str]()
    for seed in range(SESSIONS):
        series = session(seed)
        result = calibrate(series)
        warnings += result.warnings
        report = measure_emva("", series, result, {}).estimates
        errors.append([normalised(result.estimates["prnu"]), normalised(report["prnu_pixel"])])
    assert np.all(np.abs(np.mean(errors, axis=0)) < 3 / np.sqrt(SESSIONS)), np.mean(errors, axis=0)
    assert np.all(np.std(errors, axis=0) < 1.4)
    assert not warnings
