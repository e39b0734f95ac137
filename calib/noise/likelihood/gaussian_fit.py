"""The marginal Gaussian likelihood of dark and flat frames, as expressions for casadi, and its maximum by IPOPT.

The model of a dark pixel i in frame k of series j is `dn = o_i + d_i t_j + jitter_k + noise`, the noise of variance

    v_j = r + g d t_j + 1/12                                                             (1)

with r = g²σ² the read noise in DN², d = g D the dark signal in DN/s and 1/12 the rounding to whole DN. EMVA 1288
release 4 has the same line for flats, `σ_y² = K²σ_d² + 1/12 + K(μ_y − μ_dark)`, with K = g. Offsets o_i ~ N(μ, s²) and
dark signals d_i ~ N(d, q²) of the pixels are integrated out. Fitting them one by one would lose a degree of freedom in
every pixel and series, and bias the noise by (n − 1)/n. The likelihood depends on the frames through a few numbers
only; `calib.noise.likelihood.moments` gives the distribution of each.
"""

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import astuple, dataclass, field, fields, replace
from typing import Any

import casadi as ca
import numpy as np
from scipy import stats

from faintfield.calib.errors import PoorFit
from faintfield.calib.estimate import NORMAL_QUANTILE
from faintfield.calib.noise.likelihood.moments import Excess, Moments, SeriesMoments
from faintfield.calib.noise.likelihood.response import (
    BENDS,
    bend_log_prior,
    charge_dn,
    charge_slope,
    level_log_likelihood,
)
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.calib.noise.strips import Array

# IPOPT prints nothing only with all of these. It also tries points with a negative variance, and backs off by itself.
_QUIET: dict[str, Any] = {"ipopt.print_level": 0, "print_time": False, "ipopt.sb": "yes", "show_eval_warnings": False}

# Gradient of −ln L per unit of a parameter at which the search ends. A gradient of one is one standard error where that
# is one unit, and −ln L of 10⁵ is rounded such that its gradient may not come below 10⁻⁷.
_TOLERANCE = 1e-6

# Limits of parameters. Without dark signal nothing determines the gain, and the search would not end.
_LIMITS = {"jitter_dn2": (0.0, np.inf), "log_gain": (np.log(1e-4), np.log(1e4))}

_SPREADS = ("dsnu_dn2", "dcnu_dn2_per_s2")

# Largest jitter that counts as zero, over the one that the levels can show: IPOPT stops a little above its bound, where
# the likelihood may be curved the wrong way.
_NO_JITTER = 1e-4


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


def flat_log_likelihood(values: Mapping[str, Any], moments: Moments) -> tuple[Any, list[Any], list[float]]:
    """Return ln L of the flats' noise up to a constant, and ln v and half the degrees of freedom of each series."""
    total, variances = 0.0, flat_variances_dn2(values, moments.flats.mean_dn)
    costs = list(_noise_costs(variances, moments.flats, moments, moments.excess.flats))
    for cost, _ in costs:
        total -= cost
    return total, [ca.log(v) for v in variances], [half for _, half in costs]


def _noise_costs(
    variances_dn2: Iterable[Any], series: SeriesMoments, moments: Moments, dispersion: float
) -> Iterator[tuple[Any, float]]:
    """Yield −ln L of the noise of each series up to a constant, and half its degrees of freedom."""
    columns = (series.frames, series.within_dn2, series.evenness, series.rounding2)
    for v, n, within, evenness, rounding2 in zip(variances_dn2, *columns, strict=True):
        degrees = (n - 1) * moments.freedom * evenness
        grown = dispersion + 0.5 * degrees * (moments.excess.variance2 + rounding2)
        yield _chi_squared(degrees / grown, within * evenness / grown, v), 0.5 * degrees / grown


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
    for cost, _ in _noise_costs(dark_v, darks, moments, moments.excess.darks):
        total += cost
    of_flats = flat_log_likelihood(values, moments)[0]
    if any(name in values for name in BENDS):
        if moments.bend_se:
            of_flats = of_flats + bend_log_prior(values, moments.range_dn, moments.bend_se)
        if moments.light.groups.size:
            levels = moments.flats.mean_dn, moments.flats.exposure_s, level_variances_dn2(values, moments)
            of_flats = of_flats + level_log_likelihood(values, moments.light, *levels)
    return total - of_flats


def _dark_level_cost(values: Mapping[str, Any], dark_v: list[Any], moments: Moments) -> Any:
    """Return −ln of the restricted likelihood (REML) of the frames' levels about the straight line μ + d t.

    Offset and slope are integrated out, which would otherwise make the jitter too small.
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
    return 0.5 * (freedom * ca.log(variance) + squares / variance)


def _wishart_cost(values: Mapping[str, Any], dark_v: list[Any], moments: Moments) -> Any:
    """Return −ln of the Wishart likelihood of the scatter of pixel means, covariance A + s² 11ᵀ + q² ttᵀ.

    A is diagonal with v_j/n_j. Woodbury's identity reduces it to 2 × 2 matrices, whatever the number of series. Series
    of one frame are left out, since they cannot separate noise from pattern.
    """
    several = moments.darks.frames > 1
    scatter = moments.scatter_dn2[np.ix_(several, several)]
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
    left, right = (ca.vertcat(*[w * side[j] for j, w in enumerate(weight)]) for side in (a, b))
    return ca.mtimes([left.T, ca.DM(scatter), right])


@dataclass(frozen=True)
class Bend:
    """Coefficients κ₁, κ₂ … of the response by their names, and their covariance."""

    values: dict[str, float]
    covariance: Array


@dataclass(frozen=True)
class NoiseFit:
    """Maximum-likelihood parameters of a sensor and their covariance.

    Attributes
    ----------
    values : dict
        `offset_dn` μ, `log_read_dn2` ln r, `dsnu_dn2` s², `jitter_dn2` τ², and, if the series determine them,
        `dark_signal_dn_per_s` d, `dcnu_dn2_per_s2` q², `log_gain` ln g, and κ₁, κ₂ … by the names in `response.BENDS`.
    covariance, plain_covariance : array (parameter, parameter)
        Covariance in the order of `values`, zero for a jitter that is zero; the same without any scatter beyond that of
        the model.
    log_likelihood : float
        Log-likelihood at the maximum, up to a constant.
    sources : tuple of (array, int)
        Derivative of the covariance by the logarithm of each scatter between series that was measured from them, with
        its degrees of freedom.
    chances : dict of float
        Probability with which chance makes as much of each scatter, by the names of `Excess`.
    """

    values: dict[str, float]
    covariance: Array
    log_likelihood: float
    sources: tuple[tuple[Array, int], ...] = ()
    plain_covariance: Array = field(default_factory=lambda: np.zeros((0, 0)))
    chances: dict[str, float] = field(default_factory=dict)

    @property
    def bend(self) -> Bend:
        """Bend of the response."""
        at = [index for index, name in enumerate(self.values) if name in BENDS]
        values = {name: value for name, value in self.values.items() if name in BENDS}
        return Bend(values, self.covariance[np.ix_(at, at)])

    def quantile(self, gradient: Array) -> float:
        """Return the half width of a 95 % interval, in standard errors, of a linear combination of the parameters.

        The scatter between series is known from few of them only. Student's t has Satterthwaite's degrees of freedom
        (Biometrics Bulletin 2, 110, 1946), from the variance of the variance.
        """
        variance = float(gradient @ self.covariance @ gradient)
        shares = ((float(np.clip(gradient @ c @ gradient, 0, variance)), freedom) for c, freedom in self.sources)
        spread = sum(share**2 / freedom for share, freedom in shares)
        if not spread > 1e-6 * variance**2:
            return NORMAL_QUANTILE
        return float(stats.t.ppf(0.975, variance**2 / spread))

    def quantile_of(self, name: str) -> float:
        """Return the same of one parameter."""
        return self.quantile(np.array([float(parameter == name) for parameter in self.values]))

    def standard_error(self, name: str) -> float:
        """Return the standard error of one parameter, infinite for one that was not fitted."""
        if name not in self.values:
            return float("inf")
        index = list(self.values).index(name)
        return float(np.sqrt(self.covariance[index, index]))


class GaussianProblem:
    """The likelihood of given moments, to be maximized for several sizes of the scatter between series.

    Parameters
    ----------
    moments : Moments
        Sufficient statistics, of which some series have two frames or more; their scatter is not used.
    bends : int
        Number of coefficients κ₁, κ₂ … of the response to fit, eq. (5), which only flats can show.
    """

    def __init__(self, moments: Moments, bends: int = 0) -> None:
        self._start, self._scale = _start(moments, bends)
        self._units = np.array([*self._scale.values()])
        x, p = ca.SX.sym("x", len(self._start)), ca.SX.sym("p", len(fields(Excess)))
        values = {name: x[i] * scale for i, (name, scale) in enumerate(self._scale.items())}
        symbols: Any = ca.vertsplit(p)
        moments = replace(moments, excess=Excess(*symbols))
        objective = negative_log_likelihood(values, moments)
        options = _QUIET | {"ipopt.acceptable_iter": 0, "ipopt.tol": _TOLERANCE}
        self._solver = ca.nlpsol("fit", "ipopt", {"x": x, "p": p, "f": objective}, options)
        self._hessian = ca.Function("hessian", [x, p], [ca.hessian(objective, x)[0]])

    def fit(self, excess: Excess, near: Mapping[str, float] | None = None) -> NoiseFit:
        """Return the maximum for a scatter between series; `near` are parameters to start from.

        Raises
        ------
        PoorFit
            IPOPT did not converge.
        """
        solver, units, start = self._solver, self._units, self._start | dict(near or {})
        # The spreads over pixels may be negative, as unbiased differences of variances can be. A bound at zero would
        # push what contradicts it (pickup whose phase turns from frame to frame, for example) into the read noise.
        limits = np.array([_LIMITS.get(name, (-np.inf, np.inf)) for name in start]) / units[:, None]
        # The first step from the spreads that the frames suggest may overshoot to a variance of zero; smaller spreads
        # avoid that.
        for share in (1.0, 0.1, 0.01):
            first = [value * (share if name in _SPREADS else 1.0) for name, value in start.items()]
            minimum = solver(x0=(first / units).tolist(), p=list(astuple(excess)), lbx=limits[:, 0], ubx=limits[:, 1])
            if solver.stats()["success"]:
                values = dict(zip(start, (np.array(minimum["x"]).ravel() * units).tolist(), strict=True))
                return NoiseFit(values, self.covariance(values, excess), -float(minimum["f"]))
        raise PoorFit(
            f"the noise likelihood has no maximum: IPOPT stopped with {solver.stats()['return_status']} after "
            f"{solver.stats()['iter_count']} iterations; check that the darks were taken with the lens covered"
        )

    def covariance(self, values: Mapping[str, float], excess: Excess) -> Array:
        """Return the inverse of the Hessian of −ln L at given parameters, in their order; huge if undetermined."""
        at = np.array([*values.values()]) / self._units
        free = np.array([name != "jitter_dn2" or at[i] > _NO_JITTER for i, name in enumerate(values)])
        hessian = np.array(self._hessian(at, list(astuple(excess))))
        eigenvalues, vectors = np.linalg.eigh(hessian[np.ix_(free, free)])
        inverse = np.where(eigenvalues > 1e-9, 1.0 / np.maximum(eigenvalues, 1e-9), 1e12)
        covariance = np.zeros_like(hessian)
        covariance[np.ix_(free, free)] = (vectors * inverse) @ vectors.T
        return covariance * np.outer(self._units, self._units)


def _start(moments: Moments, bends: int) -> tuple[dict[str, float], dict[str, float]]:
    """Return initial values from simple moments, and the scale, of each parameter that the series determine."""
    darks, flats = moments.darks, moments.flats
    measured = darks.frames > 1
    variance = darks.within_dn2[measured] / ((darks.frames[measured] - 1) * moments.freedom)
    read = max(float(variance.min()) - ROUNDING_DN2, 1e-3)
    exposures, repeated = np.unique(darks.exposure_s), np.unique(darks.exposure_s[measured])
    line = np.polyfit(darks.exposure_s, darks.mean_dn, 1) if exposures.size > 1 else (0.0, darks.mean_dn.mean())
    # No smaller than any jitter that the levels can show; from far below the search would take long.
    jitter = float(darks.level_scatter_dn2.sum() / max((darks.frames - 1).sum(), 1)) + read / moments.pixels
    start = {"offset_dn": float(line[1]), "log_read_dn2": float(np.log(read)), "dsnu_dn2": read, "jitter_dn2": jitter}
    scale = {"offset_dn": 1.0, "log_read_dn2": 1.0, "dsnu_dn2": read, "jitter_dn2": jitter}
    if exposures.size > 1:
        longest = float(exposures[-1])
        start["dark_signal_dn_per_s"], scale["dark_signal_dn_per_s"] = float(line[0]), 1 / longest
    if repeated.size > 1:
        start["dcnu_dn2_per_s2"], scale["dcnu_dn2_per_s2"] = 0.01 * read / longest**2, read / longest**2
    if flats.frames.size or repeated.size > 1:
        # Excess variance over signal, of the brightest flat or the longest dark.
        k = int(flats.mean_dn.argmax()) if flats.frames.size else int((darks.exposure_s * measured).argmax())
        series = flats if flats.frames.size else darks
        excess = series.within_dn2[k] / max((series.frames[k] - 1) * moments.freedom, 1) - read
        signal = flats.mean_dn[k] - darks.mean_dn.min() if flats.frames.size else float(line[0]) * darks.exposure_s[k]
        gain = float(np.clip(excess / signal if signal > 0 else 1.0, 1e-2, 1e2))
        start["log_gain"], scale["log_gain"] = float(np.log(gain)), 1.0
    for power, name in enumerate(BENDS[:bends], 1):
        brightest = float(flats.mean_dn.max()) - float(line[1])
        start[name], scale[name] = 0.0, 0.01 / brightest**power
    return start, scale
