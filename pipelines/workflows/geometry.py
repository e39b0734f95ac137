"""The lens, and where the camera was at every node, with their page: `faintfield geometry`."""

from collections.abc import Sequence
from pathlib import Path

import msgspec

from faintfield.calib.geometry import GeometrySettings
from faintfield.pipelines.arguments import LensName
from faintfield.pipelines.calibration.geometry import (
    MeasuredGeometry,
    geometry_files,
    geometry_record,
    measure_geometry,
)
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.results.geometry import (
    DEFAULT_DEPTHS_MM,
    GEOMETRY_PAGE,
    GeometryOptions,
    GeometryRecord,
    LensRecord,
    RepeatabilityRecord,
    StageRecord,
    write_geometry,
)
from faintfield.pipelines.formats.sets.board_set import load_board_set
from faintfield.pipelines.pages.calibration_pages import geometry_page

# Above this the nodes of one sweep no longer stand for those of another.
_MAX_REPEATABILITY_MM = 0.020


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
    repeatability: RepeatabilityRecord | None
    stage: StageRecord


def measure_stage(
    directory: Path,
    out: Path | None = None,
    lens: LensName = "opencv5",
    depth_mm: Sequence[float] | None = None,
    limit_px: float = 0.5,
) -> GeometrySummary:
    """Measure lens and poses from the boards of a session or set, and write them with their page."""
    board_set = load_board_set(directory)
    out = out or board_set.source.parent
    options = GeometryOptions(lens, tuple(depth_mm or DEFAULT_DEPTHS_MM), limit_px)
    limits = GeometrySettings(lens, options.depth_mm, limit_px)
    measured = measure_geometry(board_set, limits)
    record = geometry_record(measured, options)
    write_geometry(out, record, {**geometry_files(measured), GEOMETRY_PAGE: geometry_page(record, limits)})
    _inform_of(measured, record)
    figures = {name: getattr(record, name) for name in GeometrySummary.__struct_fields__[2:]}
    return GeometrySummary(str(out), str(out / GEOMETRY_PAGE), **figures)


def _inform_of(measured: MeasuredGeometry, record: GeometryRecord) -> None:
    """Print in a few lines how good the geometry is."""
    known = ", ".join(f"{sigma:.3f} px at {depth} mm" for depth, sigma in record.transfer_sigma_px.items())
    inform(f"{len(record.nodes)} nodes, {record.corners} corners, residual {record.rms_inlier_px:.3f} px")
    inform(f"transfer between views known to {known}")
    missing = {view.node for view in measured.board_set.views} - set(measured.rig.nodes)
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
