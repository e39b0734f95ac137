"""Detail that total variation lost, from the back-projection: a collaborative Wiener filter with the picture as pilot."""

from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.collaborative_kernels import filter_rows
from faintfield.recon.threads import run_in_threads


class Noise(NamedTuple):
    """Second moments of the noise of a picture: `Cov(p, p + d) = variance[p] · kernel[1 + d]`."""

    variance: NDArray[np.float32]
    kernel: NDArray[np.float64]


def collaborative_wiener(
    picture, pilot, noise, *, sizes=((8, 4, 16), (12, 5, 18)), members=64, workers=None
):
    total = np.zeros_like(pilot)
    for size, step, radius in sizes:
        total += _filtered(picture, pilot, noise, size, step, radius, members, workers or int(numba.config.NUMBA_NUM_THREADS))
    return total / len(sizes)


def _filtered(picture, pilot, noise, size, step, radius, members, workers):
    above, below = np.zeros_like(pilot), np.zeros_like(pilot)
    hidden = np.where(np.isfinite(noise.variance), pilot, np.float32(np.nan))
    rows, columns = (_corners(n, size, step) for n in pilot.shape)
    cosines = _cosines(size)
    kaiser = np.kaiser(size, 2.0)
    transform = (cosines, coefficient_variances(noise.kernel, cosines), np.outer(kaiser, kaiser).astype(np.float32))
    height = 2 * radius + size
    strips = [rows[rows // height == k] for k in range(rows[-1] // height + 1)]
    for first in (0, 1):
        def work(worker):
            for strip in strips[first::2][worker::workers]:
                filter_rows(picture, hidden, noise.variance, strip, columns, (radius, members), transform, above, below)
        run_in_threads(work, range(workers))
    return np.where(below > 0, above / np.where(below > 0, below, 1), pilot)


def _corners(n, size, step):
    r = np.arange(0, n - size + 1, step)
    return r if r[-1] == n - size else np.append(r, n - size)


def _cosines(size):
    k, i = np.arange(size)[:, None], np.arange(size)
    c = np.sqrt(2 / size) * np.cos(np.pi * k * (2 * i + 1) / (2 * size))
    c[0] = np.sqrt(1 / size)
    return c.astype(np.float32)


def coefficient_variances(kernel, cosines):
    size = len(cosines)
    out = np.zeros((size, size))
    c = cosines.astype(np.float64)
    for a in (-1, 0, 1):
        for b in (-1, 0, 1):
            ra, rb = (np.einsum("ki,ij,kj->k", c, np.eye(size, k=d), c) for d in (a, b))
            out += kernel[1 + a, 1 + b] * np.outer(ra, rb)
    return out.astype(np.float32)
