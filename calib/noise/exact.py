"""The marginal likelihood of the digital numbers themselves, for data that no Gaussian describes.

Where values are cut off at the black level, or read noise is below an electron so that single electrons show, means
and variances lose or distort what the frames tell. Here every pixel keeps the count of each value in each dark series,
and its likelihood is the product of the masses (`calib.noise.mass`), integrated over its unknown offset
o ~ N(μ, s²), on a grid, and over its dark current, at Gauss-Hermite nodes:

    L_i = Σ_q N(o_q; μ, s²) Σ_d w_d Π_jk P_j(y_ijk | o_q, D_d)                                          (4)

The maximum is found by scoring with the sum over pixels of s_i s_iᵀ, the scores s_i = ∇ ln L_i being posterior means
(Fisher's identity); Berndt, Hall, Hall and Hausman, Annals of Economic and Social Measurement 3/4, 653 (1974).
"""

from collections.abc import Sequence
from dataclasses import dataclass

import casadi as ca
import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from faintfield.calib.errors import PoorFit
from faintfield.calib.noise.gaussian import NoiseFit, flat_log_likelihood
from faintfield.calib.noise.mass import DARK_LOG_WEIGHTS, MASS_PARAMETERS, MassTable, mass_function
from faintfield.calib.noise.moments import FlatMoments

PARAMETERS = (*MASS_PARAMETERS, "offset_dn", "log_dsnu_dn")
_DCNU = PARAMETERS.index("dcnu")

_CHUNK_PX = 2048
_MAX_STEPS = 80

# Spreads of the dark current to try, relative, and by how much one must raise ln L to be believed.
_TRIED_DCNU, _CONVINCING = (0.08, 0.3), 4.0


@dataclass(frozen=True)
class Counts:
    """The values of the pixels in use, and how to tabulate them.

    Attributes
    ----------
    exposure_s : tuple of float
        Exposure of each dark series.
    values_dn : tuple of arrays (frame, pixel), int
        Values of each series, the same pixels in each.
    floor_dn : int, optional
        The black level at which values are cut off; None where none is.
    """

    exposure_s: tuple[float, ...]
    values_dn: tuple[NDArray[np.int32], ...]
    floor_dn: int | None = None


def fit_exact(
    counts: Counts, start: dict[str, float], flats: FlatMoments, freedom: float, *, exact: bool, try_spread: bool
) -> NoiseFit:
    """Maximise the likelihood (4), with the flats' photon transfer where there is one.

    Dark currents are taken to be the same for all pixels unless the values are much likelier when they are not.

    Parameters
    ----------
    counts : Counts
        Dark values.
    start : dict
        Where to begin, by the names in `PARAMETERS`; also decides the grids.
    flats : FlatMoments
        Possibly of no series.
    freedom : float
        Degrees of freedom of a flat frame's pixels.
    exact : bool
        The Poisson sum, eq. (2), rather than the censored normal law, eq. (3).
    try_spread : bool
        Whether to look for pixels that differ in dark current, which takes five times as long.

    Returns
    -------
    NoiseFit
        In the parameters of the Gaussian fit; the covariance is the inverse of the summed products of the scores.

    Raises
    ------
    PoorFit
        The steps do not settle.
    """
    even = _maximise(_Objective(counts, start, flats, freedom, exact=exact, spread=False), start)
    if not try_spread:
        return _as_fit(even)
    spread = _Objective(counts, start, flats, freedom, exact=exact, spread=True)
    tried = {dcnu: spread(np.array([*even.x[:_DCNU], dcnu, *even.x[_DCNU + 1 :]]))[0] for dcnu in _TRIED_DCNU}
    likeliest = max(tried, key=tried.__getitem__)
    if tried[likeliest] < even.log_likelihood + _CONVINCING:
        return _as_fit(even)
    begin = dict(zip(PARAMETERS, even.x.tolist(), strict=True)) | {"dcnu": likeliest}
    return _as_fit(_maximise(spread, begin))


class _Objective:
    """The log-likelihood of darks and flats together, with gradient and information."""

    def __init__(
        self,
        counts: Counts,
        start: dict[str, float],
        flats: FlatMoments,
        freedom: float,
        *,
        exact: bool,
        spread: bool,
    ) -> None:
        self.marginal = _Marginal(counts, start, exact=exact, spread=spread)
        self.flats = flats
        self.freedom = freedom
        self.free = np.array([spread or i != _DCNU for i in range(len(PARAMETERS))])

    def __call__(self, x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        dark, flat = self.marginal.evaluate(x), _flat_part(x, self.flats, self.freedom)
        return dark[0] + flat[0], dark[1] + flat[1], dark[2] + flat[2]


@dataclass(frozen=True)
class _Maximum:
    """Where the likelihood is highest, in the order of `PARAMETERS`."""

    x: NDArray[np.float64]
    covariance: NDArray[np.float64]
    log_likelihood: float


def _maximise(objective: _Objective, start: dict[str, float]) -> _Maximum:
    """Climb by scoring steps, halved where they overshoot."""
    free = objective.free
    x = np.array([start[name] for name in PARAMETERS])
    x[~free] = 0.0
    best = objective(x)
    for _ in range(_MAX_STEPS):
        step = np.zeros_like(x)
        step[free] = np.linalg.lstsq(best[2][np.ix_(free, free)], best[1][free])[0]
        step *= min(1.0, 1.0 / max(float(np.abs(step).max()), 1e-12))
        if best[1] @ step < 1e-3:
            covariance = np.zeros_like(best[2])
            covariance[np.ix_(free, free)] = np.linalg.pinv(best[2][np.ix_(free, free)])
            return _Maximum(x, covariance, best[0])
        length = 1.0
        while (tried := objective(x + length * step))[0] < best[0] and length > 1e-4:
            length /= 2
        x, best = x + length * step, tried
    raise PoorFit(
        f"the likelihood of the dark values did not settle in {_MAX_STEPS} steps; check that the darks were taken "
        "with the lens covered, or record flats, which fix the gain"
    )


def _as_fit(maximum: _Maximum) -> NoiseFit:
    """Return the result in the parameters of the Gaussian fit, from those in `PARAMETERS`."""
    log_gain, log_read_e, log_dark, dcnu, offset, log_dsnu = maximum.x
    slope, dsnu2 = np.exp(log_gain + log_dark), np.exp(2 * log_dsnu)
    spread2 = (dcnu * slope) ** 2
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
    values = {
        "offset_dn": offset,
        "log_read_dn2": 2 * (log_gain + log_read_e),
        "dsnu_dn2": dsnu2,
        "dark_signal_dn_per_s": slope,
        "dcnu_dn2_per_s2": spread2,
        "log_gain": log_gain,
    }
    covariance = jacobian @ maximum.covariance @ jacobian.T
    return NoiseFit({name: float(v) for name, v in values.items()}, covariance, maximum.log_likelihood)


def exact_likelihood(
    counts: Counts, values: dict[str, float], *, exact: bool, spread: bool
) -> tuple[float, NDArray[np.float64]]:
    """Return ln L of the darks, eq. (4), and the sum over pixels of the products of the scores, by `PARAMETERS`.

    At the truth, of frames enough, the latter is the Fisher information: the Cramér-Rao bound's inverse.
    """
    likelihood, _, products = _Marginal(counts, values, exact=exact, spread=spread).evaluate(
        np.array([values[name] for name in PARAMETERS])
    )
    return likelihood, products


class _Marginal:
    """Equation (4) over all pixels: counts as a sparse matrix, masses as a dense one."""

    def __init__(self, counts: Counts, start: dict[str, float], *, exact: bool, spread: bool) -> None:
        gain, read = np.exp(start["log_gain"]), np.exp(start["log_read_e"])
        noise_dn = float(np.sqrt((gain * read) ** 2 + 1 / 12))
        frames = sum(len(values) for values in counts.values_dn)
        self.per_dn = int(np.ceil(1.4 * np.sqrt(frames) / noise_dn))
        self.log_weights = DARK_LOG_WEIGHTS if spread else np.zeros(1)
        self.anchor, half_width = self._anchors(counts, start, noise_dn)
        self.floor = counts.floor_dn
        self.offsets = np.arange(-half_width * self.per_dn, half_width * self.per_dn + 1) / self.per_dn
        self.rows: list[NDArray[np.int64]] = []
        columns, first = [], 0
        for values in counts.values_dn:
            relative = values - self.anchor
            self.rows.append(np.arange(relative.min(), relative.max() + 1))
            columns.append(relative - relative.min() + first)
            first += self.rows[-1].size
        self.counts = _count(columns, first)
        charge = np.exp(start["log_dark_e_per_s"]) * np.array(counts.exposure_s) * (1 + 3 * start["dcnu"])
        self.masses = [
            mass_function(self._grid(rows), t, 1.5 * most, exact=exact, spread=spread)
            for rows, t, most in zip(self.rows, counts.exposure_s, charge, strict=True)
        ]

    @staticmethod
    def _anchors(counts: Counts, start: dict[str, float], noise_dn: float) -> tuple[NDArray[np.int64], int]:
        """Return a whole number near each pixel's offset, and how far around it the offset can be.

        Measured from its anchor, one table of masses serves every pixel. A floor is at the same value for all, so
        with one they all share an anchor.
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

    def _grid(self, rows: NDArray[np.int64]) -> NDArray[np.float64]:
        """Return the grid of u = value − offset that holds every pair of them."""
        low, high = rows[0] - self.offsets[-1], rows[-1] - self.offsets[0]
        return np.asarray(low + np.arange(round((high - low) * self.per_dn) + 1) / self.per_dn)

    def evaluate(self, x: NDArray[np.float64]) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
        """Return ln L, its gradient, and the sum of the products of the scores."""
        tables = [mass(x[: len(MASS_PARAMETERS)]) for mass in self.masses]
        log_mass = np.vstack([self._by_offset(t, r) for t, r in zip(tables, self.rows, strict=True)])
        slopes = [
            np.vstack([self._by_offset(t, r, parameter) for t, r in zip(tables, self.rows, strict=True)])
            for parameter in range(len(MASS_PARAMETERS))
        ]
        total, gradient = 0.0, np.zeros(len(PARAMETERS))
        products = np.zeros((len(PARAMETERS), len(PARAMETERS)))
        for first in range(0, self.counts.shape[0], _CHUNK_PX):
            pixels = slice(first, first + _CHUNK_PX)
            log_likelihood, scores = self._scores(pixels, x, log_mass, slopes)
            total += log_likelihood
            gradient += scores.sum(0)
            products += scores.T @ scores
        return total, gradient, products

    def _by_offset(
        self, table: MassTable, rows: NDArray[np.int64], parameter: int | None = None
    ) -> NDArray[np.float64]:
        """Spread a table over u to one over (value, offset × node)."""
        mass, tail = table.log_mass, table.log_tail
        if parameter is not None:
            mass, tail = table.mass_slope[parameter], table.tail_slope[parameter]
        low = rows[0] - self.offsets[-1]
        index = np.rint((rows[:, None] - self.offsets - low) * self.per_dn).astype(np.int64)
        spread = mass[index]
        if self.floor is not None:
            at_floor = rows + self.anchor[0] == self.floor
            spread[at_floor] = tail[index[at_floor]]
        return np.asarray(spread.reshape(rows.size, -1))

    def _scores(
        self, pixels: slice, x: NDArray[np.float64], log_mass: NDArray[np.float64], slopes: list[NDArray[np.float64]]
    ) -> tuple[float, NDArray[np.float64]]:
        """Return Σ ln L_i and the scores (pixel, parameter) of some pixels."""
        counts = self.counts[pixels]
        nodes = self.log_weights.size
        spread_dn = np.exp(x[5])
        deviation = (self.anchor[pixels, None] + self.offsets - x[4]) / spread_dn
        log_prior = -0.5 * deviation**2 - np.log(np.sqrt(2 * np.pi) * spread_dn * self.per_dn)
        joint = counts @ log_mass
        joint += (log_prior[:, :, None] + self.log_weights).reshape(joint.shape)
        highest = joint.max(1, keepdims=True)
        np.exp(joint - highest, out=joint)
        evidence = joint.sum(1, keepdims=True)
        joint /= evidence
        scores = [np.einsum("iq,iq->i", joint, counts @ slope) for slope in slopes]
        by_offset = joint.reshape(-1, self.offsets.size, nodes).sum(2)
        scores.append((by_offset * deviation).sum(1) / spread_dn)
        scores.append((by_offset * (deviation**2 - 1)).sum(1))
        return float((np.log(evidence) + highest).sum()), np.stack(scores, 1)


def _count(columns: Sequence[NDArray[np.int64]], values: int) -> sparse.csr_array:
    """Return how often each pixel took each value of each series, (pixel, value)."""
    column = np.vstack(columns)
    pixel = np.broadcast_to(np.arange(column.shape[1]), column.shape)
    ones = np.ones(column.size)
    return sparse.coo_array((ones, (pixel.ravel(), column.ravel())), shape=(column.shape[1], values)).tocsr()


def _flat_part(
    x: NDArray[np.float64], flats: FlatMoments, freedom: float
) -> tuple[float, NDArray[np.float64], NDArray[np.float64]]:
    """Return the flats' ln L, gradient and Fisher information by `PARAMETERS`."""
    size = len(PARAMETERS)
    if not flats.frames.size:
        return 0.0, np.zeros(size), np.zeros((size, size))
    s = ca.SX.sym("s", size)
    log_likelihood, log_variances, half_freedom = flat_log_likelihood(
        {"log_gain": s[0], "log_read_dn2": 2 * (s[0] + s[1]), "offset_dn": s[4]}, flats, freedom
    )
    slopes = ca.jacobian(ca.vertcat(*log_variances), s)
    outputs = [log_likelihood, ca.gradient(log_likelihood, s), slopes]
    value, gradient, by_series = (np.array(part) for part in ca.Function("flats", [s], outputs)(x))
    return float(value[0, 0]), gradient.ravel(), (by_series.T * np.array(half_freedom)) @ by_series
