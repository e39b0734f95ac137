"""Darks at several temperatures: the growth of their dark current, and what it makes of the result."""

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from scipy import stats
from scipy.optimize import minimize_scalar

from faintfield.calib.estimate import Estimate, interval
from faintfield.calib.noise.likelihood.gaussian_fit import NoiseFit
from faintfield.calib.noise.likelihood.moments import Moments
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array

# Smallest range of temperatures that shows the growth, and limits of the kelvins over which dark current may double.
_MIN_RANGE_K, _MIN_DOUBLING_K, _MAX_DOUBLING_K = 5.0, 2.0, 30.0

# Largest relative standard error of a value.
_MAX_RELATIVE_SE = 0.1

# Standard errors from which a stated doubling contradicts that of the darks.
_MAX_SIGMAS = 3.0

# Relative change of the dark current per kelvin of most sensors, where the darks do not tell it.
_USUAL_PER_K = 0.1


@dataclass(frozen=True)
class Warmth:
    """Range of the temperatures of the darks, and warnings about them.

    `doubling` are the kelvins over which the dark current doubles, if the series were taken to one temperature by it;
    without a value if nothing tells by what.
    """

    doubling: Estimate | None = None
    range_k: float = 0.0
    warnings: tuple[str, ...] = ()


def settle_temperature(series: Sequence[Series]) -> tuple[Sequence[Series], Warmth]:
    """Return the series with their dark current over that at their mean temperature, and what their temperatures say.

    Nothing changes if they state no temperature, or already state their dark current.
    """
    darks = [item for item in series if item.conditions.kind == "dark" and item.conditions.temperature_c is not None]
    warmth = np.array([dark.conditions.temperature_c for dark in darks], np.float64)
    if np.unique(warmth).size < 2:
        return series, Warmth()
    levels, frames = np.concatenate([dark.levels_dn for dark in darks]), [dark.frames for dark in darks]
    times_s = np.repeat([dark.conditions.exposure_s for dark in darks], frames)
    range_k, doubling = float(np.ptp(warmth)), dark_current_doubling(levels, times_s, np.repeat(warmth, frames))
    stated_k, value, se = _stated_doubling_k(darks), doubling.value, doubling.se
    if stated_k is not None:
        if value is None or se is None or abs(value - stated_k) <= _MAX_SIGMAS * se:
            return series, Warmth(range_k=range_k)
        contradiction = (
            f"dark_current_doubling_k = {stated_k:.3g} is stated, but the dark current of these darks doubles every "
            f"{value:.3g} ± {se:.2g} K ({abs(value - stated_k) / se:.0f} standard errors): correct it, or leave it out "
            "to have it measured"
        )
        return series, Warmth(range_k=range_k, warnings=(contradiction,))
    if value is None:
        why = (
            f"the darks have {warmth.min():g} to {warmth.max():g} °C and nothing tells how their dark current grows: "
            f"its interval allows for {_USUAL_PER_K:.0%} per kelvin; state dark_current_doubling_k, or record all "
            f"darks at one temperature ({doubling.why})"
        )
        return series, Warmth(doubling, range_k, (why,))
    reference_c = float(np.average(warmth, weights=frames))
    note = (
        f"dark_current_doubling_k is not stated: the dark current of these darks doubles every {value:.3g} ± "
        f"{se:.2g} K, by which it is taken to that at {reference_c:.1f} °C"
    )

    settled = []
    for item in series:
        warmth_c = item.conditions.temperature_c
        factor = item.conditions.dark_factor if warmth_c is None else dark_factor(warmth_c, reference_c, value)
        settled.append(replace(item, conditions=replace(item.conditions, dark_factor=factor)))
    return settled, Warmth(doubling, range_k, (note,))


def with_doubling_error(fit: NoiseFit, moments: Moments, darks: Sequence[Series], warmth: Warmth) -> NoiseFit:
    """Return a fit whose dark signal has the error of the doubling, too."""
    if warmth.doubling is None or "dark_signal_dn_per_s" not in fit.values:
        return fit
    error = 0.5 * _USUAL_PER_K * warmth.range_k * fit.values["dark_signal_dn_per_s"]
    if warmth.doubling.value is not None and warmth.doubling.se is not None:
        doublings = np.log2([dark.conditions.dark_factor for dark in darks]) * warmth.doubling.value
        ends = [warmth.doubling.value + sign * warmth.doubling.se for sign in (-1, 1)]
        exposure_s, weights = [dark.conditions.exposure_s for dark in darks], np.sqrt(moments.darks.frames)
        times_s = [2.0 ** (doublings / end) * exposure_s for end in ends]
        low, high = (float(np.polyfit(t, moments.darks.mean_dn, 1, w=weights)[0]) for t in times_s)
        error = 0.5 * (high - low)
    at = list(fit.values).index("dark_signal_dn_per_s")
    covariance = fit.covariance.copy()
    covariance[at, at] += error**2
    return replace(fit, covariance=covariance)


def _stated_doubling_k(darks: Sequence[Series]) -> float | None:
    """Return the kelvins over which the stated dark current doubles, None if none is stated."""
    low, high = (pick(darks, key=lambda dark: dark.conditions.temperature_c or 0.0).conditions for pick in (min, max))
    if low.dark_factor == high.dark_factor or low.temperature_c is None or high.temperature_c is None:
        return None
    return float((high.temperature_c - low.temperature_c) / np.log2(high.dark_factor / low.dark_factor))


def dark_factor(temperature_c: float, reference_c: float, doubling_k: float) -> float:
    """Return the dark current at a temperature over that at the reference, if it doubles every `doubling_k` kelvins."""
    return float(2.0 ** ((temperature_c - reference_c) / doubling_k))


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
