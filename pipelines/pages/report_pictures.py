"""The pictures of a report: planes on one grey scale (side by side, on sliders), and their sigmas."""

from collections.abc import Iterable
from dataclasses import dataclass, field
from typing import Any, NamedTuple, TypedDict

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.formats.image_files import encoded, grey_levels, shrunk, white_level
from faintfield.pipelines.formats.results.records import (
    JOINT_METHODS,
    Certificate,
    FocusCurve,
    ReconstructionRecord,
)
from faintfield.pipelines.formats.units import StatedUnits
from faintfield.pipelines.pages.page import data_uri, words_of_depths
from faintfield.pipelines.pages.report_curves import focus_curve, weight_curves
from faintfield.pipelines.pages.report_planes import Plane, best_column, column_titles, plane_words

# Largest number of depths side by side; more are shown on a slider only.
_MAX_ROWS = 6

# Widths of the pictures side by side, of all that stand in one row, and on the sliders.
_GRID_WIDTH_PX, _ROW_WIDTH_PX, _SLIDER_WIDTH_PX = 640, 1920, 800

# Ends of the scale of what the data moved, in standard deviations.
_MOST_MOVED = 3.0


@dataclass(frozen=True)
class Row:
    """The pictures of one plane side by side, one per column as a data URI; None if it was not reconstructed."""

    words: str
    cells: list[str | None]


@dataclass(frozen=True)
class Sigmas:
    """The standard deviations of the planes on one scale, whose white is in the unit of light.

    A picture is its title, the median, and the data URI.
    """

    white: float
    pictures: list[tuple[str, float, str]]


class Proposed(NamedTuple):
    """Proposal of a prior for a plane and its change by the data, as data URIs."""

    title: str
    proposal: str
    moved: str


class Slide(TypedDict):
    """One picture of the sliders, which the page's script takes from the viewer, and the samples across the plane."""

    depth: float
    words: str
    samples: int


class SliderColumn(TypedDict):
    """The planes of one column, the nearest first."""

    title: str
    planes: list[Slide]


@dataclass(frozen=True, kw_only=True)
class PlaneSections:
    """Part of the page about the planes, by default without any; the names are those of the template.

    Attributes
    ----------
    best, best_title : Plane, str
        If there are planes, one of the column that the page leads with, and the title of the column.
    left_out : str, optional
        Why occlusion was left out, if it was.
    blurred : bool
        The best planes contain the blur of other planes.
    best_planes : list of (str, str)
        Their names and pictures.
    certificates : list of (str, Certificate)
        Bounds on their distance to the optimum.
    columns, rows : list
        Titles, and pictures side by side.
    slider, slider_column, slider_depth : list, int, int
        The sliders, and what they show first.
    slider_picture, slider_width_px : str, int
        The picture that they show first, and the largest width of theirs.
    proposals : list of Proposed
        What a prior proposed, where that was saved.
    depths : int
        Number of planes per column.
    white : float
        White of the grey scale, in the unit of light.
    sharp : str
        Depths at which the focus curve peaks, in words; empty if there are none.
    """

    best: Plane | None = None
    best_title: str = ""
    left_out: str | None = None
    blurred: bool = False
    best_planes: list[tuple[str, str]] = field(default_factory=list)
    weight_curves: str | None = None
    certificates: list[tuple[str, Certificate]] = field(default_factory=list)
    columns: list[str] = field(default_factory=list)
    rows: list[Row] = field(default_factory=list)
    slider: list[SliderColumn] | None = None
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
    """Return what the page shows of the planes."""
    if not planes:
        return PlaneSections()
    depths = sorted({plane.depth_mm for plane in planes if not plane.name})
    places = sorted({plane.place for plane in planes})
    focus = next((result.focus for result in results if result.focus), None)
    units = planes[0].units
    titles, best = column_titles(planes), best_column(planes)
    columns = list(titles)
    white = _shared_white(planes, columns)
    shown = _shown_depths(depths, focus)
    rows = _side_by_side(planes, columns, shown, white)
    of_best = [plane for plane in planes if plane.column == best]
    records = [record for plane in of_best for record in plane.records]
    place = columns.index(best)
    several = len(places) > 1 or len(columns) > 1
    slider_depth = _first_depth([depth for depth, _ in places], focus)
    first_slide = _in_order(planes, best)[: slider_depth + 1][-1]
    return PlaneSections(
        best=of_best[0],
        best_title=titles[best],
        left_out=next((record.occlusion_left_out for record in records if record.occlusion_left_out), None),
        blurred=len(places) > 1 and of_best[0].method not in JOINT_METHODS,
        best_planes=[
            (row.words, cell) for row in _side_by_side(of_best, [best], shown, white) for cell in row.cells if cell
        ],
        weight_curves=weight_curves(of_best),
        certificates=[
            (plane.words, record.certificate)
            for plane in of_best
            for record in plane.records
            if record.certificate and record.certificate.is_bound
        ],
        columns=list(titles.values()),
        rows=rows,
        slider=_slider(planes, titles) if several else None,
        slider_column=place,
        slider_depth=slider_depth,
        slider_picture=_picture(first_slide.pixels(), white, _SLIDER_WIDTH_PX, ".jpg") if several else None,
        sigmas=_sigmas(planes, titles, shown),
        proposals=_proposals(planes, titles, shown, white),
        depths=len(places),
        white=white,
        focus_curve=focus_curve(focus, units) if focus else None,
        sharp=_sharp(focus, units) if focus else "",
    )


def _sharp(focus: FocusCurve, units: StatedUnits) -> str:
    """Return the depths at which a focus curve peaks, in words."""
    if units.depth == "mm":
        return ", ".join(f"{depth:.0f} mm" for depth in focus.sharp_mm)
    return words_of_depths(units, *focus.sharp_mm) if focus.sharp_mm else ""


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


def _side_by_side(planes: list[Plane], columns: list[str], depths: list[float], white: float) -> list[Row]:
    """Return the pictures side by side: a row per depth, and per plane given by a pose; a cell per column."""
    by_place = {(plane.place, plane.column): plane for plane in planes}
    width_px = min(_GRID_WIDTH_PX, _ROW_WIDTH_PX // len(columns))
    rows = []
    for place in sorted({plane.place for plane in planes if plane.name or plane.depth_mm in depths}):
        found = (by_place.get((place, column)) for column in columns)
        cells = [None if plane is None else _picture(plane.pixels(), white, width_px, ".png") for plane in found]
        rows.append(Row(plane_words(planes[0].units, *place), cells))
    return rows


def _sigmas(planes: list[Plane], titles: dict[str, str], depths: list[float]) -> Sigmas | None:
    """Return the standard deviations on one scale of their own, None if they were not asked for."""
    ordered = sorted(planes, key=lambda plane: plane.depth_mm)
    known = [(plane, plane.sigma_e()) for plane in ordered if plane.name or plane.depth_mm in depths]
    found = [(plane, sigma) for plane, sigma in known if sigma is not None]
    if not found:
        return None
    white = max(white_level(sigma) for _, sigma in found)
    pictures = [
        (
            f"{titles[plane.column]}, {plane.words}",
            float(np.median(sigma)),
            _picture(sigma, white, _GRID_WIDTH_PX, ".png"),
        )
        for plane, sigma in found
    ]
    return Sigmas(white, pictures)


def _proposals(planes: list[Plane], titles: dict[str, str], depths: list[float], white: float) -> list[Proposed]:
    """Return what was proposed on the scale of the planes, and what the data moved, on one of ± 3 σ."""
    found = []
    for plane in sorted(planes, key=lambda plane: plane.depth_mm):
        if not (plane.name or plane.depth_mm in depths):
            continue
        proposal, moved = plane.proposal_e(), plane.moved_sigma()
        if proposal is not None and moved is not None:
            levels = shrunk(grey_levels(moved, _MOST_MOVED, -_MOST_MOVED), _GRID_WIDTH_PX)
            picture = _picture(proposal, white, _GRID_WIDTH_PX, ".png")
            title = f"{titles[plane.column]}, {plane.words}"
            found.append(Proposed(title, picture, data_uri(encoded(levels, ".png"), ".png")))
    return found


def _slider(planes: list[Plane], titles: dict[str, str]) -> list[SliderColumn]:
    """Return what the sliders show: the planes of each column by depth."""
    columns: list[SliderColumn] = []
    for column, title in titles.items():
        columns.append({"title": title, "planes": [_slide(plane) for plane in _in_order(planes, column)]})
    return columns


def _slide(plane: Plane) -> Slide:
    """Return one picture of the sliders."""
    return {"depth": plane.depth_mm, "words": plane.words, "samples": plane.pixels().shape[1]}


def _in_order(planes: list[Plane], column: str) -> list[Plane]:
    """Return the planes of a column by depth."""
    return sorted((plane for plane in planes if plane.column == column), key=lambda plane: plane.place)


def _first_depth(depths: list[float], focus: FocusCurve | None) -> int:
    """Return the index of the depth that the slider shows first: the peak of the focus curve if there is one."""
    if focus is None:
        return 0
    best = focus.depth_mm[int(np.argmax(focus.detail_e2))]
    return int(np.argmin(np.abs(np.array(depths) - best)))


def _picture(pixels: NDArray[Any], white: float, width_px: int, suffix: str) -> str:
    return data_uri(encoded(shrunk(grey_levels(pixels, white), width_px), suffix), suffix)
