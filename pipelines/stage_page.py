"""The page about the stage: figures with their uncertainty, and a drawing of real against nominal nodes."""

import io
from pathlib import Path
from typing import Any

import numpy as np

from calib.geometry import RigGeometry
from calib.geometry.stage import Estimate, StageReport
from pipelines.files import write_whole

PAGE_FILE = "geometry.html"

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

_MOST_MAGNIFIED_SHARE = 0.35


def write_stage_page(out: Path, geometry: RigGeometry, stage: StageReport, content: dict[str, Any]) -> Path:
    """Write geometry.html into `out` and return its path."""
    from pipelines.report import template  # loads jinja2

    page = template("geometry.html").render(
        rows=[_row(getattr(stage, name), words, unit, factor) for name, words, unit, factor in _FIGURES],
        drawing=node_drawing(geometry, stage) if stage.residuals_mm else None,
        geometry=content,
        nodes=[
            {**node, "centre_mm": centre}
            for node, centre in zip(content["nodes"], geometry.centres_mm().tolist(), strict=True)
        ],
    )
    path = out / PAGE_FILE
    write_whole(path, page)
    return path


def _row(estimate: Estimate, words: str, unit: str, factor: float) -> dict[str, str]:
    """Return a line of the table, with as many digits as the uncertainty deserves."""
    if estimate.value is None or estimate.sigma is None:
        return {"words": words, "value": "–", "sigma": "", "unit": "", "why": estimate.why or ""}
    sigma = estimate.sigma * factor
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 7)) if sigma > 0 else 3
    value = f"{estimate.value * factor:.{digits}f}"
    return {"words": words, "value": value, "sigma": f"± {sigma:.{digits}f}", "unit": unit, "why": ""}


def node_drawing(geometry: RigGeometry, stage: StageReport) -> str:
    """Return real against nominal nodes as SVG, deviations magnified, that takes its colour from the page."""
    from matplotlib.figure import Figure  # loading it costs most of a second

    ink = "#010203"  # replaced below: the page's own colour, light or dark
    nodes = np.array(geometry.nodes, float)
    row_0, column_0 = geometry.nodes[geometry.reference]
    assert stage.pitch_x_mm.value is not None
    assert stage.pitch_y_mm.value is not None
    pitch = np.array([stage.pitch_x_mm.value, stage.pitch_y_mm.value])
    nominal = (nodes[:, ::-1] - [column_0, row_0]) * pitch
    residuals = np.array(stage.residuals_mm)
    factor = _magnification(residuals, float(pitch.min()))
    real = nominal + factor * residuals[:, :2]
    across_mm = np.ptp(nominal, axis=0) + 2 * pitch
    figure = Figure(
        figsize=(6.6, float(np.clip(6.0 * across_mm[1] / across_mm[0], 2.5, 8)) + 0.7), layout="constrained"
    )
    axes = figure.subplots()
    axes.plot(
        *nominal.T, "+", color=ink, markersize=10, markeredgewidth=1, alpha=0.6, label="regular grid that fits best"
    )
    limit = float(np.abs(residuals[:, 2]).max()) or 1e-6
    deviation: dict[str, Any] = {
        "c": 1e3 * residuals[:, 2],
        "cmap": "coolwarm",
        "vmin": -1e3 * limit,
        "vmax": 1e3 * limit,
    }
    dots = axes.scatter(real[:, 0], real[:, 1], s=60, zorder=3, edgecolors=ink, linewidths=0.6, **deviation)
    dots.set_label(f"camera, deviation × {factor:g}")
    for start, end in zip(nominal, real, strict=True):
        axes.plot(*np.array([start, end]).T, color=ink, linewidth=0.8, alpha=0.7, zorder=2)
    bar = figure.colorbar(dots, ax=axes, shrink=0.8)
    bar.set_label("along the normal (µm)", color=ink)
    bar.ax.tick_params(colors=ink)
    bar.outline.set_edgecolor(ink)
    axes.set_aspect("equal")
    axes.margins(0.1)
    axes.invert_yaxis()
    axes.set_xlabel("x (mm)", color=ink)
    axes.set_ylabel("y, downwards (mm)", color=ink)
    axes.tick_params(colors=ink)
    axes.spines[:].set_color(ink)
    axes.spines[["top", "right"]].set_visible(False)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), ncols=2, frameon=False, labelcolor=ink)
    text = io.StringIO()
    figure.savefig(text, format="svg", transparent=True, metadata={"Date": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :].replace(ink, "currentColor")


def _magnification(residuals: Any, pitch_mm: float) -> float:
    """Return by how much deviations are drawn larger: a round number that keeps the largest within its cell."""
    largest = float(np.linalg.norm(residuals[:, :2], axis=1).max())
    if largest <= 0:
        return 1.0
    wanted = _MOST_MAGNIFIED_SHARE * pitch_mm / largest
    power = 10 ** np.floor(np.log10(wanted))
    return float(max(next(step for step in (5, 2, 1) if step * power <= wanted) * power, 1.0))
