"""The Cramér–Rao bound: the smallest errors with which an unbiased method can measure a sensor from given frames.

The log-likelihood of `calib.noise.likelihood.gaussian_fit` is linear in the sufficient statistics: its Hessian at their
expected values is exactly the Fisher information. Nothing is sampled.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.noise.likelihood.gaussian_fit import main_quantities, negative_log_likelihood
from faintfield.calib.noise.likelihood.moments import Moments, SeriesMoments
from faintfield.calib.noise.likelihood.rounding import ROUNDING_DN2


@dataclass(frozen=True)
class Sensor:
    """True parameters of a sensor: EMVA 1288's K, σ_d and μ_I, offset, spreads over pixels, and jitter of frames."""

    gain_dn_per_e: float
    read_noise_e: float
    dark_current_e_per_s: float
    offset_dn: float = 0.0
    dsnu_e: float = 0.0
    dcnu_e_per_s: float = 0.0
    jitter_dn: float = 0.0


def cramer_rao(
    sensor: Sensor,
    exposures_s: Sequence[float],
    frames: int,
    pixels: int,
    *,
    flat_signals_dn: Sequence[float] = (),
    flat_frames: int = 2,
) -> dict[str, float]:
    """Return the Cramér–Rao bound on the standard errors of `gain_dn_per_e`, `read_noise_e`, `dark_current_e_per_s`.

    There are `frames` darks at each exposure, and `flat_frames` flats of each signal above the offset.
    """
    values = _parameters(sensor)
    moments = _expected_moments(sensor, np.asarray(exposures_s, float), frames, pixels, flat_signals_dn, flat_frames)
    x = ca.SX.sym("x", len(values))
    objective = negative_log_likelihood({name: x[i] for i, name in enumerate(values)}, moments)
    fisher = np.array(ca.Function("fisher", [x], [ca.hessian(objective, x)[0]])(list(values.values())))
    # A spread of zero is on the boundary of the model, and does not affect the errors of the others.
    free = [i for i, (name, value) in enumerate(values.items()) if value > 0 or not name.endswith(("dn2", "per_s2"))]
    covariance = np.linalg.inv(fisher[np.ix_(free, free)])
    derivatives = {name: by for name, (_, by) in main_quantities(values).items() if name != "offset_dn"}
    gradients = {name: np.array([by.get(key, 0.0) for key in values])[free] for name, by in derivatives.items()}
    return {name: float(np.sqrt(gradient @ covariance @ gradient)) for name, gradient in gradients.items()}


def _parameters(sensor: Sensor) -> dict[str, float]:
    """Return the parameters of the likelihood for a sensor."""
    gain = sensor.gain_dn_per_e
    return {
        "offset_dn": sensor.offset_dn,
        "log_read_dn2": float(np.log((gain * sensor.read_noise_e) ** 2)),
        "dsnu_dn2": (gain * sensor.dsnu_e) ** 2,
        "jitter_dn2": sensor.jitter_dn**2,
        "dark_signal_dn_per_s": gain * sensor.dark_current_e_per_s,
        "dcnu_dn2_per_s2": (gain * sensor.dcnu_e_per_s) ** 2,
        "log_gain": float(np.log(gain)),
    }


def _expected_moments(
    sensor: Sensor,
    exposures_s: NDArray[np.float64],
    frames: int,
    pixels: int,
    flat_signals_dn: Sequence[float],
    flat_frames: int,
) -> Moments:
    """Return the expected values of the sufficient statistics."""
    gain = sensor.gain_dn_per_e
    read_dn2 = (gain * sensor.read_noise_e) ** 2 + ROUNDING_DN2
    noise_dn2 = read_dn2 + gain**2 * sensor.dark_current_e_per_s * exposures_s
    n = np.full(exposures_s.shape, float(frames))
    scatter = np.diag(noise_dn2 / n) + (gain * sensor.dsnu_e) ** 2
    scatter = scatter + (gain * sensor.dcnu_e_per_s) ** 2 * np.outer(exposures_s, exposures_s)
    level_dn2 = sensor.jitter_dn**2 + noise_dn2 / pixels
    signals = np.asarray(flat_signals_dn, float)
    flat_n, none = np.full(signals.shape, float(flat_frames)), np.zeros(signals.shape)
    line = sensor.offset_dn + gain * sensor.dark_current_e_per_s * exposures_s
    flat_within = (flat_n - 1) * pixels * (read_dn2 + gain * signals)
    series = SeriesMoments(
        exposure_s=np.append(exposures_s, none),
        frames=np.append(n, flat_n),
        mean_dn=np.append(line, sensor.offset_dn + signals),
        within_dn2=np.append((n - 1) * pixels * noise_dn2, flat_within),
        level_scatter_dn2=np.append((n - 1) * level_dn2, none),
        rounding2=np.zeros(n.size + flat_n.size),
        evenness=np.ones(n.size + flat_n.size),
    )
    return Moments(float(pixels), float(pixels), series, pixels * scatter)
