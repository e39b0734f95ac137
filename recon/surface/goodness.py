"""Goodness of a surface: the part of the views' detail that it predicts, and what it leaves unexplained."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.surface.blur import gaussian
from faintfield.recon.surface.evidence import DepthEvidence, detail
from faintfield.recon.surface.held_out import seen_of, squared_errors

# Scale of the window in samples, and of the blur that light is compared with.
_WINDOW, _DETAIL = 6.0, 6.0

# Log-likelihood that chance may add to both, in a window.
_CHANCE = 100.0


def explained_share(evidence: DepthEvidence, index: NDArray[np.floating]) -> NDArray[np.float32]:
    """Return how much of the views' detail a surface explains, near each sample (row, column), between 0 and 1.

    In a window, let E be by how much the detail of the light raises the log-likelihood, as far as the two halves of
    the views agree on it, and X by how much the errors of one half, predicted by the light of the other, exceed those
    of the noise. Returned is `(E + c) / (E + X + c)`, with c for what chance does to both. It is small where something
    shines, is seen through or repeats itself, because no light of one surface then fits all views. It is near 1 where
    little is seen at all.

    Parameters
    ----------
    evidence : DepthEvidence
        Of the views.
    index : float array (row, column)
        The surface, as fractional index of the depths.
    """
    known = evidence.explained(index)
    views = np.sum([known.operator.sensitivity(half) for half in evidence.halves], axis=0)
    first, second = (detail(light, np.ones_like(light), _DETAIL) for light in known.lights)
    explained = np.asarray(0.5 * views * first * second / evidence.variance, np.float32)
    excess = np.zeros_like(evidence.views.light_e)
    for half, light in zip(evidence.halves, reversed(known.lights), strict=True):
        errors = squared_errors(evidence, known.operator.forward(light, half), half)
        excess[half] = np.where(seen_of(evidence, known, half), 0.5 * (errors - 1), 0)
    misfit = np.asarray(known.operator.adjoint(excess), np.float32)
    e, x = (np.maximum(gaussian(part, _WINDOW) * np.float32(4 * np.pi * _WINDOW**2), 0) for part in (explained, misfit))
    return np.asarray((e + _CHANCE) / (e + x + _CHANCE), np.float32)
