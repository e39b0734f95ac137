"""Measure the photo response from flats: vignetting, PRNU, dead pixels, quantum efficiency."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from faintfield.calib.noise.pixels import dead_pixels
from faintfield.calib.noise.statistics import Series


@dataclass(frozen=True)
class Response:
    """Response of the sensor to even light.

    Attributes
    ----------
    relative, vignetting : array (row, column)
        Response over its mean, and its smooth part.
    prnu, prnu_se : float
        Standard deviation of the rest relative to the mean (EMVA 1288's PRNU after its high-pass filter), and its
        standard error.
    dead : array (row, column), bool
        Pixels that respond less than half as much as their neighbourhood.
    """

    relative: NDArray[np.float64]
    vignetting: NDArray[np.float64]
    prnu: float
    prnu_se: float
    dead: NDArray[np.bool_]


def measure_response(
    signals_dn: Sequence[NDArray[np.float64]], noise_dn2: Sequence[float], usable: NDArray[np.bool_]
) -> Response:
    """Separate vignetting from PRNU, and shrink the latter by its share of noise.

    Parameters
    ----------
    signals_dn : sequence of arrays (row, column)
        Mean of each flat series minus offset and dark signal.
    noise_dn2 : sequence of float
        Variance of these means for a pixel of mean signal.
    usable : array (row, column), bool
        Pixels in use.
    """
    total = np.sum(signals_dn, axis=0)
    mean = float(total.mean(where=usable))
    raw = total / mean
    dead = dead_pixels(raw, _smooth(raw, usable)) & usable
    usable = usable & ~dead
    vignetting = _smooth(raw, usable)
    pixel = raw / np.maximum(vignetting, 1e-6) - 1
    # Shot noise grows less than the signal, so that brighter pixels have less of it in relation to their signal.
    noise = float(np.sum(noise_dn2)) / mean**2 / np.maximum(vignetting, 1e-6)
    spread2 = max(float(pixel.var(where=usable)) - float(noise.mean(where=usable)), 0.0)
    kept = spread2 / (spread2 + noise)
    total2 = spread2 + float(noise.mean(where=usable))
    return Response(
        relative=vignetting * (1 + np.where(usable, kept * pixel, 0.0)),
        vignetting=vignetting,
        prnu=float(np.sqrt(spread2)),
        prnu_se=float(total2 * np.sqrt(2 / usable.sum()) / max(2 * np.sqrt(spread2), 1e-9)),
        dead=dead,
    )


def _smooth(response: NDArray[np.float64], usable: NDArray[np.bool_]) -> NDArray[np.float64]:
    """Return the running mean over the usable pixels of a neighbourhood, a sixteenth of the frame wide."""
    window = max(15, min(response.shape) // 16) | 1
    weight = ndimage.uniform_filter(usable.astype(float), window, mode="nearest")
    mean = ndimage.uniform_filter(np.where(usable, response, 0.0), window, mode="nearest")
    return np.asarray(mean / np.maximum(weight, 1e-6))


def quantum_efficiency(
    flats: Sequence[Series], charges_e: Sequence[float], gain_relative_se: float
) -> tuple[float, float] | None:
    """Return electrons per photon with the standard error, from the flats that state their photons; None without any.

    EMVA 1288's η = R/K is the slope of charge over photons through the origin. Its error is that of the gain and of the
    light's steadiness.
    """
    stated = [
        (series.conditions.photons, charge)
        for series, charge in zip(flats, charges_e, strict=True)
        if series.conditions.photons
    ]
    if not stated:
        return None
    photons, charge = np.array(stated, float).T
    slope = float(charge @ photons / (photons @ photons))
    scatter = float(np.sum((charge - slope * photons) ** 2)) / max(len(stated) - 1, 1) / float(photons @ photons)
    return slope, float(np.hypot(slope * gain_relative_se, np.sqrt(scatter)))
