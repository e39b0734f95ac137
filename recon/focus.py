"""Where something is sharp: a focus measure that noise does not bias."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter
from scipy.signal import find_peaks

from recon.images import ElementalImages
from recon.operator import PlaneOperator
from recon.solvers import back_projection

# Details between these two scales count: finer ones are noise, coarser ones are blur.
_FINE_PX, _COARSE_PX = 1.0, 4.0

_LEAST_PROMINENCE = 0.1


def focus_measure(
    operator: PlaneOperator, images: ElementalImages, halves: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> float:
    """Return the power of fine detail that two halves of the views agree on, in e⁻².

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
    return float(np.mean(first[both] * second[both], dtype=np.float64)) if both.any() else 0.0


def sharp_depths_mm(depths_mm: Sequence[float], measures: Sequence[float]) -> list[float]:
    """Return the depths at which a focus curve peaks, each refined by a parabola through its neighbours.

    A peak counts when it stands out by a tenth of the curve's range.
    """
    order = np.argsort(depths_mm)
    depth, curve = np.asarray(depths_mm, float)[order], np.asarray(measures, float)[order]
    span = float(np.ptp(curve)) if len(curve) else 0.0
    if len(curve) < 3 or span == 0:
        return []
    padded = np.concatenate([[curve.min()], curve, [curve.min()]])
    peaks, _ = find_peaks(padded, prominence=_LEAST_PROMINENCE * span)
    return [_vertex(depth, curve, int(peak) - 1) for peak in peaks]


def _detail(plane: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return the plane between the fine and the coarse scale."""
    return np.asarray(gaussian_filter(plane, _FINE_PX) - gaussian_filter(plane, _COARSE_PX))


def _vertex(depth: NDArray[np.floating], curve: NDArray[np.floating], peak: int) -> float:
    """Return where the parabola through a peak and its neighbours has its top; at an end, the end itself."""
    if not 0 < peak < len(depth) - 1:
        return float(depth[peak])
    a, b, _ = np.polyfit(depth[peak - 1 : peak + 2] - depth[peak], curve[peak - 1 : peak + 2], 2)
    return float(depth[peak] - b / (2 * a)) if a < 0 else float(depth[peak])
