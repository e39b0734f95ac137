"""What the views say of each depth of each sample: log-likelihood ratios against a surface assumed so far."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.operator.surface_operator import SurfaceOperator
from faintfield.recon.solver.penalties import Penalty
from faintfield.recon.solver.proximal import DualField

# Weights of total variation in units of the noise: of the light at each depth, and of the light of the surface.
_OF_DEPTH, _OF_SURFACE = 0.6, 1.15

# Steps of the proximal problems: the light is good enough long before its minimum.
_STEPS = 40

# Views below which the light of a sample follows its neighbours.
_FEW_VIEWS = 8.0

# Scales of blurs in samples: of light that few views see, of a view where it sees no part of the surface, and of the
# surface's light, from which its detail is counted.
_SPARSE, _UNSEEN_LIGHT, _DETAIL = 4.0, 5.0, 4.0

# A view does not count where something hides a sample that lies at least this many samples away from it in the picture.
_REACH = 8.0


@dataclass(frozen=True)
class Half:
    """One half of the views: its numbers, its images, and its operators."""

    views: NDArray[np.intp]
    light_e: Image


class DepthEvidence:
    """The evidence for each depth of a sweep, from two halves of the views that share the scene but not the noise.

    Parameters
    ----------
    inverse_depths : float array (depth,)
        1/depth, ascending in equal steps.
    planes : sequence of PlaneOperator
        H of the plane at each.
    surface : callable
        Returns H of the surface with 1/depth (row, column).
    images : ElementalImages
        The views.
    halves : two int arrays
        The views of each half.
    reach : float array (view,)
        Parallax of each view in samples per 1/depth.
    """

    def __init__(
        self,
        inverse_depths: NDArray[np.float64],
        planes: Sequence[PlaneOperator],
        surface: Callable[[NDArray[np.floating]], SurfaceOperator],
        images: ElementalImages,
        halves: tuple[NDArray[np.intp], NDArray[np.intp]],
        reach: NDArray[np.floating],
    ) -> None:
        self.inverse_depths = inverse_depths
        self._planes, self._surface, self._halves = planes, surface, halves
        self._light = images.electrons - np.float32(images.background_e)
        middle = planes[len(planes) // 2]
        mean = _ratio(middle.adjoint(self._light), middle.sensitivity(), _DETAIL * 2)
        self.variance = np.maximum(mean, 0) + np.float32(np.mean(images.known_variance_e2()))
        self._reach = reach.astype(np.float32)
        self._blurred = [
            np.stack([cv2.GaussianBlur(image, (0, 0), _UNSEEN_LIGHT) for image in self._light[half]]) for half in halves
        ]

    def against(self, index: NDArray[np.floating] | None) -> Image:
        """Return the evidence (row, column, depth) for each depth given a surface, as fractional index of the depths."""
        shape = self._planes[0].samples_shape
        evidence = np.zeros((*shape, len(self._planes)), np.float32)
        if index is None:
            for number, plane in enumerate(self._planes):
                sums = [(plane.adjoint(self._light, half), plane.sensitivity(half)) for half in self._halves]
                lights = [self._denoised(*pair, _OF_DEPTH) for pair in sums]
                for (sum_e, views), other in zip(sums, reversed(lights), strict=True):
                    detail, seen = _detail(other, views, 3 * _DETAIL), _detail(sum_e / np.maximum(views, 0.5), views, 3 * _DETAIL)
                    evidence[:, :, number] += views * (seen * detail - 0.5 * detail**2) / self.variance
            return evidence
        q = np.interp(index, np.arange(len(self._planes)), self.inverse_depths)
        operator = self._surface(q)
        relief = operator.inverse_depth_of_pixels()
        lights = [self._denoised(operator.adjoint(self._light, half), operator.sensitivity(half), _OF_SURFACE) for half in self._halves]
        explained = []
        for half, light, blurred in zip(self._halves, reversed(lights), self._blurred, strict=True):
            expected = np.where(relief[half] > 0, operator.forward(light, half), blurred)
            explained.append(self._light[half] * expected - 0.5 * expected**2)
        details = [_detail(light, np.ones_like(light), _DETAIL) for light in lights]
        for number, plane in enumerate(self._planes):
            nearer = (relief - np.float32(self.inverse_depths[number])) * self._reach[:, np.newaxis, np.newaxis]
            visible = nearer <= _REACH
            sums = []
            for half, known in zip(self._halves, explained, strict=True):
                stack = np.zeros_like(self._light)
                stack[half] = visible[half]
                views = plane.adjoint(stack, half)
                stack[half] *= self._light[half]
                sum_e = plane.adjoint(stack, half)
                stack[half] = known * visible[half]
                sums.append((sum_e, views, plane.adjoint(stack, half)))
            own = [self._denoised(sum_e, views, _OF_DEPTH) for sum_e, views, _ in sums]
            for (sum_e, views, known), light, detail in zip(sums, reversed(own), reversed(details), strict=True):
                ratio = sum_e * light - 0.5 * views * light**2 - known
                matched = views * _detail(sum_e / np.maximum(views, 0.5), views, _DETAIL) * detail
                evidence[:, :, number] += 0.5 * (ratio + matched) / self.variance
        return evidence

    def _denoised(self, sum_e: Image, views: Image, strength: float) -> Image:
        """Return light (row, column) from its sum over views, smoothed by total variation as its noise asks for."""
        share = np.clip(views / _FEW_VIEWS, 0, 1)
        light = share * sum_e / np.maximum(views, 0.5) + (1 - share) * _ratio(sum_e, views, _SPARSE)
        metric = np.maximum(views, 1.0) / self.variance
        weight = strength * float(np.sqrt(np.median(metric)))
        dual = DualField.zero([light.shape], light.dtype)
        return dual.prox(light.astype(np.float32), metric.astype(np.float32), weight, Penalty(), lambda _: 0.0, _STEPS).plane


def _ratio(sum_e: Image, views: Image, scale: float) -> Image:
    """Return blurred sums over blurred numbers of views."""
    return np.asarray(cv2.GaussianBlur(sum_e, (0, 0), scale) / np.maximum(cv2.GaussianBlur(views, (0, 0), scale), 0.3))


def _detail(light: Image, views: Image, scale: float) -> Image:
    """Return light less its mean over neighbours, weighted by the views that see them."""
    return np.asarray(light - _ratio(light * views, views, scale))
