# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Steps of a primal-dual iteration on a penalised plane, compiled: several at a time on a tile.

The penalty of a plane x is `β Σ φ(|∇(x − x̂)|)`, with `(∇x)[i,j] = (x[i+1,j] − x[i,j], x[i,j+1] − x[i,j])` and no
difference taken across an edge. x̂ is a proposal, by default zero. The dual field p has a vector of length at most one
for each sample (of any length where φ is quadratic everywhere).

A step changes a row using the rows next to it. The steps follow one another down a tile, each a row behind the one
before, so that the rows in work stay in the cache and the planes pass through memory once for all steps. n steps on a
tile need n rows and columns of its neighbours on each side, whose values become stale one after the other. They are
copied before any tile is changed, so that tiles can be processed in any order, and the result does not depend on their
number.
"""

import numpy as np

from faintfield.recon.numba_tools import compiled


@compiled
def step_tile(
    first, stop, left, right, above, below, before, behind,
    dual, plane, ahead, centre, reach, sizes, origin, smoothing, bounded, lengths, momenta,
):  # fmt: skip
    """Make `momenta.size` steps on a tile of the dual field, the plane, and the plane ahead.

    Parameters
    ----------
    first, stop, left, right : int
        Rows and columns of the tile.
    above, below : array (4, step, column)
        The rows before and after the tile of p, of x and of x ahead; without rows at an edge of the plane.
    before, behind : array (4, row, step)
        The columns before and after it, likewise.
    dual, plane, ahead : array (2, row, column), (row, column), (row, column)
        p; x; x extrapolated beyond its last step, less x̂. They are changed.
    centre, reach, sizes, origin : array (row, column)
        v, β/w, the size of a step on p, and x̂, of size zero where it is zero everywhere.
    smoothing, bounded : number, bool
        δ of the penalty, in the unit of the plane; whether |p| ≤ 1.
    lengths, momenta : array (step,)
        τ, the length of each step on x in the metric; its extrapolation.
    """
    count = momenta.size
    top, bottom = first - above.shape[1], stop + below.shape[1]
    west, east = left - before.shape[2], right + behind.shape[2]
    columns, inner, after = east - west, left - west, right - west
    number = centre.dtype.type
    one, smoothing = number(1), number(smoothing)
    # A ring of rows in work, those of p after a column of zeros, those ahead with their last value twice
    kept = count + 3
    p, x = np.zeros((kept, 2, columns + 1), dual.dtype), np.empty((kept, columns), dual.dtype)
    x_ahead, over_top = np.empty((kept, columns + 1), dual.dtype), np.zeros((2, columns + 1), dual.dtype)
    for front in range(top, bottom + count):
        if front < bottom:
            k = front % kept
            if front < first:
                _load(above[:2], above[2], above[3], front - top, west, east, 0, p[k], x[k], x_ahead[k])
            elif front >= stop:
                _load(below[:2], below[2], below[3], front - stop, west, east, 0, p[k], x[k], x_ahead[k])
            else:
                _load(before[:2], before[2], before[3], front, 0, inner, 0, p[k], x[k], x_ahead[k])
                _load(dual, plane, ahead, front, left, right, inner, p[k], x[k], x_ahead[k])
                _load(behind[:2], behind[2], behind[3], front, 0, columns - after, after, p[k], x[k], x_ahead[k])
            x_ahead[k, columns] = x_ahead[k, columns - 1]
        for step in range(count):
            row = front - 1 - step
            if row < top:
                break
            if row < bottom:
                k = row % kept
                next_row = (row + 1) % kept if row + 1 < bottom else k
                length, momentum = number(lengths[step]), number(momenta[step])
                size = sizes[row, west:east]
                _step_dual(x_ahead[k], x_ahead[next_row], size, one / length, smoothing, bounded, p[k])
                over = p[(row - 1) % kept] if row > top else over_top
                v, r = centre[row, west:east], reach[row, west:east]
                if origin.size > 0:
                    _step_primal(over, p[k], v, r, origin[row, west:east], length, momentum, x[k], x_ahead[k])
                else:
                    _step_primal(over, p[k], v, r, None, length, momentum, x[k], x_ahead[k])
        row = front - count
        if first <= row < stop:
            k = row % kept
            _store(p[k], x[k], x_ahead[k], inner, after, row, left, dual, plane, ahead)


@compiled
def _load(dual, plane, ahead, row, begin, end, to, p, x, x_ahead):
    """Copy columns of a row of p, x and x ahead to a row in work, from its column `to` on."""
    _copy_row(
        dual[0, row, begin:end],
        dual[1, row, begin:end],
        plane[row, begin:end],
        ahead[row, begin:end],
        p[0, 1 + to :],
        p[1, 1 + to :],
        x[to:],
        x_ahead[to:],
    )


@compiled
def _store(p, x, x_ahead, begin, end, row, left, dual, plane, ahead):
    """Copy columns of a row in work back to a tile, whose first column is `left`."""
    _copy_row(
        p[0, 1 + begin : 1 + end],
        p[1, 1 + begin : 1 + end],
        x[begin:end],
        x_ahead[begin:end],
        dual[0, row, left:],
        dual[1, row, left:],
        plane[row, left:],
        ahead[row, left:],
    )


@compiled
def _copy_row(down, right, plane, ahead, to_down, to_right, to_plane, to_ahead):
    """Copy a row in work; `a[:] = b` would take seconds to compile, for the message that sizes differ."""
    for j in range(plane.size):
        to_down[j], to_right[j], to_plane[j], to_ahead[j] = down[j], right[j], plane[j], ahead[j]


@compiled
def _step_dual(x, below, sizes, scale, smoothing, bounded, p):
    """Make a step on a row of the dual field, given the planes ahead in this row and the next."""
    one = x.dtype.type(1)
    down_field, right_field, beside = p[0, 1:], p[1, 1:], x[1:]
    for j in range(sizes.size):
        size = sizes[j] * scale
        shrink = one / (one + size * smoothing)
        down = (down_field[j] + size * (below[j] - x[j])) * shrink
        right = (right_field[j] + size * (beside[j] - x[j])) * shrink
        inverse = one / np.sqrt(max(down * down + right * right, one)) if bounded else one
        down_field[j] = down * inverse
        right_field[j] = right * inverse


@compiled
def _step_primal(above, p, centre, reach, origin, length, momentum, x, ahead):
    """Make a step on a row of the plane, given p in this row and the one above; set the row ahead, less x̂ if any."""
    number = x.dtype.type
    share, zero = number(1) / (number(1) + length), number(0)
    over, down, right, left = above[0, 1:], p[0, 1:], p[1, 1:], p[1, :-1]
    for j in range(x.size):
        before = x[j]
        minimum = centre[j] + reach[j] * (down[j] - over[j] + right[j] - left[j])
        after = max((before + length * minimum) * share, zero)
        x[j] = after
        beyond = after + momentum * (after - before)
        ahead[j] = beyond if origin is None else beyond - origin[j]
    ahead[x.size] = ahead[x.size - 1]


@compiled
def primal_of_dual(first, stop, dual, centre, reach, plane):
    """Set rows of `plane` to `v − β/w ∇ᵀp`, not clipped at zero."""
    zero = centre.dtype.type(0)
    for row in range(first, stop):
        for j in range(centre.shape[1]):
            divergence = dual[0, row, j] + dual[1, row, j]
            divergence -= dual[0, row - 1, j] if row > 0 else zero
            divergence -= dual[1, row, j - 1] if j > 0 else zero
            plane[row, j] = centre[row, j] + reach[row, j] * divergence


@compiled
def distance_from_primal(first, stop, plane, dual, centre, metric, weight):
    """Return Σ ½ w (x − u₊)² and Σ w (−u)₊ x over rows of a plane x ≥ 0, with `u = v − β/w ∇ᵀp`.

    Their sum is how far x is from the minimum for a fixed p; each term is at least zero.
    """
    zero, half, square, excess = centre.dtype.type(0), centre.dtype.type(0.5), 0.0, 0.0
    for row in range(first, stop):
        square_of_row, excess_of_row = zero, zero
        for j in range(centre.shape[1]):
            divergence = dual[0, row, j] + dual[1, row, j]
            divergence -= dual[0, row - 1, j] if row > 0 else zero
            divergence -= dual[1, row, j - 1] if j > 0 else zero
            w, x = metric[row, j], plane[row, j]
            minimum = centre[row, j] + weight / w * divergence
            change = x - max(minimum, zero)
            square_of_row += half * w * change * change
            excess_of_row += w * max(-minimum, zero) * x
        square += square_of_row
        excess += excess_of_row
    return np.array([square, excess])


@compiled
def penalty_and_slack(first, stop, plane, dual, smoothing, bounded):
    """Return Σ φ(|∇x|) over rows of a plane, and how far p is from being its subgradient: Σ φ − p·∇x + ½ δ |p|².

    Each term of the second sum is at least zero, and zero where p belongs to x.
    """
    rows, columns = plane.shape
    number = plane.dtype.type
    zero, half, smoothing = number(0), number(0.5), number(smoothing)
    penalty, slack = 0.0, 0.0
    for row in range(first, stop):
        below = min(row + 1, rows - 1)
        of_row, slack_of_row = zero, zero
        for j in range(columns):
            x = plane[row, j]
            down = plane[below, j] - x
            right = plane[row, min(j + 1, columns - 1)] - x
            square = down * down + right * right
            length = np.sqrt(square)
            quadratic = (length < smoothing) | (not bounded)
            value = half * square / max(smoothing, number(1e-30)) if quadratic else length - half * smoothing
            p_down, p_right = dual[0, row, j], dual[1, row, j]
            tie = half * smoothing * (p_down * p_down + p_right * p_right) - down * p_down - right * p_right
            of_row += value
            slack_of_row += max(value + tie, zero)
        penalty += of_row
        slack += slack_of_row
    return penalty, slack


@compiled
def interpolate_edges(first, stop, coarse, fine):
    """Set the vectors (2, row, column) at the edges of fine samples to those of coarse ones, linearly between them.

    That is done for the fine samples of rows of coarse ones; beyond the last sample there is no vector.
    """
    rows, columns = fine.shape[1:]
    half, zero = fine.dtype.type(0.5), fine.dtype.type(0)
    for row in range(2 * first, min(2 * stop, rows)):
        i = row // 2
        for column in range(columns):
            j = column // 2
            down, right = coarse[0, i, j], coarse[1, i, j]
            if row % 2 == 0:
                down = half * (down + (coarse[0, i - 1, j] if i > 0 else zero))
            if column % 2 == 0:
                right = half * (right + (coarse[1, i, j - 1] if j > 0 else zero))
            fine[0, row, column] = down if row < rows - 1 else zero
            fine[1, row, column] = right if column < columns - 1 else zero


@compiled
def squared_distance(plane, other, metric):
    """Return Σ w (x − y)² over samples (sample,), summed in float64; y = 0 if it has no samples."""
    total = 0.0
    if other.size > 0:
        for k in range(plane.size):
            change = plane[k] - other[k]
            total += np.float64(metric[k] * change * change)
    else:
        for k in range(plane.size):
            total += np.float64(metric[k] * plane[k] * plane[k])
    return total
