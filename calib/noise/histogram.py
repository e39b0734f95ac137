"""Predicted and observed frequency of each digital number, for a check of the fit by eye."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.signal import fftconvolve

from faintfield.calib.noise.mass import mass_function

# Mean charge in electrons above which the normal law replaces the Poisson sum: as good there, and smaller in memory.
_MAX_POISSON_CHARGE_E = 200.0


@dataclass(frozen=True)
class Histogram:
    """Observed and predicted values of one dark series.

    Attributes
    ----------
    exposure_s : float
        Exposure time.
    value_dn : array (value,)
        All digital numbers from the lowest to the highest.
    count, expected : array (value,)
        Number of times each occurred among the sampled pixels and frames, and its expectation by the fit.
    """

    exposure_s: float
    value_dn: NDArray[np.int64]
    count: NDArray[np.int64]
    expected: NDArray[np.float64]


def compare_histogram(
    values_dn: NDArray[np.int32],
    exposure_s: float,
    fitted: Mapping[str, float],
    pattern_dn2: float,
    floor_dn: int | None,
) -> Histogram:
    """Count the values of one dark series and predict the counts.

    Parameters
    ----------
    values_dn : array (frame, pixel), int
        Values of the series.
    exposure_s : float
        Exposure time.
    fitted : mapping
        Parameters of the fit, which include the gain.
    pattern_dn2 : float
        Variance over pixels, rows, columns and frames of the level about which values scatter.
    floor_dn : int, optional
        Black level at which values are cut off.
    """
    lowest, highest = int(values_dn.min()), int(values_dn.max())
    value = np.arange(lowest, highest + 1)
    spread_dn = float(np.sqrt(max(pattern_dn2, 1e-4)))
    per_dn = max(2, int(np.ceil(2 / spread_dn)))
    reach = int(np.ceil(5 * spread_dn))
    offset = np.arange(-reach * per_dn, reach * per_dn + 1) / per_dn
    prior = np.exp(-0.5 * (offset / spread_dn) ** 2)
    prior /= prior.sum()
    # A black level that drifts down moves the values but makes no charge; see `dark_variances_dn2`.
    level_dn = fitted["offset_dn"] + min(fitted.get("dark_signal_dn_per_s", 0.0), 0.0) * exposure_s
    u = lowest - reach + np.arange((highest - lowest + 2 * reach) * per_dn + 1) / per_dn - level_dn
    mass, tail = (fftconvolve(np.exp(log), prior, "valid")[::per_dn] for log in _logs(u, exposure_s, fitted))
    if floor_dn == lowest:
        mass[0] = tail[0]
    count = np.bincount((values_dn - lowest).ravel(), minlength=value.size)
    return Histogram(exposure_s, value, count, np.maximum(mass, 0) * values_dn.size)


def _logs(
    u_dn: NDArray[np.float64], exposure_s: float, fitted: Mapping[str, float]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return ln of the mass at each u = value − level without charge, and ln of the mass up to it."""
    slope = max(fitted.get("dark_signal_dn_per_s", 0.0), 1e-9)
    log_gain = fitted["log_gain"]
    charge = float(slope / np.exp(log_gain)) * exposure_s
    masses = mass_function(u_dn, exposure_s, charge, exact=charge < _MAX_POISSON_CHARGE_E, spread=False)
    table = masses(np.array([log_gain, 0.5 * fitted["log_read_dn2"] - log_gain, np.log(slope) - log_gain, 0.0]))
    return table.log_mass[:, 0], table.log_tail[:, 0]
