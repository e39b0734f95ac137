"""The geometry against the simulated truth: errors, stated uncertainty, and what is refused."""

import os
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from faintfield.calib.errors import NotIdentifiable, PoorFit, TooFewViews
from faintfield.calib.geometry import (
    BoardObservation,
    GeometrySettings,
    RigGeometry,
    calibrate_geometry,
    rms_over_views,
    transfer_sigma_at,
)
from faintfield.calib.geometry.bundle import _c_library_silenced
from faintfield.calib.homography import fronto_parallel_rt_ref_plane, image_lattice, transfer
from faintfield.calib.lens import Lens
from faintfield.rig.simulation.boards import SimulatedBoard, six_boards
from tests.calib.geometry.simulated import (
    BOARDS,
    LENIENT,
    NOISE_PX,
    OPTICS,
    Simulated,
    calibrated,
    centres_mm,
    simulated,
)

TRUE_LENS = Lens(OPTICS.size_px, OPTICS.fx_px, OPTICS.fy_px, OPTICS.cx_px, OPTICS.cy_px, OPTICS.distortion)

type Calibrated = tuple[Simulated, RigGeometry]


def normalized_error(truth: Simulated, geometry: RigGeometry) -> float:
    """Return e' C⁻¹ e per number, of lens and poses without the reference's."""
    true_lens = np.array([OPTICS.fx_px, OPTICS.fy_px, OPTICS.cx_px, OPTICS.cy_px, *OPTICS.distortion])
    error = np.concatenate([geometry.lens.parameters - true_lens, (geometry.rt_cam_ref - truth.poses).ravel()])
    known = np.diag(geometry.covariance) > 0
    assert (~known).sum() == 6  # the gauge
    return float(error[known] @ np.linalg.solve(geometry.covariance[np.ix_(known, known)], error[known])) / known.sum()


def largest_error_mm(truth: Simulated, geometry: RigGeometry) -> float:
    return float(np.abs(centres_mm(geometry.rt_cam_ref) - centres_mm(truth.poses)).max())


@pytest.fixture(scope="module")
def many() -> list[Calibrated]:
    return [(truth, calibrated(truth, LENIENT)) for truth in (simulated(seed) for seed in range(4, 8))]


def test_corners_without_noise_give_the_truth() -> None:
    truth = simulated(1, noise_px=1e-6)
    geometry = calibrated(truth)
    np.testing.assert_allclose(geometry.rt_cam_ref, truth.poses, atol=2e-3)  # the solver's pull on the distortion
    assert geometry.lens.fx_px == pytest.approx(OPTICS.fx_px, abs=0.01)
    assert geometry.rms_inlier_px < 1e-3


def test_covariance_is_that_of_the_errors(many: list[Calibrated]) -> None:
    """NEES has mean one; 4 seeds of 57 numbers put two standard errors at 0.2."""
    assert np.mean([normalized_error(truth, geometry) for truth, geometry in many]) == pytest.approx(1.0, abs=0.2)


def test_centre_sigma_is_that_of_the_centres(many: list[Calibrated]) -> None:
    square = [np.square(centres_mm(g.rt_cam_ref) - centres_mm(s.poses)).sum(axis=1).mean() for s, g in many]
    assert np.mean(square) == pytest.approx(np.mean([np.square(g.sigma_mm()).mean() for _, g in many]), rel=0.35)


def test_transfer_sigma_is_that_of_the_transfers(many: list[Calibrated]) -> None:
    plane, pixels = fronto_parallel_rt_ref_plane(600.0), image_lattice(OPTICS.size_px)
    square = []
    for truth, geometry in many:
        moved = np.arange(len(truth.poses)) != geometry.reference
        for rt, rt_true in zip(geometry.rt_cam_ref[moved], truth.poses[moved], strict=True):
            there = transfer(TRUE_LENS, rt_true, plane, pixels)
            inside = ((there >= -0.5) & (there <= np.array(OPTICS.size_px) - 0.5)).all(axis=1)
            square.append(np.square(transfer(geometry.lens, rt, plane, pixels) - there)[inside].sum(axis=1))
    stated = np.sqrt(np.mean([rms_over_views(transfer_sigma_at(g, 600.0)) ** 2 for _, g in many]))
    assert np.sqrt(np.concatenate(square).mean()) == pytest.approx(stated, rel=0.25)


def test_corner_noise_is_measured(many: list[Calibrated]) -> None:
    assert np.mean([geometry.sigma_px for _, geometry in many]) == pytest.approx(NOISE_PX, rel=0.01)
    for _, geometry in many:
        assert geometry.rms_inlier_px < geometry.sigma_px  # the fit takes up some of the noise
        assert geometry.holdout_ratio == pytest.approx(1.0, abs=0.1)
        assert geometry.repeatability is None
        assert geometry.warnings == []


@pytest.mark.deep
def test_order_of_observations_does_not_matter(many: list[Calibrated]) -> None:
    truth, geometry = many[3]
    shuffled = replace(truth, observations=truth.observations[::-1])
    np.testing.assert_allclose(calibrated(shuffled, LENIENT).rt_cam_ref, geometry.rt_cam_ref, atol=1e-9)


def test_outliers_are_marked_and_do_not_pull() -> None:
    truth = simulated(5)
    for view in truth.observations[::7]:
        view.pixels[0] += [15.0, -9.0]
    geometry = calibrated(truth)
    wrong = len(truth.observations[::7])
    assert wrong <= geometry.outliers < 3 * wrong
    assert largest_error_mm(truth, geometry) < 0.5


def test_boards_in_turn_reveal_the_repeatability() -> None:
    geometry = calibrated(simulated(6, side=4, miss_mm=0.05), LENIENT)
    assert geometry.repeatability is not None
    assert geometry.repeatability.sd_mm == pytest.approx(0.05, abs=3 * geometry.repeatability.se_mm)
    assert geometry.repeatability.se_mm < 0.008
    assert geometry.sigma_px == pytest.approx(NOISE_PX, rel=0.03)


@pytest.mark.deep
def test_covariance_includes_the_repeatability() -> None:
    """Without the gantry's share the ratio would be several; with it, 8 seeds of 57 numbers: 0.9 to 1.1 within 0.25."""
    ratios, blind = [], []
    for seed in range(20, 28):
        truth = simulated(seed, miss_mm=0.05)
        ratios.append(normalized_error(truth, calibrated(truth, LENIENT)))
        together = [replace(view, target=replace(view.target, sweep=0)) for view in truth.observations]
        blind.append(normalized_error(truth, calibrated(replace(truth, observations=together), LENIENT)))
    assert np.mean(ratios) == pytest.approx(1.0, abs=0.25)
    assert np.mean(blind) > 1.5


FACING = SimulatedBoard(6, 8, 40.0, np.array([0.0, 0, 0, -140, -100, 600.0]))


@pytest.mark.parametrize(
    ("standing", "kept", "settings", "error", "words"),
    [
        ([FACING], None, {}, NotIdentifiable, r"transfer.*limit 0.5 px.*1 board pose.*tilted by 20 to 40"),
        (None, [(1, 1), (1, 2), (2, 2)], {}, TooFewViews, r"^3 node\(s\) show the boards .*, limit 4; take more nodes"),
        (None, None, {"depths_mm": (500.0, 5.0)}, NotIdentifiable, "plane at 5 mm: 0 of the 8 views .* --depth-mm"),
        (None, [(0, 0), (0, 1)], {}, TooFewViews, r"node \(1, 1\), whose camera is the reference"),
        (None, [], {}, TooFewViews, "no board was found"),
    ],
    ids=["one board, facing", "few nodes", "plane outside views", "no reference", "no board"],
)
def test_insufficient_views_are_refused(
    standing: list[SimulatedBoard] | None,
    kept: list[tuple[int, int]] | None,
    settings: dict[str, Any],
    error: type[Exception],
    words: str,
) -> None:
    truth = simulated(9, standing=standing)
    views = [view for view in truth.observations if kept is None or view.node in kept]
    with pytest.raises(error, match=words) as refusal:
        calibrated(replace(truth, observations=views), GeometrySettings(**settings))
    assert "\n" not in str(refusal.value)


def with_square(square_mm: float, noise_px: float = NOISE_PX) -> Simulated:
    boards = six_boards(6, 8, 40.0)
    boards[2] = replace(boards[2], square_mm=square_mm)
    return simulated(11, standing=boards, noise_px=noise_px)


def test_board_of_another_size_is_refused() -> None:
    with pytest.raises(PoorFit):
        calibrated(with_square(40.4))


def test_tiny_holdout_residuals_are_judged_in_pixels() -> None:
    slightly = with_square(40.02, noise_px=0.002)
    ratio = calibrated(slightly).holdout_ratio
    assert ratio is not None
    assert ratio > 1.3
    with pytest.raises(PoorFit, match=r"times its residual of 0\.0"):
        calibrated(slightly, GeometrySettings(negligible_holdout_px=0.001))


def test_lens_model_with_eight_coefficients() -> None:
    geometry = calibrated(simulated(13), replace(LENIENT, lens_model="opencv8"))
    assert len(geometry.lens.distortion) == 8
    assert geometry.lens.fx_px == pytest.approx(OPTICS.fx_px, abs=2.0)


def test_lens_without_distortion() -> None:
    geometry = calibrated(simulated(13, optics=OPTICS.ideal()), replace(LENIENT, lens_model="pinhole"))
    assert not geometry.lens.distortion
    assert geometry.lens.fx_px == pytest.approx(OPTICS.fx_px, abs=2.0)


def changed(truth: Simulated, board: str, change: Callable[[BoardObservation], BoardObservation]) -> Simulated:
    """Return the observations with a change of those of one board."""
    views = [change(view) if view.target.board == board else view for view in truth.observations]
    return replace(truth, observations=views)


def test_shaken_view_is_named_and_does_not_pull() -> None:
    truth, generator = simulated(14), np.random.default_rng(1)

    def shake(view: BoardObservation) -> BoardObservation:
        if view.node != (0, 0):
            return view
        return replace(view, pixels=view.pixels + generator.normal([3.0, 1.0], 1.5, view.pixels.shape))

    geometry = calibrated(changed(truth, "board-1", shake))
    (warning,) = geometry.warnings
    assert "at node (0, 0), board 'board-1' (" in warning
    assert "node (0, 0), board 'board-2'" not in warning
    assert largest_error_mm(truth, geometry) < 0.5


@pytest.mark.deep
def test_view_of_another_node_is_named() -> None:
    truth = simulated(15)
    wrong = next(view for view in truth.observations if (view.node, view.target.board) == ((2, 2), "board-3"))
    labelled = changed(truth, "board-3", lambda view: replace(wrong, node=(0, 1)) if view.node == (0, 1) else view)
    with pytest.raises(PoorFit, match=r"worst at node \(0, 1\), board 'board-3'; check .*the node of every image"):
        calibrated(labelled)


def test_nodes_swapped_in_a_sweep_are_named() -> None:
    swap = {(0, 0): (0, 1), (0, 1): (0, 0)}
    truth = simulated(16, standing=six_boards(6, 8, 40.0)[:5])
    swapped = changed(truth, "board-0", lambda view: replace(view, node=swap.get(view.node, view.node)))
    with pytest.raises(
        PoorFit, match=r"% of the corners disagree .*node \(0, [01]\).*check that every image has its right"
    ):
        calibrated(swapped)


@pytest.mark.deep
def test_board_that_is_not_the_print_is_refused() -> None:
    boards = {name: replace(board, columns=10) for name, board in BOARDS.items()}
    with pytest.raises(PoorFit, match=r"check columns, rows and first_marker_id of every \[\[board\]\]"):
        calibrate_geometry(boards, simulated(17).observations, OPTICS.size_px, (1, 1))


def test_output_of_the_solver_is_silenced() -> None:
    before = os.fstat(2)
    with _c_library_silenced():
        assert os.path.samestat(os.fstat(2), os.stat(os.devnull))
    assert os.path.samestat(os.fstat(2), before)
