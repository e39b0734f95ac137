"""The collaborative Wiener filter against a slow one in numpy, and the noise of back-projections in closed form."""

from itertools import islice

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.fft import dctn, idctn

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.prior.collaborative import Patches, collaborative_wiener
from faintfield.recon.prior.evidence import Noise, noise_of_back_projection
from faintfield.recon.prior.patches import refined
from faintfield.recon.solver.data_fit import DataFit
from faintfield.recon.solver.initialization import back_projection, smooth_start, universal_penalty_weight
from faintfield.recon.solver.pmlem import pmlem

SHAPE = (96, 112)
KERNEL = np.outer([0.2, 1.0, 0.2], [0.3, 1.0, 0.3])


def views_displaced_by(
    shifts: Image, shape: tuple[int, int] = SHAPE, *, width: int = 0, turn_rad: float = 0.0
) -> PlaneOperator:
    """Views of one pixel per sample, displaced by `shifts` (view, 2) down and right; `width` columns are seen."""
    columns, rows = np.meshgrid(np.arange(-1.0, (width or shape[1]) + 1), np.arange(-1.0, shape[0] + 1))
    turn = np.array([[np.cos(turn_rad), -np.sin(turn_rad)], [np.sin(turn_rad), np.cos(turn_rad)]])
    homographies = np.stack([np.eye(3)] * len(shifts))
    homographies[:, :2, :2], homographies[:, :2, 2] = turn, shifts[:, ::-1]
    rays = np.stack([columns, rows], axis=-1)
    return PlaneOperator(homographies, rays, PlaneGrid(shape, 1.0, (0.0, 0.0)), workers=1)


def inner(plane: NDArray[np.floating]) -> NDArray[np.floating]:
    return plane[4:-4, 4:-4]


def without_light(operator: PlaneOperator, background_e: float, variance_e2: float) -> ElementalImages:
    return ElementalImages(np.zeros(operator.images_shape, np.float32), background_e, variance_e2)


# --- the noise of a back-projection ----------------------------------------------------------------------------------


@pytest.mark.parametrize("in_phase", [False, True])
def test_the_noise_of_displaced_views_has_the_covariance_of_their_bilinear_weights(in_phase: bool) -> None:
    shifts = np.random.default_rng(5).uniform(-0.3, 0.3, (6, 2)) + np.array([0.5, 0.25])
    shifts = np.full((6, 2), 0.5) if in_phase else shifts
    operator = views_displaced_by(shifts)
    plane = np.full(SHAPE, 3.0, np.float32)
    noise = noise_of_back_projection(operator, without_light(operator, 0.5, 12.0), plane, draws=2)
    # A sample has the weights (1 − φ, φ) ⊗ (1 − φ', φ') in each view
    phases = shifts % 1
    own = phases**2 + (1 - phases) ** 2
    of_neighbours = phases * (1 - phases)
    factor = np.sum(own[:, 0] * own[:, 1])
    expected = 15.5 * factor / 36
    assert np.median(inner(noise.variance)) == pytest.approx(expected, rel=0.03)
    np.testing.assert_allclose(inner(noise.variance), expected, rtol=0.25)
    kernel = np.ones((3, 3))
    kernel[1, ::2] = np.sum(own[:, 0] * of_neighbours[:, 1]) / factor
    kernel[::2, 1] = np.sum(of_neighbours[:, 0] * own[:, 1]) / factor
    kernel[::2, ::2] = np.sum(of_neighbours[:, 0] * of_neighbours[:, 1]) / factor
    np.testing.assert_allclose(noise.kernel, kernel, atol=0.025)
    assert noise.kernel[1, 1] == 1


def test_averaged_over_all_phases_the_weights_squared_are_four_ninths() -> None:
    operator = views_displaced_by(np.random.default_rng(6).uniform(-9, 9, (12, 2)), turn_rad=0.11)
    noise = noise_of_back_projection(operator, without_light(operator, 0.0, 9.0), np.zeros(SHAPE, np.float32))
    coverage = operator.coverage()
    well = coverage > 6
    ratio = noise.variance[well] * coverage[well] / 9
    assert well.mean() > 0.6
    assert np.median(ratio) == pytest.approx(4 / 9, rel=0.05)
    np.testing.assert_allclose(noise.kernel, np.outer([0.25, 1, 0.25], [0.25, 1, 0.25]), atol=0.03)


def test_noise_follows_the_light_and_the_number_of_views_sample_by_sample() -> None:
    generator = np.random.default_rng(7)
    shifts = generator.uniform(0, 1, (8, 2))
    operator = views_displaced_by(np.concatenate([shifts, shifts + np.array([0, 56])]))  # half of them see the left
    plane = np.full(SHAPE, 1.0, np.float32)
    plane[48:] = 30.0
    images = without_light(operator, 0.5, 4.0)
    found = noise_of_back_projection(operator, images, plane).variance
    draws = []
    for _ in range(80):
        sd = np.sqrt(operator.forward(plane) + 4.5)
        noise = generator.standard_normal(sd.shape, np.float32) * sd + np.float32(0.5)
        draws.append(back_projection(operator, ElementalImages(noise, 0.5)))
    drawn = np.var(draws, axis=0)
    for part in (np.s_[4:40, 4:50], np.s_[56:-4, 4:50], np.s_[4:40, 62:-4], np.s_[56:-4, 62:-4]):
        assert np.median(found[part] / drawn[part]) == pytest.approx(1, rel=0.15)
        assert np.mean(abs(np.log(found[part] / drawn[part]))) < 0.25  # of single samples, 0.13 is that of the draws
    left, right = found[4:40, 4:50].mean(), found[4:40, 62:-4].mean()
    assert left / right == pytest.approx(2, rel=0.25)
    # A column on either side of a border must not take the mean of both
    np.testing.assert_allclose(found[4:-4, 52] / found[4:-4, 60], 2, rtol=0.3)
    np.testing.assert_allclose(found[51, 4:50] / found[44, 4:50], 34.5 / 5.5, rtol=0.3)


def test_noise_is_infinite_where_no_view_sees_and_repeatable() -> None:
    operator = views_displaced_by(np.zeros((2, 2)), width=60)
    images, plane = without_light(operator, 0.0, 4.0), np.ones(SHAPE, np.float32)
    noise, again = (noise_of_back_projection(operator, images, plane, seed=3) for _ in range(2))
    np.testing.assert_array_equal(np.isinf(noise.variance), operator.coverage() == 0)
    assert 0 < np.isinf(noise.variance).sum() < noise.variance.size
    np.testing.assert_array_equal(noise.variance, again.variance)
    assert noise_of_back_projection(operator, images, plane, seed=4).kernel[0, 0] != noise.kernel[0, 0]


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


def slow_filter(y: Image, pilot: Image, noise: Noise, patches: Patches) -> Image:
    """One group after the other, in float64."""
    size, step, radius, members = patches
    above, below = np.zeros(y.shape), np.zeros(y.shape)
    window = np.outer(np.kaiser(size, 2.0), np.kaiser(size, 2.0))
    per_coefficient = coefficient_variances(noise.kernel, size)
    last = y.shape[0] - size, y.shape[1] - size
    firsts = [sorted({*range(0, length, step), length}) for length in last]
    for row in firsts[0]:
        for column in firsts[1]:
            candidates = [
                (np.sum((cut(pilot, row, column, size) - cut(pilot, r, c, size)) ** 2), r, c)
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
            gain = spectra[1] ** 2 / (spectra[1] ** 2 + level * per_coefficient)
            weight = window / (np.mean(gain**2 * level * per_coefficient) + 1e-3 * level)
            filtered = np.tensordot(haar.T, spectra[0] * gain, 1)
            for (_, r, c), coefficients in zip(alike, filtered, strict=True):
                cut(above, r, c, size)[:] += weight * idctn(coefficients, norm="ortho")
                cut(below, r, c, size)[:] += weight
    return np.where(below > 0, above / np.where(below > 0, below, 1), pilot)


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
@pytest.mark.parametrize("partly_unseen", [False, True])
def test_the_filter_agrees_with_a_slow_one(shape: tuple[int, int], patches: Patches, partly_unseen: bool) -> None:
    y, pilot, noise = pictures(shape, 8)
    if partly_unseen:
        noise.variance[: shape[0] // 3, -2:] = np.inf
        noise.variance[-1, 0] = np.inf
        y[noise.variance == np.inf] = np.nan
    expected = slow_filter(y, pilot, noise, patches)
    found = collaborative_wiener(y, pilot, noise, patches, workers=2)
    assert found.dtype == np.float32
    np.testing.assert_allclose(found, expected, atol=1e-5 * np.abs(y[np.isfinite(y)]).max())


@pytest.mark.parametrize("workers", [1, 2, 5])
def test_the_result_does_not_depend_on_the_number_of_workers(workers: int) -> None:
    y, pilot, noise = pictures((300, 64), 9)
    single = collaborative_wiener(y, pilot, noise, workers=1)
    np.testing.assert_array_equal(collaborative_wiener(y, pilot, noise, workers=workers), single)


def test_without_noise_the_picture_is_returned() -> None:
    y, pilot, noise = pictures((60, 50), 10)
    clean = Noise(np.zeros_like(noise.variance), noise.kernel)
    np.testing.assert_allclose(collaborative_wiener(y, pilot, clean), y, atol=1e-4)


def test_noise_on_a_flat_pilot_is_averaged_over_patches_and_groups() -> None:
    noise = Noise(np.full((80, 80), 4.0, np.float32), np.outer([0, 1.0, 0], [0, 1.0, 0]))
    y = 50 + 2 * np.random.default_rng(11).standard_normal((80, 80), np.float32)
    left = collaborative_wiener(y, np.full_like(y, 50), noise, workers=2) - y.mean()
    # The mean of 64 patches of 144 samples, which lie within an area of at least 19 x 19 samples
    assert np.sqrt(4 / (64 * 144)) < left.std() < 2 * np.sqrt(4 / 19**2)
    assert abs(left.mean()) < 0.02


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
    for size in (0, 6, 24):
        with pytest.raises(ValueError, match=f"patches of {size} samples"):
            collaborative_wiener(y, pilot, noise, Patches(size))


# --- the refinement --------------------------------------------------------------------------------------------------


def test_refining_brings_a_texture_back_that_total_variation_flattens() -> None:
    generator = np.random.default_rng(14)
    row, column = np.indices(SHAPE)
    truth = (8 + 2.5 * np.sin(2 * np.pi * row / 6) * np.sin(2 * np.pi * column / 7)).astype(np.float32)
    operator = views_displaced_by(generator.uniform(-0.5, 0.5, (9, 2)))
    expected = operator.forward(truth)
    read_noise = generator.normal(0, np.sqrt(6.0), expected.shape)
    images = ElementalImages((generator.poisson(expected + 0.3) + read_noise).astype(np.float32), 0.3, 6.0)
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
