"""The stage report against stages whose faults are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from faintfield.calib.geometry import GeometrySettings, RigGeometry, calibrate_geometry
from faintfield.calib.geometry.stage import approach_directions, stage_report
from faintfield.rig.plan import grid_nodes
from tests.calib.geometry.simulated import BOARDS, OPTICS, simulated

NODES = grid_nodes(5, 5)
SERPENTINE = [(row, column if row % 2 == 0 else 4 - column) for row in range(5) for column in range(5)]
TILT = Rotation.from_rotvec([0.01, -0.02, 0.3])


@pytest.fixture(scope="module")
def measured() -> RigGeometry:
    given = simulated(1, side=5)
    return calibrate_geometry(BOARDS, given.observations, OPTICS.size_px, (2, 2), GeometrySettings())


def faulty(measured: RigGeometry, backlash_x_mm: float = 0.0) -> RigGeometry:
    """Return cameras on a stage 0.2 % long in x, 0.1 % short in y, 3 mrad out of square, turned and tilted."""
    directions = approach_directions([(node, 0) for node in SERPENTINE])
    poses = []
    for row, column in NODES:
        x = 50.1 * (column - 2) - backlash_x_mm * directions[row, column][0] / 2
        y = 49.95 * (row - 2)
        centre = TILT.apply([x - np.sin(0.003) * y, np.cos(0.003) * y, 0.0])
        poses.append(np.append(np.zeros(3), -centre))
    return replace(measured, rt_cam_ref=np.array(poses))


def test_known_faults_are_found(measured: RigGeometry) -> None:
    directions = approach_directions([(node, 0) for node in SERPENTINE])
    report = stage_report(faulty(measured, backlash_x_mm=0.08), directions, 50.0)
    assert report.scale_x.value == pytest.approx(1.002, rel=1e-9)
    assert report.scale_y.value == pytest.approx(0.999, rel=1e-9)
    assert report.squareness_rad.value == pytest.approx(0.003, abs=1e-9)
    assert report.backlash_x_mm.value == pytest.approx(0.08, abs=1e-9)
    axis_of_grid = TILT.apply([0, 0, 1])
    assert report.tilt_rad.value == pytest.approx(np.arccos(axis_of_grid[2]), abs=1e-9)
    assert report.node_residual_rms_mm.value == pytest.approx(0, abs=1e-9)
    assert report.backlash_y_mm.value is None
    assert "three columns or more in alternation" in str(report.backlash_y_mm.why)


def test_stated_sigma_is_that_of_many_stages(measured: RigGeometry) -> None:
    directions = approach_directions([(node, 0) for node in SERPENTINE])
    generator = np.random.default_rng(1)
    certain = replace(measured, covariance=np.zeros_like(measured.covariance))
    names = ("scale_x", "scale_y", "squareness_rad", "backlash_x_mm")
    values, sigmas = [], []
    for _ in range(300):
        stage = faulty(certain)
        stage.rt_cam_ref[:, 3:] += generator.normal(size=(25, 3)) * 0.05
        report = stage_report(stage, directions, 50.0)
        values.append([getattr(report, name).value for name in names])
        sigmas.append([getattr(report, name).sigma for name in names])
    np.testing.assert_allclose(np.std(values, axis=0), np.sqrt(np.mean(np.square(sigmas), axis=0)), rtol=0.13)


def test_residuals_are_those_of_a_plain_least_squares_grid_turned_into_its_axes(measured: RigGeometry) -> None:
    generator = np.random.default_rng(8)
    nodes = np.array(NODES, float)
    x, y = 60.0 * (nodes[:, 1] - 2), 25.0 * (nodes[:, 0] - 2)
    centres = TILT.apply(np.column_stack([x, y, np.zeros(25)]) + generator.normal(size=(25, 3)) * [0.3, 0.2, 0.1])
    stage = replace(measured, rt_cam_ref=np.hstack([np.zeros((25, 3)), -centres]))
    report = stage_report(stage, {}, None)
    design = np.column_stack([np.ones(25), nodes])
    solution = np.linalg.lstsq(design, centres)[0]
    left = centres - design @ solution
    found = np.array(report.residuals_mm)
    # The same lengths, whatever the axes; of the three axes x lies along the rows, and the third across both
    np.testing.assert_allclose(np.linalg.norm(found, axis=1), np.linalg.norm(left, axis=1), rtol=1e-9)
    along_x = solution[2] / np.linalg.norm(solution[2])
    across = np.cross(solution[2], solution[1])
    np.testing.assert_allclose(found[:, 0], left @ along_x, atol=1e-9)
    np.testing.assert_allclose(found[:, 2], left @ across / np.linalg.norm(across), atol=1e-9)
    # 75 coordinates less 9 numbers of the grid
    freedom = 75 - 9
    rms_mm = np.sqrt(3 * (left**2).sum() / freedom)
    assert report.node_residual_rms_mm.value == pytest.approx(rms_mm)
    assert report.node_residual_rms_mm.sigma == pytest.approx(rms_mm / np.sqrt(2 * freedom))
    assert report.pitch_x_mm.value == pytest.approx(np.linalg.norm(solution[2]))
    assert report.pitch_y_mm.value == pytest.approx(np.linalg.norm(solution[1]))


def test_an_axis_that_never_moved_was_approached_from_neither_side() -> None:
    along_a_row = [((0, column), 0) for column in (2, 1, 0)]
    assert approach_directions(along_a_row) == {(0, column): (-1.0, 0.0) for column in range(3)}
    assert approach_directions([((1, 1), 0)]) == {(1, 1): (0.0, 0.0)}


def test_directions_of_a_serpentine_and_of_its_reverse_cancel() -> None:
    there = [(node, 0) for node in SERPENTINE]
    back = [(node, 1) for node in SERPENTINE[::-1]]
    directions = approach_directions(there)
    assert directions[0, 1] == (1.0, 1.0)
    assert directions[1, 2] == (-1.0, 1.0)
    assert approach_directions(there + back)[1, 2] == (0.0, 0.0)


def test_without_pitch_mm_there_is_no_scale(measured: RigGeometry) -> None:
    report = stage_report(faulty(measured), {}, None)
    assert report.pitch_x_mm.value == pytest.approx(50.1)
    assert report.scale_x.value is None


def test_nodes_on_a_line_say_nothing_of_the_stage(measured: RigGeometry) -> None:
    row = [index for index, node in enumerate(NODES) if node[0] == 2]
    columns = np.concatenate([np.arange(9), *[9 + 6 * index + np.arange(6) for index in row]])
    line = replace(
        measured,
        nodes=[NODES[index] for index in row],
        reference=2,
        rt_cam_ref=measured.rt_cam_ref[row],
        covariance=measured.covariance[np.ix_(columns, columns)],
    )
    assert "one line" in str(stage_report(line, {}, 50.0).squareness_rad.why)


def test_swapped_nodes_are_named(measured: RigGeometry) -> None:
    poses = faulty(measured).rt_cam_ref.copy()
    poses[[3, 21]] = poses[[21, 3]]
    first, second = stage_report(replace(measured, rt_cam_ref=poses), {}, 50.0).warnings
    assert "node (0, 3) lies 223" in first
    assert "where node (4, 1) belongs: check the node of its images" in first
    assert "node (4, 1) lies 223" in second
    assert "where node (0, 3) belongs" in second


def test_lost_steps_are_named(measured: RigGeometry) -> None:
    poses = faulty(measured).rt_cam_ref.copy()
    poses[7, 3] += 20.0
    (warning,) = stage_report(replace(measured, rt_cam_ref=poses), {}, 50.0).warnings
    assert "node (1, 2) lies 20.0 mm from its place: check" in warning


def test_squares_of_another_size_show_in_the_distance_of_the_nodes(measured: RigGeometry) -> None:
    assert stage_report(faulty(measured), {}, 50.0).warnings == []  # 0.2 % is a stage
    warnings = stage_report(faulty(measured), {}, 51.0).warnings
    assert len(warnings) == 2
    assert "along x the nodes lie 1.8% closer together than pitch_mm says: measure square_mm" in warnings[0]
    assert "along y" in warnings[1]
