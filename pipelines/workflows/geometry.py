"""Lens and camera poses from a board set, with their record, files and page: `faintfield geometry`."""

import io
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
from msgspec import UNSET, structs

from faintfield.calib.detection import BoardCorners, detect_boards
from faintfield.calib.errors import TooFewViews
from faintfield.calib.estimate import Repeatability, StageReport
from faintfield.calib.geometry import (
    BoardObservation,
    BoardPose,
    GeometrySettings,
    RigGeometry,
    Target,
    calibrate_geometry,
    rms_over_views,
    transfer_sigma_at,
)
from faintfield.calib.geometry.bundle import load_mrcal
from faintfield.calib.geometry.stage import approach_directions, stage_report
from faintfield.calib.noise.strips import usable_cores
from faintfield.pipelines.arguments import LensName
from faintfield.pipelines.console import inform, progress, working
from faintfield.pipelines.formats.exchange.mrcal import camera_model_text, solution_text
from faintfield.pipelines.formats.files import check_results_folder
from faintfield.pipelines.formats.frames import read_ahead
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.geometry import (
    CAMERA_FILE,
    CORNERS_FILE,
    COVARIANCE_FILE,
    DEFAULT_DEPTHS_MM,
    GEOMETRY_PAGE,
    MODEL_FILE,
    BoardRecord,
    GeometryOptions,
    GeometryRecord,
    LensRecord,
    camera_poses,
    write_geometry,
)
from faintfield.pipelines.formats.sets.board_set import BoardSet, BoardView, load_board_set
from faintfield.pipelines.pages.calibration_pages import geometry_page

# Above this the nodes of one sweep no longer stand for those of another.
_MAX_REPEATABILITY_MM = 0.020

# A message about missed boards names this many nodes; more would not fit one line.
_MAX_NODES_NAMED = 8


class GeometrySummary(msgspec.Struct, frozen=True):
    """The result of `faintfield geometry`: where it is, and the main figures of geometry.json."""

    out: str
    report: str
    lens: LensRecord
    rms_inlier_px: float
    corners: int
    outliers: int
    holdout_ratio: float | None
    transfer_sigma_px: dict[str, float]
    repeatability: Repeatability | None
    stage: StageReport


def measure_stage(
    directory: Path,
    out: Path | None = None,
    lens: LensName = "opencv5",
    depth_mm: Sequence[float] | None = None,
    limit_px: float = 0.5,
) -> GeometrySummary:
    """Measure lens and poses from the boards of a session or set, and write them with their page.

    Raises
    ------
    InputError, CalibrationError
        mrcal is not installed, an image cannot be used, or the corners do not determine the geometry.
    """
    board_set = load_board_set(directory)
    out = out or board_set.source.parent
    options = GeometryOptions(lens, tuple(depth_mm or DEFAULT_DEPTHS_MM), limit_px)
    settings = GeometrySettings(lens, options.depth_mm, limit_px)
    check_results_folder(out)
    load_mrcal()  # fails at once if it is missing, not after all images were searched
    observations, size_px = _observe(board_set)
    with working("solving lens and poses"):
        rig = calibrate_geometry(board_set.boards, observations, size_px, board_set.reference, settings)
    visits = [] if board_set.one_sided else [(view.node, view.sweep) for view in board_set.views]
    stage = stage_report(rig, approach_directions(visits), board_set.pitch_mm)
    record = _record(board_set, rig, stage, options)
    write_geometry(out, record, {**_files(rig, observations), GEOMETRY_PAGE: geometry_page(record, settings)})
    _inform_of(board_set, record)
    figures = {name: getattr(record, name) for name in GeometrySummary.__struct_fields__[2:]}
    return GeometrySummary(str(out), str(out / GEOMETRY_PAGE), **figures)


def _observe(board_set: BoardSet) -> tuple[list[BoardObservation], tuple[int, int]]:
    """Find the boards in all views; return their corners and the size of the images."""
    boards, views = list(board_set.boards.values()), board_set.views
    first = views[0].image()
    size_px = first.shape[1], first.shape[0]

    def detect(view: BoardView) -> list[BoardCorners]:
        return detect_boards(first if view is views[0] else view.image(size_px), boards)

    detections = read_ahead(views, detect, usable_cores())
    per_view = list(progress(detections, "looking for boards", len(views)))
    _inform_of_boards(per_view)
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


def _inform_of_boards(per_view: list[tuple[BoardView, list[BoardCorners]]]) -> None:
    """Name views without boards, and prints in the older layout."""
    empty = [view.node for view, seen in per_view if not any(len(board.corners) for board in seen)]
    if empty:
        names = ", ".join(str(list(node)) for node in empty[:_MAX_NODES_NAMED])
        more = " …" if empty[_MAX_NODES_NAMED:] else ""
        inform(f"no board was found in {len(empty)} of {len(per_view)} views (nodes {names}{more})")
    legacy = sorted({board.board for _, seen in per_view for board in seen if board.legacy})
    if legacy:
        inform(f"printed in OpenCV's older layout, which begins with a white square: {', '.join(legacy)}")


def _record(board_set: BoardSet, rig: RigGeometry, stage: StageReport, options: GeometryOptions) -> GeometryRecord:
    transfers_px = {f"{depth:g}": rms_over_views(transfer_sigma_at(rig, depth)) for depth in options.depth_mm}
    return GeometryRecord(
        **structs.asdict(camera_poses(rig)),
        rms_inlier_px=rig.rms_inlier_px,
        rms_mrcal_px=rig.rms_mrcal_px,
        corner_sigma_px=rig.sigma_px,
        corners=rig.corners,
        outliers=rig.outliers,
        holdout_ratio=rig.holdout_ratio,
        warnings=[*rig.warnings, *_homing_warnings(board_set, rig)],
        transfer_sigma_px=transfers_px,
        repeatability=rig.repeatability,
        boards=[_board_record(board_set, pose, rig.warp_mm.tolist()) for pose in rig.boards],
        stage=stage,
        **provenance("geometry", options, dict(board_set.input_hashes())).parts(),
    )


def _homing_warnings(board_set: BoardSet, rig: RigGeometry) -> list[str]:
    """Return a warning where the stage homed within the only sweep, and may have come back to another place."""
    if not rig.undetermined_homings or board_set.switches_repeat:
        return []
    return [
        f"the stage homed again within sweep {', '.join(map(str, rig.undetermined_homings))}, and no other sweep joins "
        "the nodes before and after, which may be shifted by as much as its switches repeat; take one more sweep"
    ]


def _board_record(board_set: BoardSet, pose: BoardPose, warp_mm: list[float]) -> BoardRecord:
    """Return a board with what is printed on it, so that the stored corners can be solved again."""
    return BoardRecord(
        **asdict(board_set.boards[pose.target.board]),
        sweep=pose.target.sweep,
        rt_ref_board=tuple(pose.rt_ref_board.tolist()),
        warp_mm=(warp_mm[0], warp_mm[1]),
        homing=pose.target.homing or UNSET,
    )


def _files(rig: RigGeometry, observations: Sequence[BoardObservation]) -> dict[str, bytes | str]:
    """Return the files beside geometry.json by name: covariance, corners, and camera models.

    There is a camera model for each node, and one with all that mrcal's tools need. The covariance is of fx, fy, cx,
    cy, the distortion, then rt_cam_ref of every node. The corners, one row each, are those of the boards whose pose was
    solved; with the homings of these poses if they are told apart.
    """
    solved = {(board.target.board, board.target.sweep) for board in rig.boards}
    kept = [seen for seen in observations if (seen.target.board, seen.target.sweep) in solved]
    counts = [len(seen.corners) for seen in kept]
    corners = _npz(
        pixels=np.concatenate([seen.pixels for seen in kept]),
        sigma_px=np.concatenate([seen.sigma_px for seen in kept]),
        corner=np.concatenate([seen.corners for seen in kept]),
        node=np.repeat([seen.node for seen in kept], counts, axis=0),
        sweep=np.repeat([seen.target.sweep for seen in kept], counts),
        homing=np.repeat([seen.target.homing if rig.homings else 0 for seen in kept], counts),
        board=np.repeat([seen.target.board for seen in kept], counts),
    )
    covariance = _npz(covariance=rig.covariance, nodes=np.array(rig.nodes), intrinsics=rig.lens.parameters)
    cameras = {
        CAMERA_FILE.format(*node): camera_model_text(rig.lens, rig.lens_model, rt_cam_ref)
        for node, rt_cam_ref in zip(rig.nodes, rig.rt_cam_ref, strict=True)
    }
    model = {} if rig.solution is None else {MODEL_FILE: solution_text(rig.solution)}
    return {COVARIANCE_FILE: covariance, CORNERS_FILE: corners, **model, **cameras}


def _npz(**arrays: Any) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()


def _inform_of(board_set: BoardSet, record: GeometryRecord) -> None:
    known = ", ".join(f"{sigma:.3f} px at {depth} mm" for depth, sigma in record.transfer_sigma_px.items())
    inform(f"{len(record.nodes)} nodes, {record.corners} corners, residual {record.rms_inlier_px:.3f} px")
    inform(f"transfer between views known to {known}")
    missing = {view.node for view in board_set.views} - {entry.node for entry in record.nodes}
    if missing:
        inform(f"without a pose, since no board ties them to the rest: nodes {sorted(missing)}; take them again")
    off_grid = record.stage.node_residual_rms_mm.value
    if off_grid is not None:
        inform(f"nodes lie {off_grid:.3f} mm rms off the regular grid that fits best")
    for shift in record.homings or ():
        by = ", ".join(f"{mm:.3f} ± {sigma:.3f}" for mm, sigma in zip(shift.shift_mm, shift.sigma_mm, strict=True))
        inform(f"homing {shift.after} shifted the cameras by ({by}) mm from those of homing {shift.before}: taken out")
    for warning in (*record.warnings, *record.stage.warnings):
        inform(warning)
    repeatability = record.repeatability
    if repeatability is not None and repeatability.sd_mm > _MAX_REPEATABILITY_MM:
        inform(
            f"the stage comes back to a node within {1e3 * repeatability.sd_mm:.0f} ± {1e3 * repeatability.se_mm:.0f} "
            f"µm only (limit {1e3 * _MAX_REPEATABILITY_MM:.0f} µm); the uncertainties above include it. "
            "Show several boards at once in one sweep, or let the stage settle longer"
        )
