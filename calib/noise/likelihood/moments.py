# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Reduce series to the sufficient statistics of the Gaussian likelihood.

Under Gaussian noise the likelihood depends on nothing else. With R rows, C columns and P pixels in use, removing
levels and profiles takes R + C − 1 of the P degrees of freedom. Of the rest,

- the sum of squares within pixels, W_j, is v_j χ² with (n_j − 1)(P − R − C + 1) degrees of freedom,
- the J × J scatter of the pixel means of the dark series is Wishart with P − R − C + 1,
- the mean of each dark series and the scatter of its frames' levels determine the dark signal and the frame jitter.

Sums over blocks, rows and columns of pixels, from one pass, show how far the noise of a series scatters.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields

import numpy as np

from faintfield.calib.noise.likelihood.response import Light, known_light
from faintfield.calib.noise.likelihood.rounding import dark_roundings, flat_rounding
from faintfield.calib.noise.series import Series
from faintfield.calib.noise.strips import Array, Mask, compiled, mean_over, over_strips, total_of

# Blocks of pixels along each side of a frame.
BLOCKS = 8

# Means between which the noise that is expected of the pixels of a flat is interpolated, and parts of a frame that are
# summed apart, whatever the number of cores, so that sums do not depend on it.
_NODES, _PARTS = 64, 4


@dataclass(frozen=True)
class SeriesNoise:
    """Sums of the noise of a series over groups of pixels in use.

    Attributes
    ----------
    share : float
        Degrees of freedom that rows and columns leave, over the number of pixels.
    nodes_dn : array (node,)
        Means for which the expected noise is to be stated; one of a dark, whose pixels share it.
    blocks, rows, columns : array (group, 2 + node)
        For each group its number of pixels, its sum of squares, and the weight of each node in the expected noise.
    """

    frames: int
    share: float
    nodes_dn: Array
    blocks: Array
    rows: Array
    columns: Array

    def scatter(self, groups: Array, variances_dn2: Array | float) -> tuple[Array, Array]:
        """Return the noise of groups over the expected one, and the degrees of freedom of each, both (group,).

        Parameters
        ----------
        groups : array (group, 2 + node)
            One of the three sums; groups with fewer than two pixels are left out.
        variances_dn2 : array (node,) or float
            Expected noise of pixels with the means `nodes_dn`.
        """
        count, measured, weights = groups[:, 0], groups[:, 1], groups[:, 2:]
        expected = weights @ np.broadcast_to(variances_dn2, weights.shape[1:])
        enough, freedom = count > 1, (self.frames - 1) * self.share
        return measured[enough] / (expected[enough] * freedom), count[enough] * freedom


@dataclass(frozen=True)
class SeriesMoments:
    """Statistics of several series over the P pixels in use, arrays (series,).

    Attributes
    ----------
    exposure_s, frames : array
        Exposure time t_j at the temperature of reference, and number of frames n_j.
    mean_dn : array
        Mean over frames and pixels.
    within_dn2 : array
        W_j, the squared deviations of pixels from their means, summed over frames and pixels, as if rounding had
        added 1/12 DN² to each value's variance.
    level_scatter_dn2 : array
        Squared deviations of the frames' mean levels from the series' level, summed over frames.
    rounding2 : array
        Square of the relative error of the noise that rounding may make; see `calib.noise.likelihood.rounding`.
    evenness : array
        ⟨s⟩²/⟨s²⟩ of the signal s of a flat over the pixels: the factor on the degrees of freedom where brighter pixels
        are noisier than others. 1 for darks.
    """

    exposure_s: Array
    frames: Array
    mean_dn: Array
    within_dn2: Array
    level_scatter_dn2: Array
    rounding2: Array
    evenness: Array

    def part(self, which: slice) -> "SeriesMoments":
        """Return the statistics of some of the series."""
        return SeriesMoments(*(getattr(self, item.name)[which] for item in fields(self)))


@dataclass(frozen=True)
class Excess:
    """Scatter that the model of the pixels does not explain; see `calib.noise.scatter`.

    Attributes
    ----------
    darks, flats : float
        Squared deviations of variances over blocks of pixels, over those of normal noise.
    variance2 : float
        Relative variance of a series' noise about the model.
    drift_dn2, light2 : float
        Variance of the level of a series of darks about the straight line; relative one of flats about the response.
    """

    darks: float = 1.0
    flats: float = 1.0
    variance2: float = 0.0
    drift_dn2: float = 0.0
    light2: float = 0.0


NO_EXCESS = Excess()


@dataclass(frozen=True)
class Moments:
    """Sufficient statistics of all series, darks first, from `pixels` pixels in use with `freedom` degrees of freedom.

    Attributes
    ----------
    scatter_dn2 : array (dark, dark)
        S, the products of the pixels' patterns in two series of darks, summed over pixels.
    light : Light
        Light of the flats, as far as it is known.
    range_dn, bend_se : float, tuple of float
        Signal at the end of the range, and the standard errors of the bends there before they are measured; the last
        one is that of all further bends.
    noise : tuple of SeriesNoise
        Sums of the noise of each series over groups of pixels.
    """

    pixels: float
    freedom: float
    series: SeriesMoments
    scatter_dn2: Array
    light: Light = field(default_factory=lambda: known_light([]))
    range_dn: float = np.inf
    bend_se: tuple[float, ...] = ()
    excess: Excess = NO_EXCESS
    noise: tuple[SeriesNoise, ...] = ()

    @property
    def darks(self) -> SeriesMoments:
        """Statistics of the darks."""
        return self.series.part(slice(len(self.scatter_dn2)))

    @property
    def flats(self) -> SeriesMoments:
        """Statistics of the flats, possibly none."""
        return self.series.part(slice(len(self.scatter_dn2), None))

    @property
    def noise_freedom(self) -> Array:
        """Degrees of freedom of the noise of each series."""
        return (self.series.frames - 1) * self.freedom * self.series.evenness


def gather_moments(darks: Sequence[Series], flats: Sequence[Series], used: Mask) -> Moments:
    """Sum the statistics of the series, at least one of darks, over pixels that are neither defective nor suspect."""
    pixels = float(used.sum())
    freedom = max(pixels - sum(used.shape) + 1.0, 1.0)
    both = (*darks, *flats)
    mean_dn = np.array([mean_over(item.mean_of, used) for item in both])
    frames = np.array([item.frames for item in both], np.float64)
    noise = tuple(group_noise(item, used, min(mean_dn[: len(darks)]), (BLOCKS, BLOCKS)) for item in both)
    roundings = [*dark_roundings(darks, used), *(flat_rounding(flat, used) for flat in flats)]
    excess_dn2 = np.array([rounding.excess_dn2 for rounding in roundings])

    def work(strip: slice) -> Array:
        patterns = np.array([dark.pattern_dn[strip][used[strip]] for dark in darks], np.float64)
        return patterns @ patterns.T

    series = SeriesMoments(
        exposure_s=np.array([item.conditions.dark_time_s for item in both]),
        frames=frames,
        mean_dn=mean_dn,
        within_dn2=np.array([item.rows[:, 1].sum() for item in noise]) - excess_dn2 * (frames - 1) * freedom,
        level_scatter_dn2=np.array([item.levels_dn.var() * item.frames for item in both]),
        rounding2=np.array([rounding.error**2 for rounding in roundings]),
        evenness=np.array([1.0] * len(darks) + [_evenness(flat, darks[0], used) for flat in flats]),
    )
    scatter_dn2 = total_of(work, used.shape)
    return Moments(pixels, freedom, series, scatter_dn2, light=known_light(flats), noise=noise)


def _evenness(flat: Series, dark: Series, used: Mask) -> float:
    def work(rows: slice) -> Array:
        signal = (flat.mean_of(rows) - dark.mean_of(rows))[used[rows]]
        return np.array([signal.sum(), signal @ signal])

    mean, square = total_of(work, used.shape) / float(used.sum())
    return float(mean**2 / max(square, 1e-12))


def group_noise(series: Series, used: Mask, floor_dn: float, blocks: tuple[int, int]) -> SeriesNoise:
    """Return the sums of a series; a flat's pixels count as no darker than `floor_dn`."""
    nodes = np.zeros(1)
    if series.conditions.kind == "flat":
        ends = over_strips(lambda rows: (mean := series.mean_of(rows)).min() + 1j * mean.max(), used.shape)
        low, high = max(np.real(ends).min(), floor_dn), max(np.imag(ends).max(), floor_dn)
        nodes = np.linspace(low, high + 1e-6, _NODES)
    row_of, column_of = (np.arange(size) * count // size for size, count in zip(used.shape, blocks, strict=True))
    by_row = np.zeros((len(used), 2 + nodes.size))

    def work(rows: slice) -> tuple[Array, Array]:
        by_block, by_column = (np.zeros((size, 2 + nodes.size)) for size in (blocks[0] * blocks[1], used.shape[1]))
        of_rows, block_of_row = series.row_dn[rows] + series.levels_dn.mean(), row_of[rows] * blocks[1]
        maps = series.within_dn2[rows], used[rows], series.pattern_dn[rows]
        places = of_rows, series.column_dn, nodes, block_of_row, column_of
        _sum_groups(*maps, *places, by_block, by_row[rows], by_column)
        return by_block, by_column

    by_block, by_column = (sum(parts) for parts in zip(*over_strips(work, used.shape, _PARTS), strict=True))
    pixels = float(used.sum())
    share = max(pixels - sum(used.shape) + 1, 1.0) / pixels
    return SeriesNoise(series.frames, share, nodes, by_block, by_row, by_column)


@compiled
def _sum_groups(within, used, pattern, of_rows, of_columns, nodes, block_of_row, column_of, blocks, rows, columns):
    last = nodes.size - 1
    per_dn = last / (nodes[last] - nodes[0]) if last else 0.0
    for row in range(within.shape[0]):
        count, total = 0.0, 0.0
        for column in range(within.shape[1]):
            if not used[row, column]:
                continue
            block, squares = block_of_row[row] + column_of[column], float(within[row, column])
            count += 1.0
            total += squares
            blocks[block, 0] += 1.0
            blocks[block, 1] += squares
            columns[column, 0] += 1.0
            columns[column, 1] += squares
            if last == 0:
                continue
            place = (pattern[row, column] + of_rows[row] + of_columns[column] - nodes[0]) * per_dn
            place = min(max(place, 0.0), float(last))
            node = min(int(place), last - 1)
            share = place - node
            blocks[block, 2 + node] += 1.0 - share
            blocks[block, 3 + node] += share
            rows[row, 2 + node] += 1.0 - share
            rows[row, 3 + node] += share
            columns[column, 2 + node] += 1.0 - share
            columns[column, 3 + node] += share
        rows[row, 0], rows[row, 1] = count, total
    if last == 0:
        blocks[:, 2], rows[:, 2], columns[:, 2] = blocks[:, 0], rows[:, 0], columns[:, 0]
