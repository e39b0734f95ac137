"""Probability of each digital number: values are whole, never below the black level, and rarely Gaussian.

With offset o, gain g, read noise σ and mean charge λ = D t, the value of a dark pixel is y = round(o + g(k + σ z)),
k ~ Poisson(λ), z ~ N(0, 1), and no less than the floor c. In u = y − o:

    exact      P(y | o) = Σ_k e^−λ λ^k / k! · [ Φ((u + ½ − g k) / gσ) − Φ((u − ½ − g k) / gσ) ]        (2)
    censored   P(y | o) = Φ((u + ½ − g λ) / s) − Φ((u − ½ − g λ) / s),  s² = g²(σ² + λ)                (3)

and at the floor, y = c, only the first Φ of the bracket, since everything below ends there (Tobin, Econometrica 26, 24,
1958). (3) replaces the Poisson law of (2) by a normal one, which suffices when σ hides single electrons.
"""

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy.special import gammaln

# The parameters of a mass function, in this order.
MASS_PARAMETERS = ("log_gain", "log_read_e", "log_dark_e_per_s", "dcnu")

# Gauss-Hermite nodes and weights for dark currents D(1 + δ z) that differ from pixel to pixel, z ~ N(0, 1).
_Z, _WEIGHT = np.polynomial.hermite_e.hermegauss(5)
DARK_NODES = _Z
DARK_LOG_WEIGHTS = np.log(_WEIGHT / _WEIGHT.sum())

# Smallest probability: keeps one cosmic ray from deciding the fit, and the rounding of erf out of the logarithms.
_MIN_PROBABILITY = 1e-14


@dataclass(frozen=True)
class MassTable:
    """ln P and its derivatives on a grid of u = y − o, for one exposure.

    Attributes
    ----------
    log_mass, log_tail : array (u, node)
        ln P(y | o), and ln P(≤ y | o), which is the mass of the floor.
    mass_slope, tail_slope : array (parameter, u, node)
        Their derivatives by `MASS_PARAMETERS`.
    """

    log_mass: NDArray[np.float64]
    log_tail: NDArray[np.float64]
    mass_slope: NDArray[np.float64]
    tail_slope: NDArray[np.float64]


def mass_function(
    u_dn: NDArray[np.float64], exposure_s: float, max_charge_e: float, *, exact: bool, spread: bool
) -> Callable[[NDArray[np.float64]], MassTable]:
    """Return the mass function of one exposure, differentiated by casadi.

    Parameters
    ----------
    u_dn : array (u,)
        Values y − o at which to tabulate.
    exposure_s : float
        Exposure time t.
    max_charge_e : float
        Largest λ at which the function will be evaluated; the Poisson sum extends well above it.
    exact : bool
        Use eq. (2) rather than (3).
    spread : bool
        Let pixels differ in dark current, with several nodes rather than one.

    Returns
    -------
    callable
        Function from the values of `MASS_PARAMETERS` to a `MassTable`.
    """
    x = ca.MX.sym("x", len(MASS_PARAMETERS))
    gain, read, dark = ca.exp(x[0]), ca.exp(x[1]), ca.exp(x[2])
    mass, tail = [], []
    for z in DARK_NODES if spread else (0.0,):
        charge = dark * ca.fmax(1 + x[3] * z, 0.05) * exposure_s
        upper, lower = (
            _poisson_tail(u, charge, gain, read, max_charge_e) if exact else _normal_tail(u, charge, gain, read)
            for u in (u_dn + 0.5, u_dn - 0.5)
        )
        mass.append(ca.log(ca.fmax(upper - lower, _MIN_PROBABILITY)))
        tail.append(ca.log(ca.fmax(upper, _MIN_PROBABILITY)))
    table = ca.vertcat(*mass, *tail)
    return partial(_tabulate, ca.Function("mass", [x], [table, ca.jacobian(table, x)]), (2, len(mass), u_dn.size))


def _tabulate(function: ca.Function, shape: tuple[int, int, int], values: NDArray[np.float64]) -> MassTable:
    """Return the table at some values of `MASS_PARAMETERS`; `shape` is (mass or tail, node, u)."""
    logs, slopes = (np.array(part) for part in function(values))
    logs = logs.reshape(shape).transpose(0, 2, 1)
    slopes = slopes.reshape(*shape, len(MASS_PARAMETERS)).transpose(0, 3, 2, 1)
    return MassTable(logs[0], logs[1], slopes[0], slopes[1])


def _normal_tail(u_dn: NDArray[np.float64], charge: ca.MX, gain: ca.MX, read: ca.MX) -> ca.MX:
    """Return Φ((u − g λ) / s), eq. (3)."""
    return _ndtr((ca.MX(u_dn) - gain * charge) / (gain * ca.sqrt(read**2 + charge)))


def _poisson_tail(u_dn: NDArray[np.float64], charge: ca.MX, gain: ca.MX, read: ca.MX, max_charge_e: float) -> ca.MX:
    """Return Σ_k P(k; λ) Φ((u − g k) / gσ), eq. (2)."""
    k = np.arange(int(max_charge_e + 8 * np.sqrt(max_charge_e) + 10))
    poisson = ca.exp(ca.DM(k) * ca.log(charge) - charge - ca.DM(gammaln(k + 1.0)))
    u, electrons = np.repeat(u_dn[:, None], k.size, 1), np.repeat(k[None, :].astype(float), u_dn.size, 0)
    return ca.mtimes(_ndtr((ca.DM(u) - gain * ca.DM(electrons)) / (gain * read)), poisson)


def _ndtr(z: ca.MX) -> ca.MX:
    """Return the normal distribution function Φ."""
    return ca.MX(0.5 * (1 + ca.erf(z / np.sqrt(2.0))))
