"""Fit of the marginal likelihood of single values, for frames that no Gaussian describes.

Where values are cut off at the black level, or read noise is below an electron so that single electrons show, means
and variances lose or distort information. The likelihood of the values themselves keeps it
(`calib.noise.likelihood.marginal`). Its maximum is found by scoring with the sum over pixels of s_i s_iᵀ,
s_i = ∇ ln L_i; Berndt, Hall, Hall and Hausman, Annals of Economic and Social Measurement 3/4, 653 (1974).
"""

from collections.abc import Callable

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri

from faintfield.calib.errors import NotIdentifiable, PoorFit
from faintfield.calib.noise.likelihood.gaussian_fit import Bend, NoiseFit, flat_log_likelihood
from faintfield.calib.noise.likelihood.marginal import PARAMETERS, Counts, MarginalLikelihood
from faintfield.calib.noise.likelihood.moments import Moments
from faintfield.calib.noise.strips import Array, Mask

# The log-likelihood of darks and flats together at given parameters, with gradient and information.
type _Objective = Callable[[Array], tuple[float, Array, Array]]

_IS_DCNU = np.array([name == "dcnu" for name in PARAMETERS])

# Largest number of scoring steps; the climb ends long before if it converges at all.
_MAX_STEPS = 80

# The climb ends when a step promises to raise ln L by less than this, and steps are halved down to this length.
_MIN_GAIN, _MIN_STEP_LENGTH = 1e-3, 1e-4

# Relative spreads of the dark current that are tried, and the rise of ln L from which one is accepted.
_TRIED_DCNU, _MIN_RISE = (0.08, 0.3), 4.0


def fit_exact(
    counts: Counts, start: dict[str, float], moments: Moments, bend: Bend, *, exact: bool, try_spread: bool
) -> NoiseFit:
    """Maximize the likelihood (4), times that of the flats' photon transfer if there are flats.

    All pixels have the same dark current unless a spread makes the values much likelier.

    Parameters
    ----------
    counts, start, exact
        As for `MarginalLikelihood`.
    moments, bend : Moments, Bend
        Statistics of the flat series, if there are any, with the scatter of their noise; and their response, which
        darks do not reach.
    try_spread : bool
        Try dark currents that differ from pixel to pixel, which takes five times as long.

    Returns
    -------
    NoiseFit
        Parameters of the Gaussian fit; the covariance is the inverse of Σ s_i s_iᵀ.

    Raises
    ------
    PoorFit
        The steps do not converge.
    """

    def objective(*, spread: bool) -> _Objective:
        darks = MarginalLikelihood(counts, start, exact=exact, spread=spread)

        def evaluate(x: Array) -> tuple[float, Array, Array]:
            dark, flat = darks.evaluate(x), _flat_part(x, moments, bend)
            return dark[0] + flat[0], dark[1] + flat[1], dark[2] + flat[2]

        return evaluate

    maximum = _maximize(objective(spread=False), np.array([start[name] for name in PARAMETERS]), ~_IS_DCNU)
    if try_spread:
        spread = objective(spread=True)
        starts = [np.where(_IS_DCNU, dcnu, [*maximum.values.values()]) for dcnu in _TRIED_DCNU]
        rises = [spread(x)[0] - maximum.log_likelihood for x in starts]
        if max(rises) >= _MIN_RISE:
            maximum = _maximize(spread, starts[int(np.argmax(rises))], np.ones_like(_IS_DCNU))
    size, fit = len(PARAMETERS), _in_gaussian_terms(maximum)
    covariance = np.zeros((size + len(bend.values),) * 2)
    covariance[:size, :size], covariance[size:, size:] = fit.covariance, bend.covariance
    return NoiseFit(fit.values | bend.values, covariance, fit.log_likelihood)


def _in_gaussian_terms(maximum: NoiseFit) -> NoiseFit:
    """Return a maximum over `PARAMETERS` in the parameters of the Gaussian fit."""
    log_gain, log_read_e, log_dark, dcnu, offset, log_dsnu = maximum.values.values()
    slope, dsnu2 = float(np.exp(log_gain + log_dark)), float(np.exp(2 * log_dsnu))
    spread2 = (dcnu * slope) ** 2
    values = {
        "offset_dn": offset,
        "log_read_dn2": 2 * (log_gain + log_read_e),
        "dsnu_dn2": dsnu2,
        "dark_signal_dn_per_s": slope,
        "dcnu_dn2_per_s2": spread2,
        "log_gain": log_gain,
    }
    jacobian = np.array(
        [
            [0, 0, 0, 0, 1, 0],
            [2, 2, 0, 0, 0, 0],
            [0, 0, 0, 0, 0, 2 * dsnu2],
            [slope, 0, slope, 0, 0, 0],
            [2 * spread2, 0, 2 * spread2, 2 * dcnu * slope**2, 0, 0],
            [1, 0, 0, 0, 0, 0],
        ]
    )
    return NoiseFit(values, jacobian @ maximum.covariance @ jacobian.T, maximum.log_likelihood)


def _maximize(objective: _Objective, begin: Array, free: Mask) -> NoiseFit:
    """Climb over the free parameters by scoring steps, halved where they overshoot; the others are zero."""
    x = np.where(free, begin, 0.0)
    best = objective(x)
    for _ in range(_MAX_STEPS):
        step = np.zeros_like(x)
        step[free] = np.linalg.lstsq(best[2][np.ix_(free, free)], best[1][free])[0]
        step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-12))
        if best[1] @ step < _MIN_GAIN:
            # The logarithm of a dark current near zero has next to no information, but the dark current has an error.
            information, covariance = best[2][np.ix_(free, free)], np.zeros_like(best[2])
            root = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
            scale = np.outer(root, root)
            covariance[np.ix_(free, free)] = np.linalg.pinv(information / scale) / scale
            return NoiseFit(dict(zip(PARAMETERS, x.tolist(), strict=True)), covariance, best[0])
        length = 1.0
        while (trial := objective(x + length * step))[0] < best[0] and length > _MIN_STEP_LENGTH:
            length /= 2
        x, best = x + length * step, trial
    raise PoorFit(
        f"the likelihood of the dark values did not settle in {_MAX_STEPS} steps; check that the darks were taken "
        "with the lens covered, or record flats, which fix the gain"
    )


def _flat_part(x: Array, moments: Moments, bend: Bend) -> tuple[float, Array, Array]:
    """Return the flats' ln L, gradient and Fisher information by `PARAMETERS`, the bend integrated out.

    Its normal law times a likelihood that is normal near its coefficients leaves ½ gᵀ M g, with the gradient g by the
    coefficients, and M the inverse of both their informations (Laplace).
    """
    size = len(PARAMETERS)
    if not moments.flats.frames.size:
        return 0.0, np.zeros(size), np.zeros((size, size))
    s, b = ca.SX.sym("s", size), ca.SX.sym("b", len(bend.values))
    values = {"log_gain": s[0], "log_read_dn2": 2 * (s[0] + s[1]), "offset_dn": s[4]}
    units = np.sqrt(np.diag(bend.covariance))
    values |= {name: bend.values[name] + b[k] * units[k] for k, name in enumerate(bend.values)}
    log_likelihood, log_variances, half_freedom = flat_log_likelihood(values, moments)
    logs = ca.vertcat(*log_variances)
    by_bend, weight = ca.jacobian(logs, b), ca.diag(ca.DM(half_freedom))
    if bend.values:
        prior = ca.DM(np.linalg.pinv(bend.covariance / np.outer(units, units)))
        precision = prior + by_bend.T @ weight @ by_bend
        slope = ca.gradient(log_likelihood, b)
        log_likelihood = log_likelihood + 0.5 * slope.T @ ca.solve(precision, slope)
    else:
        precision = ca.SX(0, 0)
    outputs = [log_likelihood, ca.gradient(log_likelihood, s), ca.jacobian(logs, s), by_bend, precision]
    results = ca.Function("flats", [s, b], outputs)(x, np.zeros(len(bend.values)))
    value, gradient, by_series, bends, inverse = (np.array(part) for part in results)
    information = (by_series.T * np.array(half_freedom)) @ by_series
    if bend.values:
        cross = (by_series.T * np.array(half_freedom)) @ bends
        information -= cross @ np.linalg.solve(inverse, cross.T)
    return float(value[0, 0]), gradient.ravel(), information


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
    series = zip(counts.exposure_s, counts.values_dn, strict=True)
    normals = [(t, *law) for t, values in series if (law := _normal_above(values, counts.floor_dn or 0))]
    if len({t for t, *_ in normals}) < 2:
        raise NotIdentifiable(
            f"the darks are cut off at the black level: of {len(counts.exposure_s)} exposures {len(normals)} have a "
            "twentieth of their values above it, 2 are needed; raise the camera's black offset and record them again"
        )
    exposure, centre, spread2 = zip(*normals, strict=True)
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
