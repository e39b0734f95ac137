"""The page about the stage: figures with their uncertainty, and a drawing of real against nominal nodes."""

from pathlib import Path
from typing import Any

import numpy as np

from faintfield.calib.geometry import GeometrySettings, RigGeometry
from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.sets.measured_poses import GEOMETRY_PAGE
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


def write_stage_page(out: Path, geometry: RigGeometry, content: dict[str, Any]) -> Path:
    """Write geometry.html into `out` and return its path."""
    page = template("geometry.html").render(
        rows=stage_rows(content["stage"]),
        holdout=holdout_rows(content),
        lens=lens_rows(content["lens"]),
        drawing=node_drawing(content),
        maps=sigma_maps(content),
        geometry=content,
        nodes=[
            {**node, "centre_mm": centre}
            for node, centre in zip(content["nodes"], geometry.centres_mm().tolist(), strict=True)
        ],
    )
    path = out / GEOMETRY_PAGE
    write_whole(path, page)
    return path


def stage_rows(stage: dict[str, Any]) -> list[dict[str, str]]:
    """Return the table of the `stage` of geometry.json: words, value, uncertainty, unit, or why there is none."""
    return [_row(stage[name], words, unit, factor) for name, words, unit, factor in _FIGURES]


def holdout_rows(geometry: dict[str, Any]) -> list[dict[str, str]]:
    """Return what is said of boards left out of the fit: the ratio and what it adds, each beside its limit, or why not.

    Parameters
    ----------
    geometry : dict
        The contents of geometry.json.
    """
    words, ratio, limits = (
        "residual of boards left out, over that of the fit",
        geometry["holdout_ratio"],
        GeometrySettings(),
    )
    if ratio is None:
        why = "none can be left out: some node would see no other board"
        if len(geometry["boards"]) < 2:
            why = "none can be left out: there is one only"
        return [{"words": words, "value": "–", "why": why}]
    added_px = geometry["rms_inlier_px"] * np.sqrt(max(ratio**2 - 1, 0))
    limit = f"limit {limits.max_holdout_ratio:g}"
    if ratio > limits.max_holdout_ratio:
        limit += ", waived: what it adds to so small a residual is negligible"
    return [
        {"words": words, "value": figure(ratio), "why": limit},
        {
            "words": "what leaving them out adds, rms per axis",
            "value": figure(added_px),
            "why": f"px; up to {limits.negligible_holdout_px:g} px is never refused",
        },
    ]


def lens_rows(lens: dict[str, Any]) -> list[dict[str, str]]:
    """Return the table of the `lens` of geometry.json."""
    in_px = ("focal length fx", "focal length fy", "principal point cx", "principal point cy")
    words = [*((name, "px") for name in in_px), *((f"distortion {name}", "") for name in _DISTORTION)]
    values = [*(lens[f"{name}_px"] for name in ("fx", "fy", "cx", "cy")), *lens["distortion"]]
    return [
        _row({"value": value, "sigma": sigma}, *name, 1.0)
        for value, sigma, name in zip(values, lens["sigma"], words, strict=False)
    ]


def _row(estimate: dict[str, Any], words: str, unit: str, factor: float) -> dict[str, str]:
    """Return a line of the table, with as many digits as the uncertainty deserves."""
    if estimate["value"] is None or estimate["sigma"] is None:
        return {"words": words, "value": "–", "sigma": "", "unit": "", "why": estimate.get("why") or ""}
    sigma = estimate["sigma"] * factor
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 7)) if sigma > 0 else 3
    value = f"{estimate['value'] * factor:.{digits}f}".replace("-", "−")
    return {"words": words, "value": value, "sigma": f"± {sigma:.{digits}f}", "unit": unit, "why": ""}
