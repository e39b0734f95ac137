"""Depths in focus: where detail peaks, where much of the picture lies, and the focus of views that come one by one."""

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.depth.agreement import Agreement, DepthEstimate
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.solver.initialization import back_projection

# Spacings of the blurs, of standard deviations 1 and 4 samples, that limit the detail: finer is noise, coarser is blur.
_FINE = (1, 1)
_COARSE = (1, 1, 1, 1, 2, 2, 2, 4)

# Smallest prominence of a peak, relative to the range of a focus curve or to the highest peak of a distribution over
# depth, and in standard deviations of a focus curve's noise.
_MIN_PROMINENCE, _MIN_SIGMAS = 0.1, 5.0

# Smallest probability of a sample's depth for the sample to count.
SURE = 0.9

# Fewest samples of a plane, a number and a share of the sure samples, and their largest distance in steps of the sweep.
MIN_SAMPLES, _MIN_SHARE, _REACH = 12, 0.02, 1.5

# Correlated samples of a product of two smoothed noises: 2π times the fine scale squared.
_CORRELATED_SAMPLES = 2 * np.pi

# Least coverage of each half, in views, of samples whose detail counts.
_MIN_COVERAGE = 0.5


class FocusMeasure(NamedTuple):
    """The power of detail at one depth, and its standard deviation due to noise, both in (e⁻)²."""

    detail_e2: float
    sigma_e2: float


def focus_measure(
    operator: SceneOperator, images: ElementalImages, halves: tuple[NDArray[np.intp], NDArray[np.intp]]
) -> FocusMeasure:
    """Return the power of fine detail of a plane that two halves of the views agree on.

    Each half is back-projected separately and band-passed. Noise is independent between the halves and averages out of
    the product, while detail of an object at this depth is the same in both. Detail of objects elsewhere is blurred.
    The halves are preferably the two colours of a checkerboard of nodes.
    """
    first, second = (back_projection(operator, images, half) for half in halves)
    both = (operator.sensitivity(halves[0]) >= 1) & (operator.sensitivity(halves[1]) >= 1)
    return shared_detail(first, second, both)


def shared_detail(first: Image, second: Image, both: NDArray[np.bool_]) -> FocusMeasure:
    """Return the power of fine detail that two back-projections (row, column) share where `both` have data."""
    if not both.any():
        return FocusMeasure(0.0, 0.0)
    product = (_detail(first) * _detail(second))[both].astype(np.float64)
    return FocusMeasure(float(product.mean()), float(np.sqrt(np.mean(product**2) * _CORRELATED_SAMPLES / product.size)))


def sharp_depths_mm(depths_mm: Sequence[float], curve: Sequence[FocusMeasure]) -> list[float]:
    """Return the depths at which a focus curve peaks, each refined by a parabola through its neighbours.

    A peak stands out by a tenth of the curve's range and by five standard deviations of the noise: the median over the
    depths, because sharp detail adds to it where it is. An end of the curve is no peak: it may rise beyond.
    """
    order = np.argsort(depths_mm)
    depth = np.asarray(depths_mm, float)[order]
    detail = np.array([point.detail_e2 for point in curve])[order]
    noise_e2 = float(np.median([point.sigma_e2 for point in curve]))
    threshold = max(_MIN_PROMINENCE * float(np.ptp(detail)), _MIN_SIGMAS * noise_e2)
    peaks = [index for index in range(1, len(detail) - 1) if prominence(detail, index) > threshold]
    return [_vertex(depth, detail, peak) for peak in peaks]


def places_of_focus(depths: DepthEstimate, planes: int) -> list[NDArray[np.bool_]]:
    """Return the samples (row, column) of each depth at which much of the picture lies, in the order of depths.

    These are the peaks of the sure samples' distribution over the `planes` of the sweep that stand out by a tenth of
    the highest and hold at least one in fifty of these samples. There are none if fewer than `MIN_SAMPLES` are sure.
    """
    sure = depths.confidence >= SURE
    if np.count_nonzero(sure) < MIN_SAMPLES:
        return []
    histogram = np.bincount(np.rint(depths.index[sure]).astype(int), minlength=planes)
    counts = np.convolve(histogram, (0.25, 0.5, 0.25))[1:-1]
    fewest = max(MIN_SAMPLES, _MIN_SHARE * np.count_nonzero(sure))
    peaks = [peak for peak in range(planes) if prominence(counts, peak) > _MIN_PROMINENCE * counts.max()]
    places = [sure & (np.abs(depths.index - peak) <= _REACH) for peak in peaks]
    return [place for place in places if np.count_nonzero(place) >= fewest]


def sure_of_lit(confidence: Image, lit_share: float) -> float:
    """Return the share of the samples with light whose depth is sure."""
    return min(float(np.mean(confidence >= SURE)) / max(lit_share, 1e-9), 1.0)


def likeliest_depth_mm(planes: Sequence[Agreement], depths_mm: Sequence[float], place: NDArray[np.bool_]) -> float:
    """Return the depth at which the views agree best on all samples of a place (row, column), by a parabola.

    The depths are in equal steps of 1/depth, and the planes have samples of the same angular pitch.
    """
    squares = np.array([plane.squares[place].sum(dtype=np.float64) for plane in planes])
    degrees = np.array([(plane.sensitivity[place] - 1).sum(dtype=np.float64) for plane in planes])
    reduced = squares / np.maximum(degrees, 1e-9)
    inverse = 1 / np.asarray(depths_mm)
    best = int(reduced.argmin())
    if not 0 < best < len(planes) - 1:
        return float(depths_mm[best])
    before, here, after = reduced[best - 1 : best + 2]
    bend = before - 2 * here + after
    offset = 0.5 * (before - after) / bend if bend > 0 else 0.0
    return float(1 / (inverse[best] + offset * (inverse[best + 1] - inverse[best])))


def prominence(curve: Image, peak: int) -> float:
    """Return the prominence of a peak: its height above the lower ground that separates it from a higher one."""
    height = curve[peak]
    lowest = []
    for side in (curve[:peak][::-1], curve[peak + 1 :]):
        higher = np.flatnonzero(side > height)
        ground = side[: higher[0]] if higher.size else side
        lowest.append(ground.min() if ground.size else (height if higher.size else curve.min()))
    return float(height - max(lowest))


def _detail(plane: Image) -> Image:
    return blurred(plane, _FINE) - blurred(plane, _COARSE)


def _vertex(depth: Image, curve: Image, peak: int) -> float:
    """Return the maximum of the parabola through a peak and its neighbours."""
    a, b, _ = np.polyfit(depth[peak - 1 : peak + 2] - depth[peak], curve[peak - 1 : peak + 2], 2)
    return float(depth[peak] - b / (2 * a)) if a < 0 else float(depth[peak])


class SeenByView(NamedTuple):
    """Light Hᵀ(g − b) and coverage Hᵀ H 1 of one view on a plane, both (row, column)."""

    light: Image
    coverage: Image

    def mean(self) -> Image:
        """Return the back-projection of the view alone, zero where it sees nothing."""
        return _quotient(self.light, self.coverage)


def seen_by_view(operator: PlaneOperator, images: ElementalImages, share: float = 1.0) -> SeenByView:
    """Return the light and coverage of the views of an operator, usually one.

    `share` is the exposure of the images relative to that of a whole view: the mean is in electrons of a whole view.
    """
    light = operator.adjoint(images.electrons)
    if np.any(images.background_e):
        light -= operator.adjoint_of_map(images.background_e)
    return SeenByView(light, operator.coverage() * operator.dtype.type(share))


class RunningPlane:
    """Sums over the views of one plane (row, column) so far, in two halves; adding a view takes no other view.

    Once all views are added, `mean` is their `back_projection` within rounding. It takes four arrays of the size of the
    plane, however many views there are.
    """

    def __init__(self, shape: tuple[int, int]) -> None:
        self._light = np.zeros((2, *shape), np.float32)
        self._coverage = np.zeros((2, *shape), np.float32)

    def add(self, view: SeenByView, half: int) -> None:
        """Add a view to one half, 0 or 1."""
        self._light[half] += view.light
        self._coverage[half] += view.coverage

    def remove(self, view: SeenByView, half: int) -> None:
        """Take away a view that was added before; rounding leaves a part in ten million."""
        self._light[half] -= view.light
        self._coverage[half] -= view.coverage

    @property
    def covered(self) -> NDArray[np.bool_]:
        """Mask of the samples that at least half a view sees."""
        return np.asarray(self._coverage.sum(axis=0) > _MIN_COVERAGE)

    def mean(self) -> Image:
        """Return the back-projection of all views so far (row, column), in electrons; zero where none sees it."""
        return _quotient(self._light.sum(axis=0), self._coverage.sum(axis=0))

    def focus(self) -> FocusMeasure:
        """Return the power of fine detail that the halves agree on; zero while one of them is empty."""
        both = (self._coverage > _MIN_COVERAGE).all(axis=0)
        first, second = (_quotient(*half) for half in zip(self._light, self._coverage, strict=True))
        return shared_detail(first, second, both)


def _quotient(light: Image, coverage: Image) -> Image:
    return np.divide(light, coverage, out=np.zeros_like(light), where=coverage > 1e-3)
