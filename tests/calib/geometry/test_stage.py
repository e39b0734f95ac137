"""The stage report against stages whose faults are known."""

from dataclasses import replace

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from faintfield.calib.geometry import RigGeometry
from faintfield.calib.geometry.stage import approach_directions, stage_report
from faintfield.rig.plan import grid_nodes
from tests.calib.geometry.simulated import calibrated, simulated

SIDE = 5
NODES = grid_nodes(SIDE, SIDE)
SERPENTINE = [((row, column if row % 2 == 0 else 4 - column), 0) for row in range(SIDE) for column in range(SIDE)]
DIRECTIONS = approach_directions(SERPENTINE)
TILT = Rotation.from_rotvec([0.01, -0.02, 0.3])


@pytest.fixture(scope="module")
def measured() -> RigGeometry:
    """Lens and covariance of a 3 x 3 calibration, repeated for as many nodes as the stages have."""
    geometry = calibrated(simulated(1))
    lens = geometry.covariance.shape[0] - 6 * len(geometry.nodes)
    covariance = np.zeros((lens + 6 * len(NODES),) * 2)
    covariance[:lens, :lens] = geometry.covariance[:lens, :lens]
    covariance[lens:, lens:] = np.kron(np.eye(len(NODES)), geometry.covariance[lens : lens + 6, lens : lens + 6])
    return replace(geometry, nodes=NODES, reference=12, rt_cam_ref=np.zeros((25, 6)), covariance=covariance)


def faulty(measured: RigGeometry, backlash_x_mm: float = 0.0) -> RigGeometry:
    """Return cameras on a stage 0.2 % long in x, 0.1 % short in y, 3 mrad out of square, turned and tilted."""
    poses = []
    for row, column in NODES:
        x = 50.1 * (column - 2) - backlash_x_mm * DIRECTIONS[row, column][0] / 2
        y = 49.95 * (row - 2)
        centre = TILT.apply([x - np.sin(0.003) * y, np.cos(0.003) * y, 0.0])
        poses.append(np.append(np.zeros(3), -centre))
    return replace(measured, rt_cam_ref=np.array(poses))


def subset(geometry: RigGeometry, indices: list[int]) -> RigGeometry:
    columns = np.concatenate([np.arange(9), *[9 + 6 * index + np.arange(6) for index in indices]])
    return replace(
        geometry,
        nodes=[NODES[index] for index in indices],
        reference=len(indices) // 2,
        rt_cam_ref=geometry.rt_cam_ref[indices],
        covariance=geometry.covariance[np.ix_(columns, columns)],
    )


def test_known_faults_are_measured(measured: RigGeometry) -> None:
    report = stage_report(faulty(measured, backlash_x_mm=0.08), DIRECTIONS, 50.0)
    assert report.scale_x.value == pytest.approx(1.002, rel=1e-9)
    assert report.scale_y.value == pytest.approx(0.999, rel=1e-9)
    assert report.squareness_rad.value == pytest.approx(0.003, abs=1e-9)
    assert report.backlash_x_mm.value == pytest.approx(0.08, abs=1e-9)
    axis_of_grid = TILT.apply([0, 0, 1])
    assert report.tilt_rad.value == pytest.approx(np.arccos(axis_of_grid[2]), abs=1e-9)
    assert report.node_residual_rms_mm.value == pytest.approx(0, abs=1e-9)
    assert report.backlash_y_mm.value is None
    assert "three columns or more in alternation" in str(report.backlash_y_mm.why)
    assert report.warnings == []  # 0.2 % is a stage


def test_sigma_follows_from_the_residuals(measured: RigGeometry) -> None:
    """A figure is linear in small errors of the centres, so that its slopes give its error."""
    generator = np.random.default_rng(1)
    stage = subset(faulty(measured), [index for index, node in enumerate(NODES) if min(node) > 0 and max(node) < 4])
    stage = replace(stage, covariance=np.zeros_like(stage.covariance))
    stage.rt_cam_ref[:, 3:] += generator.normal(size=(9, 3)) * 0.05
    names, step_mm = ("scale_x", "scale_y", "squareness_rad", "backlash_x_mm", "tilt_rad"), 1e-3
    report, slopes = stage_report(stage, DIRECTIONS, 50.0), []
    for place in np.ndindex(9, 3):
        moved = stage.rt_cam_ref.copy()
        moved[:, 3:][place] += step_mm
        shifted = stage_report(replace(stage, rt_cam_ref=moved), DIRECTIONS, 50.0)
        slopes.append([(getattr(shifted, name).value - getattr(report, name).value) / step_mm for name in names])
    residual_mm = report.node_residual_rms_mm.value or 0.0
    expected = residual_mm / np.sqrt(3) * np.linalg.norm(slopes, axis=0)
    np.testing.assert_allclose([getattr(report, name).sigma for name in names], expected, rtol=1e-3)


def test_residuals_are_those_of_least_squares(measured: RigGeometry) -> None:
    generator = np.random.default_rng(8)
    nodes = np.array(NODES, float)
    x, y = 60.0 * (nodes[:, 1] - 2), 25.0 * (nodes[:, 0] - 2)
    centres = TILT.apply(np.column_stack([x, y, np.zeros(25)]) + generator.normal(size=(25, 3)) * [0.3, 0.2, 0.1])
    report = stage_report(replace(measured, rt_cam_ref=np.hstack([np.zeros((25, 3)), -centres])), {}, None)
    design = np.column_stack([np.ones(25), nodes])
    solution = np.linalg.lstsq(design, centres)[0]
    residuals = centres - design @ solution
    reported = np.array(report.residuals_mm)
    # The same lengths, whatever the axes; of the three axes x lies along the rows, and the third across both
    np.testing.assert_allclose(np.linalg.norm(reported, axis=1), np.linalg.norm(residuals, axis=1), rtol=1e-9)
    along_x = solution[2] / np.linalg.norm(solution[2])
    across = np.cross(solution[2], solution[1])
    np.testing.assert_allclose(reported[:, 0], residuals @ along_x, atol=1e-9)
    np.testing.assert_allclose(reported[:, 2], residuals @ across / np.linalg.norm(across), atol=1e-9)
    freedom = 75 - 9  # coordinates less numbers of the grid
    rms_mm = np.sqrt(3 * (residuals**2).sum() / freedom)
    assert report.node_residual_rms_mm.value == pytest.approx(rms_mm)
    assert report.node_residual_rms_mm.sigma == pytest.approx(rms_mm / np.sqrt(2 * freedom))
    assert report.pitch_x_mm.value == pytest.approx(np.linalg.norm(solution[2]))
    assert report.pitch_y_mm.value == pytest.approx(np.linalg.norm(solution[1]))
    assert report.scale_x.value is None, "no pitch was commanded"


def test_approach_directions_are_averaged_moves() -> None:
    assert DIRECTIONS[0, 1] == (1.0, 1.0)
    assert DIRECTIONS[1, 2] == (-1.0, 1.0)
    back = [(node, 1) for node, _ in SERPENTINE[::-1]]
    assert approach_directions(SERPENTINE + back)[1, 2] == (0.0, 0.0)
    row = [((0, column), 0) for column in (2, 1, 0)]
    assert approach_directions(row) == {node: (-1.0, 0.0) for node, _ in row}, "the other axis never moved"
    assert approach_directions([((1, 1), 0)]) == {(1, 1): (0.0, 0.0)}


def test_nodes_on_a_line_give_no_report(measured: RigGeometry) -> None:
    line = subset(measured, [index for index, node in enumerate(NODES) if node[0] == 2])
    assert "one line" in str(stage_report(line, {}, 50.0).squareness_rad.why)


def test_misplaced_nodes_are_named(measured: RigGeometry) -> None:
    swapped, lost = faulty(measured).rt_cam_ref.copy(), faulty(measured).rt_cam_ref.copy()
    swapped[[3, 21]] = swapped[[21, 3]]
    first, second = stage_report(replace(measured, rt_cam_ref=swapped), {}, 50.0).warnings
    assert "node (0, 3) lies 223" in first
    assert "where node (4, 1) belongs: check the node of its images" in first
    assert "node (4, 1) lies 223" in second
    assert "where node (0, 3) belongs" in second
    lost[7, 3] += 20.0
    (warning,) = stage_report(replace(measured, rt_cam_ref=lost), {}, 50.0).warnings
    assert "node (1, 2) lies 20.0 mm from its place: check" in warning


def test_squares_of_another_size_show_in_the_pitch(measured: RigGeometry) -> None:
    along_x, along_y = stage_report(faulty(measured), {}, 51.0).warnings
    assert "along x the nodes lie 1.8% closer together than pitch_mm says: measure square_mm" in along_x
    assert "along y" in along_y
