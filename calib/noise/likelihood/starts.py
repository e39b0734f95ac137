"""Start values of the search for the likelihood of single values."""

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from faintfield.calib.errors import NotIdentifiable
from faintfield.calib.noise.likelihood.marginal import Counts
from faintfield.calib.noise.likelihood.maximum import NoiseFit


def gaussian_start(gaussian: NoiseFit) -> dict[str, float]:
    """Return initial values for the exact likelihood from the Gaussian fit."""
    values = gaussian.values
    signal = max(values["dark_signal_dn_per_s"], 1e-6)
    return {
        "log_gain": values["log_gain"],
        "log_read_e": 0.5 * values["log_read_dn2"] - values["log_gain"],
        "log_dark_e_per_s": float(np.log(signal)) - values["log_gain"],
        "dcnu": float(np.sqrt(max(values.get("dcnu_dn2_per_s2", 0.0), 0.0)) / signal),
        "offset_dn": values["offset_dn"],
        "log_dsnu_dn": 0.5 * float(np.log(max(values["dsnu_dn2"], 1e-2))),
    }


def censored_start(counts: Counts) -> dict[str, float]:
    """Return initial values for the censored likelihood from quantiles above the floor.

    Raises
    ------
    NotIdentifiable
        There are no two exposures at which a twentieth of the values is above the black level.
    """
    exposure, centre, spread2 = [], [], []
    for t, values in zip(counts.exposure_s, counts.values_dn, strict=True):
        normal = _normal_above(values, counts.floor_dn or 0)
        if normal is not None:
            exposure.append(t)
            centre.append(normal[0])
            spread2.append(normal[1])
    if len(set(exposure)) < 2:
        raise NotIdentifiable(
            f"the darks are cut off at the black level: of {len(counts.exposure_s)} exposures {len(exposure)} have a "
            "twentieth of their values above it, 2 are needed; raise the camera's black offset and record them again"
        )
    slope, offset = np.polyfit(exposure, centre, 1)
    slope = max(float(slope), 1e-6)
    excess, both = np.polyfit(exposure, spread2, 1)
    gain = float(np.clip(excess / slope, 0.05, 50.0))
    read2 = max(0.7 * float(both), 0.1)
    return {
        "log_gain": float(np.log(gain)),
        "log_read_e": 0.5 * float(np.log(read2)) - float(np.log(gain)),
        "log_dark_e_per_s": float(np.log(slope / gain)),
        "dcnu": 0.05,
        "offset_dn": float(offset),
        "log_dsnu_dn": 0.5 * float(np.log(max(0.3 * float(both), 0.1))),
    }


def _normal_above(values: NDArray[np.int32], floor_dn: int) -> tuple[float, float] | None:
    """Return mean and variance of the normal law through two quantiles above the floor, None with too few values."""
    hidden = float((values == floor_dn).mean())
    if hidden > 0.95:
        return None
    low, high = max(0.5, hidden + 0.2 * (1 - hidden)), max(0.84, hidden + 0.8 * (1 - hidden))
    # Half a DN of dither smooths the steps of the rounding.
    dithered = values + np.linspace(-0.5, 0.5, values.size).reshape(values.shape)
    below, above = np.quantile(dithered, [low, high])
    sigma = float((above - below) / (ndtri(high) - ndtri(low)))
    return float(below - sigma * ndtri(low)), sigma**2
