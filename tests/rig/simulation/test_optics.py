"""The simulated lens, compared with its forward model, with OpenCV's, and with the cosine law."""

import cv2
import numpy as np
import pytest

from faintfield.rig.simulation.optics import SimulatedOptics, distort

RATIONAL = (0.2, -0.1, -1e-3, 2e-3, 0.02, 0.3, -0.05, 0.01)


def optics_of(distortion: tuple[float, ...], *, vignetting: bool = True) -> SimulatedOptics:
    return SimulatedOptics((31, 21), 40.0, 42.0, 14.0, 11.5, distortion, vignetting)


@pytest.mark.parametrize("distortion", [(), (-0.2, 0.05, 1e-3, -2e-3), RATIONAL])
def test_distortion_is_opencvs(distortion: tuple[float, ...]) -> None:
    rays = np.random.default_rng(1).uniform(-0.4, 0.4, (50, 2))
    coefficients = np.array([*distortion, *[0.0] * (8 - len(distortion))])
    projected, _ = cv2.projectPoints(
        np.column_stack([rays, np.ones(50)]), np.zeros(3), np.zeros(3), np.eye(3), coefficients
    )
    x, y = distort(rays[:, 0], rays[:, 1], distortion)
    np.testing.assert_allclose(np.column_stack([x, y]), projected[:, 0], atol=1e-14)


@pytest.mark.parametrize("distortion", [(-0.2, 0.05, 1e-3, -2e-3), RATIONAL])
@pytest.mark.parametrize("samples_per_px", [1, 2])
def test_samples_lie_evenly_within_each_pixel(distortion: tuple[float, ...], samples_per_px: int) -> None:
    rays = optics_of(distortion).rays(samples_per_px).astype(float)
    x, y = distort(rays[..., 0], rays[..., 1], distortion)
    columns, rows = 40.0 * x + 14.0, 42.0 * y + 11.5
    offsets = (2 * np.arange(samples_per_px) + 1) / (2 * samples_per_px) - 0.5
    expected_columns = np.add.outer(np.arange(31), offsets).ravel()
    expected_rows = np.add.outer(np.arange(21), offsets).ravel()
    assert rays.shape == (21 * samples_per_px, 31 * samples_per_px, 2)
    np.testing.assert_allclose(columns, np.broadcast_to(expected_columns, columns.shape), atol=1e-5)
    np.testing.assert_allclose(rows, np.broadcast_to(expected_rows[:, np.newaxis], rows.shape), atol=1e-5)


@pytest.mark.parametrize("distortion", [(), RATIONAL])
def test_light_falls_off_with_the_fourth_power_of_the_cosine(distortion: tuple[float, ...]) -> None:
    optics = optics_of(distortion)
    angle = np.arctan(np.hypot(*np.moveaxis(optics.rays().astype(float), -1, 0)))
    np.testing.assert_allclose(optics.relative_illumination(), np.cos(angle) ** 4, rtol=1e-6)
    np.testing.assert_array_equal(optics_of(distortion, vignetting=False).relative_illumination(), 1.0)


def test_the_ideal_optics_are_a_pinhole_with_the_same_view() -> None:
    ideal = optics_of(RATIONAL).ideal()
    assert ideal == SimulatedOptics((31, 21), 40.0, 42.0, 14.0, 11.5, (), vignetting=False)
    np.testing.assert_allclose(ideal.rays()[3, 30], [16 / 40, -8.5 / 42], rtol=1e-6)


@pytest.mark.parametrize("distortion", [(-2.5,), (0.0, 0.0, 0.0, 0.0, 0.0, 9.0)])
def test_a_lens_that_folds_is_refused(distortion: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="cannot be inverted"):
        optics_of(distortion).rays()
