"""Camera poses from a board set: corners found, lens and poses solved; the record and files of the result."""

import io
from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET

from faintfield.calib.detection import BoardCorners, detect_boards
from faintfield.calib.errors import TooFewViews
from faintfield.calib.geometry import (
    BoardObservation,
    GeometrySettings,
    RigGeometry,
    Target,
    calibrate_geometry,
    rms_over_views,
    transfer_sigma_at,
)
from faintfield.calib.geometry.bundle import load_mrcal
from faintfield.calib.geometry.homings import HomingShift
from faintfield.calib.geometry.stage import StageReport, approach_directions, stage_report
from faintfield.calib.noise.strips import read_ahead, usable_cores
from faintfield.pipelines.console import inform, progress, working
from faintfield.pipelines.formats.exchange.mrcal import camera_model_text
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.geometry import (
    CAMERA_FILE,
    CORNERS_FILE,
    COVARIANCE_FILE,
    BoardRecord,
    GeometryOptions,
    GeometryRecord,
    HomingRecord,
    LensRecord,
    NodeRecord,
    RepeatabilityRecord,
    StageRecord,
)
from faintfield.pipelines.formats.sets.board_set import BoardSet, BoardView

# A message about missed boards names this many nodes; more would not fit one line.
_MAX_NODES_NAMED = 8


@dataclass(frozen=True)
class MeasuredGeometry:
    """Calibration of the camera and its stage from a board set.

    Attributes
    ----------
    board_set : BoardSet
        The images.
    settings : GeometrySettings
        Lens model and limits.
    observations : list of BoardObservation
        All corners that were found.
    rig : RigGeometry
        Lens and poses.
    stage : StageReport
        What the poses say of the stage.
    """

    board_set: BoardSet
    settings: GeometrySettings
    observations: list[BoardObservation]
    rig: RigGeometry
    stage: StageReport


def measure_geometry(board_set: BoardSet, settings: GeometrySettings) -> MeasuredGeometry:
    """Find the boards in all images of a set, and solve for the lens and the camera's poses.

    Raises
    ------
    InputError, CalibrationError
        mrcal is not installed, an image cannot be used, or the corners do not determine the geometry.
    """
    load_mrcal()  # fails at once if it is missing, not after all images were searched
    observations, size_px = _observe(board_set)
    with working("solving lens and poses"):
        rig = calibrate_geometry(board_set.boards, observations, size_px, board_set.reference, settings)
    visits = [] if board_set.one_sided else [(view.node, view.sweep) for view in board_set.views]
    stage = stage_report(rig, approach_directions(visits), board_set.pitch_mm)
    return MeasuredGeometry(board_set, settings, observations, rig, stage)


def geometry_record(measured: MeasuredGeometry, options: GeometryOptions) -> GeometryRecord:
    """Return the record of a measured geometry."""
    rig, lens = measured.rig, measured.rig.lens
    lens_sigma = tuple(np.sqrt(np.diag(rig.covariance)[: len(lens.parameters)]).tolist())
    poses = zip(rig.nodes, rig.rt_cam_ref.tolist(), rig.sigma_mm().tolist(), rig.sigma_rad().tolist(), strict=True)
    return GeometryRecord(
        lens=LensRecord(
            rig.lens_model, lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, tuple(lens.distortion), lens_sigma
        ),
        size_px=lens.size_px,
        reference_node=rig.nodes[rig.reference],
        nodes=[NodeRecord(*pose) for pose in poses],
        homings=[_homing_record(shift) for shift in rig.homings] or UNSET,
        rms_inlier_px=rig.rms_inlier_px,
        rms_mrcal_px=rig.rms_mrcal_px,
        corner_sigma_px=rig.sigma_px,
        corners=rig.corners,
        outliers=rig.outliers,
        holdout_ratio=rig.holdout_ratio,
        warnings=[*rig.warnings, *_homing_warnings(measured)],
        transfer_sigma_px={
            f"{depth:g}": rms_over_views(transfer_sigma_at(rig, depth)) for depth in measured.settings.depths_mm
        },
        repeatability=msgspec.convert(rig.repeatability, RepeatabilityRecord | None, from_attributes=True),
        boards=_board_records(measured),
        stage=msgspec.convert(measured.stage, StageRecord, from_attributes=True),
        **provenance("geometry", options, dict(measured.board_set.input_hashes())).parts(),
    )


def _homing_warnings(measured: MeasuredGeometry) -> list[str]:
    """Return a warning where the stage homed within the only sweep, and may have come back to another place."""
    sweeps = measured.rig.undetermined_homings
    if not sweeps or measured.board_set.switches_repeat:
        return []
    return [
        f"the stage homed again within sweep {', '.join(map(str, sweeps))}, and no other sweep joins the nodes before "
        "and after, which may be shifted by as much as its switches repeat; take one more sweep"
    ]


def _homing_record(shift: HomingShift) -> HomingRecord:
    """Return the record of a shift."""
    (x, y, z), sigmas = shift.shift_mm.tolist(), np.sqrt(np.diag(shift.covariance_mm2)).tolist()
    return HomingRecord(shift.before, shift.after, (x, y, z), (sigmas[0], sigmas[1], sigmas[2]))


def geometry_files(measured: MeasuredGeometry) -> dict[str, bytes | str]:
    """Return the files beside geometry.json by name: covariance, corners, and a camera model for each node.

    The covariance is of fx, fy, cx, cy, the distortion, then rt_cam_ref of every node. The corners are those of the
    boards whose pose was solved.
    """
    rig = measured.rig
    solved = {(board.target.board, board.target.sweep) for board in rig.boards}
    files: dict[str, bytes | str] = {
        COVARIANCE_FILE: _npz(covariance=rig.covariance, nodes=np.array(rig.nodes), intrinsics=rig.lens.parameters),
        CORNERS_FILE: _corners_npz(
            [seen for seen in measured.observations if (seen.target.board, seen.target.sweep) in solved],
            apart=bool(rig.homings),
        ),
    }
    for node, rt_cam_ref in zip(rig.nodes, rig.rt_cam_ref, strict=True):
        files[CAMERA_FILE.format(*node)] = camera_model_text(rig.lens, rig.lens_model, rt_cam_ref)
    return files


def _observe(board_set: BoardSet) -> tuple[list[BoardObservation], tuple[int, int]]:
    """Find the boards in all views; return their corners and the size of the images."""
    boards, views = list(board_set.boards.values()), board_set.views
    first = views[0].image()
    size_px = first.shape[1], first.shape[0]

    def seen_in(view: BoardView) -> list[BoardCorners]:
        return detect_boards(first if view is views[0] else view.image(size_px), boards)

    found = read_ahead(views, seen_in, usable_cores())
    per_view = list(progress(found, "looking for boards", len(views)))
    _inform_of_found(per_view)
    observations = [
        BoardObservation(
            view.node, Target(seen.board, view.sweep, view.homing), seen.corners, seen.pixels, seen.sigma_px
        )
        for view, boards_seen in per_view
        for seen in boards_seen
        if len(seen.corners)
    ]
    if not observations:
        markers = sum(board.markers for _, seen in per_view for board in seen)
        raise TooFewViews(
            f"{board_set.source}: {markers} markers of the boards and no corner between them in {len(views)} "
            f"views; compare [[board]] ({'columns, rows' if markers else 'dictionary'}, first_marker_id) with the print"
            ", or expose longer"
        )
    return observations, size_px


def _inform_of_found(per_view: list[tuple[BoardView, list[BoardCorners]]]) -> None:
    """Name views without boards, and prints in the older layout."""
    empty = [view.node for view, seen in per_view if not any(len(board.corners) for board in seen)]
    if empty:
        names = ", ".join(str(list(node)) for node in empty[:_MAX_NODES_NAMED])
        more = " …" if empty[_MAX_NODES_NAMED:] else ""
        inform(f"no board was found in {len(empty)} of {len(per_view)} views (nodes {names}{more})")
    legacy = sorted({board.board for _, seen in per_view for board in seen if board.legacy})
    if legacy:
        inform(f"printed in OpenCV's older layout, which begins with a white square: {', '.join(legacy)}")


def _board_records(measured: MeasuredGeometry) -> list[BoardRecord]:
    """Return each board with what is printed on it, so that the stored corners can be solved again."""
    warp_x_mm, warp_y_mm = measured.rig.warp_mm.tolist()
    return [
        BoardRecord(
            **asdict(measured.board_set.boards[pose.target.board]),
            sweep=pose.target.sweep,
            rt_ref_board=tuple(pose.rt_ref_board.tolist()),
            warp_mm=(warp_x_mm, warp_y_mm),
            homing=pose.target.homing or UNSET,
        )
        for pose in measured.rig.boards
    ]


def _corners_npz(observations: Sequence[BoardObservation], *, apart: bool) -> bytes:
    """Return all corners, one row per corner; with the homings of the boards' poses if these are told apart."""
    counts = [len(seen.corners) for seen in observations]
    return _npz(
        pixels=np.concatenate([seen.pixels for seen in observations]),
        sigma_px=np.concatenate([seen.sigma_px for seen in observations]),
        corner=np.concatenate([seen.corners for seen in observations]),
        node=np.repeat([seen.node for seen in observations], counts, axis=0),
        sweep=np.repeat([seen.target.sweep for seen in observations], counts),
        homing=np.repeat([seen.target.homing if apart else 0 for seen in observations], counts),
        board=np.repeat([seen.target.board for seen in observations], counts),
    )


def _npz(**arrays: Any) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()
