"""The simulated lens, sensor, cooling and experiment, compared with OpenCV, Monte Carlo and closed forms."""

import cv2
import numpy as np
import pytest

from faintfield.rig.plan import centre_node, grid_nodes, nominal_poses_rt_cam_ref
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment
from faintfield.rig.simulation.lab import Cooling
from faintfield.rig.simulation.optics import SimulatedOptics, SimulatedSensor, distort

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
def test_light_falls_off_with_cosine_to_the_fourth(distortion: tuple[float, ...]) -> None:
    optics = optics_of(distortion)
    angle = np.arctan(np.hypot(*np.moveaxis(optics.rays().astype(float), -1, 0)))
    np.testing.assert_allclose(optics.relative_illumination(), np.cos(angle) ** 4, rtol=1e-6)
    np.testing.assert_array_equal(optics_of(distortion, vignetting=False).relative_illumination(), 1.0)


def test_ideal_optics_are_a_pinhole() -> None:
    ideal = optics_of(RATIONAL).ideal()
    assert ideal == SimulatedOptics((31, 21), 40.0, 42.0, 14.0, 11.5, (), vignetting=False)
    np.testing.assert_allclose(ideal.rays()[3, 30], [16 / 40, -8.5 / 42], rtol=1e-6)


@pytest.mark.parametrize("distortion", [(-2.5,), (0.0, 0.0, 0.0, 0.0, 0.0, 9.0)])
def test_lens_that_folds_is_refused(distortion: tuple[float, ...]) -> None:
    with pytest.raises(ValueError, match="cannot be inverted"):
        optics_of(distortion).rays()


PIXELS = (400, 400)


@pytest.mark.parametrize("photons", [0.0, 3.84, 5000.0])
@pytest.mark.parametrize("exposure_s", [0.1, 100.0])
def test_frame_has_mean_and_variance_of_eq_6(photons: float, exposure_s: float) -> None:
    sensor = SimulatedSensor()
    frame_dn = sensor.expose(np.full(PIXELS, photons), exposure_s, np.random.default_rng(20110919))
    electrons = (frame_dn.astype(float) - 100.0) / 2.0
    mean_e = 0.5 * photons + 0.2 * exposure_s
    variance_e2 = mean_e + 12.0 + 1 / (12 * 2.0**2)  # the last: rounding to whole DN
    assert electrons.mean() == pytest.approx(mean_e, abs=4 * np.sqrt(variance_e2 / electrons.size))
    assert electrons.var() == pytest.approx(variance_e2, rel=4 * np.sqrt(2.2 / electrons.size))


def test_without_read_noise_frames_are_poisson_counts() -> None:
    sensor = SimulatedSensor(read_noise_e=0.0, dark_current_e_per_s=0.0, gain_dn_per_e=3.0, offset_dn=7.0)
    frame_dn = sensor.expose(np.full(PIXELS, 4.0), 1.0, np.random.default_rng(20110919))
    counts, remainder = np.divmod(frame_dn.astype(int) - 7, 3)
    assert not remainder.any()
    assert np.mean(counts == 0) == pytest.approx(np.exp(-2.0), abs=4 * np.sqrt(0.135 * 0.865 / counts.size))


def test_electrons_are_rounded_and_clipped_to_the_range() -> None:
    sensor = SimulatedSensor(offset_dn=10.0, gain_dn_per_e=2.0, saturation_dn=4095)
    frame_dn = sensor.digitise(np.array([[0.0, 0.2, 0.3, -0.3, -5.2, -80.0, 2042.4, 2042.6, 1e9]]))
    assert frame_dn.dtype == np.uint16
    np.testing.assert_array_equal(frame_dn, [[10, 10, 11, 9, 0, 0, 4095, 4095, 4095]])


def test_temperature_falls_exponentially_with_a_ripple() -> None:
    cooling = Cooling(20.0, -10.0, 100.0, seed=1)
    times_s = np.linspace(0.0, 2000.0, 4001)
    curve_c = np.array([cooling.temperature_c(at_s) for at_s in times_s])
    ripple_c = curve_c - (-10.0 + 30.0 * np.exp(-times_s / 100.0))
    assert 0.02 < np.abs(ripple_c).max() <= 0.09
    assert abs(ripple_c.mean()) < 0.01
    assert cooling.temperature_c(7.0) != Cooling(20.0, -10.0, 100.0, seed=2).temperature_c(7.0)
    assert Cooling(None, -20.0, 100.0, seed=1).temperature_c(7.0) == -20.0


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 5), (4, 2)])
def test_poses_follow_the_nodes_in_raster_order(rows: int, columns: int) -> None:
    poses = nominal_poses_rt_cam_ref(rows, columns, 50.0)
    nodes, centre = grid_nodes(rows, columns), centre_node(rows, columns)
    assert nodes == sorted(nodes)
    assert len(set(nodes)) == rows * columns
    np.testing.assert_array_equal(poses[nodes.index(centre)], 0.0)
    for (row, column), pose in zip(nodes, poses, strict=True):
        # The camera's centre, −Rᵀt with R = 1: right of the reference for later columns, below it for later rows
        np.testing.assert_array_equal(-pose[3:], [50.0 * (column - centre[1]), 50.0 * (row - centre[0]), 0])
        np.testing.assert_array_equal(pose[:3], 0.0)


def test_field_of_view_is_independent_of_pixels() -> None:
    small, large = (paper_experiment(*size).optics for size in [(80, 60), (640, 480)])
    # Outer edges of the first and last pixels, half a pixel beyond their centres
    edges = [
        ((np.array([-0.5, size - 0.5]) - centre) / f)
        for optics in (small, large)
        for size, centre, f in zip(
            optics.size_px, (optics.cx_px, optics.cy_px), (optics.fx_px, optics.fy_px), strict=True
        )
    ]
    np.testing.assert_allclose(edges[:2], edges[2:], rtol=1e-12)


def test_pose_errors_have_given_deviations_except_reference() -> None:
    experiment = SimulatedExperiment((), paper_experiment(8, 6).optics, rows=61, columns=61)
    poses = experiment.poses_rt_cam_ref(0.5, 2e-3, np.random.default_rng(20110919))
    errors = poses - experiment.nominal_poses_rt_cam_ref()
    np.testing.assert_array_equal(errors[experiment.reference_view], 0.0)
    # A standard deviation from n numbers is known to 1 / √(2 n) of itself
    np.testing.assert_allclose(errors.std(axis=0), [2e-3] * 3 + [0.5] * 3, rtol=4 / np.sqrt(2 * 61**2))
    np.testing.assert_allclose(errors.mean(axis=0), 0, atol=4 * 0.5 / 61)
