"""Growth of the dark current with temperature, from dark frames at several temperatures."""

import numpy as np
from numpy.typing import NDArray
from scipy import stats
from scipy.optimize import minimize_scalar

from faintfield.calib.noise.intervals import interval
from faintfield.calib.noise.result import Estimate

type Array = NDArray[np.float64]

# Smallest range of temperatures that shows the growth, and limits of the kelvins over which dark current may double.
_MIN_RANGE_K, _MIN_DOUBLING_K, _MAX_DOUBLING_K = 5.0, 2.0, 30.0

# Largest relative standard error of a value.
_MAX_RELATIVE_SE = 0.1


def dark_current_doubling(level_dn: Array, exposure_s: Array, temperature_c: Array) -> Estimate:
    """Return the temperature difference over which the dark current doubles, in kelvins.

    The level of a dark is a + b (T − T₀) + d t 2^((T − T₀)/T_d): the offset may drift with temperature too.

    Parameters
    ----------
    level_dn, exposure_s, temperature_c : array (frame,)
        Mean of each dark frame, its exposure and its temperature; NaN where that is not known.
    """
    known = np.isfinite(temperature_c)
    level, t, warmth = level_dn[known], exposure_s[known], temperature_c[known]
    if not known.any():
        return Estimate(None, why="no dark states its temperature")
    if np.ptp(warmth) < _MIN_RANGE_K:
        return Estimate(
            None,
            why=f"the temperatures of the darks differ by {np.ptp(warmth):.2g} K (limit {_MIN_RANGE_K:g} K); record "
            "darks of several exposures at several temperatures",
        )
    freedom = level.size - 4
    if freedom < 3 or np.unique(t).size < 2:
        return Estimate(None, why="darks of at least 2 exposures and 7 frames are needed; record more darks")
    warmth = warmth - warmth.mean()

    def design(per_k: float) -> Array:
        return np.stack([np.ones_like(warmth), warmth, t * 2.0 ** (per_k * warmth)], axis=1)

    def squares(per_k: float) -> float:
        matrix = design(per_k)
        return float(np.sum((level - matrix @ np.linalg.lstsq(matrix, level)[0]) ** 2))

    limits = 1 / _MAX_DOUBLING_K, 1 / _MIN_DOUBLING_K
    per_k = float(minimize_scalar(squares, bounds=limits, method="bounded", options={"xatol": 1e-9}).x)
    matrix = design(per_k)
    current = float(np.linalg.lstsq(matrix, level)[0][2])
    jacobian = np.column_stack([matrix, current * matrix[:, 2] * np.log(2.0) * warmth])
    # Long exposures are noisier than short ones: each frame counts with its own residual (HC3 of MacKinnon and White)
    inverse = np.linalg.pinv(jacobian)
    leverage = np.minimum(np.sum(jacobian * inverse.T, axis=1), 0.99)
    residual = (level - matrix @ np.linalg.lstsq(matrix, level)[0]) / (1 - leverage)
    variance = float(np.sum((inverse[3] * residual) ** 2))
    doubling_k, relative = 1 / per_k, float(np.sqrt(variance)) / per_k
    inside = limits[0] * 1.001 < per_k < limits[1] * 0.999
    if current <= 0 or not inside or not relative <= _MAX_RELATIVE_SE:
        return Estimate(None, why="the darks hold too little dark current to show its growth; record longer exposures")
    return interval(doubling_k, relative * doubling_k, float(stats.t.ppf(0.975, freedom)), positive=True)
