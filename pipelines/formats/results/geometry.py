"""`geometry.json` and what lies beside it: the corners it was found from, its covariance, one camera model per node."""

import io
from collections.abc import Sequence
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np

from faintfield.calib.board import Board
from faintfield.calib.geometry import (
    BoardObservation,
    GeometrySettings,
    Node,
    RigGeometry,
    Target,
    rms_over_views,
    transfer_sigma_at,
)
from faintfield.calib.geometry.stage import StageReport
from faintfield.calib.lens import Lens
from faintfield.pipelines.formats.files import remove, write_json, write_whole
from faintfield.pipelines.formats.sets.measured_poses import CAMERA_FILE, CORNERS_FILE, COVARIANCE_FILE, GEOMETRY_FILE
from faintfield.pipelines.pages.stage_page import write_stage_page


def geometry_content(
    geometry: RigGeometry,
    settings: GeometrySettings,
    boards: Sequence[Board],
    stage: StageReport,
    record: dict[str, Any],
) -> dict[str, Any]:
    """Return what geometry.json says."""
    return {
        "format": 1,
        **_summary(geometry, settings),
        "boards": _board_entries(geometry, boards),
        "stage": {"doubts" if name == "warnings" else name: value for name, value in asdict(stage).items()},
        **record,
    }


def write_geometry(
    out: Path, geometry: RigGeometry, observations: Sequence[BoardObservation], content: dict[str, Any]
) -> Path:
    """Write the files of a geometry into `out`, geometry.json last, and return the path of its page."""
    remove(out / GEOMETRY_FILE)  # it would vouch for files that replace its own
    for earlier in out.glob(CAMERA_FILE.format("*", "*")):
        remove(earlier)  # it may be of a node that is none any more
    solved = {board.target for board in geometry.boards}
    write_whole(out / COVARIANCE_FILE, _covariance_npz(geometry))
    write_whole(out / CORNERS_FILE, _corners_npz([seen for seen in observations if seen.target in solved]))
    for node, rt_cam_ref in zip(geometry.nodes, geometry.rt_cam_ref, strict=True):
        text = camera_model_text(geometry.lens, geometry.lens_model, rt_cam_ref)
        write_whole(out / CAMERA_FILE.format(*node), text)
    page = write_stage_page(out, geometry, content)
    write_json(out / GEOMETRY_FILE, content)
    return page


def _summary(geometry: RigGeometry, settings: GeometrySettings) -> dict[str, Any]:
    """Return lens, nodes and figures as geometry.json has them."""
    lens = geometry.lens
    sigmas = zip(geometry.nodes, geometry.rt_cam_ref, geometry.sigma_mm(), geometry.sigma_rad(), strict=True)
    repeatability = geometry.repeatability
    return {
        "lens": {
            "model": geometry.lens_model,
            **{name: getattr(lens, name) for name in ("fx_px", "fy_px", "cx_px", "cy_px", "distortion")},
            "sigma": np.sqrt(np.diag(geometry.covariance)[: len(geometry.intrinsics)]).tolist(),
        },
        "size_px": lens.size_px,
        "reference_node": geometry.nodes[geometry.reference],
        "nodes": [
            {"node": node, "rt_cam_ref": rt.tolist(), "sigma_mm": float(mm), "sigma_rad": float(rad)}
            for node, rt, mm, rad in sigmas
        ],
        "rms_inlier_px": geometry.rms_inlier_px,
        "rms_mrcal_px": geometry.rms_mrcal_px,
        "corner_sigma_px": geometry.sigma_px,
        "corners": geometry.corners,
        "outliers": geometry.outliers,
        "holdout_ratio": geometry.holdout_ratio,
        "doubts": geometry.warnings,
        "transfer_sigma_px": {
            f"{depth:g}": rms_over_views(transfer_sigma_at(geometry, depth)) for depth in settings.depths_mm
        },
        "repeatability": None if repeatability is None else asdict(repeatability),
    }


def _board_entries(geometry: RigGeometry, boards: Sequence[Board]) -> list[dict[str, Any]]:
    """Return the boards as they stood, each with what it is, so that the stored corners can be solved again."""
    by_name = {board.name: board for board in boards}
    return [
        {
            **asdict(by_name[pose.target.board]),
            "sweep": pose.target.sweep,
            "rt_ref_board": pose.rt_ref_board.tolist(),
            "warp_mm": geometry.warp_mm.tolist(),
        }
        for pose in geometry.boards
    ]


def _covariance_npz(geometry: RigGeometry) -> bytes:
    """Return the covariance of fx, fy, cx, cy, the distortion, then rt_cam_ref of every node."""
    return _npz(covariance=geometry.covariance, nodes=np.array(geometry.nodes), intrinsics=geometry.intrinsics)


def _corners_npz(observations: Sequence[BoardObservation]) -> bytes:
    """Return all corners, one row per corner."""
    counts = [len(seen.corners) for seen in observations]
    return _npz(
        pixels=np.concatenate([seen.pixels for seen in observations]),
        sigma_px=np.concatenate([seen.sigma_px for seen in observations]),
        corner=np.concatenate([seen.corners for seen in observations]),
        node=np.repeat([seen.node for seen in observations], counts, axis=0),
        sweep=np.repeat([seen.target.sweep for seen in observations], counts),
        board=np.repeat([seen.target.board for seen in observations], counts),
    )


def read_corners(path: Path) -> list[BoardObservation]:
    """Return the corners that a geometry was found from, as they were stored beside it."""
    with np.load(path, allow_pickle=False) as stored:
        arrays = {name: stored[name] for name in ("pixels", "sigma_px", "corner", "node", "sweep", "board")}
    groups: dict[tuple[Node, Target], list[int]] = {}
    for row, (node, sweep, board) in enumerate(zip(arrays["node"], arrays["sweep"], arrays["board"], strict=True)):
        groups.setdefault(((int(node[0]), int(node[1])), Target(str(board), int(sweep))), []).append(row)
    return [
        BoardObservation(node, target, arrays["corner"][rows], arrays["pixels"][rows], arrays["sigma_px"][rows])
        for (node, target), rows in groups.items()
    ]


def camera_model_text(lens: Lens, lens_model: str, rt_cam_ref: Any) -> str:
    """Return a camera as mrcal's tools read it; lengths there are metres."""
    import mrcal  # loading it takes a while

    model_name = {"pinhole": "LENSMODEL_PINHOLE"}.get(lens_model, f"LENSMODEL_{lens_model.upper()}")
    intrinsics = np.array([lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion])
    rt_metres = np.array(rt_cam_ref, np.float64) * [1, 1, 1, 1e-3, 1e-3, 1e-3]
    model = mrcal.cameramodel(
        intrinsics=(model_name, intrinsics), imagersize=np.array(lens.size_px, np.int32), rt_cam_ref=rt_metres
    )
    text = io.StringIO()
    model.write(text)
    return text.getvalue()


def _npz(**arrays: Any) -> bytes:
    content = io.BytesIO()
    np.savez_compressed(content, **arrays)
    return content.getvalue()
