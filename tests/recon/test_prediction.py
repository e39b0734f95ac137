"""Predictions against closed forms, sums over all counts, squares drawn into pixels, and estimates really made."""

import math

import numpy as np
import pytest
from numpy.typing import NDArray
from scipy.stats import norm, poisson

from faintfield.recon.likelihood.images import ElementalImages, PixelLikelihood, read_noise_share
from faintfield.recon.prediction import (
    depth_resolution_mm,
    depth_sigma_mm,
    feature_area_px2,
    information_of_views,
    interpolation,
    interpolation_at,
    pixel_information,
    sample_sigma_e,
    smallest_contrast,
)
from faintfield.recon.solver.data_fit import DataFit
from tests.recon.displaced import views_displaced_by


def summed_information(mean_e: float, read_noise_e: float) -> float:
    """Fisher's information from the density and its derivative, both summed over counts on a grid of values."""
    counts = np.arange(int(mean_e + 12 * math.sqrt(mean_e)) + 20)
    chance = poisson.pmf(counts, mean_e)
    slope = poisson.pmf(counts - 1, mean_e) - chance
    values = np.linspace(-10 * read_noise_e, counts[-1] + 10 * read_noise_e, 40 * int(counts[-1] / read_noise_e + 20))
    around = norm.pdf(values[:, np.newaxis], counts, read_noise_e)
    density, change = around @ chance, around @ slope
    score2 = np.divide(change**2, density, out=np.zeros_like(density), where=density > 1e-300)
    return float(np.trapezoid(score2, values))


@pytest.mark.parametrize("read_noise_e", [0.1, 0.7, 2.9])
@pytest.mark.parametrize("mean_e", [0.01, 2.0])
def test_information_of_a_pixel_is_of_its_density(mean_e: float, read_noise_e: float) -> None:
    assert pixel_information(mean_e, read_noise_e) == pytest.approx(summed_information(mean_e, read_noise_e), rel=2e-3)


@pytest.mark.parametrize(("mean_e", "read_noise_e"), [(0.01, 3.1), (101.0, 1.0)])
def test_much_noise_or_light_gives_shifted_information(mean_e: float, read_noise_e: float) -> None:
    information = pixel_information(mean_e, read_noise_e)
    assert information == pytest.approx(1 / (mean_e + read_noise_e**2), rel=1e-12)
    assert 0.945 < information / summed_information(mean_e, read_noise_e) <= 1.0005


def test_sigma_is_of_counts_or_of_read_noise() -> None:
    light_e, views = 3.7, 49
    counting = sample_sigma_e(views * pixel_information(light_e, 0.0), interpolation(views))
    assert counting == pytest.approx(math.sqrt((1 + 48 * 4 / 9) / 49 * light_e / views), rel=1e-12)
    reading = sample_sigma_e(views * pixel_information(1e-9, 5.0), interpolation(views))
    assert reading == pytest.approx(math.sqrt((1 + 48 * 4 / 9) / 49) * 5.0 / 7, rel=1e-9)


def test_views_with_less_light_say_less() -> None:
    response = np.array([1.0, 0.5, 0.0])
    result = information_of_views(2.0, 0.5, 0.0, response)
    np.testing.assert_allclose(result, [1 / 2.5, 0.25 / 1.5, 0.0], rtol=1e-12)
    result = information_of_views(2.0, 0.5, 1.0, np.array([0.95, 0.85]))
    exact = [r**2 * pixel_information(2.0 * r + 0.5, 1.0) for r in (0.95, 0.85)]
    np.testing.assert_allclose(result, exact, rtol=2e-3)
    np.testing.assert_array_equal(information_of_views(1.0, 0.0, 0.0, np.array([1.0, 0.0])), [1.0, 0.0])


@pytest.mark.parametrize(
    ("light_e", "read_noise_e", "name"),
    [(0.97, 3.46, "shifted-poisson"), (0.5, 0.3, "poisson-gaussian"), (2.0, 0.0, "poisson")],
)
def test_maximum_likelihood_scatters_as_predicted(light_e: float, read_noise_e: float, name: str) -> None:
    generator = np.random.default_rng(11)
    # The plane itself, and views in which it is moved by any part of a sample
    shifts = np.concatenate([np.zeros((1, 2)), generator.uniform(-2, 2, (29, 2))])
    operator = views_displaced_by(shifts, (24, 24), margin=2)
    start = np.full(operator.samples_shape, light_e, np.float32)
    expected = operator.forward(start)
    share = read_noise_share(light_e, read_noise_e)
    likelihood = PixelLikelihood(name, read_noise_share=share)  # type: ignore[arg-type]
    squares, draws = np.zeros(operator.samples_shape), 40
    for _ in range(draws):
        drawn = generator.poisson(expected) + read_noise_e * generator.standard_normal(expected.shape)
        images = ElementalImages(drawn.astype(np.float32), 0.0, read_noise_e**2, likelihood=likelihood)
        fit = DataFit(operator, images, light_e)
        squares += np.square(fit.value_and_gradient(start)[1] / fit.metric(start))
    result = math.sqrt(squares[4:-4, 4:-4].mean() / draws)
    assert result == pytest.approx(
        sample_sigma_e(30 * pixel_information(light_e, read_noise_e), interpolation(30)), rel=0.04
    )


def bar_in_pixels(side_px: float, at_px: float, blur_px: float) -> NDArray[np.float64]:
    """The share of a blurred bar of a width in each of 60 pixels."""
    edges = np.arange(61.0)

    def lit_up_to(x: NDArray[np.float64]) -> NDArray[np.float64]:
        """The area under an edge at zero, up to x."""
        if blur_px == 0:
            return np.maximum(x, 0)
        return np.asarray(x * norm.cdf(x / blur_px) + blur_px * norm.pdf(x / blur_px))

    return np.diff(lit_up_to(edges - at_px + side_px / 2) - lit_up_to(edges - at_px - side_px / 2))


@pytest.mark.parametrize(("side_px", "blur_px"), [(0.5, 0.0), (7.0, 0.0), (1.0, 0.8)])
def test_area_is_the_mean_over_places_of_square(side_px: float, blur_px: float) -> None:
    energies = [np.square(bar_in_pixels(side_px, 30 + at, blur_px)).sum() for at in np.linspace(0, 1, 50, False)]
    assert feature_area_px2(side_px, blur_px) == pytest.approx(np.mean(energies) ** 2, rel=5e-3)


def test_large_square_has_roses_contrast() -> None:
    assert feature_area_px2(300.0) == pytest.approx(300.0**2, rel=3e-3)
    roses = 5 / math.sqrt(4.0 * 9 * 300.0**2)  # k over the root of the counts that fall on it
    assert smallest_contrast(300.0, 4.0, 9 / 4.0) == pytest.approx(roses, rel=2e-3)
    assert smallest_contrast(8.0, 2.0, 0.9, k=3) == pytest.approx(0.6 * smallest_contrast(8.0, 2.0, 0.9))


@pytest.mark.parametrize(("side_px", "blur_px"), [(8.0, 0.0), (5.0, 1.0)])
def test_depth_bound_is_of_squares_that_move(side_px: float, blur_px: float) -> None:
    depth_mm, f_px, difference_e, information = 500.0, 800.0, 0.7, 0.3
    nodes = [(x, y) for x in (-50.0, 0.0, 50.0) for y in (-50.0, 0.0, 50.0)]
    step_mm, places = 1e-3, np.linspace(0, 1, 20, False)
    result = np.zeros((len(places), len(places)))
    for x_mm, y_mm in nodes:
        ends = []
        for z_mm in (depth_mm - step_mm, depth_mm + step_mm):
            moved = [f_px * c * (1 / z_mm - 1 / depth_mm) for c in (x_mm, y_mm)]
            ends.append([np.stack([bar_in_pixels(side_px, 30 + at - d, blur_px) for at in places]) for d in moved])
        (before_x, before_y), (after_x, after_y) = ends
        before = np.einsum("ai,bj->abij", before_x, before_y)
        slope = difference_e * (np.einsum("ai,bj->abij", after_x, after_y) - before) / (2 * step_mm)
        result += information * np.square(slope).sum(axis=(2, 3))
    centres_mm = np.array(nodes) + 17.0  # wherever the reference camera is
    options = {"side_px": side_px, "difference_e": difference_e, "blur_px": blur_px}
    assert depth_sigma_mm(depth_mm, f_px, centres_mm, np.full(9, information), **options) == pytest.approx(
        result.mean() ** -0.5, rel=0.03
    )


def test_depth_resolution_is_a_pixel_of_disparity() -> None:
    def disparity_px(depth_mm: float) -> float:
        return 800 * 300 / depth_mm

    resolved = depth_resolution_mm(500.0, 800.0, 300.0)
    assert disparity_px(500.0 - resolved / 2) - disparity_px(500.0 + resolved / 2) == pytest.approx(1.0, rel=1e-5)


@pytest.mark.parametrize("shift_px", [0.0, 8.0, 0.3, 12.5])
@pytest.mark.parametrize("error_px", [0.0, 0.1, 5.0])
def test_interpolation_is_mean_of_squared_weights(shift_px: float, error_px: float) -> None:
    places = shift_px + error_px * np.random.default_rng(1).standard_normal((40_000, 2)) * (shift_px > 0)
    part = places - np.floor(places)
    weights = np.stack([1 - part, part], axis=-1)
    expected = np.mean(np.square(weights[:, 0, :, np.newaxis] * weights[:, 1, np.newaxis]).sum(axis=(1, 2)))
    assert interpolation_at(np.full((1, 2), shift_px), error_px) == pytest.approx(expected, rel=0.01)
