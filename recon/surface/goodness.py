"""Goodness of a surface: the samples that have light, the part of the views' detail that it explains, and the rest."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.surface.blur import gaussian
from faintfield.recon.surface.evidence import DepthEvidence, detail
from faintfield.recon.surface.held_out import seen_of, squared_errors
from faintfield.recon.surface.pinhole_views import PinholeViews

# Scale of the window in samples over which light is gathered: that of the smallest window in which depths are compared.
_LIGHT_WINDOW = 1.5

# Smallest light, in standard deviations of its noise and relative to the picture's level: less may be stray light.
_MIN_SIGMAS, _MIN_LIGHT = 4.0, 0.03

# Scale of the window in samples over which detail is gathered, and of the blur that light is compared with.
_WINDOW, _DETAIL = 6.0, 6.0

# Log-likelihood that chance may add to both, in a window.
_CHANCE = 100.0


def lit_samples(views: PinholeViews, inverse_depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the samples (row, column) of a surface whose light stands out of noise: black looks alike at any depth.

    Counts the mean, over a small window, of what all views show of the surface. The picture's level is its root mean
    square.

    Parameters
    ----------
    views : PinholeViews
        The views.
    inverse_depth : float array (row, column)
        1/depth of the surface.
    """
    operator = views.surface_operator(inverse_depth)
    count = np.maximum(gaussian(operator.sensitivity(), _LIGHT_WINDOW), np.float32(1e-3))
    light = np.maximum(gaussian(operator.adjoint(views.light_e), _LIGHT_WINDOW) / count, 0)
    sigma = np.sqrt((light + views.variance_e2) / (count * 4 * np.pi * _LIGHT_WINDOW**2))
    level = np.sqrt(np.mean(np.square(light, dtype=np.float64)))
    return np.asarray((light > _MIN_SIGMAS * sigma) & (light > _MIN_LIGHT * level))


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
