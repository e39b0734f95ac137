"""Detail that a penalty removed, found in the back-projection by a collaborative Wiener filter."""

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

# Spacings of the blurs of the noise of a draw, which stands in for many draws, and of the number of views.
_WIDE_BLUR, _NARROW_BLUR = (1, 2, 4, 8, 12), (1, 1)

# Where the variance is smaller, there is none.
_TINY = 1e-30

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
    """How groups of alike patches are formed.

    Attributes
    ----------
    size : int
        Samples of a patch along each side, a multiple of four.
    step : int
        Samples from one reference patch to the next.
    radius : int
        How far from its reference a patch may lie, along rows and columns.
    members : int
        Largest number of patches in a group.
    """

    size: int = 12
    step: int = 5
    radius: int = 18
    members: int = 64


def refined(operator: SceneOperator, images: ElementalImages, plane: Image) -> Image:
    """Return a picture with the detail that its penalty removed: `( f + w − u )₊`.

    u is the back-projection of H f, as blurred as that of the data, y; and w is y filtered with u as its pilot.

    Parameters
    ----------
    operator : SceneOperator
        H of one plane or surface.
    images : ElementalImages
        The data.
    plane : float array (row, column)
        f, in electrons.
    """
    noise = noise_of_back_projection(operator, images, plane)
    u, coverage = operator.adjoint_of_forward(plane), operator.coverage()
    np.divide(u, coverage, out=u, where=coverage > 0)  # where none sees, u is zero anyway
    w = collaborative_wiener(back_projection(operator, images), u, noise)
    return np.maximum(plane + (w - u).astype(plane.dtype), 0)


def noise_of_back_projection(
    operator: SceneOperator, images: ElementalImages, plane: Image, *, seed: int = 0, draws: int = 1
) -> Noise:
    """Return the covariance of the back-projection's noise, for data of variance `H f + b + σ²`.

    A pixel of variance v adds h² v to the variance of a sum Hᵀ g, and the operator can only add h v. The ratio of the
    two sums changes slowly over the plane, so it is measured, like the kernel, on back-projected draws of the noise,
    one view at a time.

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
        products += _products_of_neighbours(np.where(seen, light, 0) / np.sqrt(np.maximum(variance, _TINY)))
    factor = blurred(squares, _WIDE_BLUR) / (draws * np.maximum(blurred(variance, _WIDE_BLUR), _TINY))
    factor *= blurred(variance, _NARROW_BLUR)
    of_mean = np.full(coverage.shape, np.inf, np.float32)
    np.divide(factor, np.square(blurred(coverage, _NARROW_BLUR)), out=of_mean, where=seen)
    return Noise(of_mean, products / products[1, 1])


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
    patches: Patches | None = None,
    *,
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
    patches : Patches, optional
        How groups are formed.
    workers : int, optional
        Number of threads; the result does not depend on it.

    Raises
    ------
    ValueError
        Shapes differ, the picture is smaller than a patch, or the size of a patch is not a multiple of four.
    """
    patches = patches or Patches()
    picture, pilot, variance = (np.ascontiguousarray(array, np.float32) for array in (picture, pilot, noise.variance))
    _check(picture, pilot, variance, patches)
    # A distance to NaN is below none
    seen = np.where(np.isfinite(variance), pilot, np.float32(np.nan))
    above, below = np.zeros_like(pilot), np.zeros_like(pilot)
    transform = _transform(noise.kernel, patches.size)
    rows, columns = (_corners(length, patches) for length in pilot.shape)

    def work(strips: list[NDArray[np.intp]]) -> None:
        for strip in strips:
            search = (patches.radius, patches.members)
            filter_rows(picture, seen, variance, strip, columns, search, transform, above, below)

    # Groups reach into the next strips, but no farther: the strips of one turn can be filtered at the same time
    strip_of_row = rows // (2 * patches.radius + patches.size)
    strips_of_all = [rows[strip_of_row == k] for k in range(strip_of_row[-1] + 1)]
    for turn in range(min(2, len(strips_of_all))):
        strips = strips_of_all[turn::2]
        count = min(workers or int(numba.config.NUMBA_NUM_THREADS), len(strips))
        run_in_threads(work, [strips[worker::count] for worker in range(count)])
    np.copyto(above, pilot, where=below == 0)
    return np.divide(above, below, out=above, where=below > 0)


def _check(picture: Image, pilot: Image, variance: Image, patches: Patches) -> None:
    """Refuse shapes that differ or are too small for a patch, and sizes that are not multiples of four (ValueError)."""
    if not picture.shape == pilot.shape == variance.shape:
        raise ValueError(
            f"picture, pilot and variance have shapes {picture.shape}, {pilot.shape} and {variance.shape}; give "
            "all the same"
        )
    if patches.size < 4 or patches.size % 4 or patches.size > min(picture.shape):
        raise ValueError(
            f"patches of {patches.size} samples in a picture {picture.shape}; give a multiple of four that fits into it"
        )


def _corners(length: int, patches: Patches) -> NDArray[np.intp]:
    """Return the first samples of the reference patches along one axis, the last of which ends at the edge."""
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
    arrays = cosines, cosines.T, variances, np.outer(window, window)
    return Transform(*(np.ascontiguousarray(array, np.float32) for array in arrays))
