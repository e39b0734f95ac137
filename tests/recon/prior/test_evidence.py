"""Evidence of each plane in the views against dense matrices, and the noise of back-projections in closed form."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.recon.likelihood.images import ElementalImages, Image
from faintfield.recon.operator.occlusion import Occluders
from faintfield.recon.operator.scene_operator import SceneOperator
from faintfield.recon.prior.evidence import evidence_of_planes, noise_of_back_projection
from faintfield.recon.solver.initialization import back_projection, well_seen_samples
from tests.recon.displaced import SHAPE, dark_images, noisy_images, planes_displaced_by, views_displaced_by
from tests.recon.operator_contract import dense_matrix

TINY = (7, 9)


def inner(plane: NDArray[np.floating]) -> NDArray[np.floating]:
    return plane[4:-4, 4:-4]


def tiny_scene(planes: int, seed: int, *, occluded: bool = False) -> tuple[SceneOperator, list[Image], ElementalImages]:
    """Return planes in six views, the second partly out of sight, and noisy images."""
    generator = np.random.default_rng(seed)
    shifts = [generator.uniform(-0.5, 0.5, (6, 2)) + np.array([0.0, 3.0 * k]) for k in range(planes)]
    hiding = Occluders(list(generator.uniform(0, 0.8, (planes, *TINY))), range(planes)) if occluded else None
    operator = planes_displaced_by(shifts, TINY, occluders=hiding, dtype=np.float64)
    lights = list(generator.uniform(1, 5, (planes, *TINY)))
    clean = noisy_images(operator, operator.samples_of(lights), 0.4, 2.0, seed)
    background, variance = generator.uniform(0.2, 0.6, (2, *operator.images_shape[1:]))
    return operator, lights, ElementalImages(clean.electrons, background, 1.5 + variance)


def divided(sums: Image, coverage: Image) -> Image:
    """Return sums by coverage, zero where there is none."""
    sums = sums.reshape(coverage.shape)
    return np.where(coverage > 0, sums / np.where(coverage > 0, coverage, 1), 0)


@pytest.mark.parametrize(("planes", "held_out", "occluded"), [(1, [1, 4], False), (2, [0, 3], False), (2, None, True)])
def test_picture_leaves_out_light_of_other_planes(planes: int, held_out: list[int] | None, occluded: bool) -> None:
    operator, lights, images = tiny_scene(planes, planes, occluded=occluded)
    views = operator.all_views if held_out is None else np.setdiff1d(operator.all_views, held_out)
    chosen = None if held_out is None else views
    dense = np.split(dense_matrix(operator, views), planes, axis=1)
    samples, colour = (operator.samples_of([f(light) for light in lights]) for f in (np.copy, lambda light: 3 - light))
    signal = (images.electrons - images.background_e)[views].ravel()
    all_light = sum(part @ light.ravel() for part, light in zip(dense, lights, strict=True))
    coloured = evidence_of_planes(operator, images, samples, chosen, other_colours=colour)
    for own, light, plain, evidence in zip(
        dense, lights, evidence_of_planes(operator, images, samples, chosen), coloured, strict=True
    ):
        coverage = (own.T @ own.sum(axis=1)).reshape(TINY)
        left = own.T @ (signal - all_light + own @ light.ravel())
        np.testing.assert_allclose(evidence.coverage, coverage, atol=1e-12)
        np.testing.assert_allclose(evidence.picture, divided(left, coverage), atol=1e-10)
        np.testing.assert_allclose(evidence.pilot, divided(own.T @ own @ light.ravel(), coverage), atol=1e-10)
        assert plain.other_colours is None
        assert evidence.other_colours is not None
        np.testing.assert_allclose(
            evidence.other_colours, divided(own.T @ own @ (3 - light).ravel(), coverage), atol=1e-10
        )


def test_unseen_samples_have_no_light_and_infinite_noise() -> None:
    operator, lights, images = tiny_scene(2, 4)
    for result in evidence_of_planes(operator, images, operator.samples_of(lights)):
        np.testing.assert_array_equal(np.isinf(result.noise.variance), ~well_seen_samples(result.coverage))
        unseen = result.coverage == 0
        assert not result.picture[unseen].any()
        assert not result.pilot[unseen].any()
    assert unseen.any()  # of the plane that is displaced by three samples


def test_noise_of_each_plane_is_in_all_light() -> None:
    """The variance of `Hᵀn / HᵀH1` is `Σ h² v / (HᵀH1)²` with v of both planes, background and sensor."""
    generator = np.random.default_rng(5)
    shape = (22, 26)
    shifts = [generator.uniform(-0.5, 0.5, (5, 2)), generator.uniform(-0.5, 0.5, (5, 2)) + 2.0]
    operator = planes_displaced_by(shifts, shape, dtype=np.float64)
    lights = [np.full(shape, 6.0), np.full(shape, 2.0)]
    images = dark_images(operator, 0.5, 4.0)
    some = np.array([0, 2, 3])
    dense = np.split(dense_matrix(operator, some), 2, axis=1)
    variance = sum(part @ light.ravel() for part, light in zip(dense, lights, strict=True)) + 4.5
    for part, result in zip(
        dense, evidence_of_planes(operator, images, operator.samples_of(lights), some), strict=True
    ):
        expected = ((part**2).T @ variance).reshape(shape) / result.coverage.clip(1e-9) ** 2
        assert np.median(inner(result.noise.variance) / inner(expected)) == pytest.approx(1, rel=0.1)
        np.testing.assert_allclose(inner(result.noise.variance), inner(expected), rtol=0.5)


@pytest.mark.parametrize("in_phase", [False, True])
def test_noise_has_covariance_of_bilinear_weights(in_phase: bool) -> None:
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


def test_noise_follows_light_and_number_of_views() -> None:
    generator = np.random.default_rng(7)
    shifts = generator.uniform(0, 1, (8, 2))
    operator = views_displaced_by(np.concatenate([shifts, shifts + np.array([0, 56])]))  # half of them see the left
    plane = np.full(SHAPE, 1.0, np.float32)
    plane[48:] = 30.0
    images = dark_images(operator, 0.5, 4.0)
    result = noise_of_back_projection(operator, images, plane).variance
    draws = []
    for _ in range(60):
        sd = np.sqrt(operator.forward(plane) + 4.5)
        noise = generator.standard_normal(sd.shape, np.float32) * sd + np.float32(0.5)
        draws.append(back_projection(operator, ElementalImages(noise, 0.5)))
    drawn = np.var(draws, axis=0)
    for part in (np.s_[4:40, 4:50], np.s_[56:-4, 4:50], np.s_[4:40, 62:-4], np.s_[56:-4, 62:-4]):
        assert np.median(result[part] / drawn[part]) == pytest.approx(1, rel=0.15)
        assert np.mean(abs(np.log(result[part] / drawn[part]))) < 0.25  # of single samples, 0.13 is that of the draws
    left, right = result[4:40, 4:50].mean(), result[4:40, 62:-4].mean()
    assert left / right == pytest.approx(2, rel=0.25)
    # A column on either side of a border must not take the mean of both
    np.testing.assert_allclose(result[4:-4, 52] / result[4:-4, 60], 2, rtol=0.3)
    np.testing.assert_allclose(result[51, 4:50] / result[44, 4:50], 34.5 / 5.5, rtol=0.3)
