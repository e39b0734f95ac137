"""Drift while the frames are taken: the lamp, the black level and the temperature."""

import numpy as np

from faintfield.calib.noise.likelihood.gaussian import flat_variances_dn2
from faintfield.calib.noise.likelihood.maximum import NoiseFit
from faintfield.calib.noise.likelihood.moments import Moments


def lamp_flicker2(fit: NoiseFit, moments: Moments) -> tuple[float, float] | None:
    """Return the relative variance of the light from frame to frame with its standard error; None without flats.

    It is what the levels of the frames of a series scatter beyond pixel noise and jitter of the black level. Neither
    enters the pixel noise, since levels are taken out of every frame.
    """
    flats = moments.flats
    if not flats.frames.size:
        return None
    noise = np.array(flat_variances_dn2(fit.values, flats.mean_dn), float) / moments.pixels
    still = fit.values.get("jitter_dn2", 0.0) + noise
    freedom, signal2 = flats.frames - 1, (flats.mean_dn - fit.values["offset_dn"]) ** 2
    total = float(freedom @ signal2)
    if not total > 0:
        return None
    found = float(np.sum(flats.level_scatter_dn2 - freedom * still)) / total
    spread = np.sqrt(2 * float(freedom @ (still + max(found, 0.0) * signal2) ** 2))
    return found, float(spread) / total


def dark_factor(temperature_c: float, reference_c: float, doubling_k: float) -> float:
    """Return the dark current at a temperature over that at the reference, if it doubles every `doubling_k` kelvins."""
    return float(2.0 ** ((temperature_c - reference_c) / doubling_k))
