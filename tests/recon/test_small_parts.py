"""Grids, blurs, opacity and parabolas against closed forms and scipy."""

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy import ndimage, stats

from faintfield.recon.likelihood.images import ElementalImages, read_noise_share, select_likelihood
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.operator.occlusion import opacity
from faintfield.recon.operator.plane_operator import PlaneOperator
from faintfield.recon.smoothing import blurred
from faintfield.recon.solver.cross_validation import _lowest_offset
from faintfield.recon.solver.data_fit import DataFit


def test_a_grid_covers_a_rectangle_with_samples_in_the_middle_of_squares() -> None:
    grid = PlaneGrid.covering(-6.0, 2.0, 9.0, 10.0, 2.5)
    assert grid == PlaneGrid((3, 6), 2.5, (-4.75, 3.25))
    assert PlaneGrid.covering(0.0, 0.0, 10.4, 9.6, 1.0).shape == (10, 10), "whole samples, the nearest number"


def test_binned_samples_lie_in_the_middle_of_those_that_they_replace() -> None:
    grid = PlaneGrid((7, 10), 2.0, (5.0, -3.0))
    binned = grid.binned(3)
    assert binned.shape == (2, 3)
    assert binned.pitch_mm == 6.0
    assert binned.origin_mm == (7.0, -1.0)  # the second of three samples 2 mm apart
    assert grid.binned(1) == grid


@given(st.integers(0, 2**32 - 1), st.lists(st.integers(1, 3), max_size=3))
def test_a_blur_is_scipys_convolution_with_repeated_edges(seed: int, spacings: list[int]) -> None:
    image = np.random.default_rng(seed).normal(size=(9, 12))
    expected = image
    for spacing in spacings:
        kernel = np.zeros(2 * spacing + 1)
        kernel[[0, spacing, -1]] = 0.25, 0.5, 0.25
        for axis in (0, 1):
            expected = ndimage.convolve1d(expected, kernel, axis=axis, mode="nearest")
    np.testing.assert_allclose(blurred(image, spacings), expected, atol=1e-14)


@pytest.mark.parametrize(("share", "expected"), [(0.15, 0.0), (0.2, 0.25), (0.35, 1.0)])
def test_opacity_rises_from_fifteen_to_thirty_five_hundredths_of_the_typical_light(
    share: float, expected: float
) -> None:
    # Halves of light 1 and b have the typical light (1 + b²)/(1 + b), and b shall be `share` of it
    b = (np.sqrt(1 + 4 * share * (1 - share)) - 1) / (2 * (1 - share))
    plane = np.ones((40, 80))
    plane[:, 40:] = b
    assert b * (1 + b) == pytest.approx(share * (1 + b**2))
    found = opacity(plane)
    assert found[20, 10] == 1.0
    assert found[20, 70] == pytest.approx(expected, abs=0.03)


def test_a_black_plane_is_transparent() -> None:
    assert not opacity(np.zeros((8, 8), np.float32)).any()
    assert opacity(np.zeros((8, 8), np.float32)).dtype == np.float32


def test_the_lowest_point_of_a_parabola() -> None:
    vertex = -0.4
    assert _lowest_offset([7 + 2 * (n - vertex) ** 2 for n in (-1, 0, 1)]) == pytest.approx(vertex)


def test_no_parabola_has_its_lowest_point_in_the_middle_and_a_slope_at_half_a_step() -> None:
    for losses in ([None, 1.0, 2.0], [2.0, 1.0, None], [1.0, 1.0, 1.0], [1.0, 2.0, 1.0]):
        assert _lowest_offset(losses) == 0.0
    assert _lowest_offset([10.0, 1.0, 0.0]) == 0.5
    assert _lowest_offset([0.0, 1.0, 10.0]) == -0.5


def small_operator() -> PlaneOperator:
    rows, columns = np.indices((12, 16), float)
    homographies = np.stack([np.eye(3)] * 3)
    homographies[:, 0, 2] = [-2.3, 0.0, 3.1]
    return PlaneOperator(homographies, np.stack([columns, rows], axis=-1), PlaneGrid((12, 16), 1.0, (0.0, 0.0)))


def test_a_map_of_equal_noise_bounds_the_curvature_like_one_number() -> None:
    operator = small_operator()
    electrons = np.random.default_rng(2).poisson(5.0, operator.images_shape).astype(np.float64)
    samples = np.random.default_rng(3).uniform(1, 9, operator.samples_shape)
    one = ElementalImages(electrons, background_e=0.5, read_variance_e2=2.0)
    of_each = ElementalImages(
        electrons, background_e=np.full((1, 12, 16), 0.5), read_variance_e2=np.full((1, 12, 16), 2.0)
    )
    expected = DataFit(operator, one, 5.0).metric(samples)
    np.testing.assert_allclose(DataFit(operator, of_each, 5.0).metric(samples), expected, rtol=1e-5)


def test_noisier_pixels_bound_the_curvature_of_the_samples_that_they_see_by_the_mean_precision() -> None:
    operator = small_operator()
    electrons = np.random.default_rng(2).poisson(5.0, operator.images_shape).astype(np.float64)
    noise = np.random.default_rng(4).uniform(1.0, 6.0, (1, 12, 16))
    images = ElementalImages(electrons, background_e=0.0, read_variance_e2=noise)
    level_e = 5.0
    samples = np.full(operator.samples_shape, level_e)
    # A sample's noise is that whose precision, with the typical light, is the mean of Hᵀ
    precision = operator.adjoint(np.broadcast_to(1 / (level_e + noise), operator.images_shape).copy())
    mean = precision / operator.sensitivity()
    response = operator.coverage() / operator.sensitivity()
    known_e2 = 1 / mean - level_e
    expected = operator.coverage() * blurred(1 / (level_e * response + known_e2), (1,))
    found = DataFit(operator, images, level_e).metric(samples)
    np.testing.assert_allclose(found, expected, rtol=1e-5)


@pytest.mark.parametrize(("mean_e", "read_noise_e"), [(0.05, 0.6), (1.0, 0.2), (20.0, 1.5)])
def test_the_share_of_read_noise_is_that_of_fishers_information(mean_e: float, read_noise_e: float) -> None:
    counts = np.arange(int(mean_e + 12 * np.sqrt(mean_e)) + 20)

    places = np.linspace(-7 * read_noise_e, counts[-1], 4000)
    readings = stats.norm.pdf(places[:, np.newaxis], counts, read_noise_e)
    below, here, above = (readings @ stats.poisson.pmf(counts, mean_e * factor) for factor in (0.9999, 1, 1.0001))
    slope = (above - below) / (2e-4 * mean_e)
    integrand = np.divide(slope**2, here, out=np.zeros_like(here), where=here > 1e-250)
    information = np.trapezoid(integrand, places)
    expected = np.clip((1 / information - mean_e) / read_noise_e**2, 0, 1)
    assert read_noise_share(mean_e, read_noise_e) == pytest.approx(expected, abs=2e-3)


@pytest.mark.parametrize(("mean_e", "read_noise_e"), [(101.0, 0.1), (1.0, 3.1), (1.0, 0.03)])
def test_read_noise_counts_whole_in_bright_light_where_it_is_large_and_where_it_does_not_matter(
    mean_e: float, read_noise_e: float
) -> None:
    assert read_noise_share(mean_e, read_noise_e) == 1.0


def test_the_chosen_likelihood_counts_the_share_of_the_typical_pixel() -> None:
    electrons = np.ones((2, 4, 4))
    images = ElementalImages(electrons, background_e=0.5, read_variance_e2=np.full((1, 4, 4), 0.36))
    found = select_likelihood(images, "auto", 1.5)
    assert found.name == "poisson-gaussian"
    assert found.read_noise_share == read_noise_share(2.0, 0.6)
    assert select_likelihood(images, "least-squares", 0.0).level_e > 0
