"""`faintfield geometry`: where the camera was at every node, from images of ChArUco boards."""

import os
from pathlib import Path
from typing import Any

from faintfield.calib.detection import BoardCorners, detect_all
from faintfield.calib.errors import TooFewViews
from faintfield.calib.geometry import BoardObservation, GeometrySettings, RigGeometry, Target, calibrate_geometry
from faintfield.calib.geometry.stage import StageReport, approach_directions, stage_report
from faintfield.pipelines.arguments import LensName, Positive
from faintfield.pipelines.console import progress, say
from faintfield.pipelines.errors import WrongSize
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.geometry import geometry_content, write_geometry
from faintfield.pipelines.formats.sets.board_set import BoardSet, BoardView, load_board_set

# Above this the nodes of one sweep no longer stand for those of another.
_MOST_REPEATABILITY_MM = 0.020

_NODES_OF_ONE_LINE = 8


def geometry(
    directory: Path,
    /,
    *,
    out: Path | None = None,
    lens: LensName = "opencv5",
    depth_mm: list[Positive] | None = None,
    limit_px: Positive = 0.5,
) -> dict[str, Any]:
    """Measure the lens, and where the camera was at every node, from images of ChArUco boards.

    Writes geometry.json, its covariance, a .cameramodel per node, and a page about the stage. A set that cannot tell
    the geometry is refused, with the reason and what to add.

    Parameters
    ----------
    directory
        A session with charuco frames, or a folder with charuco.toml and the images it names.
    out
        Folder for the results; DIRECTORY by default.
    lens
        Distortion model.
    depth_mm
        Depth of a plane that will be reconstructed; give it once per plane. 500 and 700 by default.
    limit_px
        How well the transfer between views by such a plane must be known: standard deviation, rms over views.
    """
    board_set = load_board_set(directory)
    out = out or board_set.source.parent
    settings = GeometrySettings(lens, tuple(depth_mm or (500.0, 700.0)), limit_px)
    observations, size_px = _observe(board_set)
    measured = calibrate_geometry(board_set.boards, observations, size_px, board_set.reference, settings)
    visits = [] if board_set.one_sided else [(view.node, view.sweep) for view in board_set.views]
    stage = stage_report(measured, approach_directions(visits), board_set.pitch_mm)
    options = {"lens": lens, "depth_mm": settings.depths_mm, "limit_px": limit_px}
    record = provenance("geometry", options, dict(board_set.input_hashes()))
    boards = list(board_set.boards.values())
    content = geometry_content(measured, settings, boards, stage, record)
    page = write_geometry(out, measured, observations, content)
    _say_result(board_set, measured, stage, content)
    return {"out": str(out), "report": str(page), **{name: content[name] for name in _RETURNED}}


_RETURNED = (
    "lens",
    "rms_inlier_px",
    "corners",
    "outliers",
    "holdout_ratio",
    "transfer_sigma_px",
    "repeatability",
    "stage",
)


def _observe(board_set: BoardSet) -> tuple[list[BoardObservation], tuple[int, int]]:
    """Find the boards in all views, and return the corners and the size of the images."""
    boards = list(board_set.boards.values())
    size_px: tuple[int, int] | None = None

    def images() -> Any:
        nonlocal size_px
        for view in board_set.views:
            image = view.image()
            size_px = size_px or image.shape[::-1]
            if image.shape[::-1] != size_px:
                raise WrongSize(
                    f"{view.paths[0]}: is {image.shape[1]} x {image.shape[0]} px, the first image "
                    f"{size_px[0]} x {size_px[1]}; all images of one camera have one size; "
                    "take it again, or leave it out"
                )
            yield image

    found = progress(detect_all(images(), boards, os.cpu_count() or 1), "looking for boards", len(board_set.views))
    per_view = list(zip(board_set.views, found, strict=True))
    _say_what_was_found(per_view)
    observations = [
        BoardObservation(view.node, Target(seen.board, view.sweep), seen.corners, seen.pixels, seen.sigma_px)
        for view, boards_seen in per_view
        for seen in boards_seen
        if len(seen.corners)
    ]
    if not observations or size_px is None:
        markers = sum(board.markers for _, seen in per_view for board in seen)
        raise TooFewViews(
            f"{board_set.source}: {markers} markers of the boards and no corner between them in {len(board_set.views)} "
            f"views; compare [[board]] ({'columns, rows' if markers else 'dictionary'}, first_marker_id) with the print"
            ", or expose longer"
        )
    return observations, size_px


def _say_what_was_found(per_view: list[tuple[BoardView, list[BoardCorners]]]) -> None:
    """Tell of views without boards, and of prints in the older layout."""
    empty = [view.node for view, seen in per_view if not any(len(board.corners) for board in seen)]
    if empty:
        names = ", ".join(str(list(node)) for node in empty[:_NODES_OF_ONE_LINE])
        say(f"no board was found in {len(empty)} of {len(per_view)} views (nodes {names}{' …' if empty[8:] else ''})")
    legacy = sorted({board.board for _, seen in per_view for board in seen if board.legacy})
    if legacy:
        say(f"printed in OpenCV's older layout, which begins with a white square: {', '.join(legacy)}")


def _say_result(board_set: BoardSet, measured: RigGeometry, stage: StageReport, content: dict[str, Any]) -> None:
    """Say in a few lines how good the geometry is."""
    known = ", ".join(f"{sigma:.3f} px at {depth} mm" for depth, sigma in content["transfer_sigma_px"].items())
    say(f"{len(measured.nodes)} nodes, {measured.corners} corners, residual {measured.rms_inlier_px:.3f} px")
    say(f"transfer between views known to {known}")
    missing = {view.node for view in board_set.views} - set(measured.nodes)
    if missing:
        say(f"without a pose, since no board ties them to the rest: nodes {sorted(missing)}; take them again")
    if stage.node_residual_rms_mm.value is not None:
        say(f"nodes lie {stage.node_residual_rms_mm.value:.3f} mm rms off the regular grid that fits best")
    for doubt in (*measured.warnings, *stage.warnings):
        say(doubt)
    repeatability = measured.repeatability
    if repeatability is not None and repeatability.sd_mm > _MOST_REPEATABILITY_MM:
        say(
            f"the stage comes back to a node within {1e3 * repeatability.sd_mm:.0f} ± {1e3 * repeatability.se_mm:.0f} "
            f"µm only (limit {1e3 * _MOST_REPEATABILITY_MM:.0f} µm); the uncertainties above include it. "
            "Show several boards at once in one sweep, or let the stage settle longer"
        )
