"""The light that explains the views, on a surface or on planes: each view by that of the views in other folds."""

from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.errors import NothingInFocus
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.operator.single_plane import PlaneOperator
from faintfield.recon.operator.surface_operator import homographies_of_surface
from faintfield.recon.solver.data_fit import SceneProblem
from faintfield.recon.solver.initialization import mean_light_e
from faintfield.recon.solver.penalty_weight import MAX_FOLDS, universal_penalty_weight, validation_views
from faintfield.recon.solver.pmlem import pmlem
from faintfield.recon.solver.proximal import DualField
from faintfield.recon.surface.estimate import equal_steps, first_depths, found_range, halves, next_depths
from faintfield.recon.surface.evidence import DepthEvidence, denoised
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews, gaussian

# Weight of total variation in units of the noise, for the light of a surface; passes over the data from the last light,
# for that of planes, and from none.
_STRENGTH, _PASSES, _PASSES_AFRESH = 1.0, 5, 20

# Fewest views of a fold and of the others at samples whose gradient is compared, and the distance to where they lack.
_MIN_OWN, _MIN_OTHERS, _AWAY = 0.9, 1.5, 2.0


class Layer(NamedTuple):
    """A part of the light in some views.

    `picture` (view, row, column) are its electrons, and `inverse_depth` is 1/depth at each of its pixels, or one number
    for all. `gradient_scale` (2,) is by how much the true gradient exceeds that of the picture along rows and columns.
    """

    picture: NDArray[np.float32]
    inverse_depth: NDArray[np.float32] | float
    gradient_scale: NDArray[np.float64]

    def of_view(self, number: int) -> "Layer":
        """Return the layer in one view (row, column)."""
        depth = self.inverse_depth
        return Layer(self.picture[number], depth if isinstance(depth, float) else depth[number], self.gradient_scale)


@dataclass(frozen=True)
class Folds:
    """Views in folds, `of_view` (view,), so that no view explains its own noise."""

    of_view: NDArray[np.intp]

    @classmethod
    def of(cls, views: int) -> "Folds":
        """Return folds of about a seventh of the views each: with larger ones, steps would go too far."""
        of_view = np.zeros(views, np.intp)
        for fold in range(max(2, min(MAX_FOLDS, views // 2))):
            of_view[validation_views(views, fold)] = fold
        return cls(of_view)

    @property
    def numbers(self) -> list[int]:
        """Numbers of the folds."""
        return list(map(int, np.unique(self.of_view)))

    def views(self, fold: int) -> NDArray[np.intp]:
        """Return the views of a fold."""
        return np.flatnonzero(self.of_view == fold)

    def others(self, fold: int) -> NDArray[np.intp]:
        """Return the views of all other folds."""
        return np.flatnonzero(self.of_view != fold)


class Light(Protocol):
    """The light of a scene, given where the cameras are."""

    folds: Folds
    smooth_depth: bool
    """True if depth can change by `depth_shapes`."""

    def find_range(self, views: PinholeViews) -> None:
        """Find the range of depths again, if neither it nor the depth is given."""

    def find_depth(self, views: PinholeViews) -> None:
        """Find the depth again, if it is not given."""

    def change_depth(self, change: NDArray[np.float64]) -> None:
        """Add `depth_shapes` times `change` to 1/depth, if it is not given."""

    def fit(self, views: PinholeViews, blur: float = 0.0, *, afresh: bool = False) -> None:
        """Find the light of each fold from the views of the others; `layers` are blurred by `blur` pixels.

        `afresh` makes no use of the light of earlier calls, so that the lights of two calls can be compared.
        """

    def layers(self, fold: int) -> tuple[list[Layer], NDArray[np.bool_]]:
        """Return the light in the views of a fold, and which of their pixels (view, row, column) see it."""

    def picture(self) -> NDArray[np.float32]:
        """Return the light as the reference view sees it (row, column), by all views."""


class SurfaceLight:
    """Light on a surface, whose 1/depth is found between `limits`, which themselves are found within `searched`."""

    smooth_depth = True

    def __init__(self, folds: Folds, limits: tuple[float, float], searched: tuple[float, float] | None = None) -> None:
        self.folds, self.limits, self._searched = folds, limits, searched

    def find_range(self, views: PinholeViews) -> None:
        """Find the limits again; they stay if the views tell none."""
        if self._searched is not None:
            with suppress(NothingInFocus):
                self.limits = found_range(views, *self._searched)

    def find_depth(self, views: PinholeViews) -> None:
        """Find the depth of each sample of these views."""
        depths = equal_steps(views, *self.limits)
        evidence = DepthEvidence(views, depths, halves(views.nodes))
        index, _ = next_depths(evidence, evidence.explained(first_depths(evidence)))
        self._inverse_depth, self._grid = np.interp(index, np.arange(len(depths)), depths), views.grid

    def change_depth(self, change: NDArray[np.float64]) -> None:
        """Add `depth_shapes` times `change` to 1/depth."""
        rows, columns = np.indices(self._grid.shape)
        x, y = (
            origin + self._grid.pitch_mm * place
            for origin, place in zip(self._grid.origin_mm, (columns, rows), strict=True)
        )
        shapes = depth_shapes(x, y, self._inverse_depth)
        self._inverse_depth = np.maximum(self._inverse_depth + np.tensordot(change, shapes, 1), 0)

    def fit(self, views: PinholeViews, blur: float = 0.0, *, afresh: bool = False) -> None:
        """Take for each fold the mean of the other views on the surface, denoised."""
        self._operator = operator = views.surface_operator(_enlarged(self._inverse_depth, views.grid.shape))
        self._inverse_depths, self._blur = operator.inverse_depth_of_pixels(), blur
        self._usable, self._covered = views.light_e > UNKNOWN, np.empty(views.light_e.shape, np.bool_)
        even = np.ones(views.grid.shape, np.float32)
        for fold in map(self.folds.views, self.folds.numbers):
            self._covered[fold] = operator.forward(even, fold) > 0
        parts = [self.folds.views(fold) for fold in self.folds.numbers]
        sums = [operator.adjoint(views.light_e, part) for part in parts]
        counts = [operator.sensitivity(part) for part in parts]
        self._sum, self._count = np.sum(sums, axis=0), np.sum(counts, axis=0)
        level = float(np.median(self._sum[self._count > 0] / self._count[self._count > 0]))
        level_e = np.full(views.light_e.shape[1:], max(level, 0), np.float32)
        self._variance = np.float32(views.pixel_variance(level_e).mean())
        self._lights = [
            denoised(self._sum - own, self._count - count, self._variance, _STRENGTH, workers=None)
            for own, count in zip(sums, counts, strict=True)
        ]
        products = [
            gradient_products(light, own, count, self._count - count, blur)
            for light, own, count in zip(self._lights, sums, counts, strict=True)
        ]
        self._gradient_scale = gradient_scale(products)

    def layers(self, fold: int) -> tuple[list[Layer], NDArray[np.bool_]]:
        """Return the light in the views of a fold, and which of their pixels see it."""
        views, light = self.folds.views(fold), self._lights[self.folds.numbers.index(fold)]
        picture = self._operator.forward(light, views)
        if self._blur:
            for image, seen in zip(picture, self._covered[views], strict=True):
                share = np.maximum(gaussian(seen.astype(np.float32), self._blur), np.float32(1e-3))
                image[:] = gaussian(image, self._blur) / share
        layer = Layer(picture, self._inverse_depths[views], self._gradient_scale)
        return [layer], self._covered[views] & self._usable[views]

    def picture(self) -> NDArray[np.float32]:
        """Return the light by all views (row, column)."""
        return denoised(self._sum, self._count, self._variance, _STRENGTH, workers=None)


class PlanesLight:
    """Light on planes at given depths together, none of which hides another."""

    smooth_depth = False

    def __init__(self, folds: Folds, inverse_depths: Sequence[float]) -> None:
        self.folds, self._inverse_depths = folds, list(inverse_depths)
        self._last: dict[tuple[int, int], tuple[Image, DualField]] = {}

    def find_range(self, views: PinholeViews) -> None:
        """Do nothing: the depths are given."""

    def find_depth(self, views: PinholeViews) -> None:
        """Do nothing: the depths are given."""

    def change_depth(self, change: NDArray[np.float64]) -> None:
        """Do nothing: the depths are given."""

    def fit(self, views: PinholeViews, blur: float = 0.0, *, afresh: bool = False) -> None:
        """Take for each fold a few passes of PMLEM over the other views, from the light of the last call."""
        at_infinity, slopes = homographies_of_surface(views.ray_from_surface)
        homographies = np.stack([at_infinity + slopes * q for q in self._inverse_depths])
        rays, self._usable, self._blur = views.rays(), views.light_e > UNKNOWN, blur
        operator = SceneOperator(homographies, rays, [views.grid] * len(homographies), valid=self._usable)
        self._operators = [PlaneOperator(of_plane, rays, views.grid) for of_plane in homographies]
        variance = views.pixel_variance(np.zeros(views.light_e.shape[1:], np.float32))[np.newaxis]
        electrons = np.where(self._usable, views.light_e, np.float32(0))
        images = ElementalImages(electrons, read_variance_e2=variance, valid=self._usable)
        problem = SceneProblem(operator, images)
        start = problem.start()
        weight, level_e = universal_penalty_weight(operator, images, start), mean_light_e(operator, start)
        self._lights = []
        for fold in self.folds.numbers:
            new = start, problem.dual()
            last, dual = new if afresh else self._last.get((fold, start.size), new)
            fit = problem.fit(level_e, self.folds.others(fold))
            iterates = pmlem(fit, np.maximum(last, 1e-3 * start), penalty_weight=weight, dual=dual)
            for _ in range(_PASSES_AFRESH if afresh else _PASSES):
                iterate = next(iterates)
            self._last[fold, start.size] = iterate.plane, iterate.dual
            self._lights.append(operator.planes_of(iterate.plane))
        products = [self._products(fold, electrons) for fold in self.folds.numbers]
        self._gradient_scales = [gradient_scale(list(of_plane)) for of_plane in zip(*products, strict=True)]

    def layers(self, fold: int) -> tuple[list[Layer], NDArray[np.bool_]]:
        """Return the light in the views of a fold, and which of their pixels are usable."""
        pictures = self._pictures(fold)
        if self._blur:
            pictures = [np.stack([gaussian(image, self._blur) for image in of_plane]) for of_plane in pictures]
        planes = zip(pictures, self._inverse_depths, self._gradient_scales, strict=True)
        return [Layer(*of_plane) for of_plane in planes], self._usable[self.folds.views(fold)]

    def picture(self) -> NDArray[np.float32]:
        """Return the sum of all planes (row, column)."""
        return np.asarray(np.mean([np.sum(planes, axis=0) for planes in self._lights], axis=0), np.float32)

    def _pictures(self, fold: int) -> list[NDArray[np.float32]]:
        views, lights = self.folds.views(fold), self._lights[self.folds.numbers.index(fold)]
        pairs = zip(self._operators, lights, strict=True)
        return [
            np.asarray(operator.forward(np.ascontiguousarray(light), views), np.float32) for operator, light in pairs
        ]

    def _products(self, fold: int, electrons: Image) -> list[NDArray[np.float64]]:
        """Return the products of gradients of each plane; what the others explain is taken from the views."""
        views, others, pictures = self.folds.views(fold), self.folds.others(fold), self._pictures(fold)
        left = electrons[views] - np.sum(pictures, axis=0)
        images, products = np.zeros_like(electrons), []
        for operator, light, picture in zip(
            self._operators, self._lights[self.folds.numbers.index(fold)], pictures, strict=True
        ):
            images[views] = left + picture
            own, counts = operator.adjoint(images, views), (operator.sensitivity(views), operator.sensitivity(others))
            products.append(gradient_products(light, own, *counts, self._blur))
        return products


def depth_shapes(x: Image, y: Image, inverse_depth: Image) -> Image:
    """Return smooth changes of 1/depth (shape, …) of points in the directions x, y of the reference view."""
    q = inverse_depth
    return np.array([np.ones_like(q), x, y, x * x, x * y, y * y, q, q * x, q * y])


def gradient_products(light: Image, own: Image, count: Image, other_count: Image, blur: float) -> NDArray[np.float64]:
    """Return sums of products of gradients (2, axis): of denoised light with the true one, and with itself.

    The true gradient is that of the sum `own` of a fold's views, `count` of them at each sample, whose noise the light
    of the others, `other_count` of them, does not share.
    """
    smooth = gaussian(light, blur) if blur else light
    true, slope = np.array(np.gradient(own / np.maximum(count, np.float32(0.5)))), np.array(np.gradient(smooth))
    seen = ((count > _MIN_OWN) & (other_count > _MIN_OTHERS)).astype(np.float32)
    weight = np.where(gaussian(seen, _AWAY) > 0.999, count, 0)
    return np.asarray(np.sum([weight * slope * true, weight * slope**2], axis=(2, 3), dtype=np.float64))


def gradient_scale(products: Sequence[NDArray[np.float64]]) -> NDArray[np.float64]:
    """Return by how much the true gradient exceeds that of denoised light (2,): the slope of a regression.

    It is above 1 where denoising took too much, and below where noise was left.
    """
    true, own = np.sum(products, axis=0)
    return np.asarray(np.divide(true, own, out=np.zeros(2), where=own > 0), np.float64)


def _enlarged(values: Image, shape: tuple[int, int]) -> Image:
    """Return values of a picture at as many samples as `shape`, each the nearest."""
    rows, columns = (
        np.minimum((np.arange(size) + 0.5) * count / size, count - 1).astype(np.intp)
        for size, count in zip(shape, values.shape, strict=True)
    )
    return np.asarray(values[np.ix_(rows, columns)])
