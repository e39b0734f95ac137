"""The marginal likelihood of single values: masses integrated over each pixel's unknown offset and dark current.

Every pixel keeps the count of each value in each dark series. Its likelihood is the product of the masses
(`calib.noise.mass`), integrated on a grid over its unknown offset o ~ N(μ, s²) and at Gauss-Hermite nodes over its dark
current:

    L_i = Σ_q N(o_q; μ, s²) Σ_d w_d Π_jk P_j(y_ijk | o_q, D_d)                                          (4)

The scores s_i = ∇ ln L_i are posterior means (Fisher's identity).
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import sparse

from faintfield.calib.noise.mass import DARK_LOG_WEIGHTS, MASS_PARAMETERS, mass_function

type Array = NDArray[np.float64]

PARAMETERS = (*MASS_PARAMETERS, "offset_dn", "log_dsnu_dn")

# Pixels whose posteriors are in memory at a time.
_CHUNK_PX = 2048


@dataclass(frozen=True)
class Counts:
    """Values of the pixels in use.

    Attributes
    ----------
    exposure_s : tuple of float
        Exposure of each dark series.
    values_dn : tuple of arrays (frame, pixel), int
        Values of each series, for the same pixels in each.
    floor_dn : int, optional
        Black level at which values are cut off; None if none is.
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
        self.spread = spread
        self._per_dn = int(np.ceil(1.4 * np.sqrt(frames) / noise_dn))
        self._log_weights = DARK_LOG_WEIGHTS if spread else np.zeros(1)
        self._anchor, half_width = _anchors(counts, start, noise_dn)
        self._floor_dn = counts.floor_dn
        self._offsets = np.arange(-half_width * self._per_dn, half_width * self._per_dn + 1) / self._per_dn
        relative = [values - self._anchor for values in counts.values_dn]
        self._values = [np.arange(one.min(), one.max() + 1) for one in relative]
        self._counts = _count([one - one.min() for one in relative], [one.size for one in self._values])
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
        log_mass = self._by_offset([(table.log_mass, table.log_tail) for table in tables])
        slopes = [
            self._by_offset([(table.mass_slope[parameter], table.tail_slope[parameter]) for table in tables])
            for parameter in range(len(MASS_PARAMETERS))
        ]
        total, gradient = 0.0, np.zeros(len(PARAMETERS))
        products = np.zeros((len(PARAMETERS), len(PARAMETERS)))
        for first in range(0, self._counts.shape[0], _CHUNK_PX):
            log_likelihood, scores = self._scores(slice(first, first + _CHUNK_PX), x, log_mass, slopes)
            total += log_likelihood
            gradient += scores.sum(0)
            products += scores.T @ scores
        return total, gradient, products

    def _by_offset(self, tables: Sequence[tuple[Array, Array]]) -> Array:
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
