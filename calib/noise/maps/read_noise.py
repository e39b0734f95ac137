"""The read noise of every pixel: what its own frames say, shrunk by the population of all pixels.

The squares of pixel i within dark series j follow `W_ij ~ (r_i + s_j) χ²` with n_j − 1 degrees of freedom, the read
variance r_i and a known s_j: shot noise of the dark current, and rounding. Chance alone scatters the variance of 40
frames by 23 %, more than the pixels of many sensors differ. How much they do, the histogram of all pixels tells: it is
the population g(ln r), blurred by chance. EM steps on a grid of ln r undo the blur (Laird, JASA 73, 805, 1978),

    g_k ← mean over i of g_k L_ik / Σ_l g_l L_il,      L_ik = Π_j p(W_ij | exp(x_k) + s_j)

and the posterior of each pixel is g_k L_ik (empirical Bayes: Efron, Statistical Science 29, 285, 2014). g begins as a
log-normal law with 1 % of wide tails, and may become whatever the pixels show: a tail, two regions, telegraph pixels.
Rows and columns may be noisier as a whole (columns have amplifiers of their own); that part is taken out first.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.maps.seams import find_seams
from faintfield.calib.noise.series.statistics import Series, robust_sigma
from faintfield.calib.noise.strips import over_strips

type Array = NDArray[np.float64]

# Pixels differ, and so do rows and columns, if chance makes as much scatter with less probability than this.
_MAX_CHANCE = 1e-3

# Share of the population's first guess in wide tails.
_TAIL = 0.01

# Pixels whose variances differ by less than this share a bin while the population is learnt, by so many EM steps.
_BIN, _EM_STEPS = 0.01, 200

# Pixels without bins from which the population is learnt, and pixels that are worked on at once, within the cache.
_SAMPLE_PX, _CHUNK_PX = 6000, 1 << 10

# Most numbers that regions of rows and of columns may take.
_MAX_REGIONS = 6

# Robust standard deviations beyond which a pixel says no more about its row or column.
_CLIP_SIGMA = 3.0


@dataclass(frozen=True)
class PixelReadNoise:
    """Read noise of every pixel, arrays (row, column).

    Attributes
    ----------
    read_noise_dn, se_dn : array
        Posterior mean and standard deviation; without the error that all pixels share (see `read_noise_dn` of the fit).
    resolved : bool
        Whether the pixels differ. If not, `se_dn` is the difference that would have gone unnoticed.
    """

    read_noise_dn: Array
    se_dn: Array
    resolved: bool


def measure_read_noise(
    darks: Sequence[Series], read_dn2: float, noise_dn2: Sequence[float], usable: NDArray[np.bool_]
) -> PixelReadNoise:
    """Return the posterior read noise of every pixel.

    Parameters
    ----------
    darks : sequence of Series
        Dark series, one of them with two frames at least.
    read_dn2 : float
        Read variance of the sensor, by the fit.
    noise_dn2 : sequence of float
        v_j of the fit, read noise included.
    usable : array (row, column), bool
        Pixels of the population.
    """
    shape = darks[0].within_dn2.shape
    freedom = np.array([series.frames - 1.0 for series in darks])
    kept = np.full(shape, (1 - 1 / shape[0]) * (1 - 1 / shape[1]))
    shot_dn2 = np.maximum(np.asarray(noise_dn2) - read_dn2, 0.0)
    suspect = np.any([series.suspect for series in darks], axis=0)
    found = _measure(darks, read_dn2, shot_dn2, kept, usable)
    if not found.resolved:
        return found
    # Now that the pixels' noise is known, so is what the means of rows and columns took from it and brought to it.
    total = found.read_noise_dn**2 + freedom @ shot_dn2 / freedom.sum()
    return _measure(darks, read_dn2, shot_dn2, kept_variance(total, ~suspect) / total, usable)


def kept_variance(variance: Array, regular: NDArray[np.bool_]) -> Array:
    """Return the variances (row, column) of pixels once the means of rows and columns are subtracted.

    Parameters
    ----------
    variance : array (row, column)
        Variance of each pixel, whose noise is its own.
    regular : array (row, column), bool
        Pixels of which the means are taken.
    """
    for axis in (0, 1):
        count = np.maximum(regular.sum(axis, keepdims=True), 1)
        share = np.where(regular, 1 - 2 / count, 1.0)
        variance = share * variance + variance.sum(axis, keepdims=True, where=regular) / count**2
    return variance


def _measure(
    darks: Sequence[Series], read_dn2: float, shot_dn2: Array, kept: Array, usable: NDArray[np.bool_]
) -> PixelReadNoise:
    """Return the posterior if `kept` is the share of its variance that each pixel shows, (row, column)."""
    # Series of equal noise are one
    shot_dn2, which = np.unique(shot_dn2, return_inverse=True)
    freedom = np.bincount(which, [series.frames - 1.0 for series in darks])
    degrees = float(freedom.sum())
    squares = np.zeros((*kept.shape, freedom.size))
    for series, index in zip(darks, which, strict=True):
        squares[..., index] += series.within_dn2 / kept
    ratio = (squares / (read_dn2 + shot_dn2)).sum(-1) / degrees
    chance = 2 / degrees
    region = _region_factors(ratio, usable / chance)
    shot = float(freedom @ shot_dn2) / degrees
    limit = chance * np.sqrt((2 + 12 / degrees) / usable.sum()) * stats.norm.isf(_MAX_CHANCE)
    if (ratio / region).var(where=usable) - chance < limit:
        common = _scaled(np.full(kept.shape, np.sqrt(read_dn2)), region, shot, read_dn2)
        return PixelReadNoise(common, common * 0.5 * np.sqrt(limit), resolved=bool(np.ptp(region) > 0))
    lines = np.exp(line_shifts(np.log(np.maximum(ratio, 1e-9)), usable))
    # A spot of noisier pixels shifts its rows, columns and regions, too; a number for each must explain more than it
    # may by chance (Akaike, IEEE Transactions on Automatic Control 19, 716, 1974).
    ways = [(np.ones(kept.shape), 0)]
    ways += [(it, number) for it, number in ((region, _MAX_REGIONS), (lines, sum(kept.shape))) if np.ptp(it) > 0]
    fits = [_population(squares, ratio, factor, read_dn2, shot_dn2, freedom, usable) for factor, _ in ways]
    best = int(np.argmax([fit.log_likelihood - number for fit, (_, number) in zip(fits, ways, strict=True)]))
    factor = ways[best][0]
    mean, variance = _posterior(squares, factor, fits[best], shot_dn2, freedom)
    read = _scaled(mean, factor, shot, read_dn2)
    return PixelReadNoise(read, np.sqrt(variance) * mean * factor / read, resolved=True)


def _scaled(read_dn: Array, factor: Array, shot_dn2: float, read_dn2: float) -> Array:
    """Return the read noise of pixels in rows, columns or regions whose noise as a whole differs by a factor.

    Where a row is noisier, the factor holds for the sum of read and shot noise.
    """
    return np.asarray(np.sqrt(np.maximum(read_dn**2 * factor + shot_dn2 * (factor - 1), 0.01 * read_dn2)))


def _region_factors(ratio: Array, weight: Array) -> Array:
    """Return by which factor the variances of regions differ that are read apart, (row, column).

    Nothing shrinks them. The population would draw the noise of a region towards that of all pixels if a pixel has few
    frames, and photon transfer would take what it drew away for gain.
    """
    differs = np.zeros(ratio.shape)
    for seam in find_seams(ratio, weight):
        differs = differs + seam.map
    return np.maximum(1 + differs / np.average(ratio, weights=weight), 0.05)


def line_shifts(values: Array, usable: NDArray[np.bool_]) -> Array:
    """Return by how much whole rows and columns differ from the rest, (row, column), shrunk by what chance makes.

    Parameters
    ----------
    values : array (row, column)
        A value per pixel with independent errors.
    usable : array (row, column), bool
        Pixels that count.
    """
    centre = np.median(values[usable])
    rest = np.clip(values - centre, *(np.array([-1, 1]) * _CLIP_SIGMA * robust_sigma(values[usable])))
    shifts = np.zeros_like(values)
    for axis in (0, 1):
        count = usable.sum(axis, keepdims=True)
        means = rest.sum(axis, keepdims=True, where=usable) / np.maximum(count, 1)
        means -= means.mean(where=count > 0)
        within = float(np.var(rest - means, where=usable))
        chance = within / np.maximum(count, 1)
        lines = int((count > 0).sum())
        deviance = float(np.sum(means**2 / chance, where=count > 0)) if within > 0 else 0.0
        if lines > 1 and stats.chi2.sf(deviance, lines - 1) < _MAX_CHANCE:
            spread = max(float(means.var(where=count > 0) - chance.mean(where=count > 0)), 0.0)
            means *= spread / (spread + chance)
            shifts += means
            rest -= means
    return shifts


def _grid(ratio: Array, read_dn2: float, degrees: float, usable: NDArray[np.bool_]) -> Array:
    """Return the grid of ln r (step,): half as wide as chance scatters it, and as far as the pixels reach."""
    blur = np.sqrt(2 / degrees)
    low, high = np.log(np.quantile(ratio[usable], (0.002, 1.0)).clip(1e-3, 1e4)) + np.array([-1, 1]) * blur
    # Where shot noise is most of the noise, read noise may be anything down to nothing.
    steps = int(np.clip(np.ceil((high - low + 1.0) / max(0.5 * blur, 0.02)), 32, 300))
    return np.asarray(np.log(read_dn2) + np.linspace(low - 1.0, high, steps))


def _log_likelihood(squares: Array, grid: Array, shot_dn2: Array, freedom: Array) -> Array:
    """Return ln L (pixel, step) up to a constant, from squares (pixel, series)."""
    variance = np.exp(grid) + shot_dn2[:, None]
    log = squares @ (-0.5 / variance)
    log -= 0.5 * freedom @ np.log(variance)
    return np.asarray(log)


def _bins(ratio: Array, usable: NDArray[np.bool_], *, exact: bool) -> tuple[slice, NDArray[np.intp], Array]:
    """Return which usable pixels tell the population, the bin of each, and the number of pixels in each bin.

    Pixels of one variance tell the same if all frames are alike. If not, each is a bin of its own, and fewer do.
    """
    if not exact:
        pixel = slice(None, None, -(-int(usable.sum()) // _SAMPLE_PX))
        each = np.arange(int(usable.sum()))[pixel]
        return pixel, np.arange(each.size), np.ones(each.size)
    log = np.log(np.maximum(ratio[usable], 1e-9))
    _, member, counts = np.unique(np.round(log / _BIN), return_inverse=True, return_counts=True)
    return slice(None), member, counts.astype(float)


@dataclass(frozen=True)
class _Population:
    """Grid of ln r and population g on it, both (step,), and ln L of the pixels from which it was learnt."""

    grid: Array
    share: Array
    log_likelihood: float


def _population(
    squares: Array,
    ratio: Array,
    factor: Array,
    read_dn2: float,
    shot_dn2: Array,
    freedom: Array,
    usable: NDArray[np.bool_],
) -> _Population:
    """Return the population of squares (row, column, series) over `factor`."""
    degrees = float(freedom.sum())
    ratio = ratio / factor
    grid = _grid(ratio, read_dn2, degrees, usable)
    pixel, member, count = _bins(ratio, usable, exact=freedom.size == 1)
    chosen = np.flatnonzero(usable)[pixel]
    chosen_factor = factor.ravel()[chosen]
    scaled = squares.reshape(-1, freedom.size)[chosen] / chosen_factor[:, None]
    sums = [np.bincount(member, weights) for weights in scaled.T]
    log = _log_likelihood(np.stack(sums, axis=1) / count[:, None], grid, shot_dn2, freedom)
    peak = log.max(axis=1)
    likelihood = np.exp(log - peak[:, None])
    spread2 = robust_sigma(np.log(np.maximum(ratio[usable], 1e-9))) ** 2 - 2 / degrees
    middle = grid[np.argmax(count @ likelihood)]
    share = np.exp(-0.5 * (grid - middle) ** 2 / max(spread2, 0.2 / degrees))
    share = (1 - _TAIL) * share / share.sum() + _TAIL / grid.size
    for _ in range(_EM_STEPS):
        share = share * ((count / (likelihood @ share)) @ likelihood) / count.sum()
    total = float(count @ (np.log(likelihood @ share) + peak)) - 0.5 * degrees * float(np.log(chosen_factor).sum())
    return _Population(grid, share, total)


def _posterior(
    squares: Array, factor: Array, population: _Population, shot_dn2: Array, freedom: Array
) -> tuple[Array, Array]:
    """Return mean and variance of each pixel's read noise, (row, column), from squares (row, column, series)."""
    grid = population.grid
    sigma = np.exp(0.5 * grid)
    log_share = np.log(np.maximum(population.share, 1e-300))
    middle = float(population.share @ sigma)  # about which little is lost in single precision
    moments = np.power.outer(sigma - middle, np.arange(3)).astype(np.float32)
    finest = (0.5 * (grid[1] - grid[0])) ** 2 / 12  # of the mean squared: no finer than the grid tells
    mean, variance = np.empty(squares.shape[:2]), np.empty(squares.shape[:2])

    def work(rows: slice) -> None:
        flat = (squares[rows] / factor[rows, :, None]).reshape(-1, freedom.size)
        sums = np.empty((len(flat), 3))
        for start in range(0, len(flat), _CHUNK_PX):
            log = _log_likelihood(flat[start : start + _CHUNK_PX], grid, shot_dn2, freedom)
            log += log_share
            log -= log.max(axis=1, keepdims=True)
            sums[start : start + _CHUNK_PX] = np.exp(log.astype(np.float32)) @ moments  # fast in single precision
        total, first, second = sums.T.reshape(3, *mean[rows].shape)
        from_middle = first / total
        mean[rows] = middle + from_middle
        variance[rows] = np.maximum(second / total - from_middle**2, finest * mean[rows] ** 2)

    over_strips(work, mean.shape)
    return mean, variance
