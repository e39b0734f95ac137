"""Detail that total variation lost, from the back-projection: a collaborative Wiener filter with the picture as pilot."""

from itertools import product
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.collaborative_kernels import Transform, filter_rows
from faintfield.recon.solver.initialization import back_projection, well_seen_samples
from faintfield.recon.threads import run_in_threads

# Fraction of the filter's change w − u that is added to the picture.
_SHARE = 0.8

# Spacings of the blurs of the noise of a draw, which stands in for many draws, and of the number of views.
_WIDE_BLUR, _NARROW_BLUR = (1, 2, 4, 8, 12), (1, 1)

# Shape parameter of the Kaiser window that weights the samples of a patch.
_KAISER_BETA = 2.0


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


class Patches(NamedTuple):
    """Patches of `size` x `size` samples, every `step` samples, and how far from each others like it are sought."""

    size: int
    step: int
    radius: int


_PATCHES = (Patches(8, 4, 16), Patches(12, 5, 18))


def refined(operator: SceneOperator, images: ElementalImages, plane: Image, share: float = _SHARE) -> Image:
    """Return a picture with the detail that its penalty removed: `( f + share · (w − u) )₊`.

    u is the back-projection of H f, as blurred as that of the data, y, and w is y filtered with u as pilot.

    Parameters
    ----------
    operator : SceneOperator
        H of one plane or surface.
    images : ElementalImages
        The data.
    plane : float array (row, column)
        f, in electrons.
    share : float
        Fraction of the change that is added.
    """
    coverage = operator.coverage()
    u = operator.adjoint_of_forward(plane)
    u = np.divide(u, coverage, out=np.zeros_like(u), where=coverage > 0)
    noise = noise_of_back_projection(operator, images, plane)
    y = back_projection(operator, images)
    change = collaborative_wiener(y, u, noise) - u
    return np.asarray(np.maximum(plane + plane.dtype.type(share) * change, 0), plane.dtype)


def noise_of_back_projection(
    operator: SceneOperator, images: ElementalImages, plane: Image, *, seed: int = 0, draws: int = 1
) -> Noise:
    """Return the covariance of the back-projection's noise, for data of variance `H f + b + σ²`.

    A pixel enters the sum Hᵀ g with a variance h² v, and h is known only to the operator. But h² is about in a constant
    ratio to h: `Hᵀ v` times a smooth factor is the variance of the sum. The factor and the kernel are measured
    on back-projected draws of the noise, one view at a time.

    Parameters
    ----------
    operator, images, plane
        H of one plane or surface, the data, and f.
    seed : int
        Seed of the random generators, one per draw and view.
    draws : int
        Number of draws.
    """
    coverage = operator.coverage()
    seen = well_seen_samples(coverage)
    squares, products = np.zeros_like(coverage), np.zeros((3, 3))
    variance = operator.adjoint_of_map(images.background_e + images.read_variance_e2)
    variance += operator.adjoint_of_forward(np.maximum(plane, 0))
    for draw in range(draws):
        light = _back_projected_noise(operator, images, plane, (seed, draw))
        squares += np.square(light)
        products += _products_of_neighbours(np.where(seen, light, 0) / np.sqrt(np.maximum(variance, 1e-30)))
    factor = blurred(squares, _WIDE_BLUR) / (draws * np.maximum(blurred(variance, _WIDE_BLUR), 1e-30))
    per_sample = np.square(np.maximum(blurred(coverage, _NARROW_BLUR), 1e-30))
    variance = factor * blurred(variance, _NARROW_BLUR) / per_sample
    return Noise(np.where(seen, variance, np.inf).astype(np.float32), products / products[1, 1])


def _back_projected_noise(
    operator: SceneOperator, images: ElementalImages, plane: Image, seed: tuple[int, int]
) -> Image:
    """Return Hᵀ n (samples) of one draw of the noise n of the data."""
    total = np.zeros_like(plane)
    light = np.maximum(plane, 0)
    for view in operator.all_views.tolist():
        known = operator.map_of_views(images.background_e + images.read_variance_e2, np.array([view]))
        noise = np.random.default_rng([*seed, view]).standard_normal(operator.images_shape[1:], np.float32)
        noise *= np.sqrt(operator.forward(light, [view]) + known)[0]
        total += operator.adjoint_of_view(noise, view)
    return total


def _products_of_neighbours(picture: Image) -> NDArray[np.float64]:
    """Return the sums of products of samples and their neighbours (3, 3), over all samples with eight neighbours."""
    rows, columns = picture.shape
    inner = picture[1:-1, 1:-1]
    sums = np.empty((3, 3))
    for i, j in product(range(3), range(3)):
        sums[i, j] = np.einsum("ij,ij", inner, picture[i : rows - 2 + i, j : columns - 2 + j], dtype=np.float64)
    return (sums + sums[::-1, ::-1]) / 2


def collaborative_wiener(
    picture: Image,
    pilot: Image,
    noise: Noise,
    *,
    patches: tuple[Patches, ...] = _PATCHES,
    members: int = 32,
    workers: int | None = None,
) -> NDArray[np.float32]:
    """Return a picture (row, column) without its noise, filtered in groups of patches that are alike in the pilot.

    The collaborative filter of Dabov, Foi, Katkovnik and Egiazarian (2007), second step: each group of alike patches is
    transformed by cosines along rows and columns and by Haar's wavelets along the group, and each coefficient of the
    picture is multiplied by `U²/(U² + v)`, with U that of the pilot and v the variance of the noise. Each
    sample is the mean of what the patches around it say, with weights that fall with the noise left in them.

    Parameters
    ----------
    picture, pilot : float array (row, column)
        y, and a picture of the same scene without noise, as blurred as y.
    noise : Noise
        Covariance of the noise of y. Patches with a sample of infinite variance join no group: samples that are in no
        other patch keep the pilot's value.
    patches : tuple of Patches
        The results of several sizes of patches are averaged.
    members : int
        Largest number of patches in a group, a power of two.
    workers : int, optional
        Number of threads; the result does not depend on it.

    Raises
    ------
    ValueError
        Shapes differ, or the picture is smaller than a patch.
    """
    pilot = np.ascontiguousarray(pilot, np.float32)
    picture = np.ascontiguousarray(picture, np.float32)
    largest = max(size for size, _, _ in patches)
    if not picture.shape == pilot.shape == noise.variance.shape or min(picture.shape) < largest:
        raise ValueError(
            f"picture, pilot and variance have shapes {picture.shape}, {pilot.shape} and {noise.variance.shape}; give "
            f"them one shape of at least {largest} samples a side"
        )
    total = np.zeros_like(pilot)
    for kind in patches:
        total += _filtered(picture, pilot, noise, kind, members, workers or int(numba.config.NUMBA_NUM_THREADS))
    total /= np.float32(len(patches))
    return total


def _filtered(
    picture: NDArray[np.float32],
    pilot: NDArray[np.float32],
    noise: Noise,
    patches: Patches,
    members: int,
    workers: int,
) -> NDArray[np.float32]:
    """Return the picture filtered in patches of one size.

    The groups of a strip of rows reach into the neighbouring strips, but no farther. So the even strips are
    filtered at the same time, and then the odd ones, and sums do not depend on the number of workers.
    """
    above, below = np.zeros_like(pilot), np.zeros_like(pilot)
    # A distance to NaN is NaN, and less than none
    seen = np.where(np.isfinite(noise.variance), pilot, np.float32(np.nan))
    rows, columns = (_corners(length, patches) for length in pilot.shape)
    strip = rows // (2 * patches.radius + patches.size)
    strips = [rows[strip == k] for k in range(strip[-1] + 1)]
    transform, search = _transform(noise.kernel, patches.size), (patches.radius, members)

    def work(parts: list[NDArray[np.intp]]) -> None:
        for part in parts:
            filter_rows(picture, seen, noise.variance, part, columns, search, transform, above, below)

    for every_other in (strips[::2], strips[1::2]):
        run_in_threads(work, [every_other[worker::workers] for worker in range(workers)])
    np.copyto(above, pilot, where=below == 0)
    return np.divide(above, below, out=above, where=below > 0)


def _corners(length: int, patches: Patches) -> NDArray[np.intp]:
    """Return the first samples of the patches along one axis, with one at the far edge."""
    last = length - patches.size
    return np.unique(np.append(np.arange(0, last, patches.step), last))


def _transform(kernel: NDArray[np.float64], size: int) -> Transform:
    """Return the transform of patches, with the variance of their coefficients for noise of variance one."""
    k, i = np.arange(size)[:, np.newaxis], np.arange(size)
    cosines = np.sqrt(2 / size) * np.cos(np.pi * k * (i + 0.5) / size)
    cosines[0] /= np.sqrt(2)
    variances = np.zeros((size, size))
    for down, right in product((-1, 0, 1), repeat=2):
        along_rows, along_columns = (
            np.einsum("ki,ij,kj->k", cosines, np.eye(size, k=lag), cosines) for lag in (down, right)
        )
        variances += kernel[1 + down, 1 + right] * np.outer(along_rows, along_columns)
    window = np.kaiser(size, _KAISER_BETA)
    cosines, variances, weights = (
        np.ascontiguousarray(array, np.float32) for array in (cosines, variances, np.outer(window, window))
    )
    return Transform(cosines, np.ascontiguousarray(cosines.T), variances, weights)
