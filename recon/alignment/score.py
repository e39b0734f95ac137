"""Gradient of each view's likelihood by its pose, and by changes of the scene that all views share."""

import math
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from itertools import chain
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.alignment.cameras import POSE, PosedViews, lens_motion, motion, motion_of_step
from faintfield.recon.alignment.light import Layer, Light, depth_shapes
from faintfield.recon.likelihood.images import Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.surface_operator import homographies_of_surface
from faintfield.recon.surface.pinhole_views import gaussian
from faintfield.recon.threads import map_in_threads

# Pixels along the edges of a view that do not count, where a blurred picture is not that of the scene.
_BORDER = 2

# Errors beyond this many standard deviations count less (Huber).
_LARGE = 3.0

# Side of a cell, and half of it where fewer would be held out.
_SIDE_PX, _MIN_CELLS = 16, 300

# Side of squares of cells over which the scatter of the gradient is measured: errors of light and depth are alike in
# neighbouring pixels.
_SCATTER_CELLS = 2

# Side of a patch of the reference view in samples, and half of it if there would be fewer: neighbours in smaller ones
# would share errors of the light.
_PATCH, _MIN_PATCHES = 24, 100

# Blur of the squared errors by which pixels count less where the light does not fit.
_MISFIT_PX = 4.0

# Parts of the scene along rows and along columns.
_PARTS = 3

# A view counts less if its gradient scatters this many times more than that of all views.
_OUTLYING = 4.0


@dataclass(frozen=True)
class Score:
    """Gradient and information of the log-likelihood of each view.

    The parameters are the step of its pose, the change of the lens if that is to be found, and changes of the scene:
    motions of the light in its picture, six as those of a camera and two as those of a lens, then `depth_shapes`.

    Attributes
    ----------
    gradient, information : float array (view, parameter), (view, parameter, parameter)
        Divided by the dispersion.
    dispersion : float
        Variance of the gradient relative to what the noise explains, by its scatter over cells of the pictures; ≥ 1.
    lens : int
        Number of parameters of the lens.
    """

    gradient: NDArray[np.float64]
    information: NDArray[np.float64]
    dispersion: float
    lens: int


@dataclass(frozen=True)
class Cells:
    """Square cells of the pictures, and those (view, row of cells, column of cells) that are held out.

    A cell has a side of `side_px` pixels of the finest pictures, a multiple of the bins of all pictures.
    """

    side_px: int
    held_out: NDArray[np.bool_]

    @classmethod
    def of(cls, shape: tuple[int, int, int], share: float) -> "Cells":
        """Return cells of pictures (view, row, column), smaller ones if few; a share of them is held out."""
        views, rows, columns = shape
        side_px = _SIDE_PX if share * views * rows * columns >= _MIN_CELLS * _SIDE_PX**2 else _SIDE_PX // 2
        generator = np.random.default_rng(0)
        return cls(side_px, generator.random((views, -(-rows // side_px), -(-columns // side_px))) < share)

    def none_held_out(self) -> "Cells":
        """Return the same cells, all of which count."""
        return Cells(self.side_px, np.zeros_like(self.held_out))

    def pixels(self, view: int, shape: tuple[int, int], bins: int) -> NDArray[np.bool_]:
        """Return the pixels (row, column) of held-out cells in a picture of bins."""
        cells = self.held_out[view]
        rows, columns = (
            np.minimum(np.arange(size) * bins // self.side_px, count - 1)
            for size, count in zip(shape, cells.shape, strict=True)
        )
        return np.asarray(cells[np.ix_(rows, columns)])

    def sums(self, values: Image, bins: int, cells: int = 1) -> NDArray[np.float64]:
        """Return sums (number, square) of values (number, row, column) over squares of `cells` by `cells`."""
        side = max(self.side_px * cells // bins, 1)
        rows, columns = (np.arange(0, size, side) for size in values.shape[1:])
        sums = np.add.reduceat(np.add.reduceat(values, rows, axis=1), columns, axis=2)
        return np.asarray(sums.reshape(len(values), -1), np.float64)


def score(posed: PosedViews, light: Light, cells: Cells, precision: NDArray[np.float64], bins: int) -> Score:
    """Return the score of all views at their poses, without the cells that are held out.

    `precision` (6,) is that of a step before the views are looked at, and `bins` the width of the pictures' bins.
    """
    terms = _Terms(posed, light)
    results: dict[int, tuple[NDArray[np.float64], NDArray[np.float64], float]] = {}

    def work(item: tuple[int, list[Layer], NDArray[np.bool_]]) -> None:
        view, layers, seen = item
        held_out = cells.pixels(view, seen.shape, bins)
        flat, weight, error, to_motion = terms.of_view(view, layers, _inside(seen) & ~held_out)
        weighted = flat * weight
        gradient = to_motion.T @ (weighted @ error)
        information = to_motion.T @ (weighted @ flat.T) @ to_motion
        own = information[:POSE, :POSE]
        step = to_motion[:POSE, :POSE] @ np.linalg.solve(own + np.diag(precision), gradient[:POSE])
        left = error - step.astype(np.float32) @ flat[:POSE]
        of_cells = to_motion[:POSE, :POSE].T @ cells.sums(
            (weighted[:POSE] * left).reshape(POSE, *seen.shape), bins, _SCATTER_CELLS
        )
        scatter = float(np.sum(of_cells * (np.linalg.pinv(own, hermitian=True) @ of_cells))) / POSE
        results[view] = gradient, information, scatter

    for item in _layers_of_folds(light):
        map_in_threads(work, item)
    gradients, informations, scatters = (
        np.array(part) for part in zip(*(results[n] for n in range(len(results))), strict=True)
    )
    typical = max(1.0, float(scatters[scatters <= _OUTLYING * np.median(scatters)].mean()))
    dispersion = np.maximum(typical, scatters / _OUTLYING)
    weights = 1 / dispersion
    return Score(weights[:, None] * gradients, weights[:, None, None] * informations, typical, posed.lens_parameters)


@dataclass(frozen=True)
class PartialScores:
    """Gradient and information of parts of the scene, each a number of square patches of the reference view.

    Errors of the light at one place are alike in all views, so that a patch is the same place in all of them.

    Attributes
    ----------
    gradient : float array (patch, view, parameter)
        Of each patch.
    part : int array (patch,)
        The part that a patch belongs to.
    information : float array (part, view, parameter, parameter)
        Of each part.
    lens : int
        Number of parameters of the lens.
    """

    gradient: NDArray[np.float64]
    part: NDArray[np.intp]
    information: NDArray[np.float64]
    lens: int

    def without(self, part: int, dispersion: float) -> Score:
        """Return the score of all other parts."""
        gradient, information = self.gradient[self.part != part].sum(axis=0), np.delete(self.information, part, axis=0)
        return Score(gradient / dispersion, information.sum(axis=0) / dispersion, dispersion, self.lens)


def partial_scores(posed: PosedViews, light: Light) -> PartialScores:
    """Return the scores of parts of the scene, each of neighbours, which share errors of light and depth."""
    terms, patches = _Terms(posed, light), _Patches(posed.views.grid)
    part_of_patch = patches.parts()
    results: dict[int, tuple[NDArray[np.float64], NDArray[np.float64]]] = {}

    def work(item: tuple[int, list[Layer], NDArray[np.bool_]]) -> None:
        view, layers, seen = item
        patch = patches.of(*terms.directions(view, _mean_inverse_depth(layers))).ravel()
        flat, weight, error, to_motion = terms.of_view(view, layers, _inside(seen))
        weighted = flat * weight
        gradient = np.array([np.bincount(patch, row * error, patches.number) for row in weighted])
        part = part_of_patch[patch]
        informations = [
            to_motion.T @ (weighted[:, chosen] @ flat[:, chosen].T) @ to_motion
            for chosen in (part == number for number in range(_PARTS**2))
        ]
        results[view] = gradient.T @ to_motion, np.array(informations)

    for item in _layers_of_folds(light):
        map_in_threads(work, item)
    gradients, informations = zip(*(results[n] for n in range(len(results))), strict=True)
    stacked = np.stack(gradients, axis=1), part_of_patch, np.stack(informations, axis=1)
    return PartialScores(*stacked, posed.lens_parameters)


class _Patches:
    """Square patches of a plane's samples, row by row."""

    def __init__(self, grid: PlaneGrid) -> None:
        self._side = _PATCH if math.prod(grid.shape) >= _MIN_PATCHES * _PATCH**2 else _PATCH // 2
        self._grid, self._shape = grid, [-(-size // self._side) for size in grid.shape]

    @property
    def number(self) -> int:
        return math.prod(self._shape)

    def of(self, x: Image, y: Image) -> NDArray[np.intp]:
        """Return the patch of each point, the nearest for those outside."""
        side_mm = self._grid.pitch_mm * self._side
        column, row = (
            np.clip((place - origin) / side_mm, 0, count - 1).astype(np.intp)
            for place, origin, count in zip((x, y), self._grid.origin_mm, reversed(self._shape), strict=True)
        )
        return np.asarray(self._shape[1] * row + column)

    def parts(self) -> NDArray[np.intp]:
        """Return the part of the scene (patch,) that each patch belongs to."""
        pairs = zip(np.indices(self._shape), self._shape, strict=True)
        row, column = (_PARTS * place // count for place, count in pairs)
        return np.asarray((_PARTS * row + column).ravel())


class _Terms:
    """The derivatives, weights and errors of views."""

    def __init__(self, posed: PosedViews, light: Light) -> None:
        self._posed, self._smooth_depth = posed, light.smooth_depth
        self._rays = posed.views.rays()
        self._at_infinity, self._slopes = homographies_of_surface(posed.views.ray_from_surface)

    def directions(self, view: int, inverse_depth: Image | float) -> tuple[Image, Image]:
        """Return the directions x and y (row, column) in which the reference view sees what a view's pixels see."""
        return _directions(self._rays, self._at_infinity[view], self._slopes[view], inverse_depth)

    def of_view(
        self, view: int, layers: Sequence[Layer], usable: NDArray[np.bool_]
    ) -> tuple[Image, Image, Image, NDArray[np.float64]]:
        """Return the derivative (parameter, pixel) by motions of a view, weights and errors (pixel,).

        The last is the matrix (parameter, parameter) from steps to motions.
        """
        views, rays = self._posed.views, self._rays
        camera = rays + self._posed.principal_shift[view].astype(np.float32)
        parts: list[Image] = []
        for layer in layers:
            directions = self.directions(view, layer.inverse_depth)
            fields = [
                motion(camera[..., 0], camera[..., 1], layer.inverse_depth),
                motion(*directions, layer.inverse_depth),
            ]
            if self._posed.free_lens:
                fields = [fields[0], lens_motion(rays[..., 0], rays[..., 1]), fields[1], lens_motion(*directions)]
            if self._smooth_depth:
                fields.append(_parallax(rays, views.ray_from_surface[view, :, 3], directions, layer.inverse_depth))
            parts.append(_derivative(layer, fields, views.focal_px))
        derivative, expected = sum(parts[1:], parts[0]), _picture(layers)
        weight, error = _weights(usable, views.light_e[view] - expected, views.pixel_variance(expected))
        to_motion = np.eye(len(derivative))
        to_motion[:POSE, :POSE] = motion_of_step(self._posed.rt_cam_ref[view])
        return derivative.reshape(len(derivative), -1), weight.ravel(), error.ravel(), to_motion


def predictions(posed: PosedViews, light: Light, cells: Cells) -> NDArray[np.float32]:
    """Return the expected electrons of each pixel (view, row, column) that is held out; NaN of all others."""
    expected = np.full_like(posed.views.light_e, np.nan)
    for view, layers, seen in chain.from_iterable(_layers_of_folds(light)):
        usable = _inside(seen) & cells.pixels(view, seen.shape, 1)
        expected[view] = np.where(usable, _picture(layers), np.float32(np.nan))
    return expected


class Comparison(NamedTuple):
    """Two predictions compared over patches of the scene.

    `gain` (patch,) is the log-likelihood of the second less that of the first, and `information` (patch,) the squared
    difference of the two over the variance of the noise, which is the variance of the gain if the noise is all.
    """

    gain: NDArray[np.float64]
    information: NDArray[np.float64]


def compare(posed: PosedViews, light: Light, before: NDArray[np.float32], after: NDArray[np.float32]) -> Comparison:
    """Compare two predictions (view, row, column) where both are known; patches are assigned by the light."""
    terms, patches, views = _Terms(posed, light), _Patches(posed.views.grid), posed.views
    comparison = Comparison(np.zeros(patches.number), np.zeros(patches.number))
    for view, layers, _ in chain.from_iterable(_layers_of_folds(light)):
        known = np.isfinite(before[view]) & np.isfinite(after[view])
        patch = patches.of(*terms.directions(view, _mean_inverse_depth(layers)))[known]
        light_e, variances = views.light_e[view][known], []
        for sign, expected in ((-1, before[view]), (1, after[view])):
            variance = views.pixel_variance(expected)[known]
            error = light_e - expected[known]
            likelihood = -0.5 * (error**2 / variance + np.log(variance))
            comparison.gain[:] += sign * np.bincount(patch, likelihood, patches.number)
            variances.append(variance)
        square = (after[view] - before[view])[known] ** 2 / np.mean(variances, axis=0)
        comparison.information[:] += np.bincount(patch, square, patches.number)
    return comparison


def _layers_of_folds(light: Light) -> Iterator[list[tuple[int, list[Layer], NDArray[np.bool_]]]]:
    """Yield the views of each fold, with their layers and the pixels that see them."""
    for fold in light.folds.numbers:
        layers, seen = light.layers(fold)
        yield [
            (int(view), [layer.of_view(number) for layer in layers], seen[number])
            for number, view in enumerate(light.folds.views(fold))
        ]


def _picture(layers: Sequence[Layer]) -> Image:
    """Return the electrons of all layers (row, column)."""
    return sum((layer.picture for layer in layers[1:]), layers[0].picture)


def _mean_inverse_depth(layers: Sequence[Layer]) -> Image | float:
    return sum(layer.inverse_depth for layer in layers) / len(layers)


def _inside(mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return a mask (row, column) without its borders."""
    inside = np.zeros_like(mask)
    part = slice(_BORDER, -_BORDER)
    inside[part, part] = mask[part, part]
    return inside


def _weights(usable: NDArray[np.bool_], error: Image, variance: Image) -> tuple[Image, Image]:
    """Return weights and errors of pixels (row, column), zero where they are not usable.

    A weight is the inverse variance, of the noise or, where it is larger, of the errors nearby; less for large errors.
    """
    weight = np.where(usable, 1 / variance, np.float32(0))
    error = np.where(usable, error, np.float32(0))
    share = np.maximum(gaussian(usable.astype(np.float32), _MISFIT_PX), np.float32(1e-3))
    weight /= np.maximum(1, gaussian(weight * error**2, _MISFIT_PX) / share)
    weight *= np.minimum(1, _LARGE / np.maximum(np.abs(error) * np.sqrt(weight), np.float32(1e-6)))
    return weight, error


def _directions(
    rays: Image, at_infinity: NDArray[np.float64], slope: NDArray[np.float64], inverse_depth: Image | float
) -> tuple[Image, Image]:
    """Return the directions x and y (row, column) in which the reference view sees what the pixels of a view see."""
    x, y, q = rays[..., 0], rays[..., 1], np.float32(1) * inverse_depth
    (a, b, c), (d, e, f) = at_infinity.astype(np.float32), slope.astype(np.float32)
    scale = 1 / (c[0] * x + c[1] * y + c[2] + q * (f[0] * x + f[1] * y + f[2]))
    first = a[0] * x + a[1] * y + a[2] + q * (d[0] * x + d[1] * y + d[2])
    second = b[0] * x + b[1] * y + b[2] + q * (e[0] * x + e[1] * y + e[2])
    return first * scale, second * scale


def _parallax(
    rays: Image, translation: NDArray[np.float64], directions: tuple[Image, Image], inverse_depth: Image | float
) -> Image:
    """Return how a ray (x, y, 1) moves with each of the `depth_shapes`: (2, shape, row, column)."""
    x, y, z = translation.astype(np.float32)
    along = np.stack([x - rays[..., 0] * z, y - rays[..., 1] * z])
    shapes = depth_shapes(*directions, np.broadcast_to(np.float32(inverse_depth), directions[0].shape))
    return np.asarray(along[:, np.newaxis] * shapes)


def _derivative(layer: Layer, fields: Sequence[Image], focal_px: tuple[float, float]) -> Image:
    """Return the derivative (parameter, row, column) of a picture whose rays move by fields (2, parameter, …)."""
    along_rows, along_columns = np.gradient(layer.picture)
    along_rows *= np.float32(-focal_px[1] * layer.gradient_scale[0])
    along_columns *= np.float32(-focal_px[0] * layer.gradient_scale[1])
    derivative = np.empty((sum(field.shape[1] for field in fields), *layer.picture.shape), np.float32)
    rows = iter(derivative)
    for right, down in zip(chain(*(field[0] for field in fields)), chain(*(field[1] for field in fields)), strict=True):
        row = next(rows)
        np.multiply(along_columns, right, out=row)
        row += along_rows * down
    return derivative
