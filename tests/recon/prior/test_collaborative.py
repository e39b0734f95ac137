"""The collaborative filters against slow ones in numpy."""

import numba
import numpy as np
import pytest
from scipy.fft import dctn, idctn

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.prior.collaborative import (
    Groups,
    Patches,
    collaborative_wiener,
    patch_candidates,
    refined,
)
from faintfield.recon.prior.evidence import Evidence, Noise, noise_of_back_projection
from faintfield.recon.solver.initialization import back_projection
from tests.recon.displaced import SHAPE, views_displaced_by

KERNEL = np.outer([0.2, 1.0, 0.2], [0.3, 1.0, 0.3])


def haar_matrix(count: int) -> Image:
    matrix = np.ones((1, 1))
    while len(matrix) < count:
        means, differences = np.kron(matrix, [1, 1]), np.kron(np.eye(len(matrix)), [1, -1])
        matrix = np.concatenate([means, differences]) / np.sqrt(2)
    return matrix


def coefficient_variances(kernel: Image, size: int) -> Image:
    row, column = (index.ravel() for index in np.indices((size, size)))
    down, right = row[:, None] - row, column[:, None] - column
    near = (abs(down) <= 1) & (abs(right) <= 1)
    covariance = np.where(near, kernel[np.clip(1 + down, 0, 2), np.clip(1 + right, 0, 2)], 0)
    basis = np.stack([dctn(unit, norm="ortho").ravel() for unit in np.eye(size**2).reshape(-1, size, size)], axis=1)
    return np.asarray(np.diag(basis @ covariance @ basis.T).reshape(size, size))


def slow_filters(
    y: Image, pilot: Image, noise: Noise, patches: Patches, guide: Image | None = None
) -> tuple[Image, Image]:
    """Return pictures filtered by Wiener's gains, and with small coefficients set to zero, group by group."""
    guide = pilot if guide is None else guide
    size, step, radius, members = patches
    above, below = np.zeros((2, 2, *y.shape))
    window = np.outer(np.kaiser(size, 2.0), np.kaiser(size, 2.0))
    per_coefficient = coefficient_variances(noise.kernel, size)
    last = y.shape[0] - size, y.shape[1] - size
    firsts = [sorted({*range(0, length, step), length}) for length in last]
    for row in firsts[0]:
        for column in firsts[1]:
            candidates = [
                (np.sum((cut(guide, row, column, size) - cut(guide, r, c, size)) ** 2), r, c)
                for r in range(max(0, row - radius), min(last[0], row + radius) + 1)
                for c in range(max(0, column - radius), min(last[1], column + radius) + 1)
                if np.isfinite(cut(noise.variance, r, c, size)).all()
            ]
            if not np.isfinite(cut(noise.variance, row, column, size)).all():
                continue
            alike = sorted(candidates)[: 2 ** int(np.log2(min(members, len(candidates))))]
            haar = haar_matrix(len(alike))
            spectra = [
                np.tensordot(haar, [dctn(cut(plane, r, c, size), norm="ortho") for _, r, c in alike], 1)
                for plane in (y, pilot)
            ]
            level = np.mean([noise.variance[r + size // 2, c + size // 2] for _, r, c in alike])
            wiener = spectra[1] ** 2 / (spectra[1] ** 2 + level * per_coefficient)
            large = np.abs(spectra[0]) > 2.7 * np.sqrt(level * per_coefficient)
            large[0, 0, 0] = True  # the mean of the group
            for k, gain in enumerate((wiener, large)):
                weight = window / (np.mean(gain**2 * level * per_coefficient) + 1e-3 * level)
                filtered = np.tensordot(haar.T, spectra[0] * gain, 1)
                for (_, r, c), coefficients in zip(alike, filtered, strict=True):
                    cut(above[k], r, c, size)[:] += weight * idctn(coefficients, norm="ortho")
                    cut(below[k], r, c, size)[:] += weight
    result = np.where(below > 0, above / np.where(below > 0, below, 1), pilot)
    return result[0], result[1]


def cut(plane: Image, row: int, column: int, size: int) -> Image:
    return plane[row : row + size, column : column + size]


def pictures(shape: tuple[int, int], seed: int) -> tuple[Image, Image, Noise]:
    """Return a rough pilot, the same with noise, and noise that rises by a factor of three along the rows."""
    generator = np.random.default_rng(seed)
    pilot = 5 + np.cumsum(generator.normal(size=shape), axis=1) + generator.normal(size=shape)
    variance = np.linspace(0.5, 1.5, shape[1]) * np.ones(shape)
    y = pilot + np.sqrt(variance) * generator.normal(size=shape)
    return y.astype(np.float32), pilot.astype(np.float32), Noise(variance.astype(np.float32), KERNEL)


@pytest.mark.parametrize(
    ("shape", "patches"),
    [
        ((45, 38), Patches(8, 5, 4, 16)),
        ((30, 53), Patches(12, 7, 1, 64)),  # nine candidates, of which eight are taken; fewer in corners
        ((70, 13), Patches(4, 3, 3, 8)),  # several strips of rows
        ((12, 12), Patches(12, 6, 18, 64)),  # a single patch
    ],
)
def test_filters_agree_with_slow_ones(
    shape: tuple[int, int], patches: Patches, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also where no view sees a sample, whose data are no numbers; any number of threads gives the same bits."""
    y, pilot, noise = pictures(shape, 8)
    noise.variance[: shape[0] // 3, -2:] = np.inf
    noise.variance[-1, 0] = np.inf
    y[noise.variance == np.inf] = np.nan
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 2)
    groups = Groups(pilot, noise, patches)
    both = groups.wiener_and_thresholded(y, pilot)
    for result, expected in zip(both, slow_filters(y, pilot, noise, patches), strict=True):
        assert result.dtype == np.float32
        np.testing.assert_allclose(result, expected, atol=1e-5 * np.abs(y[np.isfinite(y)]).max())
    monkeypatch.setattr(numba.config, "NUMBA_NUM_THREADS", 5)
    np.testing.assert_array_equal(both[0], collaborative_wiener(y, pilot, noise, patches))


def test_guide_decides_which_patches_are_alike() -> None:
    y, pilot, noise = pictures((30, 28), 17)
    _, guide, _ = pictures((30, 28), 18)
    noise.variance[:16, -3:] = np.inf
    guide[:16, -3:] = np.nan
    patches = Patches(8, 5, 4, 16)
    both = Groups(guide, noise, patches).wiener_and_thresholded(y, pilot)
    unguided = slow_filters(y, pilot, noise, patches)
    for result, expected, without in zip(both, slow_filters(y, pilot, noise, patches, guide), unguided, strict=True):
        np.testing.assert_allclose(result, expected, atol=1e-5 * np.abs(y).max())
        assert np.abs(result - without).max() > 0.1
    np.testing.assert_array_equal(both[0], collaborative_wiener(y, pilot, noise, patches, guide=guide))


def test_shapes_and_sizes_without_fit_are_refused() -> None:
    y, pilot, noise = pictures((20, 20), 13)
    with pytest.raises(ValueError, match="give all the same"):
        collaborative_wiener(y[1:], pilot, noise)
    with pytest.raises(ValueError, match="give all the same"):
        collaborative_wiener(y, pilot, noise, guide=pilot[:, 1:])
    for size in (0, 6, 24):
        with pytest.raises(ValueError, match=f"patches of {size} samples"):
            collaborative_wiener(y, pilot, noise, Patches(size))
    with pytest.raises(ValueError, match="radius 91 is more than 90"):
        collaborative_wiener(y, pilot, noise, Patches(radius=91))


def test_candidates_are_those_of_slow_filters() -> None:
    """Groups are searched in what all colours show."""
    y, pilot, noise = pictures((13, 14), 21)
    others = 3 * pictures((13, 14), 22)[1]
    candidates = patch_candidates(Evidence(y, pilot, noise, np.ones_like(y), others))

    def filtered(pilot: Image) -> tuple[Image, Image]:
        return slow_filters(y, pilot, noise, Patches(8, 6, 16, 64), pilot + others)

    wiener, kept = filtered(pilot)
    twice, _ = filtered((wiener + kept) / 2)
    for name, expected in {"tv": pilot, "wiener": wiener, "twice": twice}.items():
        np.testing.assert_allclose(candidates[name], expected, atol=1e-3, err_msg=name)


def test_refined_picture_adds_the_filters_change() -> None:
    generator = np.random.default_rng(15)
    operator = views_displaced_by(generator.uniform(0, 1, (5, 2)), width=80)
    plane = generator.uniform(0, 2, SHAPE).astype(np.float32)
    electrons = operator.forward(plane) + generator.normal(0, 2, operator.images_shape).astype(np.float32)
    images = ElementalImages(electrons + np.float32(0.5), 0.5, 4.0)
    u = back_projection(operator, ElementalImages(operator.forward(plane)))
    noise = noise_of_back_projection(operator, images, plane)
    change = collaborative_wiener(back_projection(operator, images), u, noise) - u
    result = refined(operator, images, plane)
    np.testing.assert_allclose(result, np.maximum(plane + change, 0), atol=1e-5)
    assert (plane + change).min() < 0
    unseen = operator.coverage() == 0
    assert unseen.any()
    np.testing.assert_array_equal(result[unseen], plane[unseen])


def test_indefinite_kernel_keeps_result_within_the_picture() -> None:
    generator = np.random.default_rng(8)
    stripes = np.where(np.arange(64) % 2, 1.0, -1.0)[:, np.newaxis] * np.linspace(0, 1, 96)
    pilot = (3 + stripes).astype(np.float32)
    picture = (pilot + generator.normal(0, 0.5, pilot.shape)).astype(np.float32)
    kernel = np.outer([0.6, 1.0, 0.6], [0.2, 1.0, 0.2])  # samples alternating by row would have a variance below zero
    noise = Noise(np.full(pilot.shape, 0.25, np.float32), kernel)
    for result in Groups(pilot, noise, Patches(8, 6, 16, 64)).wiener_and_thresholded(picture, pilot):
        assert np.abs(result - 3).max() < np.abs(picture - 3).max()
