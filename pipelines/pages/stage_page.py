"""The page of a measured geometry: tables of the stage and the lens, and drawings of the nodes."""

from dataclasses import dataclass

import numpy as np

from faintfield.calib.geometry import GeometrySettings
from faintfield.pipelines.formats.results.geometry import GeometryRecord, LensRecord, StageFigure, StageRecord
from faintfield.pipelines.pages.node_drawings import node_drawing, sigma_maps
from faintfield.pipelines.pages.page import figure, template

_FIGURES: tuple[tuple[str, str, str, float], ...] = (
    ("pitch_x_mm", "pitch along rows", "mm", 1.0),
    ("pitch_y_mm", "pitch along columns", "mm", 1.0),
    ("scale_x", "scale along rows, real over told", "", 1.0),
    ("scale_y", "scale along columns, real over told", "", 1.0),
    ("squareness_rad", "squareness: angle between the axes less 90°", "mrad", 1e3),
    ("backlash_x_mm", "backlash along rows", "µm", 1e3),
    ("backlash_y_mm", "backlash along columns", "µm", 1e3),
    ("tilt_rad", "tilt of the camera's axis to the grid", "mrad", 1e3),
    ("node_residual_rms_mm", "nodes off the regular grid, rms", "µm", 1e3),
)

# In OpenCV's order.
_DISTORTION = ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")


@dataclass(frozen=True)
class Row:
    """A line of a table: words, value, uncertainty, unit; or, in `why`, a remark or the reason for no value."""

    words: str
    value: str
    sigma: str = ""
    unit: str = ""
    why: str = ""


def stage_page(geometry: GeometryRecord) -> str:
    """Return geometry.html: the stage, the nodes and the lens of a measured geometry."""
    return template("geometry.html").render(
        rows=stage_rows(geometry.stage),
        holdout=holdout_rows(geometry),
        lens=lens_rows(geometry.lens),
        drawing=node_drawing(geometry),
        maps=sigma_maps(geometry),
        geometry=geometry,
    )


def stage_rows(stage: StageRecord) -> list[Row]:
    """Return the table of the stage's figures."""
    return [_row(getattr(stage, name), words, unit, factor) for name, words, unit, factor in _FIGURES]


def holdout_rows(geometry: GeometryRecord) -> list[Row]:
    """Return the table of boards left out of the fit: the ratio and what it adds, each beside its limit, or why not."""
    words = "residual of boards left out, over that of the fit"
    ratio, limits = geometry.holdout_ratio, GeometrySettings()
    if ratio is None:
        why = "there is one only" if len(geometry.boards) < 2 else "some node would see no other board"
        return [Row(words, "–", why=f"none can be left out: {why}")]
    added_px = geometry.rms_inlier_px * np.sqrt(max(ratio**2 - 1, 0))
    limit = f"limit {limits.max_holdout_ratio:g}"
    if ratio > limits.max_holdout_ratio:
        limit += ", waived: what it adds to so small a residual is negligible"
    never = f"px; up to {limits.negligible_holdout_px:g} px is never refused"
    return [
        Row(words, figure(ratio), why=limit),
        Row("what leaving them out adds, rms per axis", figure(added_px), why=never),
    ]


def lens_rows(lens: LensRecord) -> list[Row]:
    """Return the table of the lens."""
    in_px = ("focal length fx", "focal length fy", "principal point cx", "principal point cy")
    words = [*((name, "px") for name in in_px), *((f"distortion {name}", "") for name in _DISTORTION)]
    values = [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion]
    return [
        _row(StageFigure(value, sigma), *name, 1.0)
        for value, sigma, name in zip(values, lens.sigma, words, strict=False)
    ]


def _row(estimate: StageFigure, words: str, unit: str, factor: float) -> Row:
    """Return a line of the table, with as many digits as the uncertainty deserves."""
    if estimate.value is None or estimate.sigma is None:
        return Row(words, "–", why=estimate.why or "")
    sigma = estimate.sigma * factor
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 7)) if sigma > 0 else 3
    value = f"{estimate.value * factor:.{digits}f}".replace("-", "−")
    return Row(words, value, f"± {sigma:.{digits}f}", unit)
