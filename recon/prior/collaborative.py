"""Collaborative filters: a picture without its noise, by groups of patches that are alike; candidates for a plane."""

from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.collaborative_kernels import Transform, filter_rows
from faintfield.recon.prior.evidence import Evidence, Noise, evidence_of_planes
from faintfield.recon.threads import map_in_threads

# Shape parameter of the Kaiser window that weights the samples of a patch.
_KAISER_BETA = 2.0

# Least variance of a coefficient, relative to that of a sample.
_LEAST_VARIANCE = 0.01

# A coefficient below so many standard deviations of its noise is taken for noise.
_THRESHOLD = 2.7


class Patches(NamedTuple):
    """Settings by which groups of similar patches are formed.

    Attributes
    ----------
    size, step, radius : int
        Samples of a patch along each side, a multiple of four; from one reference patch to the next; and from a
        reference to the farthest patch of its group, along rows and columns.
    members : int
        Largest number of patches in a group.
    """

    size: int = 12
    step: int = 5
    radius: int = 18
    members: int = 64


def collaborative_wiener(
    picture: Image, pilot: Image, noise: Noise, patches: Patches | None = None, *, guide: Image | None = None
) -> NDArray[np.float32]:
    """Return a picture (row, column) without its noise, filtered in groups of patches that are alike in the guide.

    The collaborative filter of Dabov, Foi, Katkovnik and Egiazarian (2007), second step: each group of alike patches is
    transformed by cosines along rows and columns and by Haar's wavelets along the group, and each coefficient of the
    picture is multiplied by `U²/(U² + v)`, with U that of the pilot and v the variance of the noise. Each
    sample is the mean of what the patches around it say, with weights that fall with the noise left in them.

    Parameters
    ----------
    picture, pilot, noise : float array (row, column), float array (row, column), Noise
        y, a picture of the same scene without noise, as blurred as y, and the covariance of y. Patches with a sample of
        infinite variance join no group: samples that are in no other patch keep the pilot's value.
    patches : Patches, optional
        Settings of the groups.
    guide : float array (row, column), optional
        A picture of the same scene in which alike patches are found; the pilot by default.

    Raises
    ------
    ValueError
        Shapes differ, the picture is smaller than a patch, or the size of a patch is not a multiple of four.
    """
    (wiener,) = wiener_and_thresholded(picture, pilot, noise, patches or Patches(), guide=guide, filters=1)
    return wiener


def wiener_and_thresholded(
    picture: Image, pilot: Image, noise: Noise, patches: Patches, *, guide: Image | None = None, filters: int = 2
) -> list[NDArray[np.float32]]:
    """Return what `collaborative_wiener` returns, and the picture whose groups keep what stands out of the noise.

    The second, the filter's first step, keeps the picture's own coefficients above 2.7 standard deviations of their
    noise. So it also shows what the pilot lost. It is left out if `filters` is 1.
    """
    guide = pilot if guide is None else guide
    picture, pilot, guide, variance = (
        np.ascontiguousarray(array, np.float32) for array in (picture, pilot, guide, noise.variance)
    )
    _check(picture, pilot, guide, variance, patches)
    # A distance to NaN is below none
    guide = np.where(np.isfinite(variance), guide, np.float32(np.nan))
    above, below = np.zeros((2, filters, *pilot.shape), np.float32)
    transform = _transform(noise.kernel, patches.size)
    rows, columns = (_corners(length, patches) for length in pilot.shape)
    search = (patches.radius, patches.members, np.float32(_THRESHOLD))

    def work(strip: NDArray[np.intp]) -> None:
        filter_rows(picture, pilot, guide, variance, strip, columns, search, transform, above, below)

    # Groups reach into the next strips, but no farther: the strips of one turn can be filtered at the same time
    strip_of_row = rows // (2 * patches.radius + patches.size)
    strips_of_all = [rows[strip_of_row == k] for k in range(strip_of_row[-1] + 1)]
    for turn in (0, 1):
        map_in_threads(work, strips_of_all[turn::2])
    for total, weight in zip(above, below, strict=True):
        np.copyto(total, pilot, where=weight == 0)
        np.divide(total, weight, out=total, where=weight > 0)
    return list(above)


def _check(picture: Image, pilot: Image, guide: Image, variance: Image, patches: Patches) -> None:
    shapes = [array.shape for array in (picture, pilot, guide, variance)]
    if len(set(shapes)) > 1:
        raise ValueError(f"picture, pilot, guide and variance have shapes {shapes}; give all the same")
    if patches.size < 4 or patches.size % 4 or patches.size > min(picture.shape):
        raise ValueError(
            f"patches of {patches.size} samples in a picture {picture.shape}; give a multiple of four that fits into it"
        )


def _corners(length: int, patches: Patches) -> NDArray[np.intp]:
    """Return the first samples of the reference patches along one axis; the last patch ends at the edge."""
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
    # A kernel measured on one draw need not be positive definite
    variances = np.maximum(variances, _LEAST_VARIANCE)
    window = np.kaiser(size, _KAISER_BETA)
    arrays = cosines, cosines.T, variances, np.outer(window, window)
    return Transform(*(np.ascontiguousarray(array, np.float32) for array in arrays))


# Large patches average most of the noise away, small ones keep what is seen once. Chosen on photographs.
_LARGE = Patches(size=8, step=6, radius=16, members=64)
_SMALL = Patches(size=4, step=3, radius=8, members=32)


def patch_candidates(evidence: Evidence) -> dict[str, Image]:
    """Return pictures (row, column) of a plane by name, all as blurred as the evidence, in electrons.

    "tv" is the pilot, the plane of the penalty; "wiener" the collaborative Wiener filter with this pilot; "twice" the
    filter again, its pilot the mean of the first result and of the thresholded picture, which shows what the penalty
    lost; "fine" the same with small patches, from "twice" and their thresholded picture. A plane smaller than a patch
    has its pilot only. Alike patches are found in the sum of the pilot and of the light in other colours.
    """
    picture, pilot, noise, _, other_colours = evidence

    def guide(pilot: Image) -> Image:
        return pilot if other_colours is None else pilot + other_colours

    found = {"tv": pilot}
    if min(pilot.shape) >= _LARGE.size:
        wiener, thresholded = wiener_and_thresholded(picture, pilot, noise, _LARGE, guide=guide(pilot))
        found["wiener"] = wiener
        better = (wiener + thresholded) / 2
        found["twice"] = collaborative_wiener(picture, better, noise, _LARGE, guide=guide(better))
        _, thresholded = wiener_and_thresholded(picture, pilot, noise, _SMALL, guide=guide(pilot))
        better = (found["twice"] + thresholded) / 2
        found["fine"] = collaborative_wiener(picture, better, noise, _SMALL, guide=guide(better))
    return found


def refined(operator: SceneOperator, images: ElementalImages, plane: Image) -> Image:
    """Return a picture with the detail that its penalty removed: `( f + w − u )₊`, with f ≥ 0 (row, column).

    u is the back-projection of H f, of one plane or surface, and w that of the data, y, filtered with u as its pilot.
    """
    (evidence,) = evidence_of_planes(operator, images, plane)
    w = collaborative_wiener(evidence.picture, evidence.pilot, evidence.noise)
    return np.maximum(plane + (w - evidence.pilot).astype(plane.dtype), 0)
