# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""Steps on the dual field of a penalised plane, compiled: several at a time on a strip of rows.

The penalty of a plane x is `β Σ φ(|∇(x − x̂)|)`, with `(∇x)[i,j] = (x[i+1,j] − x[i,j], x[i,j+1] − x[i,j])` and no
difference taken across an edge. x̂ is a proposal, by default zero. The dual field p has a vector of length at most one
for each sample (of any length where φ is quadratic everywhere), and determines the plane: `x = ( v − β/w ∇ᵀp )₊`.

A step changes a row of p using the rows next to it, so n steps on a strip need n more rows on each side, whose values
become stale one after the other. Each strip works on a copy, so strips can be processed in any order, and the result
does not depend on their number.
"""

import numpy as np

from faintfield.recon.numba_tools import compiled


@compiled
def _plane_row(row, down, right, centre, reach, origin, values):
    """Set `values` to a row of `( v − β/w ∇ᵀp )₊ − x̂`, with its last value twice.

    The fields begin with a row and a column of zeros.
    """
    for j in range(centre.shape[1]):
        divergence = down[row + 1, j + 1] - down[row, j + 1] + right[row + 1, j + 1] - right[row + 1, j]
        values[j] = max(centre[row, j] + reach[row, j] * divergence, values.dtype.type(0))
    if origin.size > 0:
        for j in range(centre.shape[1]):
            values[j] -= origin[row, j]
    values[values.size - 1] = values[values.size - 2]


@compiled
def _step_row(x, below, step, smoothing, bounded, momentum, fields):
    """Make one accelerated step on a row of the dual field; return how far it opposes the momentum."""
    p_down, p_right, q_down, q_right = fields
    number = x.dtype.type
    one, against = number(1), number(0)
    for j in range(step.size):
        size = step[j]
        shrink = one / (one + size * smoothing)
        down = (q_down[j] + size * (below[j] - x[j])) * shrink
        right = (q_right[j] + size * (x[j + 1] - x[j])) * shrink
        length = np.sqrt(down * down + right * right)
        inverse = one / max(length, one) if bounded else one
        down *= inverse
        right *= inverse
        ahead_down, ahead_right = down - p_down[j], right - p_right[j]
        against += (q_down[j] - down) * ahead_down + (q_right[j] - right) * ahead_right
        p_down[j] = down
        p_right[j] = right
        q_down[j] = down + momentum * ahead_down
        q_right[j] = right + momentum * ahead_right
    return against


@compiled
def step_strip(
    first, stop, dual, ahead, next_dual, next_ahead, centre, reach, steps, origin, smoothing, bounded, momenta
):
    """Make `momenta.size` accelerated projected gradient steps on rows `first` to `stop` of the dual field.

    Parameters
    ----------
    dual, ahead, next_dual, next_ahead : array (2, row, column)
        The field p and the field extrapolated beyond it; the strip's rows of both after the steps.
    centre, reach, steps : array (row, column)
        v, β/w, and the size of the step at each sample.
    origin : array (row, column)
        x̂; of size zero where it is zero everywhere.
    smoothing, bounded : number, bool
        δ of the penalty, in the unit of the plane; whether |p| ≤ 1.
    momenta : array (step,)
        Extrapolation of each step.

    Returns
    -------
    float
        How far the last step opposed its momentum; when positive, the momentum should be dropped.
    """
    top, bottom = max(first - momenta.size, 0), min(stop + momenta.size, centre.shape[0])
    local = _with_halo(top, bottom, dual, ahead)
    against = 0.0
    planes = centre[top:bottom], reach[top:bottom], steps[top:bottom], origin[top:bottom]
    for momentum in momenta:
        options = (centre.dtype.type(smoothing), bounded, centre.dtype.type(momentum))
        against = _step_rows(first - top, stop - top, local, planes, options)
    next_dual[:, first:stop] = local[:2, 1 + first - top : 1 + stop - top, 1:]
    next_ahead[:, first:stop] = local[2:, 1 + first - top : 1 + stop - top, 1:]
    return against


@compiled
def _with_halo(top, bottom, dual, ahead):
    """Return a copy (4, row, column) of rows of both fields, after the row above and a column of zeros."""
    local = np.zeros((4, bottom - top + 1, dual.shape[2] + 1), dual.dtype)
    local[:2, 1:, 1:] = dual[:, top:bottom]
    local[2:, 1:, 1:] = ahead[:, top:bottom]
    if top > 0:
        local[2, 0, 1:] = ahead[0, top - 1]
    return local


@compiled
def _step_rows(first, stop, local, planes, options):
    """Make one step on all rows of a copy; return how far rows `first` to `stop` oppose the momentum."""
    centre, reach, steps, origin = planes
    height, columns = centre.shape
    here, below = np.empty(columns + 1, centre.dtype), np.empty(columns + 1, centre.dtype)
    smoothing, bounded, momentum = options
    _plane_row(0, local[2], local[3], centre, reach, origin, here)
    against = 0.0
    for row in range(height):
        if row + 1 < height:
            _plane_row(row + 1, local[2], local[3], centre, reach, origin, below)
        else:
            below[:] = here
        fields = (local[0, row + 1, 1:], local[1, row + 1, 1:], local[2, row + 1, 1:], local[3, row + 1, 1:])
        sums = _step_row(here, below, steps[row], smoothing, bounded, momentum, fields)
        if first <= row < stop:
            against += sums
        here, below = below, here
    return against


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
