"""Evidence of the data for each plane: a picture with its noise, that of the plane without noise, and their misfit."""

from collections.abc import Sequence
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator, ViewSelection
from faintfield.recon.solver.initialization import well_seen_samples
from faintfield.recon.solver.penalty_weight import fold_count, validation_views
from faintfield.recon.threads import elementwise, summed

# Spacings of the blurs of the noise of a draw, which stands in for many draws, and of the number of views.
_WIDE_BLUR, _NARROW_BLUR = (1, 2, 4, 8, 12), (1, 1)

# Where the variance is smaller, there is none.
_TINY = 1e-30

# Largest excess of the squares of residuals over their variance in detail, and largest of detail over smooth parts: a
# calibration of the noise may be off by a percent everywhere. Chosen on `CHOSEN_ON` in
# benchmarks/imaging/uncertainty.py.
_MAX_EXCESS, _MAX_BEYOND_SMOOTH = 0.006, 0.012

# Standard errors that are added to both, and pixels that are compared at least: so many tell a mean square to a part in
# a thousand where a tenth of them see detail.
_SIGMAS, _COMPARED_PIXELS = 2.0, 2**26


class Noise(NamedTuple):
    """Covariance of the noise of a picture, `Cov(p, p + d) = variance[p] · kernel[1 + d]`, zero for distant samples.

    Attributes
    ----------
    variance : float32 array (row, column)
        In squared electrons; infinite for samples that no view sees.
    kernel : float array (3, 3)
        Correlation of a sample with its neighbours (row, column), one at the centre.
    """

    variance: NDArray[np.float32]
    kernel: NDArray[np.float64]


class Evidence(NamedTuple):
    """Evidence of some views for one plane.

    Attributes
    ----------
    picture, pilot : float array (row, column)
        y, the back-projection less the light of other planes, and u, the plane as blurred as y,
        `H_zᵀ H_z f_z / H_zᵀ H_z 1`, in electrons.
    noise : Noise
        Covariance of y.
    coverage : float array (row, column)
        `H_zᵀ H_z 1`; y and u are zero where it is.
    other_colours : float array (row, column), optional
        Light of the plane in other colours, as blurred as y.
    """

    picture: Image
    pilot: Image
    noise: Noise
    coverage: Image
    other_colours: Image | None = None


def evidence_of_planes(
    operator: SceneOperator,
    images: ElementalImages,
    samples: Image,
    views: ViewSelection = None,
    *,
    other_colours: Image | None = None,
    of_all_views: Sequence[Evidence] | None = None,
) -> list[Evidence]:
    """Return the evidence of each plane of a scene, `y_z = u_z + H_zᵀ(g − b − H f) / H_zᵀ H_z 1`.

    `samples` is f ≥ 0 in electrons, and `other_colours` (samples) the planes in other colours. All `views` by default.
    The noise is that `of_all_views`, if it is given, in proportion to the number of views; else it is measured anew.
    """
    seen = operator.adjoint_of_forward(samples, views)
    residual = operator.adjoint(images.electrons, views) - seen
    if np.any(images.background_e):
        residual -= operator.adjoint_of_map(images.background_e, views)
    own = _alone(operator, samples, seen, views)
    coverages = _alone(operator, np.ones_like(samples), operator.coverage(views), views)
    if of_all_views is None:
        variance = seen + operator.adjoint_of_map(images.background_e + images.read_variance_e2, views)
        drawn = operator.adjoint_of_noise(samples, images, views=views)
        sums = zip(coverages, operator.planes_of(variance), operator.planes_of(drawn), strict=True)
        noises = [_noise(coverage, of_variance, [of_draw]) for coverage, of_variance, of_draw in sums]
    else:
        noises = list(map(_in_proportion, of_all_views, coverages))
    shown: list[Image | None] = [None] * len(coverages)
    if other_colours is not None:
        projected = operator.adjoint_of_forward(other_colours, views)
        shown = list(map(_divided, _alone(operator, other_colours, projected, views), coverages))
    found = []
    for of_pilot, coverage, light, noise, of_residual in zip(
        own, coverages, shown, noises, operator.planes_of(residual), strict=True
    ):
        pilot, change = (_divided(array, coverage) for array in (of_pilot, of_residual))
        found.append(Evidence(elementwise(np.add, pilot, change, out=change), pilot, noise, coverage, light))
    return found


def _in_proportion(of_all_views: Evidence, coverage: Image) -> Noise:
    """Return the noise of some views: the variance of their mean falls with the number of views."""
    noise, variance = of_all_views.noise, np.full_like(of_all_views.noise.variance, np.inf)
    seen = well_seen_samples(coverage) & np.isfinite(noise.variance)
    np.divide(of_all_views.coverage, coverage, out=variance, where=seen)
    np.multiply(variance, noise.variance, out=variance, where=seen)
    return noise._replace(variance=variance)


def _alone(operator: SceneOperator, samples: Image, projected: Image, views: ViewSelection) -> list[Image]:
    """Return `H_zᵀ H_z f_z` (row, column) of each plane z alone; `projected` is Hᵀ H f."""
    if len(operator.grids) == 1:
        return operator.planes_of(projected)
    found = []
    for index, light in enumerate(operator.planes_of(samples)):
        alone = np.zeros_like(samples)
        operator.planes_of(alone)[index][:] = light
        found.append(operator.planes_of(operator.adjoint_of_forward(alone, views))[index].copy())
    return found


def _divided(sums: Image, coverage: Image) -> Image:
    return elementwise(lambda x, w: np.divide(x, w, out=np.zeros_like(x), where=w > 0), sums, coverage)


def noise_of_back_projection(
    operator: SceneOperator, images: ElementalImages, plane: Image, *, draws: int = 1
) -> Noise:
    """Return the covariance of the back-projection's noise, for data of variance `H f + b + σ²`.

    A pixel of variance v adds h² v to the variance of a sum Hᵀ g, and the operator can only add h v. The ratio of the
    two sums changes slowly over the plane, so it is measured, like the kernel, on back-projected draws of the noise.
    """
    variance = operator.adjoint_of_map(images.background_e + images.read_variance_e2)
    light = np.maximum(plane, 0)
    variance += operator.adjoint_of_forward(light)
    drawn = [operator.adjoint_of_noise(light, images, seed) for seed in range(draws)]
    return _noise(operator.coverage(), variance, drawn)


def _noise(coverage: Image, variance: Image, draws: list[Image]) -> Noise:
    """Return the covariance of `Hᵀ n / coverage` from `Hᵀ` of the variances, and draws of Hᵀ n."""
    seen = well_seen_samples(coverage)
    squares, products = np.zeros_like(coverage), np.zeros((3, 3))

    def scaled(light: Image, variance: Image, mask: NDArray[np.bool_]) -> Image:
        return np.asarray(np.where(mask, light, 0) / np.sqrt(np.maximum(variance, _TINY)))

    def of_mean(squares: Image, wide: Image, variance: Image, coverage: Image, mask: NDArray[np.bool_]) -> Image:
        factor = squares / (len(draws) * np.maximum(wide, _TINY)) * variance
        return np.asarray(np.divide(factor, np.square(coverage), out=np.full_like(factor, np.inf), where=mask))

    for light in draws:
        squares = elementwise(lambda total, light: total + np.square(light), squares, light, out=squares)
        products += _products_of_neighbours(elementwise(scaled, light, variance, seen))
    wide, narrow = (blurred(variance, spacings) for spacings in (_WIDE_BLUR, _NARROW_BLUR))
    arrays = blurred(squares, _WIDE_BLUR), wide, narrow, blurred(coverage, _NARROW_BLUR), seen
    return Noise(elementwise(of_mean, *arrays).astype(np.float32), products / max(products[1, 1], _TINY))


def _products_of_neighbours(picture: Image) -> NDArray[np.float64]:
    """Return the sums of products of samples and their neighbours (3, 3), over all samples with eight neighbours."""
    rows, columns = picture.shape
    inner = picture[1:-1, 1:-1]
    sums = np.empty((3, 3))
    for i, j in product(range(3), range(3)):
        sums[i, j] = np.einsum("ij,ij", inner, picture[i : rows - 2 + i, j : columns - 2 + j], dtype=np.float64)
    return (sums + sums[::-1, ::-1]) / 2


class Misfit(NamedTuple):
    """Means of a plane's squared residuals over their variance, and the standard error of their difference.

    `detail` is that where the plane has detail, and `smooth` where it has light but none: one for the right model.
    """

    detail: float
    smooth: float
    se: float

    @property
    def contradicts(self) -> bool:
        """True if the residuals in detail are larger than noise makes them, and larger than elsewhere."""
        chance = _SIGMAS * self.se
        return self.detail - 1 > _MAX_EXCESS + chance and self.detail - self.smooth > _MAX_BEYOND_SMOOTH + chance


def misfits(
    operator: SceneOperator, images: ElementalImages, samples: Image, regions: Sequence[dict[str, Image]]
) -> list[Misfit]:
    """Return the misfit of each plane of f ≥ 0 (samples, in electrons), in a pass over the data or a part of them.

    `regions` are shares (row, column) of the samples of each plane in "light, detail" and "light, smooth".
    """
    views = _compared_views(operator)
    variances = operator.adjoint_of_forward(samples, views)
    variances += operator.adjoint_of_map(images.background_e + images.read_variance_e2, views)
    squares = operator.adjoint_of_squares(samples, images, views)
    spreads = operator.adjoint_of_variance_of_squares(samples, images, views)
    parts = (operator.planes_of(array) for array in (squares, variances, spreads))
    return [_misfit(*of_plane) for of_plane in zip(*parts, regions, strict=True)]


def _compared_views(operator: SceneOperator) -> NDArray[np.intp]:
    """Return views of enough pixels, in all rows and columns of a grid alike."""
    views = operator.seeing_views
    chosen: list[int] = []
    for fold in range(fold_count(len(views))):
        chosen.extend(validation_views(len(views), fold))
        if len(chosen) * np.prod(operator.images_shape[1:]) >= _COMPARED_PIXELS:
            break
    return views[sorted(chosen)]


def _product(terms: Image, share: Image) -> float:
    return float(np.sum(terms * share, dtype=np.float64))


def _misfit(squares: Image, variances: Image, spreads: Image, regions: dict[str, Image]) -> Misfit:
    """Return the misfit of one plane from back-projected squares, variances, and variances of squares."""

    def ratio(share: Image) -> tuple[float, float]:
        total, expected, spread = (summed(_product, terms, share) for terms in (squares, variances, spreads))
        return (total / expected, np.sqrt(max(spread, 0.0)) / expected) if expected > 0 else (1.0, 0.0)

    (detail, of_detail), (smooth, of_smooth) = ratio(regions["light, detail"]), ratio(regions["light, smooth"])
    return Misfit(detail, smooth, float(np.hypot(of_detail, of_smooth)))
