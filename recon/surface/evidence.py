"""Evidence of the views for each depth of each sample: log-likelihood ratios against a surface assumed so far."""

from collections.abc import Callable
from dataclasses import dataclass, replace
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.surface_operator import SurfaceOperator
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews, gather, gaussian
from faintfield.recon.threads import map_in_threads

# Weights of total variation in units of the noise: of the light at each depth, and of the light of the surface.
_OF_DEPTH, _OF_SURFACE = 0.6, 1.15

# Steps of the proximal problems: the light is good enough long before its minimum.
_STEPS = 40

# Views below which the light of a sample follows its neighbours.
_FEW_VIEWS = 8.0

# Scales of blurs in samples: of light that few views see, of a view where it sees no part of the surface, and of the
# surface's light, from which its detail is counted.
_SPARSE, _UNSEEN_LIGHT, _DETAIL = 4.0, 5.0, 2.0

# The same of light at one depth while no surface is known, and the scale of the light in the variance.
_COARSE_DETAIL, _MEAN_LIGHT = 12.0, 8.0

# Least variance as a share of that of the mean light: without background and read noise, pixels in the dark have none.
_LEAST_VARIANCE = 1e-3

# A view does not count where something hides a sample that lies at least this many samples away from it in the picture.
_REACH = 8.0


class Halves(NamedTuple):
    """Two halves of the views, which share the scene but not the noise; views in neither are left out."""

    first: NDArray[np.intp]
    second: NDArray[np.intp]


class Ratios(NamedTuple):
    """Log-likelihood ratios (row, column, depth) of each depth against a surface.

    `own` are those of the light that the views show at each depth, and `both` the mean of these and of those of the
    surface's light at each depth.
    """

    own: Image
    both: Image


@dataclass(frozen=True)
class Explained:
    """A surface by its H and its relief, 1/depth at each pixel (view, row, column), 0 where it sees no sample.

    `lights` is the light (row, column) as each half of the views shows it.
    """

    operator: SurfaceOperator
    relief: NDArray[np.float32]
    lights: list[Image]

    def light(self) -> NDArray[np.float32]:
        """Return the light (row, column) by both halves."""
        return np.asarray(np.mean(self.lights, axis=0), np.float32)


class DepthEvidence:
    """The evidence for each depth of a sweep, 1/depth ascending in equal steps.

    The views that count are in two halves: depths are found in one by the light of the other.
    """

    def __init__(self, views: PinholeViews, inverse_depths: NDArray[np.float64], halves: Halves) -> None:
        self.views, self.inverse_depths, self.halves = views, inverse_depths, halves
        self._numbers = np.concatenate(halves)
        self._half = np.repeat(np.arange(2), [len(half) for half in halves])
        self._subset = replace(
            views,
            light_e=np.ascontiguousarray(views.light_e[self._numbers]),
            ray_from_surface=views.ray_from_surface[self._numbers],
            nodes=views.nodes[self._numbers],
        )
        middle = self._sums(self._stack(), float(np.median(inverse_depths)), *self._unhidden())
        mean = blurred_mean(middle[0, 1] + middle[1, 1], middle[0, 0] + middle[1, 0], _MEAN_LIGHT)
        variance = np.maximum(mean, 0) + np.float32(views.variance_e2)
        self.variance = np.maximum(variance, np.float32(max(_LEAST_VARIANCE * float(variance.mean()), 1e-6)))

    def at_first(self) -> Image:
        """Return the evidence (row, column, depth) before any surface is known: both halves show alike detail there."""
        stack, unhidden = self._stack(), self._unhidden()

        def ratio(inverse_depth: float) -> list[Image]:
            sums = self._sums(stack, inverse_depth, *unhidden)
            lights = [denoised(sum_e, count, self.variance, _OF_DEPTH) for count, sum_e in sums]
            total = np.zeros_like(self.variance)
            for (count, sum_e), other in zip(sums, reversed(lights), strict=True):
                light = detail(other, count, _COARSE_DETAIL)
                seen = detail(sum_e / np.maximum(count, 0.5), count, _COARSE_DETAIL)
                total += count * (seen * light - 0.5 * light**2)
            return [total]

        return self._of_all_depths(ratio, 1)[0]

    def explained(self, index: Image) -> Explained:
        """Return the light of a surface, given as fractional index of the depths (row, column)."""
        q = np.interp(index, np.arange(len(self.inverse_depths)), self.inverse_depths)
        operator = self.views.surface_operator(q)
        samples, relief = np.ones(self.variance.shape, np.float32), operator.inverse_depth_of_pixels()
        for view, seen in enumerate(relief):  # one at a time: all together are as large as the images
            seen[operator.forward(samples, [view])[0] == 0] = 0
        sums = [(operator.adjoint(self.views.light_e, half), operator.sensitivity(half)) for half in self.halves]
        return Explained(
            operator, relief, [denoised(*of_half, self.variance, _OF_SURFACE, workers=None) for of_half in sums]
        )

    def against(self, known: Explained) -> Ratios:
        """Return the evidence for each depth against a surface and its light."""
        stack = self._stack(self._explanation(known))
        relief, tolerance = known.relief[self._numbers], _REACH / np.maximum(self._subset.reach, np.float32(1e-9))
        details = [detail(light, np.ones_like(light), _DETAIL) for light in known.lights]

        def ratio(inverse_depth: float) -> list[Image]:
            sums = self._sums(stack, inverse_depth, relief, tolerance)
            lights = [denoised(sum_e, count, self.variance, _OF_DEPTH) for count, sum_e, _ in sums]
            own, matched = np.zeros_like(self.variance), np.zeros_like(self.variance)
            others = zip(reversed(lights), reversed(details), strict=True)
            for (count, sum_e, of_known), (light, of_surface) in zip(sums, others, strict=True):
                own += sum_e * light - np.float32(0.5) * count * light**2 - of_known
                matched += count * detail(sum_e / np.maximum(count, 0.5), count, _DETAIL) * of_surface
            return [own, np.float32(0.5) * (own + matched)]

        return Ratios(*self._of_all_depths(ratio, 2))

    def _explanation(self, known: Explained) -> Image:
        """Return the log-likelihood of each pixel (view, row, column) that counts, by the light of the surface."""
        explained = []
        for half, light in zip(self.halves, reversed(known.lights), strict=True):
            expected = known.operator.forward(light, half)
            for view, seen in zip(half, expected, strict=True):
                picture = self.views.light_e[view]
                around = gaussian(np.where(picture > UNKNOWN, picture, 0), _UNSEEN_LIGHT)
                light_e = np.where(known.relief[view] > 0, seen, around)
                explained.append(picture * light_e - np.float32(0.5) * light_e**2)
        return np.stack(explained)

    def _stack(self, *further: Image) -> NDArray[np.float32]:
        """Return pictures (view, row, column, number) of the views that count: their light, and further numbers."""
        return np.stack([self._subset.light_e, *further], axis=-1)

    def _unhidden(self) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """Return a relief and tolerances by which nothing is hidden."""
        return np.zeros_like(self._subset.light_e), np.full(len(self._numbers), np.inf, np.float32)

    def _sums(self, stack: Image, inverse_depth: float, relief: Image, tolerance: Image) -> Image:
        return gather(self._subset, stack, inverse_depth, relief, tolerance, self._half)

    def _of_all_depths(self, ratios: Callable[[float], list[Image]], count: int) -> list[Image]:
        """Return the results of a function of each depth (row, column, depth), per unit of the noise's variance."""
        volumes = [np.empty((*self.variance.shape, len(self.inverse_depths)), np.float32) for _ in range(count)]

        def work(number: int) -> None:
            for volume, found in zip(volumes, ratios(float(self.inverse_depths[number])), strict=True):
                volume[:, :, number] = found / self.variance

        map_in_threads(work, range(len(self.inverse_depths)))
        return volumes


def denoised(
    sum_e: Image, count: Image, variance: Image | np.float32, strength: float, workers: int | None = 1
) -> NDArray[np.float32]:
    """Return light (row, column) from its sum over views, smoothed by total variation as its noise asks for.

    `variance` is that of a pixel of one view, and `strength` the weight of total variation in units of the noise.
    """
    share = np.clip(count / np.float32(_FEW_VIEWS), 0, 1)
    light = share * sum_e / np.maximum(count, np.float32(0.5)) + (1 - share) * blurred_mean(sum_e, count, _SPARSE)
    metric = np.maximum(count, np.float32(1)) / variance
    weight = strength * float(np.sqrt(np.median(metric)))
    dual = DualField.zero([light.shape], np.dtype(np.float32))
    dual = dual if workers is None else replace(dual, workers=workers)
    return np.asarray(dual.prox(light, metric, weight, Penalty(), lambda _: 0.0, _STEPS).plane, np.float32)


def blurred_mean(sum_e: Image, count: Image, scale: float) -> Image:
    """Return blurred sums over blurred numbers of views."""
    blurred = gaussian(count, scale)
    return np.asarray(gaussian(sum_e, scale) / np.maximum(blurred, np.float32(0.3)), np.float32)


def detail(light: Image, count: Image, scale: float) -> Image:
    """Return light less its mean over neighbours, weighted by the views that see them."""
    return np.asarray(light - blurred_mean(light * count, count, scale))
