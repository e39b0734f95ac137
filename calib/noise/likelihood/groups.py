# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Noise of a series summed over blocks, rows and columns of pixels: what its scatter is judged by, from one pass."""

from dataclasses import dataclass

import numpy as np

from faintfield.calib.noise.series.statistics import Series
from faintfield.calib.noise.strips import Array, Mask, compiled, over_strips

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
    frames : int
        Number of frames.
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

    @property
    def within_dn2(self) -> float:
        """Sum of squares of all pixels."""
        return float(self.rows[:, 1].sum())

    def scatter(self, groups: Array, variances_dn2: Array | float) -> tuple[Array, Array]:
        """Return the noise of groups over the expected one, and the degrees of freedom of each, both (group,).

        Groups with fewer than two pixels are left out.

        Parameters
        ----------
        groups : array (group, 2 + node)
            One of the three sums.
        variances_dn2 : array (node,) or float
            Expected noise of pixels with the means `nodes_dn`.
        """
        count, measured, weights = groups[:, 0], groups[:, 1], groups[:, 2:]
        expected = weights @ np.broadcast_to(variances_dn2, weights.shape[1:])
        enough, freedom = count > 1, (self.frames - 1) * self.share
        return measured[enough] / (expected[enough] * freedom), count[enough] * freedom


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
        _sum_groups(
            series.within_dn2[rows], used[rows], series.pattern_dn[rows], series.row_dn[rows] + series.levels_dn.mean(),
            series.column_dn, nodes, row_of[rows] * blocks[1], column_of, by_block, by_row[rows], by_column,
        )  # fmt: skip
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
