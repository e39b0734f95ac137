"""Collaborative filters: a picture without its noise, by groups of patches that are alike; candidates for a plane."""

from collections.abc import Collection
from itertools import product
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.collaborative_kernels import Transform, filter_rows, find_groups
from faintfield.recon.prior.evidence import Evidence, Noise, evidence_of_planes
from faintfield.recon.threads import map_in_threads

# Shape parameter of the Kaiser window that weights the samples of a patch.
_KAISER_BETA = 2.0

# Least variance of a coefficient, relative to that of a sample.
_LEAST_VARIANCE = 0.01

# Places of members are 16-bit numbers.
_MAX_RADIUS = 90

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


class Groups:
    """Groups of patches that are alike in a guide, a picture (row, column) of the same scene as those to filter.

    `noise` is that of the pictures to filter. Patches with a sample of infinite variance join no group.
    """

    def __init__(self, guide: Image, noise: Noise, patches: Patches) -> None:
        size = patches.size
        _require_same_shapes(guide=guide, variance=noise.variance)
        if size < 4 or size % 4 or size > min(guide.shape):
            raise ValueError(
                f"patches of {size} samples in a picture {guide.shape}; give a multiple of four that fits into it"
            )
        if patches.radius > _MAX_RADIUS:
            raise ValueError(f"radius {patches.radius} is more than {_MAX_RADIUS} samples; give a smaller one")
        # A distance to NaN is below none
        known = np.where(np.isfinite(noise.variance), guide, np.nan).astype(np.float32)
        self._patches, self._variance = patches, np.asarray(noise.variance, np.float32)
        self._rows, self._columns = (_corners(length, patches) for length in guide.shape)
        self._places = np.empty((self._rows.size, self._columns.size, patches.members), np.int16)
        self._transform = _transform(noise.kernel, size)
        # Groups reach into the next strips, but no farther: every other strip can be filtered at the same time
        strip_of_row = self._rows // (2 * patches.radius + size)
        self._strips = [np.flatnonzero(strip_of_row == k) for k in range(strip_of_row[-1] + 1)]

        def find(strip: NDArray[np.intp]) -> None:
            part = slice(strip[0], strip[-1] + 1)
            find_groups(known, self._rows[part], self._columns, size, patches.radius, self._places[part])

        map_in_threads(find, self._strips)

    def wiener(self, picture: Image, pilot: Image) -> NDArray[np.float32]:
        """Return a picture as Wiener's filter leaves it: see `collaborative_wiener`."""
        return self._filtered(picture, pilot, thresholded=False)[0]

    def wiener_and_thresholded(self, picture: Image, pilot: Image) -> list[NDArray[np.float32]]:
        """Return that, and what stands out of the noise of a picture, with the pilot's samples that are in no group.

        The latter is the first step of Dabov et al.: coefficients above 2.7 standard deviations of their noise are
        kept. So it also shows what the pilot lost.
        """
        return self._filtered(picture, pilot, thresholded=True)

    def _filtered(self, picture: Image, pilot: Image, *, thresholded: bool) -> list[NDArray[np.float32]]:
        _require_same_shapes(guide=self._variance, picture=picture, pilot=pilot)
        picture, pilot = (np.ascontiguousarray(array, np.float32) for array in (picture, pilot))
        large = picture.shape if thresholded else (0, 0)
        sums = [np.zeros((2, *shape), np.float32) for shape in (picture.shape, large)]

        def work(strip: NDArray[np.intp]) -> None:
            part = slice(strip[0], strip[-1] + 1)
            groups = (self._rows[part], self._columns, self._patches.radius, self._places[part])
            filter_rows(picture, pilot, self._variance, *groups, np.float32(_THRESHOLD), self._transform, *sums)

        for turn in (0, 1):
            map_in_threads(work, self._strips[turn::2])
        for total, weight in sums:
            if total.size:
                np.copyto(total, pilot, where=weight == 0)
            np.divide(total, weight, out=total, where=weight > 0)
        return [total for total, _ in sums if total.size]


def _require_same_shapes(**pictures: Image) -> None:
    shapes = {name: picture.shape for name, picture in pictures.items()}
    if len(set(shapes.values())) > 1:
        raise ValueError(f"shapes are {shapes}; give all the same")


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
        y, a picture of the same scene without noise, as blurred as y, and the covariance of y. Samples that are in no
        group keep the pilot's value.
    patches : Patches, optional
        Settings of the groups.
    guide : float array (row, column), optional
        A picture of the same scene in which alike patches are found; the pilot by default.

    Raises
    ------
    ValueError
        Shapes differ, the picture is smaller than a patch, or the size of a patch is not a multiple of four.
    """
    return Groups(pilot if guide is None else guide, noise, patches or Patches()).wiener(picture, pilot)


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


# Chosen on photographs.
_PATCHES = Patches(size=8, step=6, radius=16, members=64)


def patch_candidates(evidence: Evidence, names: Collection[str] | None = None) -> dict[str, Image]:
    """Return pictures (row, column) of a plane by name, all as blurred as the evidence, in electrons.

    "tv" is the pilot, the plane of the penalty; "wiener" the collaborative Wiener filter with this pilot; "twice" the
    filter again, its pilot the mean of the first result and of the thresholded picture, which shows what the penalty
    lost. A plane smaller than a patch has its pilot only; so it is if `names` is "tv" alone. Alike patches are found in
    the sum of the pilot and of the light in other colours.
    """
    picture, pilot, noise, _, other_colours = evidence

    def guide(pilot: Image) -> Image:
        return pilot if other_colours is None else pilot + other_colours

    if min(pilot.shape) < _PATCHES.size or (names is not None and set(names) <= {"tv"}):
        return {"tv": pilot}
    wiener, thresholded = Groups(guide(pilot), noise, _PATCHES).wiener_and_thresholded(picture, pilot)
    better = (wiener + thresholded) / 2
    twice = collaborative_wiener(picture, better, noise, _PATCHES, guide=guide(better))
    return {"tv": pilot, "wiener": wiener, "twice": twice}


def refined(operator: SceneOperator, images: ElementalImages, plane: Image) -> Image:
    """Return a picture with the detail that its penalty removed: `( f + w − u )₊`, with f ≥ 0 (row, column).

    u is the back-projection of H f, of one plane or surface, and w that of the data, y, filtered with u as its pilot.
    """
    (evidence,) = evidence_of_planes(operator, images, plane)
    w = collaborative_wiener(evidence.picture, evidence.pilot, evidence.noise)
    return np.maximum(plane + (w - evidence.pilot).astype(plane.dtype), 0)
