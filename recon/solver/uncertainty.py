# mypy: disable-error-code="no-untyped-def, no-untyped-call"
"""The standard deviation of each sample of a penalised plane."""

from concurrent.futures import ThreadPoolExecutor
from itertools import repeat

import numba
import numpy as np

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.penalties import Penalty, differences

# Number of draws, and of updates of the penalty's curvature from their spread.
_DRAWS, _ROUNDS = 10, 10

# Relative residual at which conjugate gradients stop, and the limit on their steps.
_RESIDUAL, _MAX_STEPS = 1e-2, 200

# Spacings of the blur over neighbours that makes up for the small number of draws.
_BLUR = (1, 2)


def standard_deviation(
    plane: Image, metric: Image, weight: float, penalty: Penalty, generator: np.random.Generator
) -> Image:
    """Return the standard deviation (row, column) of a plane in electrons, by Laplace's method.

    The posterior `exp(−L − β Σ φ(|∇f|))` is approximated by a normal distribution of precision `W + β ∇ᵀ D ∇`, with W
    the solver's curvature of the data. By tangent parabolas of total variation (variational Bayes: Babacan, Molina and
    Katsaggelos 2008) `D = 1/√( |∇f|² + Var ∇f )`, with the variance of the sought distribution itself; a few rounds
    determine both. Draws are `(W + β ∇ᵀ D ∇)⁻¹ ( √W ξ + ∇ᵀ √(β D) η )` with ξ and η white.

    With total variation, β is replaced by its most likely value `n / <TV(f)>` over n samples and the same draws
    (Pereyra, Bioucas-Dias and Figueiredo 2015), because the weight that predicts best is not that of the distribution
    of planes. Only opaque samples count: empty surroundings say nothing about them.

    Parameters
    ----------
    plane, metric : float array (row, column)
        f at its optimum, and W > 0 there.
    weight, penalty : float, Penalty
        β ≥ 0 of the optimum, and φ.
    generator : Generator
        Random generator of the draws.
    """
    w = np.asarray(metric, np.float32)
    if weight == 0 or penalty.name == "none":
        return np.asarray(1 / np.sqrt(w), plane.dtype)
    white = generator.standard_normal((_DRAWS, *plane.shape), np.float32)
    of_edges = generator.standard_normal((_DRAWS, 2, *plane.shape), np.float32)
    own = _squared_gradient(np.asarray(plane, np.float32))
    spread = np.full_like(w, 2 * np.median(1 / w))
    draws = [np.zeros_like(w) for _ in white]
    opaque = opacity(np.asarray(plane, np.float32)) > 0.5
    with ThreadPoolExecutor(int(numba.config.NUMBA_NUM_THREADS)) as pool:
        for _ in range(1 if penalty.name == "quadratic" else _ROUNDS):
            curvature = np.float32(weight) * _curvature(np.sqrt(own + spread), penalty)
            draws = list(pool.map(_draw, repeat(w), repeat(curvature), white, of_edges, draws))
            spread = blurred(_mean([_squared_gradient(draw) for draw in draws]), _BLUR)
            if penalty.name == "tv" and opaque.any():
                weight = 1 / float(np.sqrt(own + spread)[opaque].mean(dtype=np.float64))
    return np.asarray(np.sqrt(blurred(_mean([np.square(draw) for draw in draws]), _BLUR)), plane.dtype)


def _mean(planes: list[Image]) -> Image:
    """Return the mean of planes."""
    return np.asarray(sum(planes) / np.float32(len(planes)))


def _squared_gradient(plane: Image) -> Image:
    """Return |∇x|² (row, column)."""
    down, right = differences(plane)
    return np.asarray(np.square(down) + np.square(right))


def _curvature(length: Image, penalty: Penalty) -> Image:
    """Return φ'(t)/t, the curvature of the parabola that touches φ at t."""
    if penalty.name == "quadratic":
        return np.full_like(length, 1 / penalty.smoothing_e)
    return 1 / np.maximum(length, penalty.smoothing_e)


def _draw(w: Image, curvature: Image, white: Image, of_edges: Image, start: Image) -> Image:
    """Return one draw, by conjugate gradients preconditioned with the diagonal."""
    target = np.sqrt(w) * white + _divergence(np.sqrt(curvature) * of_edges)
    diagonal = w + _degree(curvature)
    x, image = start.copy(), np.empty_like(start)
    _precision(w, curvature, x, image)
    residual = target - image
    z = residual / diagonal
    ahead, rho = z.copy(), float(np.vdot(residual, z))
    tolerance = _RESIDUAL**2 * float(np.vdot(target, target / diagonal))
    for _ in range(_MAX_STEPS):
        if rho <= tolerance:
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
