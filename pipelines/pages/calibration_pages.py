"""Measured geometry and noise on pages: geometry.html, and the camera in a report."""

from collections.abc import Sequence, Set
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypedDict

import msgspec
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.estimate import Estimate, StageFigure, StageReport
from faintfield.pipelines.formats.files import files_named, folders_in, sha256
from faintfield.pipelines.formats.provenance import Provenance
from faintfield.pipelines.formats.results.geometry import (
    GEOMETRY_PAGE,
    CameraPoses,
    GeometryRecord,
    LensRecord,
    read_geometry,
)
from faintfield.pipelines.formats.results.noise import NOISE_PAGES, NoiseRecord, read_noise
from faintfield.pipelines.pages.page import (
    INK,
    Quantity,
    Row,
    blank_drawing,
    colour_bar,
    estimate_row,
    figure,
    fixed,
    html_symbols,
    ink,
    svg,
    template,
)

if TYPE_CHECKING:
    from faintfield.calib.geometry import GeometrySettings

_FIGURES = (
    Quantity("pitch_x_mm", "pitch along rows", "mm"),
    Quantity("pitch_y_mm", "pitch along columns", "mm"),
    Quantity("scale_x", "scale along rows, measured over asked"),
    Quantity("scale_y", "scale along columns, measured over asked"),
    Quantity("squareness_rad", "squareness: angle between the axes less 90°", "mrad", factor=1e3),
    Quantity("backlash_x_mm", "backlash along rows", "µm", factor=1e3),
    Quantity("backlash_y_mm", "backlash along columns", "µm", factor=1e3),
    Quantity("tilt_rad", "tilt of the camera's axis to the grid", "mrad", factor=1e3),
    Quantity("node_residual_rms_mm", "nodes off the regular grid, rms", "µm", factor=1e3),
)

# In the order of `LensRecord.sigma`, whose distortion is in that of OpenCV.
_LENS = (
    Quantity("fx_px", "focal length fx", "px"),
    Quantity("fy_px", "focal length fy", "px"),
    Quantity("cx_px", "principal point cx", "px"),
    Quantity("cy_px", "principal point cy", "px"),
    *(Quantity("distortion", f"distortion {name}") for name in ("k1", "k2", "p1", "p2", "k3", "k4", "k5", "k6")),
)

# The quantities of a sensor that matter most.
NOISE_QUANTITIES = (
    Quantity("gain_dn_per_e", "gain", "DN/e⁻", symbol="K"),
    Quantity("read_noise_e", "read noise", "e⁻", symbol="σ_d"),
    Quantity("dark_current_e_per_s", "dark current", "e⁻/s", symbol="μ_I"),
    Quantity("offset_dn", "offset", "DN", symbol="μ_y.dark"),
    Quantity("quantum_efficiency", "quantum efficiency", "%", symbol="η", factor=100.0),
    Quantity("prnu", "response differs between pixels by", "%", symbol="PRNU", factor=100.0),
    Quantity("dsnu_e", "offset differs between pixels by", "e⁻", symbol="DSNU"),
    Quantity("dcnu_e_per_s", "dark current differs between pixels by", "e⁻/s", symbol="DCNU"),
)

# The largest deviation is drawn at most this long, as a share of the pitch, so that it stays within its cell.
_MAX_DRAWN_SHARE = 0.35

# Rotations are shown in mrad from here on, in µrad below.
_COARSE_RAD = 1e-4

# With more nodes than this, numbers would not fit into their cells.
_MAX_WRITTEN = 121


def geometry_page(geometry: GeometryRecord, limits: "GeometrySettings") -> str:
    """Return geometry.html; `limits` are those that the geometry was accepted by."""
    return template("geometry.html").render(
        rows=stage_rows(geometry.stage),
        holdout=holdout_rows(geometry, limits),
        lens=_lens_rows(geometry.lens),
        drawing=node_drawing(geometry),
        maps=sigma_maps(geometry),
        geometry=geometry,
    )


def stage_rows(stage: StageReport) -> list[Row]:
    """Return the table of the stage."""
    return [_row(getattr(stage, quantity.key), quantity) for quantity in _FIGURES]


def holdout_rows(geometry: GeometryRecord, limits: "GeometrySettings") -> list[Row]:
    """Return the table of boards left out of the fit: the ratio and what it adds, each beside its limit, or why not."""
    name = "residual of boards left out, over that of the fit"
    ratio = geometry.holdout_ratio
    if ratio is None:
        why = "there is one only" if len(geometry.boards) < 2 else "some node would see no other board"
        return [Row(name, why=f"none can be left out: {why}")]
    added_px = geometry.rms_inlier_px * np.sqrt(max(ratio**2 - 1, 0))
    limit = f"limit {limits.max_holdout_ratio:g}"
    if ratio > limits.max_holdout_ratio:
        limit += ", waived: what it adds to so small a residual is negligible"
    never = f"px; up to {limits.negligible_holdout_px:g} px is never refused"
    return [
        Row(name, figure(ratio), why=limit),
        Row("what leaving them out adds, rms per axis", figure(added_px), why=never),
    ]


def _lens_rows(lens: LensRecord) -> list[Row]:
    values = [lens.fx_px, lens.fy_px, lens.cx_px, lens.cy_px, *lens.distortion]
    return [
        _row(StageFigure(value, sigma), quantity)
        for value, sigma, quantity in zip(values, lens.sigma, _LENS, strict=False)
    ]


def _row(estimate: StageFigure, quantity: Quantity) -> Row:
    _, name, unit, _, factor = quantity
    if estimate.value is None or estimate.sigma is None:
        return Row(name, why=estimate.why or "")
    sigma = estimate.sigma * factor
    digits = int(np.clip(1 - np.floor(np.log10(sigma)), 0, 7)) if sigma > 0 else 3
    return Row(name, fixed(estimate.value * factor, digits), f"± {sigma:.{digits}f}", unit)


def node_drawing(geometry: GeometryRecord) -> str | None:
    """Return real against nominal nodes as SVG, deviations magnified; None without a regular grid to compare."""
    stage = geometry.stage
    pitch = np.array([stage.pitch_x_mm.value, stage.pitch_y_mm.value], float)
    residuals = np.array(stage.residuals_mm, float)
    if not len(residuals) or np.isnan(pitch).any():
        return None
    nodes = np.array([entry.node for entry in geometry.nodes], float)
    nominal = (nodes - geometry.reference_node)[:, ::-1] * pitch
    factor = _magnification(residuals, float(pitch.min()))
    real = nominal + factor * residuals[:, :2]
    across_mm = np.ptp(nominal, axis=0) + 2 * pitch
    height = float(np.clip(4.9 * across_mm[1] / across_mm[0], 2.2, 7)) + 0.9
    figure, axes = blank_drawing(5.4, height)
    axes.plot(*nominal.T, "+", color=INK, ms=10, mew=1, alpha=0.6, label="regular grid that fits best")
    limit = 1e3 * (float(np.abs(residuals[:, 2]).max()) or 1e-6)
    look: dict[str, Any] = {"cmap": "coolwarm", "vmin": -limit, "vmax": limit, "edgecolors": INK, "linewidths": 0.6}
    dots = axes.scatter(real[:, 0], real[:, 1], s=60, zorder=3, c=1e3 * residuals[:, 2], **look)
    dots.set_label(f"camera, deviation × {factor:g}")
    for start, end in zip(nominal, real, strict=True):
        axes.plot(*np.array([start, end]).T, color=INK, linewidth=0.8, alpha=0.7, zorder=2)
    colour_bar(figure, dots, axes, "along the normal (µm)")
    axes.set_aspect("equal")
    axes.margins(0.1)
    axes.invert_yaxis()
    axes.set(xlabel="x (mm)", ylabel="y, downwards (mm)")
    ink(axes)
    axes.legend(loc="lower center", bbox_to_anchor=(0.5, 1.0), frameon=False, labelcolor=INK)
    return svg(figure)


def sigma_maps(geometry: GeometryRecord) -> list[str]:
    """Return maps over the nodes of the standard deviation of position and of rotation, an SVG each."""
    nodes = [entry.node for entry in geometry.nodes]
    largest_rad = max(entry.sigma_rad for entry in geometry.nodes)
    per_rad, unit = (1e3, "mrad") if largest_rad >= _COARSE_RAD else (1e6, "µrad")
    sigmas = {
        "position, √ of the variances' sum (µm)": [1e3 * entry.sigma_mm for entry in geometry.nodes],
        f"rotation, √ of the variances' sum ({unit})": [per_rad * entry.sigma_rad for entry in geometry.nodes],
    }
    return [_sigma_map(nodes, values, f"σ of {label}") for label, values in sigmas.items()]


def _sigma_map(nodes: Sequence[tuple[int, int]], sigmas: Sequence[float], label: str) -> str:
    figure, axes = blank_drawing(4.8, 4.0)
    places = np.array(nodes)
    (top, left), (rows, columns) = places.min(axis=0), np.ptp(places, axis=0) + 1
    values = np.full((rows, columns), np.nan)  # where there is no node
    values[tuple((places - (top, left)).T)] = sigmas
    extent = (left - 0.5, left + columns - 0.5, top + rows - 0.5, top - 0.5)
    image = axes.imshow(values, cmap="cividis", vmin=0, extent=extent)
    colour_bar(figure, image, axes, label)
    if values.size <= _MAX_WRITTEN:
        decimals = int(np.clip(1 - np.floor(np.log10(max(*sigmas, 1e-6))), 0, 6))
        for (row, column), sigma in zip(nodes, sigmas, strict=True):
            colour = "black" if sigma > 0.6 * max(sigmas) else "white"
            text = f"{sigma:.{decimals}f}"
            axes.text(column, row, text, ha="center", va="center", fontsize=7, color=colour)
    axes.set(xlabel="column of the grid", ylabel="row of the grid")
    axes.locator_params(integer=True)
    ink(axes)
    return svg(figure)


def _magnification(residuals: NDArray[np.float64], pitch_mm: float) -> float:
    """Return a round factor that keeps the largest deviation within its cell."""
    largest = float(np.linalg.norm(residuals[:, :2], axis=1).max())
    if largest == 0:
        return 1.0
    wanted = _MAX_DRAWN_SHARE * pitch_mm / largest
    power = 10 ** np.floor(np.log10(wanted))
    return float(max(next(step for step in (5, 2, 1) if step * power <= wanted) * power, 1.0))


@dataclass(frozen=True, kw_only=True)
class Section[Record]:
    """A calibration on the page.

    `where` is the address of its file, and `used` tells if the planes were made with it. `pages` are the addresses of
    its own pages. `unusable`, the number of unusable pixels by
    kind, is of a noise calibration; `drawing` and `maps` are of a geometry.
    """

    where: str
    sha256: str
    used: bool
    pages: list[str]
    made: Provenance[dict[str, object]] | None
    record: Record
    rows: list[Row]
    unusable: dict[str, int] = field(default_factory=dict)
    drawing: str | None = None
    maps: list[str] = field(default_factory=list)


class _Origin(TypedDict):
    where: str
    sha256: str
    used: bool


type NoiseSection = Section[NoiseRecord]
type GeometrySection = Section[GeometryRecord]


def find_calibration(directory: Path, name: str) -> Path | None:
    """Return a calibration's file: in the folder, else in one of the two above it, else in a folder within it."""
    folders = [directory, *list(directory.resolve().parents)[:2], *folders_in(directory)]
    return next((folder / name for folder in folders if (folder / name).is_file()), None)


def noise_section(directory: Path, path: Path, inputs: Set[str]) -> NoiseSection:
    """Return the section of a noise.json; `inputs` are the SHA-256 of the files that the planes were made from."""
    record = read_noise(path)
    return Section(
        **_origin(directory, path, inputs),
        pages=[_link(directory, page) for page in files_named(path.parent, NOISE_PAGES)],
        made=record.provenance,
        record=record,
        rows=[
            estimate_row(
                measured, quantity._replace(name=html_symbols(f"{quantity.name}, {quantity.symbol}"), symbol="")
            )
            for quantity in NOISE_QUANTITIES
            if isinstance(measured := getattr(record, quantity.key), Estimate)
        ],
        unusable={kind: len(getattr(record, f"{kind}_pixels")) for kind in ("hot", "noisy", "dead")},
    )


def geometry_section(directory: Path, path: Path, inputs: Set[str]) -> GeometrySection | None:
    """Return the section of a geometry.json, None if its poses are by the views; `inputs` as for `noise_section`."""
    if read_geometry(path, CameraPoses).source == "views":
        return None
    record = read_geometry(path, GeometryRecord)
    page = path.with_name(GEOMETRY_PAGE)
    options = msgspec.structs.asdict(record.options)
    return Section(
        **_origin(directory, path, inputs),
        pages=[_link(directory, page)] if page.is_file() else [],
        made=Provenance(command=record.command, options=options, inputs=record.inputs, versions=record.versions),
        record=record,
        rows=stage_rows(record.stage),
        drawing=node_drawing(record),
        maps=sigma_maps(record),
    )


def _origin(directory: Path, path: Path, inputs: Set[str]) -> _Origin:
    digest = sha256(path)
    return {"where": _link(directory, path), "sha256": digest, "used": digest in inputs}


def _link(directory: Path, path: Path) -> str:
    return path.resolve().relative_to(directory.resolve(), walk_up=True).as_posix()
