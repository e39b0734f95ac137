"""Quantities of EMVA 1288 release 4.0 that follow from gain, noise, quantum efficiency and saturation.

With K the gain, η the quantum efficiency, σ_d the temporal dark noise in electrons and σ_q² = 1/12 DN² of rounding, a
pixel that gets μ_p photons has the signal-to-noise ratio

    SNR(μ_p) = η μ_p / √(σ_d² + σ_q²/K² + η μ_p)                                              (6)

from which the others follow; each function says how. Errors are propagated to first order with the covariance of what
the quantities follow from: gain and efficiency share most of their error, so that a ratio is known better than either.
"""

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import numpy as np

from faintfield.calib.estimate import NORMAL_QUANTILE, Estimate, interval
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2
from faintfield.calib.noise.strips import Array

# Derivatives are differences over this share of a standard error.
_STEP = 1e-3


def dark_noise_e(read_noise_e: float, dark_current_e_per_s: float, exposure_s: float) -> float:
    """Return the temporal dark noise σ_d of an exposure, √(σ_d0² + μ_I t), without that of rounding."""
    return float(np.sqrt(read_noise_e**2 + max(dark_current_e_per_s, 0.0) * exposure_s))


def threshold_e(gain_dn_per_e: float, noise_e: float) -> float:
    """Return the absolute sensitivity threshold μ_e.min, the charge at which SNR = 1.

    It solves eq. (6): μ_e.min = √(σ_d² + σ_q²/K² + 1/4) + 1/2.
    """
    return float(np.sqrt(noise_e**2 + ROUNDING_DN2 / gain_dn_per_e**2 + 0.25) + 0.5)


def snr(charge_e: Array, gain_dn_per_e: float, noise_e: float, dsnu_e: float = 0.0, prnu: float = 0.0) -> Array:
    """Return the signal-to-noise ratio of charges μ_e = η μ_p, eq. (6).

    With `dsnu_e` and `prnu` it is the total one, which counts the differences between pixels as noise too.
    """
    noise_e2 = noise_e**2 + ROUNDING_DN2 / gain_dn_per_e**2 + charge_e + dsnu_e**2 + (prnu * charge_e) ** 2
    return np.asarray(charge_e / np.sqrt(noise_e2))


@dataclass(frozen=True)
class Inputs:
    """Inputs of the derived quantities: values by name, the reasons for those without, and the covariance.

    The covariance, in the order of `values`, is scaled: 1.96 standard errors are the half width of each interval.
    """

    values: dict[str, float]
    whys: dict[str, str]
    covariance: Array

    def derive(self, needs: Sequence[str], formula: Callable[..., float]) -> Estimate:
        """Return a positive quantity, a function of those named, with its interval; or the reason of a missing one."""
        missing = next((name for name in needs if name not in self.values), None)
        if missing is not None:
            return Estimate(None, why=self.whys[missing])
        order = list(self.values)
        at = [order.index(name) for name in needs]
        covariance = self.covariance[np.ix_(at, at)]
        value, se = propagate(formula, np.array([self.values[name] for name in needs]), covariance)
        return interval(value, se, positive=True)


def propagate(formula: Callable[..., float], values: Array, covariance: Array) -> tuple[float, float]:
    """Return a function of values, and its standard error to first order."""
    steps = _STEP * np.sqrt(np.diag(covariance))
    slopes = np.zeros(values.size)
    for index, step in enumerate(steps.tolist()):
        if step > 0:
            ends = [formula(*(values + sign * step * np.eye(values.size)[index]).tolist()) for sign in (1, -1)]
            slopes[index] = (ends[0] - ends[1]) / (2 * step)
    return formula(*values.tolist()), math.sqrt(max(float(slopes @ covariance @ slopes), 0.0))


def gather_inputs(
    estimates: Mapping[str, Estimate],
    covariance: tuple[Sequence[str], Array],
    *,
    full_well: bool,
    charge_error: float = 0.0,
) -> Inputs:
    """Return gain, read noise, dark current, efficiency and saturation capacity with their covariance.

    The charge of a flat is its signal over the gain K. Errors of η, and of a capacity at the end of the converter, thus
    hold the relative error of K with the opposite sign; the charge of a full well is η times its photons.

    Parameters
    ----------
    estimates, covariance : mapping, tuple (names, array)
        `gain_dn_per_e, read_noise_e, dark_current_e_per_s, quantum_efficiency, saturation_e`, and the covariance of
        those of the first three that have values, possibly with others.
    full_well : bool
        The full well saturates, not the converter.
    charge_error : float
        Relative error of the charge of flats beside that of the gain: the bend of the response is not known exactly.
    """
    names = [name for name in ("gain_dn_per_e", "read_noise_e", "dark_current_e_per_s") if name in covariance[0]]
    derived = ("quantum_efficiency", "saturation_e") if "gain_dn_per_e" in names else ()
    names += [name for name in derived if estimates[name].value is not None]
    values = {name: estimates[name].value or 0.0 for name in names}
    errors = np.array([np.ptp(estimates[name].ci95 or (0.0, 0.0)) / (2 * NORMAL_QUANTILE) for name in names])
    known = [name for name in names if name in covariance[0]]
    at = [list(covariance[0]).index(name) for name in known]
    part = np.asarray(covariance[1])[np.ix_(at, at)]
    formal = np.sqrt(np.diag(part))
    matrix = np.zeros((len(names), len(names)))
    widened = errors[: len(known)] / np.maximum(formal, 1e-300)
    matrix[: len(known), : len(known)] = part * np.outer(widened, widened)
    # Each of the others follows from one before it, and adds an error of its own
    for index in range(len(known), len(names)):
        from_efficiency = names[index] == "saturation_e" and full_well and "quantum_efficiency" in names
        source = names.index("quantum_efficiency") if from_efficiency else 0
        factor = (1 if from_efficiency else -1) * values[names[index]] / values[names[source]]
        se, source_se = (estimates[names[at]].se or 0.0 for at in (index, source))
        own = math.sqrt(max(se**2 - (factor * source_se) ** 2, 0.0)) * (errors[index] / se if se else 1.0)
        own = math.hypot(own, 0.0 if from_efficiency else charge_error * values[names[index]])
        matrix[index, :index] = matrix[:index, index] = factor * matrix[source, :index]
        matrix[index, index] = factor**2 * matrix[source, source] + own**2
    whys = {name: estimate.why or "" for name, estimate in estimates.items() if estimate.value is None}
    return Inputs(values, whys, matrix)


def derived_quantities(inputs: Inputs, exposure_s: float) -> dict[str, Estimate]:
    """Return the quantities that follow from gain, noise, efficiency and saturation, for an exposure of the dark noise.

    Returns
    -------
    dict of Estimate
        `dark_noise_e` σ_d; `responsivity_dn_per_photon` R = K η; `threshold_e` and `threshold_photons`, μ_e.min and
        μ_p.min = μ_e.min/η; `saturation_photons` μ_p.sat = μ_e.sat/η; `snr_max` √μ_e.sat; `dynamic_range`
        μ_p.sat/μ_p.min.
    """
    gain, efficiency, capacity = "gain_dn_per_e", "quantum_efficiency", "saturation_e"
    # Without a dark current, its noise in short exposures is part of the read noise.
    dark = ["read_noise_e", *(["dark_current_e_per_s"] if "dark_current_e_per_s" in inputs.values else [])]

    def noise(read_noise_e: float, dark_current_e_per_s: float = 0.0) -> float:
        return dark_noise_e(read_noise_e, dark_current_e_per_s, exposure_s)

    return {
        "dark_noise_e": inputs.derive(dark, noise),
        "responsivity_dn_per_photon": inputs.derive((gain, efficiency), lambda gain, eta: float(gain * eta)),
        "threshold_e": inputs.derive((gain, *dark), lambda k, *d: threshold_e(k, noise(*d))),
        "threshold_photons": inputs.derive(
            (efficiency, gain, *dark), lambda eta, k, *d: threshold_e(k, noise(*d)) / eta
        ),
        "saturation_photons": inputs.derive((capacity, efficiency), lambda full, eta: full / eta),
        "snr_max": inputs.derive((capacity,), math.sqrt),
        "dynamic_range": inputs.derive((capacity, gain, *dark), lambda full, k, *d: full / threshold_e(k, noise(*d))),
    }
