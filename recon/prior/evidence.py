"""Evidence of the data for each plane: a picture with its noise, that of the plane without noise, and their misfit."""

from collections.abc import Callable, Iterable, Sequence
from itertools import islice, product
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.blur import blurred
from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.numba_tools import compiled
from faintfield.recon.operator.scene_operator import SceneOperator, ViewSelection
from faintfield.recon.solver.initialization import well_seen_samples
from faintfield.recon.solver.penalty_weight import fold_count, validation_views
from faintfield.recon.threads import run_in_threads

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
        drawn = _drawn_noise(operator, images, samples, views, (0, 0))
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
        found.append(Evidence(pilot + change, pilot, noise, coverage, light))
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
    return np.divide(sums, coverage, out=np.zeros_like(sums), where=coverage > 0)


def noise_of_back_projection(
    operator: SceneOperator, images: ElementalImages, plane: Image, *, seed: int = 0, draws: int = 1
) -> Noise:
    """Return the covariance of the back-projection's noise, for data of variance `H f + b + σ²`.

    A pixel of variance v adds h² v to the variance of a sum Hᵀ g, and the operator can only add h v. The ratio of the
    two sums changes slowly over the plane, so it is measured, like the kernel, on back-projected draws of the noise,
    one view at a time. Each draw and view has a random generator of its own.
    """
    variance = operator.adjoint_of_map(images.background_e + images.read_variance_e2)
    variance += operator.adjoint_of_forward(np.maximum(plane, 0))
    drawn = (_drawn_noise(operator, images, plane, None, (seed, draw)) for draw in range(draws))
    return _noise(operator.coverage(), variance, list(drawn))


def _noise(coverage: Image, variance: Image, draws: list[Image]) -> Noise:
    """Return the covariance of `Hᵀ n / coverage` from `Hᵀ` of the variances, and draws of Hᵀ n."""
    seen = well_seen_samples(coverage)
    squares, products = np.zeros_like(coverage), np.zeros((3, 3))
    for light in draws:
        squares += np.square(light)
        products += _products_of_neighbours(np.where(seen, light, 0) / np.sqrt(np.maximum(variance, _TINY)))
    factor = blurred(squares, _WIDE_BLUR) / (len(draws) * np.maximum(blurred(variance, _WIDE_BLUR), _TINY))
    factor *= blurred(variance, _NARROW_BLUR)
    of_mean = np.full(coverage.shape, np.inf, np.float32)
    np.divide(factor, np.square(blurred(coverage, _NARROW_BLUR)), out=of_mean, where=seen)
    return Noise(of_mean, products / max(products[1, 1], _TINY))


def _drawn_noise(
    operator: SceneOperator, images: ElementalImages, samples: Image, views: ViewSelection, seed: tuple[int, int]
) -> Image:
    """Return Hᵀ n (samples) of one draw of the noise n of the data: its deviation with random signs, fast to draw."""
    light, total = np.maximum(samples, 0), np.zeros_like(samples)
    for some in _few_views(operator, operator.all_views if views is None else np.asarray(views)):
        drawn = operator.forward(light, some)
        drawn += operator.map_of_views(images.background_e + images.read_variance_e2, some)

        def draw(view: int, variance: Image) -> None:
            random_bytes = np.random.default_rng([*seed, view]).bytes(-(-variance.size // 8))
            _draw_signs(variance.reshape(-1), np.frombuffer(random_bytes, np.uint8))

        _for_each_view(operator.workers, draw, some.tolist(), drawn)
        total += operator.adjoint_of_views(drawn, some)
    return total


@compiled
def _draw_signs(variance: Image, random_bytes: NDArray[np.uint8]) -> None:
    """Replace variances (pixel,) by their roots, with the signs of random bits."""
    one = variance.dtype.type(1)
    for k in range(variance.size):
        sign = one - 2 * one * ((random_bytes[k >> 3] >> (7 - (k & 7))) & 1)
        variance[k] = sign * np.sqrt(variance[k])


def _for_each_view(workers: int, work: Callable[..., None], *of_views: Iterable[Any]) -> None:
    """Call `work` with what belongs to each view, in threads."""

    def take(worker: int) -> None:
        for of_view in islice(zip(*of_views, strict=True), worker, None, workers):
            work(*of_view)

    run_in_threads(take, range(workers))


def _few_views(operator: SceneOperator, views: NDArray[np.intp]) -> list[NDArray[np.intp]]:
    """Return views in groups whose images together are about as large as the samples: each group takes some sweeps."""
    at_a_time = max(int(np.prod(operator.samples_shape)) // int(np.prod(operator.images_shape[1:])), 1)
    return np.array_split(views, -(-len(views) // at_a_time)) if len(views) else []


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
    squares, spreads = (np.zeros_like(samples) for _ in range(2))
    views = _compared_views(operator)
    variances = operator.adjoint_of_forward(samples, views)
    variances += operator.adjoint_of_map(images.background_e + images.read_variance_e2, views)
    for some in _few_views(operator, views):
        expected = operator.forward(samples, some)
        expected += operator.map_of_views(images.background_e, some)
        spread = expected + operator.map_of_views(images.read_variance_e2, some)

        def compare(view: int, of_view: Image, spread: Image) -> None:
            """Set the light to squares of residuals, and the variance to that of these."""
            spread *= 2 * spread  # of a Poisson number and a normal one
            spread += of_view
            np.subtract(images.electrons[view], of_view, out=of_view)
            np.square(of_view, out=of_view)

        _for_each_view(operator.workers, compare, some.tolist(), expected, spread)
        squares += operator.adjoint_of_views(expected, some)
        spreads += operator.adjoint_of_views(spread, some)
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


def _misfit(squares: Image, variances: Image, spreads: Image, regions: dict[str, Image]) -> Misfit:
    """Return the misfit of one plane from back-projected squares, variances, and variances of squares."""

    def ratio(share: Image) -> tuple[float, float]:
        total, expected, spread = (
            float(np.sum(terms * share, dtype=np.float64)) for terms in (squares, variances, spreads)
        )
        return (total / expected, np.sqrt(max(spread, 0.0)) / expected) if expected > 0 else (1.0, 0.0)

    (detail, of_detail), (smooth, of_smooth) = ratio(regions["light, detail"]), ratio(regions["light, smooth"])
    return Misfit(detail, smooth, float(np.hypot(of_detail, of_smooth)))
