"""Corners drawn from a formula, pixel by pixel by quadrature, against what the fit finds and says of itself."""

import numpy as np
import pytest
from numpy.typing import NDArray

from faintfield.calib.corner_fit import refine_corners

_PITCH, _SIDE = 40, 6
_SQUARES = np.array([[30.0, 4.0], [-5.0, 26.0]])
_CLEAR = 0.15


def checkers(
    blur_px: float, generator: np.random.Generator, dark: float = 5.0, white: float = 90.0
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return expected light of 6 x 6 lone corners, and where they are; pixels by 5 x 5 points, edges by logistics.

    The edge is no error function: a logistic of the same variance, as no lens is what a model says.
    """
    centres = np.stack(np.meshgrid(np.arange(_SIDE), np.arange(_SIDE)), axis=-1).reshape(-1, 2) * _PITCH + _PITCH / 2
    places = centres + generator.uniform(-0.5, 0.5, centres.shape)
    fine = (np.arange(5) - 2) / 5
    light = np.zeros((_SIDE * _PITCH, _SIDE * _PITCH))
    rows, columns = np.mgrid[: light.shape[0], : light.shape[1]].astype(float)
    owner = (rows // _PITCH * _SIDE + columns // _PITCH).astype(int)
    normals = np.array([[-step[1], step[0]] / np.hypot(*step) for step in _SQUARES])
    for down in fine:
        for right in fine:
            x, y = columns + right - places[owner, 0], rows + down - places[owner, 1]
            sides = [np.tanh((n[0] * x + n[1] * y) * np.pi / (2 * np.sqrt(3) * blur_px)) for n in normals]
            light += (dark + (white - dark) * (1 + sides[0] * sides[1]) / 2) / 25
    return light, places


def fitted(
    image: NDArray[np.floating], guesses: NDArray[np.float64]
) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    return refine_corners(image.astype(np.float32), guesses, np.tile(_SQUARES, (len(guesses), 1, 1)), _CLEAR)


@pytest.mark.parametrize("blur_px", [0.4, 2.0])
def test_corners_without_noise_are_exact(blur_px: float) -> None:
    generator = np.random.default_rng(1)
    light, places = checkers(blur_px, generator)
    points, sigma_px = fitted(light, places + generator.uniform(-1.5, 1.5, places.shape))
    assert np.abs(points - places).max() < 0.01
    assert sigma_px.max() < 0.03


@pytest.mark.parametrize(("white", "read_noise"), [(27.0, 3.46), (60.0, 0.0)])
def test_sigma_is_that_of_the_errors(white: float, read_noise: float) -> None:
    """288 numbers put three standard errors at 13 %; the floor of 0.01 px adds little here."""
    generator = np.random.default_rng(2)
    ratios = []
    for _ in range(4):
        light, places = checkers(0.8, generator, dark=white / 18, white=white)
        noisy = generator.poisson(light) + generator.normal(0, read_noise, light.shape)
        points, sigma_px = fitted(2.0 * noisy + 100.0, places + generator.uniform(-0.7, 0.7, places.shape))
        assert np.isfinite(sigma_px).all()
        ratios.append((points - places) / sigma_px[:, np.newaxis])
    assert np.sqrt(np.mean(np.square(ratios))) == pytest.approx(1.0, abs=0.15)


def test_errors_are_near_the_cramer_rao_bound() -> None:
    """The Cramér-Rao bound of both coordinates, from the true light's own derivatives in the same window."""
    generator, read_noise = np.random.default_rng(3), 3.46
    light, places = checkers(0.8, np.random.default_rng(4), 1.5, 27.0)
    slopes = list(np.gradient(light))
    errors = []
    for _ in range(8):
        noisy = generator.poisson(light) + generator.normal(0, read_noise, light.shape)
        points, _ = fitted(noisy, places)
        errors.append(points - places)
    bounds = []
    for column, row in np.rint(places).astype(int):
        window = np.s_[row - 11 : row + 12, column - 11 : column + 12]
        information = np.array(
            [
                [(first[window] * second[window] / (light + read_noise**2)[window]).sum() for first in slopes]
                for second in slopes
            ]
        )
        bounds.append(np.trace(np.linalg.inv(information)) / 2)
    assert np.mean(np.square(errors)) < 2.0 * np.mean(bounds)


def test_noise_and_edges_hold_no_corner() -> None:
    generator = np.random.default_rng(5)
    guesses = np.array([[20.0, 20.0], [60.0, 20.0], [20.0, 60.0], [61.0, 61.0]])
    edge = np.where(np.arange(80) < 40, 10.0, 200.0) + generator.normal(0, 3, (80, 80))
    for image, right_px in ((generator.normal(100, 5, (80, 80)), 0.0), (edge, 20.0), (np.zeros((80, 80)), 0.0)):
        assert np.isnan(fitted(image, guesses + np.array([right_px, 0.0]))[1]).all()
    assert fitted(np.zeros((80, 80)), np.empty((0, 2)))[0].shape == (0, 2)


def test_corner_beside_the_edge_is_fitted() -> None:
    light, places = checkers(0.8, np.random.default_rng(6))
    points, _ = fitted(light[14:, 14:], places - 14)
    np.testing.assert_allclose(points, places - 14, atol=0.02)


def test_covered_corner_leaves_neighbours_alone() -> None:
    light, places = checkers(0.8, np.random.default_rng(7))
    noisy = np.random.default_rng(8).poisson(light).astype(float)
    alone, stated = fitted(noisy, places)
    noisy[:_PITCH, :_PITCH] = 500.0
    points, sigma_px = fitted(noisy, places)
    assert np.isnan(points[0]).all()
    np.testing.assert_allclose(points[1:], alone[1:], atol=0.02)
    np.testing.assert_allclose(sigma_px[1:], stated[1:], rtol=0.1)
