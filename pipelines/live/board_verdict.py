"""Verdict on the board sweeps so far: what their corners determine, and where to put the board next.

The solution is that of `faintfield geometry`, without its hold-out; the error that it predicts is the one by which a
geometry is accepted.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import reduce
from operator import add

import numpy as np
from msgspec.structs import replace
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.errors import CalibrationError
from faintfield.calib.geometry import BoardObservation, Node
from faintfield.calib.geometry.calibrate import Adjustment, adjust, nominal_adjustment
from faintfield.calib.geometry.information import Information, StandingBoard, TransferPrediction, standing_boards
from faintfield.calib.geometry.placement import (
    Placement,
    board_in_view,
    board_middle_mm,
    candidate_placements,
    count_cells,
    describe_placement,
    tilt_of,
)
from faintfield.calib.lens import Lens
from faintfield.pipelines.live.board_progress import BoardVerdict, SweepProgress
from faintfield.rig.plan import CapturePlan

# The lens is not known until its focal length is known this well, relative; few boards may fit with any, even less
# than any lens has, in widths of the detector.
_MAX_FOCAL_SIGMA, _MIN_FOCAL_WIDTHS = 0.1, 0.2

# Focal length in widths of the detector that stands for the lens until then.
_NOMINAL_FOCAL_WIDTHS = 1.25

# So many boards determine a lens; corners that fit none then contradict one another.
_ENOUGH_BOARDS = 3


@dataclass(frozen=True)
class SweepPlan:
    """Nominal poses (6,) of the nodes, wanted error, depths of planes, and sweeps that have not begun, by the plan.

    `to_come` are the nodes whose frames of the present sweep are still to be taken.
    """

    rt_cam_ref: Mapping[Node, NDArray[np.float64]]
    reference: Node
    depths_mm: tuple[float, ...]
    wanted_px: float
    to_come: Mapping[int, Sequence[Node]]
    sweeps_left: int


def nominal_poses(plan: CapturePlan) -> dict[Node, NDArray[np.float64]]:
    """Return the poses (6,) that the stage is told, by node."""
    centre = plan.centre.target
    return {
        stop.node: np.array([0, 0, 0, centre.x_mm - stop.target.x_mm, centre.y_mm - stop.target.y_mm, 0.0])
        for stop in plan.stops
    }


def coverage(observations: Sequence[BoardObservation], size_px: tuple[int, int]) -> tuple[tuple[int, ...], ...]:
    """Return the number of corners in each cell of the detector."""
    pixels = [observation.pixels for observation in observations]
    cells = count_cells(np.concatenate(pixels) if pixels else np.empty((0, 2)), size_px)
    return tuple(tuple(row) for row in cells.tolist())


def sweeps_seen(
    observations: Sequence[BoardObservation], adjustment: Adjustment | None, boards: Mapping[str, Board]
) -> tuple[SweepProgress, ...]:
    """Return the boards of each sweep; where they stand follows from an adjustment, or from a view by its lens."""
    seen: dict[tuple[int, str], list[BoardObservation]] = {}
    for observation in observations:
        seen.setdefault((observation.target.sweep, observation.target.board), []).append(observation)
    return tuple(_sweep_seen(views, adjustment, boards[name]) for (_, name), views in sorted(seen.items()))


def _sweep_seen(views: Sequence[BoardObservation], adjustment: Adjustment | None, board: Board) -> SweepProgress:
    target, corners, nodes = views[0].target, sum(len(view.corners) for view in views), {view.node for view in views}
    progress = SweepProgress(target.sweep + 1, board.name, corners, len(nodes))
    if adjustment is None:
        return progress
    poses = [
        pose.rt_ref_board
        for pose in adjustment.geometry.boards
        if (pose.target.sweep, pose.target.board) == (target.sweep, board.name)
    ]
    best = max(views, key=lambda view: len(view.corners))
    rt_ref_board = poses[0] if poses else board_in_view(adjustment.geometry, board, best)
    if rt_ref_board is None:
        return progress
    tilt, distance_mm = tilt_of(rt_ref_board), float(board_middle_mm(board, rt_ref_board)[2])
    return replace(progress, distance_mm=round(distance_mm), tilt_deg=tilt.deg, direction=tilt.direction)


def judge(
    boards: Mapping[str, Board], observations: Sequence[BoardObservation], size_px: tuple[int, int], plan: SweepPlan
) -> tuple[BoardVerdict, Adjustment | None]:
    """Return the verdict on the boards so far, and the solution if the lens is known by it.

    Raises `CalibrationError` if the corners contradict one another, or the reference node sees no board.
    """
    adjustment: Adjustment | None = None
    try:
        adjustment = adjust(boards, observations, size_px, plan.reference, "opencv5")
        if not _knows_lens(adjustment):
            adjustment = None
    except CalibrationError:
        if len({observation.target for observation in observations}) >= _ENOUGH_BOARDS:
            raise
    width, height = size_px
    nominal_px = _NOMINAL_FOCAL_WIDTHS * width
    lens = Lens(size_px, nominal_px, nominal_px, (width - 1) / 2, (height - 1) / 2, (0.0,) * 5)
    start = adjustment or nominal_adjustment(boards, observations, lens, plan.reference, plan.rt_cam_ref)
    prediction = TransferPrediction(start, plan.depths_mm)
    so_far = _information(prediction, standing_boards(start, boards), plan)
    error_px, depth_mm = prediction.error_px(so_far)
    under_way = [sweep + 1 for sweep, nodes in plan.to_come.items() if nodes]
    when = f" once all frames of sweep {max(under_way)} count," if under_way else ""
    predicted = f"predicted transfer error{when} {error_px:.2g} px at {depth_mm:g} mm, wanted {plan.wanted_px:g}"
    if adjustment is not None and error_px <= plan.wanted_px:
        alone = len(adjustment.geometry.boards) == 1
        further = "; sweeps that are left may be skipped" if plan.sweeps_left else ""
        more = ", but nothing checks a single board yet" if alone else f", the boards are good enough{further}"
        return BoardVerdict(f"{predicted}: reached{more}", error_px, depth_mm, reached=True), adjustment
    board = max(boards.values(), key=lambda board: (board.columns * board.rows, board.name))
    placements = candidate_placements(prediction, so_far, board, np.array(coverage(observations, size_px)))
    advice = _advise(placements, error_px, plan, known=adjustment is not None)
    if adjustment is None:
        words = f"the boards so far do not determine the lens (wanted: a transfer error of {plan.wanted_px:g} px)"
        return BoardVerdict(f"{words}: {advice}"), None
    return BoardVerdict(f"{predicted}: {advice}", error_px, depth_mm), adjustment


def _advise(placements: Sequence[Placement], error_px: float, plan: SweepPlan, *, known: bool) -> str:
    if not placements:
        return "no placement of this board is seen from all nodes; take a smaller grid or a smaller board"
    best = placements[0]
    words = describe_placement(best, with_distance=known)
    where = f"{'after it' if any(plan.to_come.values()) else 'next'}, put the board {words}"
    if not plan.sweeps_left:
        where = f"no board sweep is left; to reach it, add one in a new session with the board {words}"
    return f"{where}; that would give {best.error_px:.2g} px" if known and best.error_px < error_px else where


def _knows_lens(adjustment: Adjustment) -> bool:
    """Return whether the focal length is known at all, and the lens one that can be."""
    geometry = adjustment.geometry
    focal_px, variance_px2 = geometry.lens.fx_px, geometry.covariance[0, 0]
    if focal_px < _MIN_FOCAL_WIDTHS * geometry.lens.size_px[0]:
        return False
    if not 0 < variance_px2 <= (_MAX_FOCAL_SIGMA * focal_px) ** 2:
        return False
    try:
        geometry.lens.rays_at(np.array([[0.0, 0.0], np.array(geometry.lens.size_px) - 1.0]))
    except CalibrationError:
        return False
    return True


def _information(
    prediction: TransferPrediction, sweeps: Mapping[int, Sequence[StandingBoard]], plan: SweepPlan
) -> Information:
    """Return the information of all corners, and of those that the rest of the present sweep will bring."""
    index = {node: place for place, node in enumerate(prediction.geometry.nodes)}
    parts = [prediction.nothing()]
    for sweep, boards in sweeps.items():
        missing = [index[node] for node in plan.to_come.get(sweep, ()) if node in index]
        full = [
            StandingBoard(
                standing.board,
                standing.rt_ref_board,
                {**prediction.seen(standing.board, standing.rt_ref_board, missing).weights, **standing.weights},
            )
            for standing in boards
        ]
        parts.append(prediction.of_sweep(full))
    return reduce(add, parts)
