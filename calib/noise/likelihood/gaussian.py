"""The marginal Gaussian likelihood of dark and flat frames, as expressions for casadi.

The model of a dark pixel i in frame k of series j is `dn = o_i + d_i t_j + jitter_k + noise`, the noise of variance

    v_j = r + g d t_j + 1/12                                                             (1)

with r = g²σ² the read noise in DN², d = g D the dark signal in DN/s and 1/12 the rounding to whole DN. EMVA 1288
release 4 has the same line for flats, `σ_y² = K²σ_d² + 1/12 + K(μ_y − μ_dark)`, with K = g. Offsets o_i ~ N(μ, s²) and
dark signals d_i ~ N(d, q²) of the pixels are integrated out. Fitting them one by one would lose a degree of freedom in
every pixel and series, and bias the noise by (n − 1)/n. The likelihood depends on the frames through a few numbers
only; `calib.noise.likelihood.moments` gives the distribution of each.
"""

from collections.abc import Mapping
from typing import Any

import casadi as ca
import numpy as np

from faintfield.calib.noise.likelihood.moments import NO_EXCESS, Excess, FlatMoments, Moments
from faintfield.calib.noise.likelihood.response import (
    BENDS,
    bend_log_prior,
    charge_dn,
    charge_slope,
    level_log_likelihood,
)
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.calib.noise.strips import Array


def main_quantities(values: Mapping[str, float]) -> dict[str, tuple[float, dict[str, float]]]:
    """Return offset, gain, read noise and dark current, each with its derivatives by the parameters."""
    gain = float(np.exp(values.get("log_gain", 0.0)))
    sigma = float(np.exp(0.5 * values["log_read_dn2"])) / gain
    current = values.get("dark_signal_dn_per_s", 0.0) / gain
    return {
        "offset_dn": (values["offset_dn"], {"offset_dn": 1.0}),
        "gain_dn_per_e": (gain, {"log_gain": gain}),
        "read_noise_e": (sigma, {"log_read_dn2": 0.5 * sigma, "log_gain": -sigma}),
        "dark_current_e_per_s": (current, {"dark_signal_dn_per_s": 1 / gain, "log_gain": -current}),
    }


def dark_variances_dn2(values: Mapping[str, Any], exposure_s: Array) -> list[Any]:
    """Return the pixel noise of each dark series, eq. (1); parameters may be numbers or casadi expressions.

    A negative dark signal, which is drift of the black level, has no shot noise.
    """
    gain = _exp(values["log_gain"]) if "log_gain" in values else 0.0
    slope = ca.fmax(values.get("dark_signal_dn_per_s", 0.0), 0.0)
    return [_exp(values["log_read_dn2"]) + gain * slope * t + ROUNDING_DN2 for t in exposure_s]


def flat_variances_dn2(values: Mapping[str, Any], mean_dn: Array) -> list[Any]:
    """Return the pixel noise of each flat series: eq. (1), with the local gain of the response, eq. (5)."""
    if not mean_dn.size:
        return []
    gain, read = _exp(values["log_gain"]), _exp(values["log_read_dn2"])
    signals = [mean - values["offset_dn"] for mean in mean_dn]
    return [(gain * charge_dn(values, s) + read) / charge_slope(values, s) ** 2 + ROUNDING_DN2 for s in signals]


def flat_log_likelihood(
    values: Mapping[str, Any], flats: FlatMoments, freedom: float, excess: Excess = NO_EXCESS
) -> tuple[Any, list[Any], list[float]]:
    """Return ln L of the flats' noise up to a constant, and ln v and half the degrees of freedom of each series."""
    total, log_variances, half_freedom = 0.0, [], []
    for index, v in enumerate(flat_variances_dn2(values, flats.mean_dn)):
        weight = flats.evenness[index]
        degrees = (flats.frames[index] - 1) * freedom * weight
        grown = excess.dispersion(degrees, flats.rounding2[index], flat=True)
        total -= _chi_squared(degrees / grown, flats.within_dn2[index] * weight / grown, v)
        log_variances.append(ca.log(v))
        half_freedom.append(0.5 * degrees / grown)
    return total, log_variances, half_freedom


def level_variances_dn2(values: Mapping[str, Any], moments: Moments) -> list[Any]:
    """Return the variance of the mean level of each flat series: pixel noise, jitter, drift and unsteady light."""
    flats, excess = moments.flats, moments.excess
    noise = flat_variances_dn2(values, flats.mean_dn)
    jitter = values.get("jitter_dn2", 0.0)
    return [
        (jitter + v / moments.pixels) / flats.frames[j]
        + excess.drift_dn2
        + excess.light2 * (flats.mean_dn[j] - values["offset_dn"]) ** 2
        for j, v in enumerate(noise)
    ]


def _exp(value: Any) -> Any:
    return ca.exp(value) if isinstance(value, ca.SX) else float(np.exp(value))


def negative_log_likelihood(values: Mapping[str, Any], moments: Moments) -> Any:
    """Return −ln L as a casadi expression, up to a constant that depends on the frames alone."""
    darks = moments.darks
    dark_v = dark_variances_dn2(values, darks.exposure_s)
    total = _wishart_cost(values, dark_v, moments) + _dark_level_cost(values, dark_v, moments)
    for j, v in enumerate(dark_v):
        freedom = (darks.frames[j] - 1) * moments.freedom
        grown = moments.excess.dispersion(freedom, darks.rounding2[j], flat=False)
        total += _chi_squared(freedom / grown, darks.within_dn2[j] / grown, v)
    return total - _flat_log_likelihood(values, moments)


def _flat_log_likelihood(values: Mapping[str, Any], moments: Moments) -> Any:
    """Return ln L of the flats: of their noise, and of their levels where these tell the bend of the response."""
    flats = moments.flats
    total = flat_log_likelihood(values, flats, moments.freedom, moments.excess)[0]
    if not any(name in values for name in BENDS):
        return total
    if np.isfinite(flats.bend_se):
        total = total + bend_log_prior(values, flats.range_dn, flats.bend_se)
    if not flats.light.groups.size:
        return total
    variances = level_variances_dn2(values, moments)
    return total + level_log_likelihood(values, flats.light, flats.mean_dn, flats.exposure_s, variances)


def _dark_level_cost(values: Mapping[str, Any], dark_v: list[Any], moments: Moments) -> Any:
    """Return −ln of the restricted likelihood (REML) of the frames' levels about the straight line μ + d t.

    Offset and slope are integrated out; otherwise the two degrees of freedom that they take would make the jitter too
    small.
    """
    darks, t = moments.darks, moments.darks.exposure_s
    total, weight = 0.0, []
    for j, v in enumerate(dark_v):
        level = values["jitter_dn2"] + v / moments.pixels
        mean = level / darks.frames[j] + moments.excess.drift_dn2
        weight.append(1 / mean)
        line = values["offset_dn"] + values.get("dark_signal_dn_per_s", 0.0) * t[j]
        total += _chi_squared(darks.frames[j] - 1, darks.level_scatter_dn2[j], level)
        total += _chi_squared(1.0, (darks.mean_dn[j] - line) ** 2, mean)
    w, wt, wtt = (sum(w * t[j] ** power for j, w in enumerate(weight)) for power in range(3))
    fitted = w * wtt - wt**2 if "dark_signal_dn_per_s" in values else w
    return total + 0.5 * ca.log(fitted)


def _chi_squared(freedom: float, squares: Any, variance: Any) -> Any:
    """Return −ln of the likelihood of a sum of squares that is `variance` times χ² of `freedom` degrees."""
    return 0.5 * (freedom * ca.log(variance) + squares / variance)


def _wishart_cost(values: Mapping[str, Any], dark_v: list[Any], moments: Moments) -> Any:
    """Return −ln of the Wishart likelihood of the scatter of pixel means, covariance A + s² 11ᵀ + q² ttᵀ.

    A is diagonal with v_j/n_j. Woodbury's identity reduces it to 2 × 2 matrices, whatever the number of series. Series
    of one frame are left out, since they cannot separate noise from pattern.
    """
    several = moments.darks.frames > 1
    scatter = moments.darks.scatter_dn2[np.ix_(several, several)]
    weight = [n / v for n, v in zip(moments.darks.frames, dark_v, strict=True) if n > 1]
    t = moments.darks.exposure_s[several]
    s2, q2 = values["dsnu_dn2"], values.get("dcnu_dn2_per_s2", 0.0)
    basis = (np.ones_like(t), t)
    p = [[sum(w * a[j] * b[j] for j, w in enumerate(weight)) for b in basis] for a in basis]
    k = [[_quadratic(weight, a, b, scatter) for b in basis] for a in basis]
    # M = I + K P with K = diag(s², q²); ln det(A + U K Uᵀ) = ln det A + ln det M, and (M⁻¹ K) corrects the trace.
    m00, m01, m10, m11 = 1 + s2 * p[0][0], s2 * p[0][1], q2 * p[1][0], 1 + q2 * p[1][1]
    determinant = m00 * m11 - m01 * m10
    correction = (m11 * s2 * k[0][0] - m01 * q2 * k[1][0] - m10 * s2 * k[0][1] + m00 * q2 * k[1][1]) / determinant
    log_det = ca.log(determinant) - sum(ca.log(w) for w in weight)
    trace = sum(w * scatter[j, j] for j, w in enumerate(weight)) - correction
    # What rounding may make of the noise, it may make of the means, too: the pixels share its error.
    rounding2 = float(moments.darks.rounding2[several].max(initial=0.0))
    return 0.5 * (moments.freedom * log_det + trace) / (1 + 0.5 * moments.freedom * rounding2)


def _quadratic(weight: list[Any], a: Array, b: Array, scatter: Array) -> Any:
    """Return aᵀ W S W b with W = diag(weight)."""
    left, right = (ca.vertcat(*[w * side[j] for j, w in enumerate(weight)]) for side in (a, b))
    return ca.mtimes([left.T, ca.DM(scatter), right])
