# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""How sure a penalised plane is: the spread of the planes that data and penalty allow, sample by sample."""

from concurrent.futures import ThreadPoolExecutor
from itertools import repeat

import numba
import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.penalties import Penalty

# Draws whose spread is taken, and how often the curvature of the penalty is brought up to date with that spread.
_DRAWS, _ROUNDS = 10, 10

# Conjugate gradients are carried on to this residual, relative to the first.
_RESIDUAL, _MOST_STEPS = 1e-2, 200

# The variance of a few draws is averaged over neighbours, by `recon.smoothing.blurred`.
_BLUR = (1, 2)


def standard_deviation(
    plane: Image, metric: Image, weight: float, penalty: Penalty, generator: np.random.Generator
) -> Image:
    """Return the standard deviation (row, column) of a plane in electrons, by Laplace's method.

    The posterior `exp(−L − β Σ φ(|∇f|))` is replaced by the normal distribution that fits it best near its maximum:
    its precision is `W + β ∇ᵀ D ∇`, with W the curvature of the data that the solver works in. Total variation has no
    curvature of its own. By its tangent parabolas (variational Bayes: Babacan, Molina and Katsaggelos 2008)
    `D = 1/√( |∇f|² + Var ∇f )`, where the variance is that of the very distribution sought; a few rounds settle both.
    Draws from it are `(W + β ∇ᵀ D ∇)⁻¹ ( √W ξ + ∇ᵀ √(β D) η )` with ξ and η white.

    The weight that predicts best is not that of the law that planes are drawn from. Total variation scales with f, so
    that `exp(−β TV)` over n samples integrates to a constant times β⁻ⁿ, and the likeliest β is `n / <TV(f)>`, the mean
    over the same draws (Pereyra, Bioucas-Dias and Figueiredo 2015). It is found along with the spread, over the samples
    where there is something to see: the emptiness around says nothing of them. Other penalties keep their weight.

    Parameters
    ----------
    plane, metric : float array (row, column)
        f at its optimum, and W > 0 there.
    weight : float
        β ≥ 0 of the optimum.
    penalty : Penalty
        φ.
    generator : Generator
        Of the draws.
    """
    w = np.asarray(metric, np.float32)
    if weight == 0 or penalty.name == "none":
        return np.asarray(1 / np.sqrt(w), plane.dtype)
    white = generator.standard_normal((_DRAWS, *plane.shape), np.float32)
    of_edges = generator.standard_normal((_DRAWS, 2, *plane.shape), np.float32)
    own = _squared_gradient(np.asarray(plane, np.float32))
    spread = np.full_like(w, 2 * np.median(1 / w))
    draws = [np.zeros_like(w) for _ in white]
    there = opacity(np.asarray(plane, np.float32)) > 0.5
    with ThreadPoolExecutor(int(numba.config.NUMBA_NUM_THREADS)) as pool:
        for _ in range(1 if penalty.name == "quadratic" else _ROUNDS):
            curvature = np.float32(weight) * _curvature(np.sqrt(own + spread), penalty)
            draws = list(pool.map(_draw, repeat(w), repeat(curvature), white, of_edges, draws))
            spread = blurred(_mean([_squared_gradient(draw) for draw in draws]), _BLUR)
            if penalty.name == "tv" and there.any():
                weight = 1 / float(np.sqrt(own + spread)[there].mean(dtype=np.float64))
    return np.asarray(np.sqrt(blurred(_mean([np.square(draw) for draw in draws]), _BLUR)), plane.dtype)


def _mean(planes: list[Image]) -> Image:
    """Return the mean of planes."""
    return np.asarray(sum(planes) / np.float32(len(planes)))


def _squared_gradient(plane: Image) -> Image:
    """Return |∇x|² (row, column)."""
    return np.asarray(np.sum(np.square(_differences(plane)), axis=0))


def _curvature(length: Image, penalty: Penalty) -> Image:
    """Return φ'(t)/t, the curvature of the parabola that touches φ at t."""
    if penalty.name == "quadratic":
        return np.full_like(length, 1 / penalty.smoothing_e)
    return 1 / np.maximum(length, penalty.smoothing_e)


def _draw(w: Image, curvature: Image, white: Image, of_edges: Image, start: Image) -> Image:
    """Return one draw, by conjugate gradients in the scale of the diagonal."""
    target = np.sqrt(w) * white + _divergence(np.sqrt(curvature) * of_edges)
    diagonal = w + _degree(curvature)
    x, image = start.copy(), np.empty_like(start)
    _precision(w, curvature, x, image)
    residual = target - image
    z = residual / diagonal
    ahead, rho = z.copy(), float(np.vdot(residual, z))
    least = _RESIDUAL**2 * float(np.vdot(target, target / diagonal))
    for _ in range(_MOST_STEPS):
        if rho <= least:
            break
        _precision(w, curvature, ahead, image)
        step = x.dtype.type(rho / float(np.vdot(ahead, image)))
        x += step * ahead
        residual -= step * image
        np.divide(residual, diagonal, out=z)
        rho, before = float(np.vdot(residual, z)), rho
        ahead *= x.dtype.type(rho / before)
        ahead += z
    return x


@numba.njit(cache=True, nogil=True)
def _precision(w, curvature, x, out):
    """Set `out` to `(W + ∇ᵀ D ∇) x`."""
    rows, columns = x.shape
    for i in range(rows):
        for j in range(columns):
            total = w[i, j] * x[i, j]
            if i + 1 < rows:
                total += curvature[i, j] * (x[i, j] - x[i + 1, j])
            if j + 1 < columns:
                total += curvature[i, j] * (x[i, j] - x[i, j + 1])
            if i > 0:
                total += curvature[i - 1, j] * (x[i, j] - x[i - 1, j])
            if j > 0:
                total += curvature[i, j - 1] * (x[i, j] - x[i, j - 1])
            out[i, j] = total


def _differences(plane: Image) -> Image:
    """Return ∇x (2, row, column), none across an edge."""
    both = np.zeros((2, *plane.shape), plane.dtype)
    np.subtract(plane[1:], plane[:-1], out=both[0, :-1])
    np.subtract(plane[:, 1:], plane[:, :-1], out=both[1, :, :-1])
    return both


def _divergence(field: Image) -> Image:
    """Return ∇ᵀp (row, column)."""
    plane = np.zeros(field.shape[1:], field.dtype)
    plane[1:] += field[0, :-1]
    plane[:-1] -= field[0, :-1]
    plane[:, 1:] += field[1, :, :-1]
    plane[:, :-1] -= field[1, :, :-1]
    return plane


def _degree(curvature: Image) -> Image:
    """Return the diagonal of ∇ᵀ D ∇ (row, column)."""
    total = np.zeros_like(curvature)
    total[1:] += curvature[:-1]
    total[:-1] += curvature[:-1]
    total[:, 1:] += curvature[:, :-1]
    total[:, :-1] += curvature[:, :-1]
    return total
