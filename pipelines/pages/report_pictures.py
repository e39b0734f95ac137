"""The pictures of a report: planes on one grey scale (side by side, on sliders), their sigmas, and their curves."""

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import encoded, light_picture, shrunk, white_level
from faintfield.pipelines.formats.results.records import JOINT_METHODS, Certificate, FocusCurve, ReconstructionRecord
from faintfield.pipelines.formats.units import StatedUnits
from faintfield.pipelines.pages.page import INK, blank_drawing, data_uri, format_depths, ink, svg
from faintfield.pipelines.pages.report_planes import Plane, best_column, column_titles, place_name

# Largest number of depths side by side; more are shown on a slider only.
_MAX_ROWS = 6

# Widths of the pictures side by side, of all that stand in one row, and on the sliders.
_GRID_WIDTH_PX, _ROW_WIDTH_PX, _SLIDER_WIDTH_PX = 640, 1920, 800

# Ends of the scale of what the data moved, in standard deviations.
_MOST_MOVED = 3.0

# Colour and mark of each of a few curves; of more, which nobody tells apart, only the colour channels differ.
_LINES = (
    ("#0072b2", "o"),
    ("#e69f00", "s"),
    ("#009e73", "^"),
    ("#cc79a7", "D"),
    ("#56b4e9", "v"),
    ("#d55e00", "P"),
    ("#8c6bb1", "X"),
    ("#808080", "*"),
)
_OF_CHANNELS = {"red": "#d55e00", "green": "#009e73", "blue": "#0072b2"}


class Sigmas(NamedTuple):
    """The standard deviations of the planes on one scale; a picture is its title, the median, and the data URI."""

    white: float
    pictures: list[tuple[str, float, str]]


class Slide(TypedDict):
    """One plane of a slider; JSON for the page's script. `samples` are those of a row."""

    depth: float
    label: str
    samples: int


class Slides(TypedDict):
    """The planes of a column."""

    title: str
    planes: list[Slide]


class Proposed(NamedTuple):
    """Proposal of a prior for a plane and its change by the data, as data URIs."""

    title: str
    proposal: str
    moved: str


@dataclass(frozen=True, kw_only=True)
class PlaneSections:
    """Part of the page about the planes, by default without any; the names are those of the template.

    The page leads with the `best` column. Pictures are data URIs, on a scale whose `white` is in the unit of light;
    `rows` are side by side, a cell per column, None if the plane was not reconstructed. Certificates of a plane are by
    channel.
    """

    best: Plane | None = None
    best_title: str = ""
    left_out: str | None = None
    blurred: bool = False
    best_planes: list[tuple[str, str]] = field(default_factory=list)
    weight_curves: str | None = None
    certificates: list[tuple[str, dict[str, Certificate]]] = field(default_factory=list)
    channels: list[str] = field(default_factory=list)
    columns: list[str] = field(default_factory=list)
    rows: list[tuple[str, list[str | None]]] = field(default_factory=list)
    slider: list[Slides] | None = None
    slider_column: int = 0
    slider_depth: int = 0
    slider_picture: str | None = None
    slider_width_px: int = _SLIDER_WIDTH_PX
    sigmas: Sigmas | None = None
    proposals: list[Proposed] = field(default_factory=list)
    depths: int = 0
    white: float = 0.0
    focus_curve: str | None = None
    sharp: str = ""


def plane_sections(planes: list[Plane], results: Iterable[ReconstructionRecord]) -> PlaneSections:
    """Return the part of the page about the planes."""
    if not planes:
        return PlaneSections()
    places = sorted({plane.place for plane in planes})
    focus = next((result.focus for result in results if result.focus), None)
    units = planes[0].units
    titles, best = column_titles(planes), best_column(planes)
    columns = list(titles)
    white = _shared_white(planes, columns)
    shown_depths = _shown_depths(sorted({plane.depth_mm for plane in planes if not plane.name}), focus)
    shown = [plane for plane in planes if plane.name or plane.depth_mm in shown_depths]
    in_order = {column: sorted((p for p in planes if p.column == column), key=lambda p: p.place) for column in columns}
    of_best = [plane for plane in planes if plane.column == best]
    records = [record for plane in of_best for record in plane.records]
    bounds = [(plane.label, _bounds(plane)) for plane in of_best]
    several = len(places) > 1 or len(columns) > 1
    slider_depth = _first_depth([depth for depth, _ in places], focus)
    first_slide = in_order[best][: slider_depth + 1][-1]
    best_rows = _side_by_side([plane for plane in shown if plane.column == best], [best], white)
    return PlaneSections(
        best=of_best[0],
        best_title=titles[best],
        left_out=next((record.occlusion_left_out for record in records if record.occlusion_left_out), None),
        blurred=len(places) > 1 and of_best[0].method not in JOINT_METHODS,
        best_planes=[(label, cell) for label, cells in best_rows for cell in cells if cell],
        weight_curves=_weight_curves(of_best),
        certificates=[(label, of_plane) for label, of_plane in bounds if of_plane],
        channels=list(dict.fromkeys(channel for _, of_plane in bounds for channel in of_plane)),
        columns=list(titles.values()),
        rows=_side_by_side(shown, columns, white),
        slider=[_slides(titles[column], in_order[column]) for column in columns] if several else None,
        slider_column=columns.index(best),
        slider_depth=slider_depth,
        slider_picture=_plane_picture(first_slide, white, _SLIDER_WIDTH_PX, ".jpg") if several else None,
        sigmas=_sigmas(shown, titles),
        proposals=_proposals(shown, titles, white),
        depths=len(places),
        white=white,
        focus_curve=_focus_curve(focus, units) if focus else None,
        sharp=_sharp(focus, units) if focus else "",
    )


def _bounds(plane: Plane) -> dict[str, Certificate]:
    """Return the certificates of a plane that bound its distance to the optimum, by channel."""
    of_channel = {record.channel: record.certificate for record in plane.records}
    return {channel: certificate for channel, certificate in of_channel.items() if certificate and certificate.is_bound}


def _slides(title: str, planes: list[Plane]) -> Slides:
    """Return the planes of a column, whose pictures the page's script takes from the viewer."""
    slides = [Slide(depth=plane.depth_mm, label=plane.label, samples=plane.pixels().shape[1]) for plane in planes]
    return Slides(title=title, planes=slides)


def _sharp(focus: FocusCurve, units: StatedUnits) -> str:
    if units.depth == "mm":
        return ", ".join(f"{depth:.0f} mm" for depth in focus.sharp_mm)
    return format_depths(units, *focus.sharp_mm) if focus.sharp_mm else ""


def _shared_white(planes: list[Plane], columns: list[str]) -> float:
    """Return the white of the grey scale, that of the least noisy column: noise may be clipped, planes are not."""
    brightest = [max(white_level(plane.pixels()) for plane in planes if plane.column == column) for column in columns]
    positive = [level for level in brightest if level > 0]
    return min(positive) if positive else 1.0


def _shown_depths(depths: list[float], focus: FocusCurve | None) -> list[float]:
    """Return the depths to show side by side: all if they are few, else those where something is sharp."""
    if len(depths) <= _MAX_ROWS:
        return depths
    sharp = focus.sharp_mm if focus else []
    marked = {min(depths, key=lambda depth: abs(depth - mark)) for mark in sharp}
    if not marked:
        marked = {depths[round(index)] for index in np.linspace(0, len(depths) - 1, 3)}
    return sorted(marked)[:_MAX_ROWS]


def _side_by_side(planes: list[Plane], columns: list[str], white: float) -> list[tuple[str, list[str | None]]]:
    """Return the pictures side by side: a row per depth, and per plane given by a pose; a cell per column."""
    by_place = {(plane.place, plane.column): plane for plane in planes}
    width_px = min(_GRID_WIDTH_PX, _ROW_WIDTH_PX // len(columns))
    rows = []
    for place in sorted({plane.place for plane in planes}):
        row = (by_place.get((place, column)) for column in columns)
        cells = [None if plane is None else _plane_picture(plane, white, width_px, ".png") for plane in row]
        rows.append((place_name(planes[0].units, *place), cells))
    return rows


def _sigmas(planes: list[Plane], titles: dict[str, str]) -> Sigmas | None:
    maps = [
        (f"{titles[plane.column]}, {plane.label}", sigma)
        for plane in sorted(planes, key=lambda plane: plane.depth_mm)
        if (sigma := plane.sidecar_pixels("sigma_file")) is not None
    ]
    if not maps:
        return None
    white = max(white_level(sigma) for _, sigma in maps)
    pictures = [
        (name, float(np.nanmedian(sigma)), _picture(sigma, white, _GRID_WIDTH_PX, ".png")) for name, sigma in maps
    ]
    return Sigmas(white, pictures)


def _proposals(planes: list[Plane], titles: dict[str, str], white: float) -> list[Proposed]:
    """Return what was proposed on the scale of the planes, and what the data moved, on one of ± 3 σ."""
    proposals = []
    for plane in sorted(planes, key=lambda plane: plane.depth_mm):
        proposal, moved = plane.sidecar_pixels("proposal_file"), plane.sidecar_pixels("moved_file")
        if proposal is not None and moved is not None:
            levels = shrunk(light_picture(moved, _MOST_MOVED, -_MOST_MOVED), _GRID_WIDTH_PX)
            picture = _picture(proposal, white, _GRID_WIDTH_PX, ".png", tone_curve=plane.units.tone_curve)
            title = f"{titles[plane.column]}, {plane.label}"
            proposals.append(Proposed(title, picture, data_uri(encoded(levels, ".png"), ".png")))
    return proposals


def _first_depth(depths: list[float], focus: FocusCurve | None) -> int:
    """Return the index of the depth that the slider shows first: the peak of the focus curve if there is one."""
    if focus is None:
        return 0
    best = focus.depth_mm[int(np.argmax(focus.detail_e2))]
    return int(np.argmin(np.abs(np.array(depths) - best)))


def _plane_picture(plane: Plane, white: float, width_px: int, suffix: str) -> str:
    return _picture(plane.pixels(), white, width_px, suffix, tone_curve=plane.units.tone_curve)


def _picture(pixels: NDArray[Any], white: float, width_px: int, suffix: str, *, tone_curve: bool = False) -> str:
    levels = light_picture(pixels, white, tone_curve=tone_curve)
    return data_uri(encoded(shrunk(levels, width_px), suffix), suffix)


def _focus_curve(focus: FocusCurve, units: StatedUnits) -> str:
    figure, axes = blank_drawing(6.0, 2.6)
    axes.plot(focus.depth_mm, focus.detail_e2, "o-", color="#2b8cbe", markersize=3, linewidth=1.5)
    for depth in focus.sharp_mm:
        axes.axvline(depth, color="#d95f02", linewidth=1, linestyle="--")
        text = f"{depth:.0f} mm" if units.depth == "mm" else units.numbers_text([depth]).replace("-", "−")
        peak = (depth, max(focus.detail_e2))
        axes.annotate(text, peak, (4, -2), textcoords="offset points", color="#d95f02", va="top")
    squared = {"electrons": "(e⁻)²", "dn": "DN²", "relative": "white²"}[units.light]
    axes.set_xlabel(f"{units.quantity} ({units.length or 'relative'})")
    axes.set_ylabel(f"detail both halves\nof the views agree on, {squared}")
    axes.ticklabel_format(axis="y", scilimits=(-3, 3))
    ink(axes)
    return svg(figure)


def _weight_curves(planes: Sequence[Plane]) -> str | None:
    """Return the prediction of the held-out views by each penalty weight as SVG; None if none were held out."""
    records = {
        (_line_name(plane), record.channel): record
        for plane in planes
        for record in plane.records
        if record.penalty_weight_curve
    }
    if not records:
        return None
    figure, axes = blank_drawing(5.6, 3.0)
    few = len(records) <= len(_LINES)
    labels: dict[str, int] = {}
    for (name, channel), record in records.items():
        curve = sorted(record.penalty_weight_curve or [], key=lambda score: score.weight)
        held_out = np.array([score.held_out for score in curve])
        of_colour = "" if channel == "grey" else f", {channel}"
        label = f"{name}{of_colour}" if few else f"{len(planes)} planes{of_colour}"
        title = None if label in labels else label
        colour, marker = _LINES[labels.setdefault(label, len(labels)) % len(_LINES)]
        colour = colour if few else _OF_CHANNELS.get(channel, colour)
        style, width = (marker, 1.5) if few else ("", 0.8)
        weights = [score.weight for score in curve]
        axes.plot(weights, held_out - held_out.min(), "-", marker=style, ms=4, lw=width, color=colour, label=title)
        if record.penalty_weight is not None:
            axes.axvline(record.penalty_weight, color=colour, linewidth=1, linestyle="--")
    axes.set_xscale("log")
    for axis_format in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        axis_format("{x:g}")
    axes.set(xlabel="penalty weight β", ylabel="held-out views: −log likelihood\nabove their minimum")
    axes.legend(frameon=False, labelcolor=INK, loc="lower left", bbox_to_anchor=(0, 1), ncols=2)
    ink(axes)
    return svg(figure)


def _line_name(plane: Plane) -> str:
    """Return the name of a plane in the legend; planes that were solved together share one curve."""
    return "all planes" if plane.method in JOINT_METHODS else plane.name or format_depths(plane.units, plane.depth_mm)
