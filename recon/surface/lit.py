"""Mask of the samples of a surface that have light: black looks alike at all depths, so that nothing tells its own."""

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.surface.blur import gaussian
from faintfield.recon.surface.pinhole_views import PinholeViews

# Scale of the window in samples over which light is gathered: that of the smallest window in which depths are compared.
_WINDOW = 1.5

# Smallest light, in standard deviations of its noise and relative to the picture's level: less may be stray light.
_MIN_SIGMAS, _MIN_LIGHT = 4.0, 0.03


def lit_samples(views: PinholeViews, inverse_depth: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Return the samples (row, column) of a surface whose light stands out of the noise.

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
    count = np.maximum(gaussian(operator.sensitivity(), _WINDOW), np.float32(1e-3))
    light = np.maximum(gaussian(operator.adjoint(views.light_e), _WINDOW) / count, 0)
    sigma = np.sqrt((light + views.variance_e2) / (count * 4 * np.pi * _WINDOW**2))
    level = np.sqrt(np.mean(np.square(light, dtype=np.float64)))
    return np.asarray((light > _MIN_SIGMAS * sigma) & (light > _MIN_LIGHT * level))
