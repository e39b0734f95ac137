"""The grid, the paper's experiment and its toys."""

import numpy as np
import pytest

from faintfield.rig.plan import centre_node, grid_nodes, nominal_poses_rt_cam_ref
from faintfield.rig.simulation.experiment import SimulatedExperiment, paper_experiment


@pytest.fixture(scope="module")
def experiment() -> SimulatedExperiment:
    return paper_experiment(80, 60)


@pytest.mark.parametrize(("rows", "columns"), [(1, 1), (3, 5), (4, 2)])
def test_poses_follow_the_nodes_in_raster_order_from_the_centre(rows: int, columns: int) -> None:
    poses = nominal_poses_rt_cam_ref(rows, columns, 50.0)
    nodes, centre = grid_nodes(rows, columns), centre_node(rows, columns)
    assert nodes == sorted(nodes)
    assert len(set(nodes)) == rows * columns
    np.testing.assert_array_equal(poses[nodes.index(centre)], 0.0)
    for (row, column), pose in zip(nodes, poses, strict=True):
        # The camera's centre, −Rᵀt with R = 1: right of the reference for later columns, below it for later rows
        np.testing.assert_array_equal(-pose[3:], [50.0 * (column - centre[1]), 50.0 * (row - centre[0]), 0])
        np.testing.assert_array_equal(pose[:3], 0.0)


def test_the_paper_has_49_nodes_50_mm_apart_and_objects_at_500_and_700_mm(experiment: SimulatedExperiment) -> None:
    poses = experiment.nominal_poses_rt_cam_ref()
    assert poses.shape == (49, 6)
    assert np.ptp(poses[:, 3]) == np.ptp(poses[:, 4]) == 300.0
    assert experiment.reference_view == 24
    assert {plane.name: plane.depth_mm for plane in experiment.planes} == {"truck": 500.0, "airplane": 700.0}
    assert experiment.exposure_s == 0.1
    sensor = experiment.sensor
    assert (sensor.quantum_efficiency, sensor.dark_current_e_per_s) == (0.5, 0.2)
    assert sensor.read_noise_e**2 == pytest.approx(12.0)


def test_the_field_of_view_does_not_depend_on_the_number_of_pixels() -> None:
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


def test_pose_errors_have_the_deviations_asked_for_and_spare_the_reference() -> None:
    experiment = SimulatedExperiment((), paper_experiment(8, 6).optics, rows=61, columns=61)
    poses = experiment.poses_rt_cam_ref(0.5, 2e-3, np.random.default_rng(20110919))
    errors = poses - experiment.nominal_poses_rt_cam_ref()
    np.testing.assert_array_equal(errors[experiment.reference_view], 0.0)
    # A standard deviation from n numbers is known to 1 / √(2 n) of itself
    np.testing.assert_allclose(errors.std(axis=0), [2e-3] * 3 + [0.5] * 3, rtol=4 / np.sqrt(2 * 61**2))
    np.testing.assert_allclose(errors.mean(axis=0), 0, atol=4 * 0.5 / 61)


def test_a_grey_experiment_sees_the_mean_of_the_colours(experiment: SimulatedExperiment) -> None:
    for colour, grey in zip(experiment.planes, experiment.grey().planes, strict=True):
        np.testing.assert_allclose(grey.reflectance, colour.reflectance.mean(axis=2))
        assert grey.grey() is grey
