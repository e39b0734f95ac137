"""Poses and their steps, and what is known of their errors; the whole of it is tested by `align` on a simulated set."""

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from faintfield.calib.lens import Lens
from faintfield.recon.alignment.cameras import lens_motion, motion, motion_of_step, move_poses, steps_between
from faintfield.recon.alignment.estimate import Gain
from faintfield.recon.alignment.light import Folds, gradient_products, gradient_scale
from faintfield.recon.alignment.prior import MeasurementErrors, PosePrior
from faintfield.recon.alignment.score import Cells, Comparison
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.surface.pinhole_views import PinholeViews

NODES = np.array([(row, column) for row in range(5) for column in range(5)])


def matrix_exponential(vector: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the rotation matrix of a vector by the series of the exponential."""
    x, y, z = vector
    cross = np.array([[0, -z, y], [z, 0, -x], [-y, x, 0]])
    term, total = np.eye(3), np.eye(3)
    for power in range(1, 25):
        term = term @ cross / power
        total = total + term
    return total


@given(st.lists(st.floats(-1, 1), min_size=12, max_size=12))
def test_step_turns_in_the_frame_of_the_camera_and_steps_are_found_again(numbers: list[float]) -> None:
    pose, step = np.array(numbers).reshape(2, 1, 6)
    after = move_poses(pose, step)
    wanted = matrix_exponential(step[0, :3]) @ matrix_exponential(pose[0, :3])
    np.testing.assert_allclose(matrix_exponential(after[0, :3]), wanted, atol=1e-9)
    np.testing.assert_allclose(after[0, 3:], pose[0, 3:] + step[0, 3:])
    np.testing.assert_allclose(steps_between(pose, after), step, atol=1e-9)


def test_motion_is_the_derivative_of_the_ray_by_the_step_of_a_pose() -> None:
    generator = np.random.default_rng(3)
    pose = np.concatenate([generator.normal(0, 0.3, 3), [120.0, -80.0, 30.0]])
    points = generator.uniform((-300, -300, 600), (300, 300, 1200), (20, 3))

    def rays(rt: NDArray[np.float64]) -> NDArray[np.float64]:
        seen = points @ matrix_exponential(rt[:3]).T + rt[3:]
        return seen[:, :2] / seen[:, 2:]

    seen = points @ matrix_exponential(pose[:3]).T + pose[3:]
    x, y = (seen[:, :2] / seen[:, 2:]).T
    found = np.einsum("dmp,ms->dsp", motion(x, y, (1 / seen[:, 2]).astype(np.float32)), motion_of_step(pose))
    for axis in range(6):
        step = np.zeros((1, 6))
        step[0, axis] = 1e-6
        slope = (rays(move_poses(pose[np.newaxis], step)[0]) - rays(move_poses(pose[np.newaxis], -step)[0])) / 2e-6
        np.testing.assert_allclose(found[:, axis].T, slope, rtol=2e-4, atol=2e-6)


def test_rays_of_a_changed_lens_are_those_of_the_lens() -> None:
    rows, columns, focal_px, centre = 48, 64, 60.0, (31.0, 23.5)
    grid = PlaneGrid((4, 4), 0.02, (0.0, 0.0))
    pictures = np.zeros((1, rows, columns), np.float32)
    views = PinholeViews(pictures, 1.0, np.zeros((1, 3, 4)), (focal_px, focal_px), centre, grid, np.zeros((1, 2), int))
    lens = Lens((columns, rows), 1.03 * focal_px, 1.03 * focal_px, *centre, (-0.1,))
    found = replace(views, lens_change=(0.03, -0.1)).rays().swapaxes(0, 1)
    pixels = np.argwhere(np.ones((columns, rows))).astype(float)
    np.testing.assert_allclose(found.reshape(-1, 2), np.asarray(lens.rays_at(pixels), float), atol=1e-4)


def test_motion_by_the_lens_is_the_derivative_of_the_pixel() -> None:
    points = np.random.default_rng(5).uniform(-0.5, 0.5, (20, 2))

    def pixels(focal_change: float, distortion_change: float) -> NDArray[np.float64]:
        square = np.sum(points**2, axis=1, keepdims=True)
        return (1 + focal_change) * points * (1 + distortion_change * square)

    found = lens_motion(points[:, 0].astype(np.float32), points[:, 1].astype(np.float32))
    for number, step in enumerate(np.eye(2) * 1e-6):
        slope = (pixels(*step) - pixels(*-step)) / 2e-6
        np.testing.assert_allclose(found[:, number].T, slope, rtol=1e-4, atol=1e-6)


@pytest.mark.parametrize("shape", [(48, 64), (30, 43)])
def test_sums_of_cells_leave_out_no_pixel(shape: tuple[int, int]) -> None:
    values = np.random.default_rng(6).normal(size=(2, *shape)).astype(np.float32)
    sums = Cells.of((3, *shape), 0.1).sums(values, 1, 2)
    np.testing.assert_allclose(sums.sum(axis=1), values.sum(axis=(1, 2)), rtol=1e-4)


def test_variances_of_poses_are_found_from_errors_that_are_known() -> None:
    generator = np.random.default_rng(1)
    start = PosePrior.of_grid(NODES, 12, sigma_rad=3e-3, sigma_mm=0.3)
    errors = generator.normal(size=(24, 6)) * np.repeat([5e-4, 0.05], 3)
    prior = start
    for _ in range(60):
        prior = prior.updated(errors.ravel(), np.zeros((144, 144)))
    assert prior.sigma_rad == pytest.approx(np.std(errors[:, :3]), rel=0.1)
    assert prior.sigma_mm == pytest.approx(np.std(errors[:, 3:]), rel=0.1)
    assert np.sqrt(prior.variances[2:] / start.variances[2:]).max() < 0.2  # there is no drift


def test_shift_of_one_group_is_told_from_errors_of_single_views() -> None:
    groups = [0] * 15 + [1] * 10
    prior = PosePrior.of_measurement(np.zeros((144, 144)), groups, 12, MeasurementErrors(1e-4, 0.02, 0.1))
    errors = np.random.default_rng(2).normal(size=(24, 6)) * np.repeat([1e-4, 0.01], 3)
    errors[14:, 3] += 0.4
    for _ in range(60):
        prior = prior.updated(errors.ravel(), np.zeros((144, 144)))
    assert prior.sigma_mm == pytest.approx(0.01, rel=0.2)
    assert np.sqrt(prior.variances[2]) == pytest.approx(0.4 / np.sqrt(3), rel=0.1)


def test_scale_of_gradients_undoes_what_denoising_took() -> None:
    generator = np.random.default_rng(4)
    true = gaussian_filter(generator.normal(size=(60, 80)), 3) * 50
    views = np.full(true.shape, 5.0, np.float32)
    own = (5 * true + generator.normal(0, 1, true.shape)).astype(np.float32)
    light = (true * [0.5]).astype(np.float32)
    found = gradient_scale([gradient_products(light, own, views, views, blur=0.0)])
    np.testing.assert_allclose(found, 2.0, rtol=0.05)


def test_standard_error_of_the_gain_counts_errors_that_the_pixels_of_a_patch_share() -> None:
    generator = np.random.default_rng(7)
    information = generator.gamma(0.5, 20.0, 60)

    def gains(slope: float) -> list[Gain]:
        errors = np.sqrt(4 * information) * generator.normal(size=(400, 60))
        return [Gain.of(Comparison(slope * information + error, information)) for error in errors]

    scores = np.array([gain.value / gain.sigma for gain in gains(0.0)])
    assert scores.std() == pytest.approx(1, abs=0.1)
    assert np.mean([gain.sure for gain in gains(0.0)]) < 0.01
    # Gains in few patches do not make it larger
    wanted = 0.5 * np.sqrt(information.sum() / 4)
    assert np.mean([gain.value / gain.sigma for gain in gains(0.5)]) == pytest.approx(wanted, rel=0.1)


@pytest.mark.parametrize("views", [8, 25, 49, 81])
def test_each_view_is_in_one_fold_of_few(views: int) -> None:
    folds = Folds.of(views)
    assert sorted(np.concatenate([folds.views(fold) for fold in folds.numbers])) == list(range(views))
    assert max(len(folds.views(fold)) for fold in folds.numbers) <= views / 3
