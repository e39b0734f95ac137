"""The marginal likelihood of single values: they are whole, never below the black level, and rarely Gaussian.

With offset o, gain g, read noise σ and mean charge λ = D t, the value of a dark pixel is y = round(o + g(k + σ z)),
k ~ Poisson(λ), z ~ N(0, 1), and no less than the floor c. Its probability, the mass, is in u = y − o:

    exact      P(y | o) = Σ_k e^−λ λ^k / k! · [ Φ((u + ½ − g k) / gσ) − Φ((u − ½ − g k) / gσ) ]        (2)
    censored   P(y | o) = Φ((u + ½ − g λ) / s) − Φ((u − ½ − g λ) / s),  s² = g²(σ² + λ)                (3)

and at the floor, y = c, only the first Φ of the bracket, since everything below ends there (Tobin, Econometrica 26, 24,
1958). (3) replaces the Poisson law of (2) by a normal one, which suffices when σ hides single electrons.

Every pixel keeps the count of each value in each dark series. Its likelihood is the product of the masses, integrated
on a grid over its unknown offset o ~ N(μ, s²) and at Gauss-Hermite nodes over its dark current:

    L_i = Σ_q N(o_q; μ, s²) Σ_d w_d Π_jk P_j(y_ijk | o_q, D_d)                                          (4)

The scores s_i = ∇ ln L_i are posterior means (Fisher's identity).
"""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse
from scipy.special import gammaln

from faintfield.calib.noise.strips import Array

# The parameters of a mass function, and those of the likelihood, in this order.
MASS_PARAMETERS = ("log_gain", "log_read_e", "log_dark_e_per_s", "dcnu")
PARAMETERS = (*MASS_PARAMETERS, "offset_dn", "log_dsnu_dn")

# Gauss-Hermite nodes and weights for dark currents D(1 + δ z) that differ from pixel to pixel, z ~ N(0, 1).
DARK_NODES, _WEIGHT = np.polynomial.hermite_e.hermegauss(5)
DARK_LOG_WEIGHTS = np.log(_WEIGHT / _WEIGHT.sum())

# Smallest probability: keeps one cosmic ray from deciding the fit, and the rounding of erf out of the logarithms.
_MIN_PROBABILITY = 1e-14

# Pixels whose posteriors are in memory at a time.
_CHUNK_PX = 2048


@dataclass(frozen=True)
class Counts:
    """Exposure of each dark series, and its values (frame, pixel), for the same pixels in each.

    `floor_dn` is the black level at which values are cut off; None if none is.
    """

    exposure_s: tuple[float, ...]
    values_dn: tuple[NDArray[np.int32], ...]
    floor_dn: int | None = None


class MarginalLikelihood:
    """Equation (4) over all pixels, evaluated with counts as a sparse matrix and masses as a dense one.

    Parameters
    ----------
    counts : Counts
        Dark values.
    start : mapping
        Values of `PARAMETERS` near which the likelihood will be evaluated; they decide the grids.
    exact : bool
        Use the Poisson sum, eq. (2), rather than the censored normal law, eq. (3).
    spread : bool
        Let the dark current differ from pixel to pixel.
    """

    def __init__(self, counts: Counts, start: Mapping[str, float], *, exact: bool, spread: bool) -> None:
        gain, read = np.exp(start["log_gain"]), np.exp(start["log_read_e"])
        noise_dn = float(np.sqrt((gain * read) ** 2 + 1 / 12))
        frames = sum(len(values) for values in counts.values_dn)
        self._per_dn = int(np.ceil(1.4 * np.sqrt(frames) / noise_dn))
        self._log_weights = DARK_LOG_WEIGHTS if spread else np.zeros(1)
        self._anchor, half_width = _anchors(counts, start, noise_dn)
        self._floor_dn = counts.floor_dn
        self._offsets = np.arange(-half_width * self._per_dn, half_width * self._per_dn + 1) / self._per_dn
        relative = [values - self._anchor for values in counts.values_dn]
        self._values = [np.arange(values.min(), values.max() + 1) for values in relative]
        self._counts = _count([values - values.min() for values in relative], [values.size for values in self._values])
        charge = np.exp(start["log_dark_e_per_s"]) * np.array(counts.exposure_s) * (1 + 3 * start["dcnu"])
        self._masses = [
            mass_function(self._grid(values), t, 1.5 * largest, exact=exact, spread=spread)
            for values, t, largest in zip(self._values, counts.exposure_s, charge, strict=True)
        ]

    def _grid(self, values: NDArray[np.int64]) -> Array:
        """Return the grid of u = value − offset that holds every pair of them."""
        low, high = values[0] - self._offsets[-1], values[-1] - self._offsets[0]
        return np.asarray(low + np.arange(round((high - low) * self._per_dn) + 1) / self._per_dn)

    def evaluate(self, x: Array) -> tuple[float, Array, Array]:
        """Return ln L, its gradient, and the sum over pixels of s_i s_iᵀ, at the values `x` of `PARAMETERS`.

        At the true parameters of many frames the sum is the Fisher information.
        """
        tables = [mass(x[: len(MASS_PARAMETERS)]) for mass in self._masses]
        log_mass = self._by_offset([logs for logs, _ in tables])
        parameters = range(len(MASS_PARAMETERS))
        slopes = [self._by_offset([by_parameter[:, index] for _, by_parameter in tables]) for index in parameters]
        total, gradient = 0.0, np.zeros(len(PARAMETERS))
        products = np.zeros((len(PARAMETERS), len(PARAMETERS)))
        for first in range(0, self._counts.shape[0], _CHUNK_PX):
            log_likelihood, scores = self._scores(slice(first, first + _CHUNK_PX), x, log_mass, slopes)
            total += log_likelihood
            gradient += scores.sum(0)
            products += scores.T @ scores
        return total, gradient, products

    def _by_offset(self, tables: Sequence[Array]) -> Array:
        """Return tables of masses and tails over u, one per series, as one table over (value, offset × node)."""
        blocks = []
        for (mass, tail), values in zip(tables, self._values, strict=True):
            low = values[0] - self._offsets[-1]
            index = np.rint((values[:, None] - self._offsets - low) * self._per_dn).astype(np.int64)
            block = mass[index]
            if self._floor_dn is not None:
                at_floor = values + self._anchor[0] == self._floor_dn
                block[at_floor] = tail[index[at_floor]]
            blocks.append(block.reshape(values.size, -1))
        return np.vstack(blocks)

    def _scores(self, pixels: slice, x: Array, log_mass: Array, slopes: list[Array]) -> tuple[float, Array]:
        """Return Σ ln L_i and the scores (pixel, parameter) of some pixels."""
        counts = self._counts[pixels]
        spread_dn = np.exp(x[5])
        deviation = (self._anchor[pixels, None] + self._offsets - x[4]) / spread_dn
        log_prior = -0.5 * deviation**2 - np.log(np.sqrt(2 * np.pi) * spread_dn * self._per_dn)
        joint = counts @ log_mass
        joint += (log_prior[:, :, None] + self._log_weights).reshape(joint.shape)
        highest = joint.max(1, keepdims=True)
        np.exp(joint - highest, out=joint)
        evidence = joint.sum(1, keepdims=True)
        joint /= evidence
        scores = [np.einsum("iq,iq->i", joint, counts @ slope) for slope in slopes]
        by_offset = joint.reshape(-1, self._offsets.size, self._log_weights.size).sum(2)
        scores.append((by_offset * deviation).sum(1) / spread_dn)
        scores.append((by_offset * (deviation**2 - 1)).sum(1))
        return float((np.log(evidence) + highest).sum()), np.stack(scores, 1)


def _anchors(counts: Counts, start: Mapping[str, float], noise_dn: float) -> tuple[NDArray[np.int64], int]:
    """Return a whole number near each pixel's offset, and the half width of the range that offsets can have around it.

    Relative to these anchors one table of masses serves every pixel. A floor is at the same value for all pixels, so
    that with one they share an anchor.
    """
    shortest = int(np.argmin(counts.exposure_s))
    values = counts.values_dn[shortest]
    if counts.floor_dn is not None:
        half_width = 5 * np.hypot(np.exp(start["log_dsnu_dn"]), noise_dn)
        return np.full(values.shape[1], round(start["offset_dn"])), int(np.ceil(half_width))
    dark_dn = np.exp(start["log_gain"] + start["log_dark_e_per_s"]) * counts.exposure_s[shortest]
    anchor = np.rint(values.mean(0) - dark_dn).astype(np.int64)
    error_dn = np.sqrt((noise_dn**2 + np.exp(start["log_gain"]) * dark_dn) / len(values))
    return anchor, int(np.ceil(0.5 + 6 * error_dn))


def _count(indices: Sequence[NDArray[np.int64]], sizes: Sequence[int]) -> sparse.csr_array:
    """Return how often each pixel took each value of each series, (pixel, value), the series side by side."""
    firsts = np.cumsum([0, *sizes])
    column = np.vstack([index + first for index, first in zip(indices, firsts, strict=False)])
    pixel = np.broadcast_to(np.arange(column.shape[1]), column.shape)
    ones = np.ones(column.size)
    return sparse.coo_array((ones, (pixel.ravel(), column.ravel())), shape=(column.shape[1], firsts[-1])).tocsr()


def mass_function(
    u_dn: Array, exposure_s: float, max_charge_e: float, *, exact: bool, spread: bool
) -> Callable[[Array], tuple[Array, Array]]:
    """Return the mass function of one exposure, differentiated by casadi.

    Parameters
    ----------
    u_dn, exposure_s : array (u,), float
        Values y − o at which to tabulate, and exposure time t.
    max_charge_e : float
        Largest λ at which the function will be evaluated; the Poisson sum extends well above it.
    exact, spread : bool
        As for `MarginalLikelihood`; a spread needs several nodes.

    Returns
    -------
    callable
        Function from the values of `MASS_PARAMETERS` to ln P(y | o) and ln P(≤ y | o), which is the mass of the floor,
        as one array (mass or tail, u, node), and their derivatives (mass or tail, parameter, u, node).
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
    function, shape = ca.Function("mass", [x], [table, ca.jacobian(table, x)]), (2, len(mass), u_dn.size)

    def tabulate(values: Array) -> tuple[Array, Array]:
        logs, slopes = (np.array(part) for part in function(values))
        return logs.reshape(shape).transpose(0, 2, 1), slopes.reshape(*shape, x.numel()).transpose(0, 3, 2, 1)

    return tabulate


def _normal_tail(u_dn: Array, charge: ca.MX, gain: ca.MX, read: ca.MX) -> ca.MX:
    return _ndtr((ca.MX(u_dn) - gain * charge) / (gain * ca.sqrt(read**2 + charge)))


def _poisson_tail(u_dn: Array, charge: ca.MX, gain: ca.MX, read: ca.MX, max_charge_e: float) -> ca.MX:
    k = np.arange(int(max_charge_e + 8 * np.sqrt(max_charge_e) + 10))
    poisson = ca.exp(ca.DM(k) * ca.log(charge) - charge - ca.DM(gammaln(k + 1.0)))
    u, electrons = np.repeat(u_dn[:, None], k.size, 1), np.repeat(k[None, :].astype(float), u_dn.size, 0)
    return ca.mtimes(_ndtr((ca.DM(u) - gain * ca.DM(electrons)) / (gain * read)), poisson)


def _ndtr(z: ca.MX) -> ca.MX:
    return ca.MX(0.5 * (1 + ca.erf(z / np.sqrt(2.0))))
