# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Consistent depths of neighbours, compiled: costs summed over eight straight paths to each sample."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.numba_tools import compiled
from faintfield.recon.threads import map_in_threads

_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


def sum_over_paths(costs: NDArray[np.float32], one_step: float, any_step: float) -> NDArray[np.float32]:
    """Return the costs (row, column, depth) of each depth, with those of the best depths on eight paths to a sample.

    Along a path, `L(p, z) = c(p, z) + min(L(q, z), L(q, z ± 1) + P₁, min L(q) + P₂) − min L(q)`, with q the sample
    before p (Hirschmüller 2008). The constant keeps numbers small.

    Parameters
    ----------
    costs : float array (row, column, depth)
        Negative log-likelihood of each depth.
    one_step, any_step : float
        P₁ and P₂: costs of a change of depth between neighbours by one, and by any number.
    """
    penalties = np.float32(one_step), np.float32(any_step)

    def work(direction: tuple[int, int]) -> NDArray[np.float32]:
        total = np.zeros_like(costs)
        _add_path(costs, *penalties, *direction, total)
        return total

    total = np.zeros_like(costs)
    for first in range(0, len(_DIRECTIONS), 2):  # two sums at a time: each is as large as the costs
        for part in map_in_threads(work, _DIRECTIONS[first : first + 2]):
            total += part
    return total


def lowest(costs: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the index of each sample's lowest cost (row, column), refined by the parabola through its neighbours."""
    best = np.clip(costs.argmin(axis=2), 1, costs.shape[2] - 2)
    before, at, after = (np.take_along_axis(costs, (best + k)[:, :, np.newaxis], 2)[:, :, 0] for k in (-1, 0, 1))
    bend = before - 2 * at + after
    offset = np.divide(0.5 * (before - after), bend, out=np.zeros_like(bend), where=bend > 0)
    return np.asarray(best + np.clip(offset, -0.5, 0.5), np.float32)


@compiled
def _add_path(costs, one_step, any_step, down, right, total):
    """Add the sums along the paths of one direction (down, right) to `total` (row, column, depth)."""
    rows, columns, depths = costs.shape
    before, here = np.zeros((columns, depths), np.float32), np.zeros((columns, depths), np.float32)
    least_before, least_here = np.zeros(columns, np.float32), np.zeros(columns, np.float32)
    for count in range(rows):
        row = count if down >= 0 else rows - 1 - count
        for step in range(columns):
            column = step if right >= 0 else columns - 1 - step
            last = column - right
            sums = here[column]
            if 0 <= row - down < rows and 0 <= last < columns:
                reached = here[last] if down == 0 else before[last]
                least = least_here[last] if down == 0 else least_before[last]
                for z in range(depths):
                    best = min(reached[z], least + any_step)
                    if z > 0:
                        best = min(best, reached[z - 1] + one_step)
                    if z < depths - 1:
                        best = min(best, reached[z + 1] + one_step)
                    sums[z] = costs[row, column, z] + best - least
            else:
                for z in range(depths):
                    sums[z] = costs[row, column, z]
            lowest_sum = sums[0]
            for z in range(depths):
                lowest_sum = min(lowest_sum, sums[z])
                total[row, column, z] += sums[z]
            least_here[column] = lowest_sum
        before, here = here, before
        least_before, least_here = least_here, least_before
