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

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy import stats

from faintfield.calib.noise.maps.seams import find_seams, mean_effect
from faintfield.calib.noise.series import Series, any_suspect, robust_sigma
from faintfield.calib.noise.strips import (
    Array,
    Map,
    Mask,
    map_of,
    maps_of,
    mean_over,
    over_strips,
    thinned,
    total_of,
    variance_over,
)

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
    """Posterior mean and standard deviation of the read noise of every pixel (row, column).

    The latter is without the error that all pixels share. If the pixels are not `resolved`, they do not differ, and
    `se_dn` is the difference that would have gone unnoticed.
    """

    read_noise_dn: Map
    se_dn: Map
    resolved: bool


def measure_read_noise(
    darks: Sequence[Series], read_dn2: float, noise_dn2: Sequence[float], usable: Mask
) -> PixelReadNoise:
    """Return the posterior read noise of every pixel.

    Parameters
    ----------
    darks, noise_dn2 : sequence (series,)
        Dark series, one of them with two frames at least, and v_j of the fit, read noise included.
    read_dn2 : float
        Read variance of the sensor, by the fit.
    usable : array (row, column), bool
        Pixels of the population.
    """
    shape = darks[0].within_dn2.shape
    freedom = np.array([series.frames - 1.0 for series in darks])
    even = np.broadcast_to((1 - 1 / shape[0]) * (1 - 1 / shape[1]), shape)
    shot_dn2 = np.maximum(np.asarray(noise_dn2) - read_dn2, 0.0)
    first = _measure(darks, read_dn2, shot_dn2, even, usable)
    if not first.resolved:
        return first
    # Now that the pixels' noise is known, so is what the means of rows and columns took from it and brought to it.
    shot, regular = float(freedom @ shot_dn2 / freedom.sum()), ~any_suspect(darks)

    def total(rows: slice) -> Array:
        return np.asarray(np.square(first.read_noise_dn[rows], dtype=np.float64) + shot)

    of_strip = kept_of(total, regular)
    kept = map_of(lambda rows: (variance := total(rows), of_strip(rows, variance) / variance)[1], shape)
    return _measure(darks, read_dn2, shot_dn2, kept, usable)


def kept_of(variance_of: Callable[[slice], Array], regular: Mask) -> Callable[[slice, Array], Array]:
    """Return a function of some rows and the variances of their pixels: what subtracted means of lines leave of these.

    `variance_of` returns the variances of some rows, and the means of rows and columns are those of `regular` pixels.
    """
    sums = total_of(lambda rows: variance_of(rows).sum(0, where=regular[rows]), regular.shape)
    per_column, per_row = (np.maximum(regular.sum(axis), 1) for axis in (0, 1))

    def kept(rows: slice, variance: Array) -> Array:
        counts = regular[rows]
        variance = np.where(counts, 1 - 2 / per_column, 1.0) * variance + sums / per_column**2
        in_row, row_sums = per_row[rows, None], variance.sum(1, keepdims=True, where=counts)
        return np.asarray(np.where(counts, 1 - 2 / in_row, 1.0) * variance + row_sums / in_row**2)

    return kept


@dataclass(frozen=True)
class _LineFactor:
    """A factor on the variance of each pixel: a function of the sum of a number of its row and one of its column."""

    of_rows: Array
    of_columns: Array
    function: Callable[[Array], Array]

    def at(self, rows: slice | NDArray[np.intp], columns: slice | NDArray[np.intp] = slice(None)) -> Array:
        """Return the factors of some rows (row, column), or of single pixels."""
        of_rows = self.of_rows[rows]
        return self.function((of_rows[:, None] if isinstance(rows, slice) else of_rows) + self.of_columns[columns])

    @property
    def varies(self) -> bool:
        return bool(np.ptp(self.of_rows) > 0 or np.ptp(self.of_columns) > 0)


@dataclass(frozen=True)
class _Squares:
    """Sums of squares of the pixels over the dark series.

    Each pixel shows the share `kept` (row, column) of its variance. Series of equal shot noise are one group, by its
    place in `which` (series,), with its variance beside read noise and its degrees of freedom (group,).
    """

    darks: Sequence[Series]
    kept: Map
    which: NDArray[np.intp]
    shot_dn2: Array
    freedom: Array

    def at(self, *where: slice | NDArray[np.intp]) -> Array:
        """Return the squares (…, group) of some rows, or of single pixels."""
        kept = self.kept[where]
        squares = np.zeros((*kept.shape, self.freedom.size))
        for series, index in zip(self.darks, self.which, strict=True):
            squares[..., index] += series.within_dn2[where] / kept
        return squares

    def ratio(self, rows: slice, read_dn2: float) -> Array:
        """Return the variance of the pixels of some rows over the expected one."""
        return np.asarray(self.at(rows) @ (1 / (read_dn2 + self.shot_dn2)) / self.freedom.sum())


def _measure(darks: Sequence[Series], read_dn2: float, shot_dn2: Array, kept: Map, usable: Mask) -> PixelReadNoise:
    shot_dn2, which = np.unique(shot_dn2, return_inverse=True)
    freedom = np.bincount(which, [series.frames - 1.0 for series in darks])
    squares = _Squares(darks, kept, which, shot_dn2, freedom)
    degrees = float(freedom.sum())
    ratio = map_of(lambda rows: squares.ratio(rows, read_dn2), kept.shape)
    chance = 2 / degrees
    region = _region_factors(ratio, usable, 1 / chance)
    shot = float(freedom @ shot_dn2) / degrees
    limit = chance * np.sqrt((2 + 12 / degrees) / usable.sum()) * stats.norm.isf(_MAX_CHANCE)
    if variance_over(lambda rows: ratio[rows] / region.at(rows), usable) - chance < limit:
        common = map_of(lambda rows: _scaled(np.sqrt(read_dn2), region.at(rows), shot, read_dn2), kept.shape)
        se_dn = map_of(lambda rows: common[rows] * 0.5 * np.sqrt(limit), kept.shape)
        return PixelReadNoise(common, se_dn, resolved=region.varies)
    log_ratio = map_of(lambda rows: np.log(np.maximum(ratio[rows], 1e-9)), kept.shape)
    lines = _LineFactor(*_line_shifts(log_ratio, usable), np.exp)
    # A spot of noisier pixels shifts its rows, columns and regions, too; a number for each must explain more than it
    # may by chance (Akaike, IEEE Transactions on Automatic Control 19, 716, 1974).
    even = _LineFactor(np.zeros(kept.shape[0]), np.zeros(kept.shape[1]), np.exp)
    ways = [(even, 0), *((way, n) for way, n in ((region, _MAX_REGIONS), (lines, sum(kept.shape))) if way.varies)]
    fits = [_population(squares, ratio, factor, read_dn2, usable) for factor, _ in ways]
    best = int(np.argmax([fit.log_likelihood - number for fit, (_, number) in zip(fits, ways, strict=True)]))
    factor, posterior = ways[best][0], _posterior(fits[best], shot_dn2, freedom)

    def work(rows: slice) -> tuple[Array, Array]:
        factors = factor.at(rows)
        mean, variance = posterior(squares.at(rows) / factors[..., None])
        read = _scaled(mean, factors, shot, read_dn2)
        return read, np.sqrt(variance) * mean * factors / read

    read_dn, se_dn = maps_of(work, kept.shape, (np.float32, np.float32))
    return PixelReadNoise(read_dn, se_dn, resolved=True)


def _scaled(read_dn: Array | float, factor: Array, shot_dn2: float, read_dn2: float) -> Array:
    """Return the read noise of pixels in lines or regions whose sum of read and shot noise differs by a factor."""
    return np.asarray(np.sqrt(np.maximum(read_dn**2 * factor + shot_dn2 * (factor - 1), 0.01 * read_dn2)))


def _region_factors(ratio: Map, usable: Mask, precision: float) -> _LineFactor:
    """Return by which factor the variances of regions differ that are read apart.

    Nothing shrinks them, and no gradient, which doubles the error of a step, is fitted beside them: photon transfer
    would take either for gain.
    """
    differs = {"rows": np.zeros(ratio.shape[0]), "columns": np.zeros(ratio.shape[1])}
    mean = mean_over(lambda rows: ratio[rows], usable)
    for seam in find_seams(ratio, usable, precision):
        differs[seam.lines] = mean_effect(seam, ratio, usable) / mean
    return _LineFactor(differs["rows"], differs["columns"], lambda effect: np.maximum(1 + effect, 0.05))


def _line_shifts(values: Map, usable: Mask) -> tuple[Array, Array]:
    """Return by how much whole rows and columns of values with independent errors differ, shrunk by chance."""
    some = thinned(values, usable)
    centre, limit = float(np.median(some)), _CLIP_SIGMA * robust_sigma(some)
    shifts = [np.zeros(size) for size in values.shape]

    def rest(rows: slice) -> Array:
        clipped = np.clip(np.subtract(values[rows], centre, dtype=np.float64), -limit, limit)
        return np.asarray(clipped - shifts[0][rows, None] - shifts[1])

    for axis in (0, 1):
        count = usable.sum(axis)
        sums = over_strips(lambda rows, axis=axis: rest(rows).sum(axis, where=usable[rows]), values.shape)  # type: ignore[misc]
        total = np.sum(sums, axis=0) if axis == 0 else np.concatenate(sums)
        means = total / np.maximum(count, 1)
        means -= means.mean(where=count > 0)

        def left(rows: slice, axis: int = axis, means: Array = means) -> Array:
            return rest(rows) - (means if axis == 0 else means[rows, None])

        within = variance_over(left, usable)
        chance = within / np.maximum(count, 1)
        lines = int((count > 0).sum())
        deviance = float(np.sum(means**2 / chance, where=count > 0)) if within > 0 else 0.0
        if lines > 1 and stats.chi2.sf(deviance, lines - 1) < _MAX_CHANCE:
            spread = max(float(means.var(where=count > 0) - chance.mean(where=count > 0)), 0.0)
            shifts[1 - axis] = means * spread / (spread + chance)
    return shifts[0], shifts[1]


def _bins(squares: _Squares, ratio: Map, factor: _LineFactor, usable: Mask) -> tuple[Array, Array, float]:
    """Return mean squares (bin, group) and number (bin,) of pixels that tell the population, and the sum of ln factor.

    Pixels of one variance tell the same if all frames are alike. If not, each is a bin of its own, and fewer do.
    """
    if squares.freedom.size > 1:
        row, column = _every_nth(usable, -(-int(usable.sum()) // _SAMPLE_PX))
        factors = factor.at(row, column)
        return squares.at(row, column) / factors[:, None], np.ones(row.size), float(np.log(factors).sum())
    first, last = (int(np.rint(np.log(end) / _BIN)) for end in (1e-9, 1e9))

    def work(rows: slice) -> tuple[Array, Array, float]:
        used, factors = usable[rows], factor.at(rows)
        log = np.log(np.clip(ratio[rows] / factors, 1e-9, 1e9))[used]
        member = np.rint(log / _BIN).astype(np.int64) - first
        counts = np.bincount(member, minlength=last - first + 1)
        sums = np.bincount(member, squares.at(rows)[..., 0][used] / factors[used], minlength=counts.size)
        return counts.astype(np.float64), sums, float(np.log(factors[used]).sum())

    counts, sums, logs = (sum(parts) for parts in zip(*over_strips(work, usable.shape), strict=True))
    full = counts > 0
    return (sums[full] / counts[full])[:, None], counts[full], logs


def _every_nth(usable: Mask, step: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    before = np.concatenate([[0], np.cumsum(usable.sum(1))])

    def work(rows: slice) -> NDArray[np.intp]:
        row, column = np.nonzero(usable[rows])
        first = -int(before[rows.start]) % step
        return np.stack([rows.start + row[first::step], column[first::step]])

    row, column = np.concatenate(over_strips(work, usable.shape), axis=1)
    return row, column


@dataclass(frozen=True)
class _Population:
    """Grid of ln r and population g on it, both (step,), and ln L of the pixels from which it was learnt."""

    grid: Array
    share: Array
    log_likelihood: float


def _population(squares: _Squares, ratio: Map, factor: _LineFactor, read_dn2: float, usable: Mask) -> _Population:
    degrees = float(squares.freedom.sum())
    some = thinned(ratio, usable, factor.at)

    def highest(rows: slice) -> float:
        return float((ratio[rows] / factor.at(rows)).max(where=usable[rows], initial=0.0))

    # The grid is half as wide as chance scatters ln r, and reaches as far as ratios do. Where shot noise is most of the
    # noise, read noise may be anything down to nothing.
    blur, ends = np.sqrt(2 / degrees), [float(np.quantile(some, 0.002)), max(over_strips(highest, usable.shape))]
    first, last = np.log(np.clip(ends, 1e-3, 1e4)) + np.array([-1, 1]) * blur
    steps = int(np.clip(np.ceil((last - first + 1.0) / max(0.5 * blur, 0.02)), 32, 300))
    grid = np.asarray(np.log(read_dn2) + np.linspace(first - 1.0, last, steps))
    binned, count, log_factors = _bins(squares, ratio, factor, usable)
    variance = np.exp(grid) + squares.shot_dn2[:, None]
    log = binned @ (-0.5 / variance)
    log -= 0.5 * squares.freedom @ np.log(variance)
    peak = log.max(axis=1)
    likelihood = np.exp(log - peak[:, None])
    spread2 = robust_sigma(np.log(np.maximum(some, 1e-9))) ** 2 - 2 / degrees
    middle = grid[np.argmax(count @ likelihood)]
    share = np.exp(-0.5 * (grid - middle) ** 2 / max(spread2, 0.2 / degrees))
    share = (1 - _TAIL) * share / share.sum() + _TAIL / grid.size
    for _ in range(_EM_STEPS):
        share = share * ((count / (likelihood @ share)) @ likelihood) / count.sum()
    total = float(count @ (np.log(likelihood @ share) + peak)) - 0.5 * degrees * log_factors
    return _Population(grid, share, total)


def _posterior(population: _Population, shot_dn2: Array, freedom: Array) -> Callable[[Array], tuple[Array, Array]]:
    """Return a function from squares (row, column, group) to mean and variance of the read noise, (row, column)."""
    grid = population.grid
    sigma = np.exp(0.5 * grid)
    variances = np.exp(grid) + shot_dn2[:, None]
    # About the likeliest step little is lost in single precision, which is fast
    centre = int(population.share.argmax())
    slope, constant = -0.5 / variances, np.log(np.maximum(population.share, 1e-300)) - 0.5 * freedom @ np.log(variances)
    slope, constant = (term - term[..., centre, None] for term in (slope, constant))
    middle = float(population.share @ sigma)
    moments = np.power.outer(sigma - middle, np.arange(3)).astype(np.float32)
    finest = (0.5 * (grid[1] - grid[0])) ** 2 / 12  # of the mean squared: no finer than the grid tells
    terms = np.concatenate([slope, constant[None]]).astype(np.float32)

    def posterior(squares: Array) -> tuple[Array, Array]:
        flat = np.ones((squares.shape[0] * squares.shape[1], freedom.size + 1), np.float32)
        flat[:, :-1] = squares.reshape(-1, freedom.size)
        sums = np.empty((len(flat), 3))
        for start in range(0, len(flat), _CHUNK_PX):
            log = flat[start : start + _CHUNK_PX] @ terms
            log -= log.max(axis=1, keepdims=True)
            sums[start : start + _CHUNK_PX] = np.exp(log, out=log) @ moments
        total, first, second = sums.T.reshape(3, *squares.shape[:2])
        from_middle = first / total
        mean = middle + from_middle
        return mean, np.maximum(second / total - from_middle**2, finest * mean**2)

    return posterior
