"""Where something is sharp: a focus measure that noise does not bias."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane import PlaneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.starts import back_projection

# Detail between standard deviations of 1 and 4 samples counts: finer is noise, coarser is blur.
_FINE = (1, 1)
_COARSE = (1, 1, 1, 1, 2, 2, 2, 4)

_LEAST_PROMINENCE, _LEAST_SIGMAS = 0.1, 5.0

# Over so many samples (2π times the fine scale squared) a product of two smoothed noises repeats itself.
_CORRELATED_SAMPLES = 2 * np.pi


class Focus(NamedTuple):
    """The power of detail at one depth, and the standard deviation that noise gives it, both in e⁻²."""

    detail_e2: float
    sigma_e2: float


def focus_measure(
    operator: PlaneOperator, images: ElementalImages, halves: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> Focus:
    """Return the power of fine detail that two halves of the views agree on.

    Each half is back-projected by itself and band-passed; noise is independent between the halves and averages out of
    the product, while detail of an object at this depth is the same in both. Detail of objects elsewhere is spread.

    Parameters
    ----------
    operator : PlaneOperator
        Of the plane in question.
    images : ElementalImages
        All views.
    halves : two int arrays
        The views of either half: best the two colours of a checkerboard of nodes.
    """
    first, second = (_detail(back_projection(operator, images, half)) for half in halves)
    both = (operator.sensitivity(halves[0]) >= 1) & (operator.sensitivity(halves[1]) >= 1)
    if not both.any():
        return Focus(0.0, 0.0)
    product = (first * second)[both].astype(np.float64)
    return Focus(float(product.mean()), float(np.sqrt(np.mean(product**2) * _CORRELATED_SAMPLES / product.size)))


def sharp_depths_mm(depths_mm: Sequence[float], curve: Sequence[Focus]) -> list[float]:
    """Return the depths at which a focus curve peaks, each refined by a parabola through its neighbours.

    A peak counts when it stands out by a tenth of the curve's range and by five standard deviations of the noise, the
    median of what the depths say of it (where something is sharp, that itself adds to the spread).
    """
    if len(curve) < 3:
        return []
    order = np.argsort(depths_mm)
    depth = np.asarray(depths_mm, float)[order]
    detail = np.array([point.detail_e2 for point in curve])[order]
    noise_e2 = float(np.median([point.sigma_e2 for point in curve]))
    least = max(_LEAST_PROMINENCE * float(np.ptp(detail)), _LEAST_SIGMAS * noise_e2)
    peaks = [index for index in range(len(detail)) if prominence(detail, index) > least]
    return [_vertex(depth, detail, peak) for peak in peaks]


def prominence(curve: NDArray[np.floating], peak: int) -> float:
    """Return how far one must come down from a peak before going up higher; zero beside a higher neighbour."""
    height = curve[peak]
    lowest = []
    for side in (curve[:peak][::-1], curve[peak + 1 :]):
        higher = np.flatnonzero(side > height)
        way = side[: higher[0]] if higher.size else side
        lowest.append(way.min() if way.size else (height if higher.size else curve.min()))
    return float(height - max(lowest))


def _detail(plane: Image) -> Image:
    """Return the plane between the fine and the coarse scale."""
    return blurred(plane, _FINE) - blurred(plane, _COARSE)


def _vertex(depth: NDArray[np.floating], curve: NDArray[np.floating], peak: int) -> float:
    """Return where the parabola through a peak and its neighbours has its top; at an end, the end itself."""
    if not 0 < peak < len(depth) - 1:
        return float(depth[peak])
    a, b, _ = np.polyfit(depth[peak - 1 : peak + 2] - depth[peak], curve[peak - 1 : peak + 2], 2)
    return float(depth[peak] - b / (2 * a)) if a < 0 else float(depth[peak])
