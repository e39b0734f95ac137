"""A focus measure that noise does not bias, and the depths at which it peaks."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.initialization import back_projection

# Spacings of the blurs, of standard deviations 1 and 4 samples, that limit the detail: finer is noise, coarser is blur.
_FINE = (1, 1)
_COARSE = (1, 1, 1, 1, 2, 2, 2, 4)

# Smallest prominence of a peak, relative to the range of the curve and in standard deviations of the noise.
_MIN_PROMINENCE, _MIN_SIGMAS = 0.1, 5.0

# Correlated samples of a product of two smoothed noises: 2π times the fine scale squared.
_CORRELATED_SAMPLES = 2 * np.pi


class FocusMeasure(NamedTuple):
    """The power of detail at one depth, and its standard deviation due to noise, both in e⁻²."""

    detail_e2: float
    sigma_e2: float


def focus_measure(
    operator: SceneOperator, images: ElementalImages, halves: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> FocusMeasure:
    """Return the power of fine detail that two halves of the views agree on.

    Each half is back-projected separately and band-passed. Noise is independent between the halves and averages out of
    the product, while detail of an object at this depth is the same in both. Detail of objects elsewhere is blurred.

    Parameters
    ----------
    operator : SceneOperator
        H of a plane.
    images : ElementalImages
        All views.
    halves : two int arrays
        The views of each half, preferably the two colours of a checkerboard of nodes.
    """
    first, second = (_detail(back_projection(operator, images, half)) for half in halves)
    both = (operator.sensitivity(halves[0]) >= 1) & (operator.sensitivity(halves[1]) >= 1)
    if not both.any():
        return FocusMeasure(0.0, 0.0)
    product = (first * second)[both].astype(np.float64)
    return FocusMeasure(float(product.mean()), float(np.sqrt(np.mean(product**2) * _CORRELATED_SAMPLES / product.size)))


def sharp_depths_mm(depths_mm: Sequence[float], curve: Sequence[FocusMeasure]) -> list[float]:
    """Return the depths at which a focus curve peaks, each refined by a parabola through its neighbours.

    A peak counts when it stands out by a tenth of the curve's range and by five standard deviations of the noise. The
    noise is the median over the depths, because sharp detail adds to it where it is.
    """
    if len(curve) < 3:
        return []
    order = np.argsort(depths_mm)
    depth = np.asarray(depths_mm, float)[order]
    detail = np.array([point.detail_e2 for point in curve])[order]
    noise_e2 = float(np.median([point.sigma_e2 for point in curve]))
    threshold = max(_MIN_PROMINENCE * float(np.ptp(detail)), _MIN_SIGMAS * noise_e2)
    peaks = [index for index in range(len(detail)) if prominence(detail, index) > threshold]
    return [_vertex(depth, detail, peak) for peak in peaks]


def prominence(curve: NDArray[np.floating], peak: int) -> float:
    """Return the prominence of a peak: its height above the lower ground that separates it from a higher one."""
    height = curve[peak]
    lowest = []
    for side in (curve[:peak][::-1], curve[peak + 1 :]):
        higher = np.flatnonzero(side > height)
        ground = side[: higher[0]] if higher.size else side
        lowest.append(ground.min() if ground.size else (height if higher.size else curve.min()))
    return float(height - max(lowest))


def _detail(plane: Image) -> Image:
    """Return the plane between the fine and the coarse scale."""
    return blurred(plane, _FINE) - blurred(plane, _COARSE)


def _vertex(depth: NDArray[np.floating], curve: NDArray[np.floating], peak: int) -> float:
    """Return the maximum of the parabola through a peak and its neighbours; at an end of the curve, the end."""
    if not 0 < peak < len(depth) - 1:
        return float(depth[peak])
    a, b, _ = np.polyfit(depth[peak - 1 : peak + 2] - depth[peak], curve[peak - 1 : peak + 2], 2)
    return float(depth[peak] - b / (2 * a)) if a < 0 else float(depth[peak])
