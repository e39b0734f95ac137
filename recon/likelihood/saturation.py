"""Consequences of saturated pixels, which do not count: samples of unknown light, and the bias of the others.

Of the pixels that see a sample, noise decides which ones stay below saturation: those that count are the darker ones.
If a share q of normal values is cut off at the top, the mean of the rest is too low by `σ φ(z)/(1 − q)`, where z is the
quantile of 1 − q.
"""

from statistics import NormalDist

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image

# Least share of a sample's pixels that must count: if most are saturated, so is the median of the light.
_LEAST_COUNTED = 0.5

_NORMAL = NormalDist()

# Shares that are cut off, and the bias of the rest in standard deviations of a pixel.
_CUT_OFF = np.concatenate([[0.0], np.geomspace(1e-4, 0.5, 30), 1 - np.geomspace(0.45, 1e-3, 30)])
_BIAS = np.array([0.0, *(_NORMAL.pdf(_NORMAL.inv_cdf(1 - share)) / (1 - share) for share in _CUT_OFF[1:].tolist())])


def unknown_samples(counted: Image, whole: Image) -> NDArray[np.bool_]:
    """Return the samples most of whose pixels are saturated, by the sensitivity without and with these.

    The pixels that count would show less light than saturation, and the truth is more.
    """
    return np.asarray(counted < _LEAST_COUNTED * whole)


def bias_of_selection(counted: Image, whole: Image) -> Image:
    """Return by how much the pixels that count may be too dark, in standard deviations of a pixel's noise."""
    share = 1 - np.divide(counted, whole, out=np.ones_like(whole), where=whole > 0)
    return np.asarray(np.interp(share, _CUT_OFF, _BIAS), counted.dtype)
