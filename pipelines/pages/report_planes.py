"""The planes of a report: read from disk, on one grey scale, side by side and on sliders, with their focus curve."""

from dataclasses import dataclass
from itertools import cycle
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.frames import read_frame
from faintfield.pipelines.formats.image_files import encoded, grey_levels, shrunk, white_level
from faintfield.pipelines.pages.page import INK, data_uri, inked, svg
from faintfield.pipelines.reconstruction.planes import TOGETHER

# So many depths stand side by side; more of them are shown on a slider only.
_MOST_ROWS = 6
_GRID_WIDTH_PX, _SLIDER_WIDTH_PX = 640, 800

# Of the curves of several planes; told apart by colour and by mark.
_LINES = (("#0072b2", "o"), ("#e69f00", "s"), ("#009e73", "^"), ("#cc79a7", "D"))

_POSES = ("measured", "nominal", "true", "stated")

OF_A_SESSION = "reconstructions"

METHOD_NAMES = {
    "backprojection": "back-projection",
    "mlem": "MLEM",
    "pmlem-osl": "PMLEM (one-step-late, TV)",
    "pmlem": "PMLEM",
    "joint": "PMLEM, all planes together",
    "occlusion": "PMLEM, all planes together, with occlusion",
}


@dataclass(frozen=True)
class Plane:
    """One plane of one method on disk."""

    column: str
    method: str
    poses: str
    depth_mm: float
    path: Path
    records: list[dict[str, Any]]

    @property
    def title(self) -> str:
        """What the method is called."""
        return method_title(self.records)

    @property
    def name(self) -> str:
        """What a plane that was given by a pose is called; nothing for others."""
        return str(self.records[0].get("name", ""))

    @property
    def place(self) -> tuple[float, str]:
        """What planes of several columns have in common when they are to stand beside each other."""
        return (self.depth_mm, self.name)

    def pixels(self) -> NDArray[Any]:
        """Return the plane (row, column[, colour]) in electrons."""
        return read_frame(self.path).pixels_dn

    def sigma_e(self) -> NDArray[Any] | None:
        """Return the standard deviation of each sample, None where none was asked for."""
        name = self.records[0].get("sigma_file")
        return None if name is None else read_frame(existing(self.path.with_name(Path(name).name))).pixels_dn


def method_title(records: list[dict[str, Any]]) -> str:
    """Return what the method of records is called, by what came of it: occlusion may have been left out."""
    method = str(records[0]["method"])
    left_out = dict.fromkeys(record["channel"] for record in records if record.get("occlusion") is False)
    if not left_out:
        return METHOD_NAMES.get(method, method)
    in_colours = "" if all(record["channel"] in left_out for record in records) else f" in {', '.join(left_out)}"
    return f"{METHOD_NAMES['joint']} (occlusion left out{in_colours})"


def read_planes(directory: Path, results: dict[Path, dict[str, Any]]) -> list[Plane]:
    """Return all planes, in the order of folders and depths; a colour plane has one record per channel."""
    planes = []
    for folder, result in results.items():
        by_file: dict[str, list[dict[str, Any]]] = {}
        for record in result["planes"]:
            by_file.setdefault(record["file"], []).append(record)
        where = folder.relative_to(directory)
        for name, records in by_file.items():
            path = folder / Path(name).name
            existing(path)
            method = records[0]["method"]
            # The folder of a method says no more than its name, and that of a session's reconstructions nothing.
            parts = [part for part in where.parts if part not in (method, OF_A_SESSION)]
            column = f"{parts[-1]}/{method}" if parts else method
            planes.append(Plane(column, method, _poses(result), records[0]["depth_mm"], path, records))
    methods = list(METHOD_NAMES)
    return sorted(
        planes,
        key=lambda plane: (
            _POSES.index(plane.poses),
            plane.column.rpartition("/")[0],
            methods.index(plane.method) if plane.method in methods else len(methods),
        ),
    )


def existing(path: Path) -> Path:
    """Return the path of a file that reconstruction.json names, and refuse one that is not there (MissingFile)."""
    if not path.is_file():
        raise MissingFile(f"{path}: is recorded in reconstruction.json but missing; reconstruct again")
    return path


def _poses(result: dict[str, Any]) -> str:
    """Return which poses planes were made with."""
    return str(result["options"].get("poses", "stated"))


def column_titles(planes: list[Plane]) -> dict[str, str]:
    """Return what stands above each column: the method, with the poses or the set's folder where these differ."""
    columns = {plane.column: plane for plane in planes}
    by_poses = {column: (plane.method, plane.poses) for column, plane in columns.items()}
    told_apart = len(set(by_poses.values())) == len(columns) and len({plane.poses for plane in planes}) > 1
    titles = {}
    for column, plane in columns.items():
        where, name = column.rpartition("/")[0], plane.title
        if told_apart and plane.poses != "stated":
            titles[column] = f"{name}, {plane.poses} poses"
        else:
            titles[column] = f"{where} set: {name}" if where else name
    return titles


def best_column(planes: list[Plane]) -> str:
    """Return the column that a report leads with: of measured poses, where there are any, by the foremost method."""
    methods = ("occlusion", "joint", "pmlem", "pmlem-osl", "mlem", "backprojection")
    poses = ("measured", "stated", "nominal", "true")
    ranks = {p.column: (poses.index(p.poses), methods.index(p.method) if p.method in methods else 9) for p in planes}
    return min(ranks, key=lambda column: ranks[column])


def shared_white(planes: list[Plane], columns: list[str]) -> float:
    """Return the white of the one grey scale: that of the least noisy column, so that noise may clip but planes not."""
    brightest = [max(white_level(plane.pixels()) for plane in planes if plane.column == column) for column in columns]
    positive = [level for level in brightest if level > 0]
    return min(positive) if positive else 1.0


def shown_depths(depths: list[float], focus: dict[str, Any] | None) -> list[float]:
    """Return the depths that stand side by side: all when they are few, else where something is sharp."""
    if len(depths) <= _MOST_ROWS:
        return depths
    sharp = focus["sharp_mm"] if focus else []
    marked = {min(depths, key=lambda depth: abs(depth - mark)) for mark in sharp}
    if not marked:
        marked = {depths[round(index)] for index in np.linspace(0, len(depths) - 1, 3)}
    return sorted(marked)[:_MOST_ROWS]


def side_by_side(planes: list[Plane], columns: list[str], depths: list[float], white: float) -> list[dict[str, Any]]:
    """Return the pictures side by side, a row per plane and a cell per column; planes of a pose always have one."""
    by_place = {(plane.place, plane.column): plane for plane in planes}
    rows = []
    for place in sorted({plane.place for plane in planes if plane.name or plane.depth_mm in depths}):
        found = [by_place.get((place, column)) for column in columns]
        cells = [None if plane is None else _picture(plane.pixels(), white, _GRID_WIDTH_PX, ".png") for plane in found]
        rows.append({"words": plane_words(*place), "cells": cells})
    return rows


def sigmas(planes: list[Plane], titles: dict[str, str], depths: list[float]) -> dict[str, Any] | None:
    """Return the standard deviations as pictures on one scale of their own, None where none were asked for."""
    ordered = sorted(planes, key=lambda plane: plane.depth_mm)
    known = [(plane, plane.sigma_e()) for plane in ordered if plane.name or plane.depth_mm in depths]
    found = [(plane, sigma) for plane, sigma in known if sigma is not None]
    if not found:
        return None
    white = max(white_level(sigma) for _, sigma in found)
    pictures = [
        {
            "title": f"{titles[plane.column]}, {plane_words(*plane.place)}",
            "median_e": float(np.median(sigma)),
            "src": _picture(sigma, white, _GRID_WIDTH_PX, ".png"),
        }
        for plane, sigma in found
    ]
    return {"white": white, "pictures": pictures}


def slider(planes: list[Plane], titles: dict[str, str], white: float) -> list[dict[str, Any]]:
    """Return the pictures of the sliders: per column the planes by depth."""
    return [
        {
            "title": title,
            "planes": [
                _slide(plane, white)
                for plane in sorted(planes, key=lambda plane: plane.place)
                if plane.column == column
            ],
        }
        for column, title in titles.items()
    ]


def _slide(plane: Plane, white: float) -> dict[str, Any]:
    """Return one picture of the sliders, and how many samples across the plane has."""
    pixels = plane.pixels()
    picture = _picture(pixels, white, _SLIDER_WIDTH_PX, ".jpg")
    return {"depth_mm": plane.depth_mm, "words": plane_words(*plane.place), "samples": pixels.shape[1], "src": picture}


def plane_words(depth_mm: float, name: str) -> str:
    """Return what a plane is called."""
    return f"{name}, {depth_mm:.1f} mm on the axis" if name else f"{round(depth_mm, 1):g} mm"


def first_depth(depths: list[float], focus: dict[str, Any] | None) -> int:
    """Return which depth the slider shows first: where the focus curve is highest, the first without a curve."""
    if focus is None:
        return 0
    best = max(zip(focus["detail_e2"], focus["depth_mm"], strict=True))[1]
    return min(range(len(depths)), key=lambda index: abs(depths[index] - best))


def _picture(pixels: NDArray[Any], white: float, width_px: int, suffix: str) -> str:
    return data_uri(encoded(shrunk(grey_levels(pixels, white), width_px), suffix), suffix)


def focus_curve(focus: dict[str, Any]) -> str:
    """Return the focus curve as SVG that takes its colour from the page."""
    from matplotlib.figure import Figure  # loading it costs most of a second, and most reports have no curve

    figure = Figure(figsize=(6.0, 2.6), layout="constrained")
    axes = figure.subplots()
    axes.plot(focus["depth_mm"], focus["detail_e2"], "o-", color="#2b8cbe", markersize=3, linewidth=1.5)
    top = max(focus["detail_e2"])
    for depth in focus["sharp_mm"]:
        axes.axvline(depth, color="#d95f02", linewidth=1, linestyle="--")
        axes.annotate(
            f"{depth:.0f} mm", (depth, top), xytext=(4, -2), textcoords="offset points", color="#d95f02", va="top"
        )
    axes.set_xlabel("depth (mm)", color=INK)
    axes.set_ylabel("detail both halves\nof the views agree on (e⁻²)", color=INK)
    axes.ticklabel_format(axis="y", scilimits=(-3, 3))
    inked(axes)
    return svg(figure)


def weight_curves(planes: list[Plane]) -> str | None:
    """Return how well each penalty weight predicts the views that were held out, as SVG; None where none were.

    Parameters
    ----------
    planes : list of Plane
        Of one column.
    """
    known = [
        ("all planes" if plane.method in TOGETHER else plane.name or f"{plane.depth_mm:g} mm", one)
        for plane in planes
        for one in plane.records
        if one.get("penalty_weight_curve")
    ]
    if not known:
        return None
    known = list({(words, one["channel"]): (words, one) for words, one in known}.values())
    from matplotlib.figure import Figure  # loading it takes a while

    figure = Figure(figsize=(5.6, 3.0), layout="constrained")
    axes = figure.subplots()
    for (words, record), (colour, marker) in zip(known, cycle(_LINES)):
        curve = sorted(record["penalty_weight_curve"], key=lambda point: float(point["weight"]))
        weights = [point["weight"] for point in curve]
        worse = np.array([point["held_out"] for point in curve]) - min(point["held_out"] for point in curve)
        colour_name = "" if record["channel"] == "grey" else f", {record['channel']}"
        axes.plot(weights, worse, marker=marker, markersize=4, color=colour, label=f"{words}{colour_name}")
        axes.axvline(record["penalty_weight"], color=colour, linewidth=1, linestyle="--")
    axes.set_xscale("log")
    for axis_format in (axes.xaxis.set_major_formatter, axes.xaxis.set_minor_formatter):
        axis_format("{x:g}")
    axes.set_xlabel("penalty weight β")
    axes.set_ylabel("held-out views: −log likelihood\nabove its least")
    axes.legend(frameon=False, labelcolor=INK)
    inked(axes)
    return svg(figure)
