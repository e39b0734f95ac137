"""Views that contradict a plane by more than noise, against views that do not."""

from dataclasses import replace

import numpy as np
import pytest

from faintfield.recon.prior.misfit import Misfit, misfits
from tests.recon.test_cross_validation import dark_views
from tests.recon.test_cross_validation import scene as pieces


@pytest.mark.parametrize(
    ("detail", "smooth", "se", "contradicts"),
    [
        (1.03, 1.0, 0.002, True),
        (1.03, 1.03, 0.002, False),  # the noise is 3 % off everywhere
        (0.99, 0.95, 0.002, False),  # detail fits
        (1.03, 1.0, 0.02, False),  # by chance
    ],
)
def test_only_detail_that_fits_worse_than_the_rest_contradicts(
    detail: float, smooth: float, se: float, contradicts: bool
) -> None:
    assert Misfit(detail, smooth, se).contradicts is contradicts


def test_the_true_plane_leaves_noise_alone_and_a_shifted_one_more_than_that() -> None:
    truth = pieces(64)
    operator, images = dark_views(truth, 3)
    steep = np.hypot(*np.gradient(truth.astype(float))) > 0.1
    regions = {"light, detail": steep.astype(np.float32), "light, smooth": (~steep).astype(np.float32)}
    (right,) = misfits(operator, images, truth, [regions])
    assert right.detail == pytest.approx(1, abs=4 * right.se)
    assert not right.contradicts
    bright = replace(images, electrons=(images.electrons + operator.forward(50 * truth)).astype(np.float32))
    (right,) = misfits(operator, bright, 51 * truth, [regions])
    (shifted,) = misfits(operator, bright, 51 * np.roll(truth, 1, axis=1), [regions])
    assert not right.contradicts
    assert shifted.contradicts


def test_squares_and_variances_are_those_of_dense_matrices() -> None:
    operator, images = dark_views(pieces(20), 1)
    images = replace(images, background_e=0.3)
    plane = pieces(20) + np.float32(0.2)
    matrix = np.stack(
        [operator.forward(column, None).ravel() for column in np.eye(plane.size).reshape(-1, *plane.shape)]
    )
    expected = matrix.T @ plane.ravel() + 0.3
    variance = expected + images.read_variance_e2
    squares = np.square(images.electrons.ravel() - expected)
    share = np.linspace(0, 1, plane.size).reshape(plane.shape)
    (found,) = misfits(operator, images, plane, [{"light, detail": share, "light, smooth": 1 - share}])
    weight = matrix.T @ share.ravel()
    assert found.detail == pytest.approx(weight @ squares / (weight @ variance), rel=1e-4)
    other = matrix.T @ (1 - share).ravel()
    spread = 2 * variance**2 + expected
    errors = [np.sqrt(w @ spread) / (w @ variance) for w in (weight, other)]
    assert found.se == pytest.approx(np.hypot(*errors), rel=1e-4)
