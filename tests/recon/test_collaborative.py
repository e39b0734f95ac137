"""The collaborative filters against slow ones in numpy."""

from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.prior.collaborative import Patches, collaborative_wiener, wiener_and_thresholded
from faintfield.recon.prior.evidence import Evidence, Noise, noise_of_back_projection
from faintfield.recon.prior.patches import patch_candidates, refined
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import back_projection, smooth_start, universal_penalty_weight
from faintfield.recon.solver.pmlem import pmlem
from tests.recon.displaced import SHAPE, noisy_images, views_displaced_by

KERNEL = np.outer([0.2, 1.0, 0.2], [0.3, 1.0, 0.3])


def inner(plane: NDArray[np.floating]) -> NDArray[np.floating]:
    return plane[4:-4, 4:-4]


# --- the filter ------------------------------------------------------------------------------------------------------


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
    """One group after the other, in float64: filtered by Wiener's gains, and with small coefficients set to zero."""
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
    found = np.where(below > 0, above / np.where(below > 0, below, 1), pilot)
    return found[0], found[1]


def cut(plane: Image, row: int, column: int, size: int) -> Image:
    return plane[row : row + size, column : column + size]


def pictures(shape: tuple[int, int], seed: int) -> tuple[Image, Image, Noise]:
    """A rough pilot, the same with noise, and noise that rises by a factor of three along the rows."""
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
def test_the_filters_agree_with_slow_ones(shape: tuple[int, int], patches: Patches) -> None:
    y, pilot, noise = pictures(shape, 8)
    noise.variance[: shape[0] // 3, -2:] = np.inf
    noise.variance[-1, 0] = np.inf
    y[noise.variance == np.inf] = np.nan
    both = wiener_and_thresholded(y, pilot, noise, patches, workers=2)
    for found, expected in zip(both, slow_filters(y, pilot, noise, patches), strict=True):
        assert found.dtype == np.float32
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(y[np.isfinite(y)]).max())
    np.testing.assert_array_equal(both[0], collaborative_wiener(y, pilot, noise, patches, workers=2))


def test_with_a_guide_its_patches_decide_who_is_alike_and_the_pilot_what_is_kept() -> None:
    y, pilot, noise = pictures((45, 38), 17)
    _, guide, _ = pictures((45, 38), 18)
    noise.variance[:20, -3:] = np.inf
    guide[:20, -3:] = np.nan
    patches = Patches(8, 5, 4, 16)
    both = wiener_and_thresholded(y, pilot, noise, patches, guide=guide, workers=2)
    unguided = slow_filters(y, pilot, noise, patches)
    for found, expected, other in zip(both, slow_filters(y, pilot, noise, patches, guide), unguided, strict=True):
        np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(y).max())
        assert np.abs(found - other).max() > 0.1
    np.testing.assert_array_equal(both[0], collaborative_wiener(y, pilot, noise, patches, guide=guide))


def test_a_guide_in_another_unit_finds_the_groups_of_the_pilot() -> None:
    y, pilot, noise = pictures((60, 50), 19)
    expected = collaborative_wiener(y, pilot, noise)
    for guide in (pilot, -4 * pilot):  # powers of two keep all digits
        np.testing.assert_array_equal(collaborative_wiener(y, pilot, noise, guide=guide), expected)
    shuffled = np.random.default_rng(20).permutation(pilot.ravel()).reshape(pilot.shape)
    assert np.abs(collaborative_wiener(y, pilot, noise, guide=shuffled) - expected).max() > 0.1


def test_the_results_do_not_depend_on_the_number_of_workers() -> None:
    y, pilot, noise = pictures((300, 64), 9)
    single = wiener_and_thresholded(y, pilot, noise, Patches(), workers=1)
    several = wiener_and_thresholded(y, pilot, noise, Patches(), workers=5)
    for found, expected in zip(several, single, strict=True):
        np.testing.assert_array_equal(found, expected)


def test_samples_that_no_view_sees_keep_the_value_of_the_pilot_and_change_no_other() -> None:
    y, pilot, noise = pictures((64, 64), 12)
    noise.variance[:, 40:] = np.inf
    y[:, 40:], other = 1e6, y.copy()
    found = collaborative_wiener(y, pilot, noise)
    np.testing.assert_array_equal(found[:, 40:], pilot[:, 40:])
    other[:, 40:] = np.nan
    np.testing.assert_array_equal(collaborative_wiener(other, pilot, noise), found)
    assert np.abs(found[:, :40] - pilot[:, :40]).max() > 0.01


def test_shapes_and_sizes_that_do_not_fit_are_refused() -> None:
    y, pilot, noise = pictures((20, 20), 13)
    with pytest.raises(ValueError, match="give all the same"):
        collaborative_wiener(y[1:], pilot, noise)
    with pytest.raises(ValueError, match="give all the same"):
        collaborative_wiener(y, pilot, noise, guide=pilot[:, 1:])
    for size in (0, 6, 24):
        with pytest.raises(ValueError, match=f"patches of {size} samples"):
            collaborative_wiener(y, pilot, noise, Patches(size))


# --- the candidates --------------------------------------------------------------------------------------------------


def test_candidates_are_those_of_slow_filters_in_groups_that_all_colours_show() -> None:
    y, pilot, noise = pictures((24, 26), 21)
    _, shown, _ = pictures((24, 26), 22)
    others = 3 * shown
    found = patch_candidates(Evidence(y, pilot, noise, np.ones_like(y), others))
    large, small = Patches(8, 6, 16, 64), Patches(4, 3, 8, 32)

    def filtered(pilot: Image, patches: Patches) -> tuple[Image, Image]:
        return slow_filters(y, pilot, noise, patches, pilot + others)

    wiener, kept = filtered(pilot, large)
    twice, _ = filtered((wiener + kept) / 2, large)
    _, kept_small = filtered(pilot, small)
    fine, _ = filtered((twice + kept_small) / 2, small)
    for name, expected in {"tv": pilot, "wiener": wiener, "twice": twice, "fine": fine}.items():
        np.testing.assert_allclose(found[name], expected, atol=1e-3, err_msg=name)


# --- the refinement --------------------------------------------------------------------------------------------------


def test_refining_brings_a_texture_back_that_total_variation_flattens() -> None:
    generator = np.random.default_rng(14)
    row, column = np.indices(SHAPE)
    truth = (8 + 2.5 * np.sin(2 * np.pi * row / 6) * np.sin(2 * np.pi * column / 7)).astype(np.float32)
    operator = views_displaced_by(generator.uniform(-0.5, 0.5, (9, 2)))
    images = noisy_images(operator, truth, 0.3, 6.0, 14)
    start = smooth_start(operator, images)
    fit = DataFit(operator, images, float(start.mean()))
    weight = universal_penalty_weight(operator, images, start)
    plane = list(islice(pmlem(fit, start, penalty_weight=weight), 30))[-1].plane
    result = refined(operator, images, plane)
    before, after = (np.mean(np.square(inner(found - truth))) for found in (plane, result))
    assert after < 0.7 * before
    assert result.dtype == plane.dtype


def test_a_refined_picture_is_the_picture_plus_what_the_filter_changed_and_never_negative() -> None:
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


def test_a_kernel_that_is_not_positive_definite_leaves_the_result_within_the_picture() -> None:
    generator = np.random.default_rng(8)
    stripes = np.where(np.arange(64) % 2, 1.0, -1.0)[:, np.newaxis] * np.linspace(0, 1, 96)
    pilot = (3 + stripes).astype(np.float32)
    picture = (pilot + generator.normal(0, 0.5, pilot.shape)).astype(np.float32)
    kernel = np.outer([0.6, 1.0, 0.6], [0.2, 1.0, 0.2])  # samples alternating by row would have a variance below zero
    noise = Noise(np.full(pilot.shape, 0.25, np.float32), kernel)
    for found in wiener_and_thresholded(picture, pilot, noise, Patches(8, 6, 16, 64)):
        assert np.abs(found - 3).max() < np.abs(picture - 3).max()
