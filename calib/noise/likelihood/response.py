"""The bend of a sensor's response to light: charge behind a signal, and what the levels of flats say of it.

The charge Q that makes the signal s = μ_y − μ_y.dark is

    K Q = s (1 + κ₁ s + κ₂ s² + …)                                                            (5)

with K the gain at zero signal, so that one more electron raises s by dμ/dQ = K / (1 + 2κ₁ s + 3κ₂ s² + …). Where flats
state their photons, or differ in exposure under one light, the charge is proportional to a light H that is known up to
a factor R. Their mean levels then show the bend directly, and the photon transfer the gain.
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array

# κ₁, κ₂, … by their names in a fit.
BENDS = tuple(f"nonlinearity_per_dn{power}" for power in ("", "2", "3", "4", "5"))

# Standard error of the bend at the end of the range before it is measured: where the light of the flats tells it, and
# where nothing does. The second is the model error of an unbent sensor: 95 % of cameras bend by less than twice that.
MEASURED_BEND_SE, UNKNOWN_BEND_SE = 0.3, 0.012

# Likewise of κ₂ where only noise tells the bend. A signal s = K Q (1 + β Q/Q_end) has κ₂ s² = 2β² at the end, 0.08 %
# for β = 2 % and 0.5 % for 5 %; without it, κ₁ and the gain are off.
SECOND_BEND_SE = 0.0025

# A light must span this factor to show a bend; so many levels beyond its scales give 1, 2, 3, 4 coefficients.
_MIN_SPAN, _LEVELS_FOR_BENDS = 2.0, (2, 4, 7, 11)

# A further coefficient is fitted if the levels scatter less with it by an F test of this probability.
_MAX_CHANCE = 0.1

# Residuals are chance alone if those of a good model are larger with this probability. With few degrees of freedom an
# interval grows so much, by Student's t, that only unlikely ones count.
_USUAL_CHANCE, _FEW_FREEDOM, _CHANCE_OF_FEW = 0.3, 8, 0.1

# Range of the linearity error as fractions of saturation, and the fewest levels in it; EMVA 1288 release 4.0.
LINEARITY_RANGE, _MIN_LINEARITY_LEVELS = (0.05, 0.95), 3


def charge_dn(values: Mapping[str, Any], signal_dn: Any) -> Any:
    """Return the charge K Q behind a signal, eq. (5); numbers, arrays or casadi expressions."""
    return signal_dn * (1.0 + _polynomial([values[name] for name in BENDS if name in values], signal_dn))


def charge_slope(values: Mapping[str, Any], signal_dn: Any) -> Any:
    """Return the derivative of `charge_dn`: the gain at zero signal over that at the signal."""
    bends = [(power + 1) * values[name] for power, name in enumerate(BENDS, 1) if name in values]
    return 1.0 + _polynomial(bends, signal_dn)


def _polynomial(coefficients: Sequence[Any], x: Any) -> Any:
    total: Any = 0.0
    for coefficient in reversed(coefficients):
        total = (coefficient + total) * x
    return total


@dataclass(frozen=True)
class Light:
    """Known light of the flat series.

    Attributes
    ----------
    amount : array (series,)
        Photons, or exposure time: the light up to a factor.
    group : array (series,), int
        Series of one group share that factor; −1 where it is of no use, because too few share it.
    odd : tuple of (int, int)
        Series left out because their level does not match their light, each with its group.
    """

    amount: Array
    group: NDArray[np.int64]
    odd: tuple[tuple[int, int], ...] = ()

    @property
    def groups(self) -> NDArray[np.int64]:
        """The groups of use."""
        return np.unique(self.group[self.group >= 0])

    @property
    def freedom(self) -> int:
        """Number of levels of use beyond the factors."""
        return int((self.group >= 0).sum()) - self.groups.size


def known_light(flats: Sequence[Series]) -> Light:
    """Return the light of flats: their photons if all state them, else the exposures at each light level."""
    photons = [flat.conditions.photons for flat in flats]
    if flats and all(photons):
        amount, group = np.array(photons, float), np.zeros(len(flats), int)
    else:
        amount = np.array([flat.conditions.exposure_s for flat in flats], float)
        group = np.unique([flat.conditions.level for flat in flats], return_inverse=True)[1].astype(int)
    for index in np.unique(group):
        amounts = amount[group == index]
        if np.unique(amounts).size < 3 or amounts.min() <= 0 or amounts.max() < _MIN_SPAN * amounts.min():
            group[group == index] = -1
    return Light(amount, group)


def level_design(light: Light, signal_dn: Array, bends: int) -> Array:
    """Return X (level, factor and bend) of the straight line s = X (R, −κ₁, −κ₂ …), over the levels of use.

    Columns of powers are scaled to the brightest level.
    """
    use = light.group >= 0
    factors = [np.where(light.group == index, light.amount, 0.0)[use] for index in light.groups]
    s = signal_dn[use]
    return np.stack([*factors, *(s * (s / s.max()) ** power for power in range(1, bends + 1))], axis=1)


def scatter_of_levels(light: Light, signal_dn: Array, variance_dn2: Array, bends: int) -> tuple[float, float]:
    """Return the relative variance of the levels beyond `variance_dn2`, and Σ r²/variance about the fitted response.

    The variance is the one with which the squares of the residuals r are as large as their degrees of freedom (Mandel
    and Paule, Analytical Chemistry 42, 1194, 1970).
    """
    use, design = light.group >= 0, level_design(light, signal_dn, bends)
    s = signal_dn[use]
    return scatter_of_line(design, s, variance_dn2[use], s**2, design.shape[0] - design.shape[1])


def scatter_of_line(design: Array, target: Array, variance: Array, scale2: Array, freedom: int) -> tuple[float, float]:
    """Return the scatter of a target about its linear fit beyond `variance`, over `scale2`, and Σ r²/variance."""

    def deviance(excess: float) -> float:
        root = np.sqrt(variance + excess * scale2)
        coefficients = np.linalg.lstsq(design / root[:, None], target / root)[0]
        return float(np.sum(((target - design @ coefficients) / root) ** 2))

    return grown_variance(deviance, freedom), deviance(0.0)


def grown_variance(deviance: Callable[[float], float], freedom: float) -> float:
    """Return the excess variance at which a falling deviance equals its degrees of freedom; 0 if chance makes it."""
    usual = _USUAL_CHANCE if freedom >= _FEW_FREEDOM else _CHANCE_OF_FEW
    if freedom < 1 or stats.chi2.sf(deviance(0.0), freedom) > usual:
        return 0.0
    low, high = 0.0, 1e-12
    while deviance(high) > freedom:
        low, high = high, 4 * high
    for _ in range(50):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if deviance(middle) > freedom else (low, middle)
    return high


def choose_bends(light: Light, signal_dn: Array, variance_dn2: Array) -> int:
    """Return how many coefficients of eq. (5) the levels of flats determine, none where they tell nothing.

    The number grows with that of the levels, and further while another one makes them scatter significantly less.
    """
    bends = sum(light.freedom >= needed for needed in _LEVELS_FOR_BENDS)
    while 0 < bends < len(BENDS) and light.freedom - bends >= 3:
        left = light.freedom - bends - 1
        excess, _ = scatter_of_levels(light, signal_dn, variance_dn2, bends + 1)
        variance = variance_dn2 + excess * signal_dn**2
        fewer, more = (scatter_of_levels(light, signal_dn, variance, n)[1] for n in (bends, bends + 1))
        if stats.f.sf((fewer - more) / max(more / left, 1e-12), 1, left) > _MAX_CHANCE:
            break
        bends += 1
    return bends


def level_log_likelihood(
    values: Mapping[str, Any], light: Light, mean_dn: Array, dark_time_s: Array, variance_dn2: Sequence[Any]
) -> Any:
    """Return ln L of the mean levels of flats up to a constant, the factors R integrated out.

    Parameters
    ----------
    values : mapping
        Parameters; numbers or casadi expressions.
    mean_dn, dark_time_s, variance_dn2 : array, sequence (series,)
        Mean level, exposure by which dark signal grows, and variance of the level, that of the light included.
    """
    total: Any = 0.0
    for group in light.groups:
        sums: list[Any] = [0.0, 0.0, 0.0]
        for j in np.flatnonzero(light.group == group).tolist():
            signal = mean_dn[j] - values["offset_dn"]
            slope = charge_slope(values, signal)
            charge = charge_dn(values, signal) - values.get("dark_signal_dn_per_s", 0.0) * dark_time_s[j]
            variance = variance_dn2[j] * slope**2
            total = total - 0.5 * ca.log(variance_dn2[j])
            for power, moment in enumerate((charge**2, charge * light.amount[j], light.amount[j] ** 2)):
                sums[power] = sums[power] + moment / variance
        total = total - 0.5 * (sums[0] - sums[1] ** 2 / sums[2]) - 0.5 * ca.log(sums[2])
    return total


def bend_log_prior(values: Mapping[str, Any], range_dn: float, bend_se: Sequence[float]) -> Any:
    """Return ln of the normal density of the bends at the end of the range, of the standard errors `bend_se`.

    The last one is that of all further bends.
    """
    at_end = [values[name] * range_dn**power for power, name in enumerate(BENDS, 1) if name in values]
    return -0.5 * sum((bend / bend_se[min(index, len(bend_se) - 1)]) ** 2 for index, bend in enumerate(at_end))


def signal_of_charge(values: Mapping[str, float], charge: Array, range_dn: float) -> Array:
    """Return the signal of a charge K Q, the inverse of eq. (5), by Newton's steps within twice the range."""
    signal = np.array(charge, float)
    for _ in range(30):
        step = (charge_dn(values, signal) - charge) / np.maximum(charge_slope(values, signal), 0.05)
        signal = np.clip(signal - step, 0.0, 2 * range_dn)
        if np.abs(step).max() < 1e-9 * range_dn:
            break
    return signal


def linearity_error(signal_dn: Array, light: Array) -> float:
    """Return EMVA 1288's linearity error LE of signals at known light (level,), both positive.

    The mean absolute value of the relative deviations from the straight line a₀ + a₁ H that minimizes the squares of
    (s − a₀ − a₁ H)/s.
    """
    design = np.stack([np.ones_like(light), light], axis=1)
    line = design @ np.linalg.lstsq(design / signal_dn[:, None], np.ones_like(signal_dn))[0]
    return float(np.mean(np.abs(signal_dn / line - 1)))


def quantum_efficiency(photons: Array, charge_e: Array, gain_relative_se: float) -> tuple[float, float]:
    """Return electrons per photon with the standard error, from the charges of flats (series,) and their photons.

    EMVA 1288's η = R/K is the slope of charge over photons through the origin. Its error is that of the gain and of the
    light's steadiness.
    """
    slope = float(charge_e @ photons / (photons @ photons))
    scatter = float(np.sum((charge_e - slope * photons) ** 2)) / max(photons.size - 1, 1) / float(photons @ photons)
    return slope, float(np.hypot(slope * gain_relative_se, np.sqrt(scatter)))


def fitted_linearity(
    values: Mapping[str, float], light: Light, signal_dn: Array, variance_dn2: Array, full_dn: float
) -> float | None:
    """Return the linearity error of the response with these bends.

    None with too few levels, or if so bent a response falls or makes no signal of their light.

    Parameters
    ----------
    light, signal_dn, variance_dn2 : Light, array (series,)
        Light and mean signal of all flats, dark signal removed, with its variance.
    full_dn : float
        Signal at saturation, or of the brightest level.
    """
    low, high = (share * full_dn for share in LINEARITY_RANGE)
    errors, sizes = [], []
    for group in light.groups:
        members = light.group == group
        signal, amount, weight = signal_dn[members], light.amount[members], 1 / variance_dn2[members]
        factor = float(weight * amount @ charge_dn(values, signal) / (weight * amount @ amount))
        inside = (signal >= low) & (signal <= high)
        if inside.sum() >= _MIN_LINEARITY_LEVELS:
            straight = signal_of_charge(values, factor * amount[inside], full_dn)
            if not np.all(straight > 0) or np.any(charge_slope(values, signal) <= 0):
                return None
            errors.append(linearity_error(straight, amount[inside]))
            sizes.append(int(inside.sum()))
    return float(np.average(errors, weights=sizes)) if errors else None
