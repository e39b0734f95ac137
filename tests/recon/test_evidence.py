"""What views say of each plane, against dense matrices, and the noise of back-projections in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.evidence import evidence_of_planes, noise_of_back_projection
from faintfield.recon.solver.initialization import back_projection, well_seen_samples
from tests.recon.displaced import SHAPE, dark_images, noisy_images, planes_displaced_by, views_displaced_by

TINY = (7, 9)


def inner(plane: NDArray[np.floating]) -> NDArray[np.floating]:
    return plane[4:-4, 4:-4]


# --- evidence --------------------------------------------------------------------------------------------------------


def columns_of(operator: SceneOperator, views: NDArray[np.intp] | None = None) -> Image:
    """H of some views as a matrix (pixel of any view, sample), from unit vectors."""
    units = np.eye(int(np.prod(operator.samples_shape))).reshape(-1, *operator.samples_shape)
    return np.stack([operator.forward(unit, views).ravel() for unit in units], axis=1)


def tiny_scene(planes: int, seed: int, *, occluded: bool = False) -> tuple[SceneOperator, list[Image], ElementalImages]:
    """Planes in six views, the second partly out of sight, and noisy images with background and noise of each pixel."""
    generator = np.random.default_rng(seed)
    shifts = [generator.uniform(-0.5, 0.5, (6, 2)) + np.array([0.0, 3.0 * k]) for k in range(planes)]
    hiding = Occluders(list(generator.uniform(0, 0.8, (planes, *TINY))), range(planes)) if occluded else None
    operator = planes_displaced_by(shifts, TINY, occluders=hiding, dtype=np.float64)
    lights = list(generator.uniform(1, 5, (planes, *TINY)))
    clean = noisy_images(operator, operator.samples_of(lights), 0.4, 2.0, seed)
    background, variance = generator.uniform(0.2, 0.6, (2, *operator.images_shape[1:]))
    return operator, lights, ElementalImages(clean.electrons, background, 1.5 + variance)


def test_the_picture_of_one_plane_is_its_back_projection_and_the_pilot_is_as_blurred() -> None:
    operator, (light,), images = tiny_scene(1, 1)
    views = np.setdiff1d(operator.all_views, [1, 4])
    (found,) = evidence_of_planes(operator, images, operator.samples_of([light]), views)
    assert found.others is None
    samples = operator.samples_of([light])
    (again,) = evidence_of_planes(operator, images, samples, views, others=2 * samples)
    assert again.others is not None
    np.testing.assert_allclose(again.others, 2 * found.pilot, rtol=1e-10)
    dense = columns_of(operator, views)
    coverage = (dense.T @ dense.sum(axis=1)).reshape(TINY)
    np.testing.assert_allclose(found.coverage, coverage, atol=1e-12)
    np.testing.assert_allclose(found.pilot, divided(dense.T @ dense @ light.ravel(), coverage), rtol=1e-10)
    signal = (images.electrons - images.background_e)[views]
    np.testing.assert_allclose(found.picture, divided(dense.T @ signal.ravel(), coverage), rtol=1e-10)
    (expected,) = operator.planes_of(back_projection(operator, images, views))
    np.testing.assert_allclose(found.picture, expected, rtol=1e-10)


def divided(sums: Image, coverage: Image) -> Image:
    """Sums by coverage, zero where there is none."""
    sums = sums.reshape(coverage.shape)
    return np.where(coverage > 0, sums / np.where(coverage > 0, coverage, 1), 0)


@pytest.mark.parametrize(("held_out", "occluded"), [([0, 3], False), (None, True)])
def test_the_picture_of_a_plane_is_the_back_projection_of_what_the_others_leave(
    held_out: list[int] | None, occluded: bool
) -> None:
    operator, lights, images = tiny_scene(2, 2, occluded=occluded)
    views = operator.all_views if held_out is None else np.setdiff1d(operator.all_views, held_out)
    dense = np.split(columns_of(operator, views), 2, axis=1)
    colour, some = operator.samples_of([3 - light for light in lights]), None if held_out is None else views
    found = evidence_of_planes(operator, images, operator.samples_of(lights), some, others=colour)
    signal = (images.electrons - images.background_e)[views].ravel()
    for own, other, here, there, evidence in zip(dense, dense[::-1], lights, lights[::-1], found, strict=True):
        coverage = (own.T @ own.sum(axis=1)).reshape(TINY)
        left = own.T @ (signal - other @ there.ravel())
        np.testing.assert_allclose(evidence.coverage, coverage, atol=1e-12)
        np.testing.assert_allclose(evidence.picture, divided(left, coverage), atol=1e-10)
        np.testing.assert_allclose(evidence.pilot, divided(own.T @ own @ here.ravel(), coverage), atol=1e-10)
        assert evidence.others is not None
        np.testing.assert_allclose(evidence.others, divided(own.T @ own @ (3 - here).ravel(), coverage), atol=1e-10)


def test_where_no_view_sees_a_plane_there_is_no_light_and_no_end_to_the_noise() -> None:
    operator, lights, images = tiny_scene(2, 4)
    for found in evidence_of_planes(operator, images, operator.samples_of(lights)):
        np.testing.assert_array_equal(np.isinf(found.noise.variance), ~well_seen_samples(found.coverage))
        unseen = found.coverage == 0
        assert not found.picture[unseen].any()
        assert not found.pilot[unseen].any()
    assert unseen.any()  # of the plane that is displaced by three samples


def test_the_noise_of_each_plane_is_that_of_the_model_in_the_light_of_all() -> None:
    """The variance of `Hᵀn / HᵀH1` is `Σ h² v / (HᵀH1)²` with v of both planes, background and sensor."""
    generator = np.random.default_rng(5)
    shape = (28, 32)
    shifts = [generator.uniform(-0.5, 0.5, (5, 2)), generator.uniform(-0.5, 0.5, (5, 2)) + 2.0]
    operator = planes_displaced_by(shifts, shape, dtype=np.float64)
    lights = [np.full(shape, 6.0), np.full(shape, 2.0)]
    images = dark_images(operator, 0.5, 4.0)
    some = np.array([0, 2, 3])
    dense = np.split(columns_of(operator, some), 2, axis=1)
    variance = sum(part @ light.ravel() for part, light in zip(dense, lights, strict=True)) + 4.5
    for part, found in zip(dense, evidence_of_planes(operator, images, operator.samples_of(lights), some), strict=True):
        expected = ((part**2).T @ variance).reshape(shape) / found.coverage.clip(1e-9) ** 2
        assert np.median(inner(found.noise.variance) / inner(expected)) == pytest.approx(1, rel=0.1)
        np.testing.assert_allclose(inner(found.noise.variance), inner(expected), rtol=0.5)


# --- the noise of a back-projection ----------------------------------------------------------------------------------


@pytest.mark.parametrize("in_phase", [False, True])
def test_the_noise_of_displaced_views_has_the_covariance_of_their_bilinear_weights(in_phase: bool) -> None:
    shifts = np.random.default_rng(5).uniform(-0.3, 0.3, (6, 2)) + np.array([0.5, 0.25])
    shifts = np.full((6, 2), 0.5) if in_phase else shifts
    operator = views_displaced_by(shifts)
    plane = np.full(SHAPE, 3.0, np.float32)
    noise = noise_of_back_projection(operator, dark_images(operator, 0.5, 12.0), plane, draws=2)
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
    noise = noise_of_back_projection(operator, dark_images(operator, 0.0, 9.0), np.zeros(SHAPE, np.float32))
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
    images = dark_images(operator, 0.5, 4.0)
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
    images, plane = dark_images(operator, 0.0, 4.0), np.ones(SHAPE, np.float32)
    noise, again = (noise_of_back_projection(operator, images, plane, seed=3) for _ in range(2))
    np.testing.assert_array_equal(np.isinf(noise.variance), operator.coverage() == 0)
    assert 0 < np.isinf(noise.variance).sum() < noise.variance.size
    np.testing.assert_array_equal(noise.variance, again.variance)
    assert noise_of_back_projection(operator, images, plane, seed=4).kernel[0, 0] != noise.kernel[0, 0]
