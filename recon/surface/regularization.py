# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Consistent depths of neighbours, compiled: costs summed over paths, and piecewise plane depths."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.numba_tools import compiled
from faintfield.recon.threads import map_in_threads

# Step of both primal and dual: the squared norm of the operator is at most 12.
_STEP = np.float32(12**-0.5)

_DIRECTIONS = ((0, 1), (0, -1), (1, 0), (-1, 0), (1, 1), (-1, -1), (1, -1), (-1, 1))


class PiecewisePlane:
    """A map that consists of planes, by total generalised variation of second order, and the state of its minimisation.

    Minimised is `Σ ½ c (u − v)² + α₁ |∇u − w| + α₀ |ℰw|` over u and the slopes w, with ℰ the symmetrised derivative
    (Bredies, Kunisch and Pock 2010), by the primal-dual method (Chambolle and Pock 2011).

    `values` (row, column) are u, and `slopes` (2, row, column) w, right and down.
    """

    def __init__(self, values: Image) -> None:
        self.values, self.slopes = np.array(values, np.float32), np.zeros((2, *values.shape), np.float32)
        self._ahead, self._dual = np.stack([self.values, *self.slopes]), np.zeros((5, *values.shape), np.float32)

    def approach(self, target: Image, weight: float, bend: tuple[float, float], steps: int) -> None:
        """Make steps towards the minimum, given v (row, column), c, and α₁ and α₀."""
        v = np.ascontiguousarray(target, np.float32)
        for _ in range(steps):
            _ascend(self._ahead, self._dual, *map(np.float32, bend))
            _descend(self.values, self.slopes, self._ahead, self._dual, v, np.float32(weight))


@compiled
def _ascend(ahead, dual, alpha_1, alpha_0):
    """Step of the dual fields, projected to lengths of at most α₁ and α₀."""
    _, rows, columns = ahead.shape
    u, right, down = ahead[0], ahead[1], ahead[2]
    zero, half, one, two = np.float32(0), np.float32(0.5), np.float32(1), np.float32(2)
    for i in range(rows):
        for j in range(columns):
            x = dual[0, i, j] + _STEP * (u[i, j + 1] - u[i, j] - right[i, j]) if j + 1 < columns else zero
            y = dual[1, i, j] + _STEP * (u[i + 1, j] - u[i, j] - down[i, j]) if i + 1 < rows else zero
            length = max(one, np.sqrt(x * x + y * y) / alpha_1)
            dual[0, i, j], dual[1, i, j] = x / length, y / length
            xx = right[i, j] - right[i, j - 1] if j > 0 else zero
            yy = down[i, j] - down[i - 1, j] if i > 0 else zero
            xy = zero
            if i > 0:
                xy += half * (right[i, j] - right[i - 1, j])
            if j > 0:
                xy += half * (down[i, j] - down[i, j - 1])
            a, b, c = dual[2, i, j] + _STEP * xx, dual[3, i, j] + _STEP * yy, dual[4, i, j] + _STEP * xy
            length = max(one, np.sqrt(a * a + b * b + two * c * c) / alpha_0)
            dual[2, i, j], dual[3, i, j], dual[4, i, j] = a / length, b / length, c / length


@compiled
def _descend(values, slopes, ahead, dual, target, weight):
    """Step of the map and its slopes, and their extrapolation."""
    rows, columns = values.shape
    one, two = np.float32(1), np.float32(2)
    for i in range(rows):
        for j in range(columns):
            divergence = dual[0, i, j] + dual[1, i, j]
            # The fields of ℰw are zero where the differences do not exist
            right, down = dual[0, i, j] - dual[2, i, j], dual[1, i, j] - dual[3, i, j]
            if j > 0:
                divergence -= dual[0, i, j - 1]
                down -= dual[4, i, j]
            if i > 0:
                divergence -= dual[1, i - 1, j]
                right -= dual[4, i, j]
            if j + 1 < columns:
                right += dual[2, i, j + 1]
                down += dual[4, i, j + 1]
            if i + 1 < rows:
                down += dual[3, i + 1, j]
                right += dual[4, i + 1, j]
            u = (values[i, j] + _STEP * (divergence + weight * target[i, j])) / (one + _STEP * weight)
            ahead[0, i, j] = two * u - values[i, j]
            values[i, j] = u
            ahead[1, i, j] = slopes[0, i, j] + two * _STEP * right
            slopes[0, i, j] += _STEP * right
            ahead[2, i, j] = slopes[1, i, j] + two * _STEP * down
            slopes[1, i, j] += _STEP * down


def sum_over_paths(costs: NDArray[np.float32], one_step: float, any_step: float) -> NDArray[np.float32]:
    """Return the costs (row, column, depth) of each depth, with those of the best depths on eight paths to a sample.

    Along a path, `L(p, z) = c(p, z) + min(L(q, z), L(q, z ± 1) + P₁, min L(q) + P₂) − min L(q)`, with q the sample
    before p (Hirschmüller 2008). The costs c are negative log-likelihoods; `one_step` P₁ and `any_step` P₂ those of a
    change of depth between neighbours by one, and by any number.
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
