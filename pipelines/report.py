"""`faintfield report`: one self-contained HTML page of everything that was reconstructed in a folder."""

import base64
import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from pipelines.console import say
from pipelines.errors import MissingFile
from pipelines.files import write_whole
from pipelines.frames import read_frame
from pipelines.image_files import encoded, grey_levels, shrunk, white_level
from pipelines.metrics import METRICS_FILE
from pipelines.overview import INTEGRAL_IMAGE, OVERVIEW_FILE, REFERENCE_OF_NOISE, REFERENCE_VIEW
from pipelines.result_files import Errors, Overview, Result, read_result

if TYPE_CHECKING:
    from jinja2 import Template

RECONSTRUCTION_FILE = "reconstruction.json"
REPORT_FILE = "report.html"

# So many depths stand side by side; more of them are shown on a slider only.
_MOST_ROWS = 6
_GRID_WIDTH_PX, _SLIDER_WIDTH_PX = 640, 800

METHOD_NAMES = {
    "backprojection": "back-projection",
    "mlem": "MLEM",
    "pmlem-osl": "PMLEM (one-step-late, TV)",
    "pmlem": "PMLEM",
}


@dataclass(frozen=True)
class _Plane:
    """One plane of one method on disk."""

    column: str
    method: str
    depth_mm: float
    path: Path
    records: list[dict[str, Any]]

    def pixels(self) -> NDArray[Any]:
        return read_frame(self.path).pixels_dn


def report(directory: Path, /) -> dict[str, Any]:
    """Draw report.html anew from the results in a folder and the folders within it.

    Parameters
    ----------
    directory
        Folder with reconstruction.json, or whose folders have one.
    """
    path = write_report(directory)
    say(f"{path}")
    return {"report": str(path)}


def write_report(directory: Path) -> Path:
    """Write report.html into a folder of results and return its path.

    Raises
    ------
    MissingFile, BadValue
        There is no result in the folder, or one that cannot be read.
    """
    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such folder; name one that `faintfield reconstruct` wrote")
    results = {path.parent: read_result(path, Result) for path in _below(directory, RECONSTRUCTION_FILE)}
    if not results:
        raise MissingFile(f"{directory}: holds no {RECONSTRUCTION_FILE}; run `faintfield reconstruct` first")
    planes = _planes(directory, results)
    depths = sorted({plane.depth_mm for plane in planes})
    focus = next((result["focus"] for result in results.values() if result.get("focus")), None)
    columns = list(dict.fromkeys(plane.column for plane in planes))
    white = _shared_white(planes, columns)
    page = template("report.html").render(
        title=_title(directory, results),
        sets=[_set_section(path.parent) for path in _below(directory, OVERVIEW_FILE)],
        columns=[{"name": name, "title": _column_title(name)} for name in columns],
        rows=_rows(planes, columns, _shown_depths(depths, focus), white),
        slider=_slider(planes, columns, white) if len(depths) > 1 else None,
        slider_column=_slider_column(columns),
        slider_depth=_slider_depth(depths, focus),
        depths=len(depths),
        white=white,
        focus_curve=_focus_curve(focus) if focus else None,
        sharp_mm=focus["sharp_mm"] if focus else [],
        metrics=_metrics(directory),
        method_names=METHOD_NAMES,
        results=[
            {"where": str(folder.relative_to(directory)), "method": _method_of(result), **result}
            for folder, result in results.items()
        ],
    )
    path = directory / REPORT_FILE
    write_whole(path, page)
    return path


def _below(directory: Path, name: str) -> list[Path]:
    """Return the files of a name in a folder and down to two folders below it, in order."""
    return sorted({path for pattern in (name, f"*/{name}", f"*/*/{name}") for path in directory.glob(pattern)})


def _metrics(directory: Path) -> list[dict[str, Any]]:
    """Return the errors against the truth: the folder's own, or those of the folders within it."""
    own = directory / METRICS_FILE
    return [
        row
        for path in ([own] if own.is_file() else _below(directory, METRICS_FILE))
        for row in read_result(path, Errors)["planes"]
    ]


def _planes(directory: Path, results: dict[Path, dict[str, Any]]) -> list[_Plane]:
    """Return all planes, in the order of folders and depths; a colour plane has one record per channel."""
    planes = []
    for folder, result in results.items():
        by_file: dict[str, list[dict[str, Any]]] = {}
        for record in result["planes"]:
            by_file.setdefault(record["file"], []).append(record)
        where = folder.relative_to(directory)
        for name, records in by_file.items():
            path = folder / Path(name).name
            if not path.is_file():
                raise MissingFile(
                    f"{path}: is recorded in {folder / RECONSTRUCTION_FILE} but missing; reconstruct again"
                )
            method = records[0]["method"]
            label = method if where.name == method else f"{where.name}/{method}" if where.name else method
            parent = where.parent.name if where.name == method else ""
            column = f"{parent}/{label}" if parent else label
            planes.append(_Plane(column, method, records[0]["depth_mm"], path, records))
    order = list(METHOD_NAMES)
    return sorted(
        planes, key=lambda p: (p.column.rpartition("/")[0], order.index(p.method) if p.method in order else 9)
    )


def _column_title(column: str) -> str:
    """Return what stands above a column: the set's folder, where there are several, and the method."""
    where, _, method = column.rpartition("/")
    name = METHOD_NAMES.get(method, method)
    return f"{where} set: {name}" if where else name


def _method_of(result: dict[str, Any]) -> str:
    methods = sorted({METHOD_NAMES.get(plane["method"], plane["method"]) for plane in result["planes"]})
    return ", ".join(methods)


def _title(directory: Path, results: dict[Path, dict[str, Any]]) -> str:
    depths = sorted({plane["depth_mm"] for result in results.values() for plane in result["planes"]})
    planes = f"{depths[0]:g} mm" if len(depths) == 1 else f"{len(depths)} depths, {depths[0]:g} to {depths[-1]:g} mm"
    return f"{directory.resolve().name}: planes at {planes}"


def _shared_white(planes: list[_Plane], columns: list[str]) -> float:
    """Return the white of the one grey scale: that of the least noisy column, so that noise may clip but planes not."""
    brightest = [max(white_level(plane.pixels()) for plane in planes if plane.column == column) for column in columns]
    positive = [level for level in brightest if level > 0]
    return min(positive) if positive else 1.0


def _shown_depths(depths: list[float], focus: dict[str, Any] | None) -> list[float]:
    """Return the depths that stand side by side: all when they are few, else where something is sharp."""
    if len(depths) <= _MOST_ROWS:
        return depths
    sharp = focus["sharp_mm"] if focus else []
    marked = {min(depths, key=lambda depth: abs(depth - mark)) for mark in sharp}
    if not marked:
        marked = {depths[round(index)] for index in np.linspace(0, len(depths) - 1, 3)}
    return sorted(marked)[:_MOST_ROWS]


def _rows(planes: list[_Plane], columns: list[str], depths: list[float], white: float) -> list[dict[str, Any]]:
    """Return the pictures side by side, a row per depth and a cell per column."""
    by_place = {(plane.depth_mm, plane.column): plane for plane in planes}
    rows = []
    for depth in depths:
        found = [by_place.get((depth, column)) for column in columns]
        cells = [None if plane is None else _picture(plane.pixels(), white, _GRID_WIDTH_PX, ".png") for plane in found]
        rows.append({"depth_mm": depth, "cells": cells})
    return rows


def _slider(planes: list[_Plane], columns: list[str], white: float) -> list[dict[str, Any]]:
    """Return the pictures of the slider: per column the planes by depth."""
    return [
        {
            "title": _column_title(column),
            "planes": [
                {"depth_mm": plane.depth_mm, "src": _picture(plane.pixels(), white, _SLIDER_WIDTH_PX, ".jpg")}
                for plane in sorted(planes, key=lambda plane: plane.depth_mm)
                if plane.column == column
            ],
        }
        for column in columns
    ]


def _slider_column(columns: list[str]) -> int:
    """Return which column the slider shows first: one that was penalised, where there is one."""
    return next((index for index, name in enumerate(columns) if "pmlem" in name), 0)


def _slider_depth(depths: list[float], focus: dict[str, Any] | None) -> int:
    """Return which depth the slider shows first: where the focus curve is highest, the first without a curve."""
    if focus is None:
        return 0
    best = max(zip(focus["detail_e2"], focus["depth_mm"], strict=True))[1]
    return min(range(len(depths)), key=lambda index: abs(depths[index] - best))


def _set_section(folder: Path) -> dict[str, Any]:
    """Return what the page says of one set."""
    overview = read_result(folder / OVERVIEW_FILE, Overview)
    pictures = {
        key: _data_uri((folder / name).read_bytes(), ".png") if (folder / name).is_file() else None
        for key, name in (
            ("integral_image", INTEGRAL_IMAGE),
            ("reference_view", REFERENCE_VIEW),
            ("noise_reference", REFERENCE_OF_NOISE),
        )
    }
    return {**overview, "pictures": pictures}


def _picture(pixels: NDArray[Any], white: float, width_px: int, suffix: str) -> str:
    return _data_uri(encoded(shrunk(grey_levels(pixels, white), width_px), suffix), suffix)


def _data_uri(content: bytes, suffix: str) -> str:
    kind = {".png": "png", ".jpg": "jpeg"}[suffix]
    return f"data:image/{kind};base64,{base64.b64encode(content).decode()}"


def _focus_curve(focus: dict[str, Any]) -> str:
    """Return the focus curve as SVG that takes its colour from the page."""
    from matplotlib import rc_context  # loading it costs most of a second, and most reports have no curve
    from matplotlib.figure import Figure

    ink = "#010203"  # replaced below: the page's own colour, light or dark
    figure = Figure(figsize=(7.2, 2.8), layout="constrained")
    axes = figure.subplots()
    axes.plot(focus["depth_mm"], focus["detail_e2"], "o-", color="#2b8cbe", markersize=3, linewidth=1.5)
    top = max(focus["detail_e2"])
    for depth in focus["sharp_mm"]:
        axes.axvline(depth, color="#d95f02", linewidth=1, linestyle="--")
        axes.annotate(
            f"{depth:.0f} mm", (depth, top), xytext=(4, -2), textcoords="offset points", color="#d95f02", va="top"
        )
    axes.set_xlabel("depth (mm)", color=ink)
    axes.set_ylabel("detail both halves\nof the views agree on (e⁻²)", color=ink)
    axes.ticklabel_format(axis="y", scilimits=(-3, 3))
    axes.tick_params(colors=ink)
    axes.spines[:].set_color(ink)
    axes.spines[["top", "right"]].set_visible(False)
    axes.yaxis.get_offset_text().set_color(ink)
    text = io.StringIO()
    with rc_context({"svg.hashsalt": "faintfield"}):  # the same curve gives the same page
        figure.savefig(text, format="svg", transparent=True, metadata={"Date": None, "Creator": None})
    svg = text.getvalue()
    return svg[svg.index("<svg") :].replace(ink, "currentColor")


def template(name: str) -> "Template":
    """Return a page's template, with `figure` to write a number to three digits."""
    from jinja2 import Environment, PackageLoader, StrictUndefined  # loaded when all images are out of memory

    environment = Environment(loader=PackageLoader("pipelines"), autoescape=True, undefined=StrictUndefined)
    environment.filters["figure"] = lambda value, digits=3: "–" if value is None else f"{value:.{digits}g}"
    return environment.get_template(name)
