"""The report: one self-contained HTML page of everything that was reconstructed in a folder."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from faintfield.pipelines.errors import MissingFile
from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.results.result_files import Errors, Result, read_result
from faintfield.pipelines.formats.results.stacks import at_depths
from faintfield.pipelines.pages.page import template
from faintfield.pipelines.pages.report_calibration import (
    calibration_origins,
    find_beside,
    geometry_section,
    noise_section,
)
from faintfield.pipelines.pages.report_depth import depth_sections
from faintfield.pipelines.pages.report_lead import facts
from faintfield.pipelines.pages.report_planes import (
    METHOD_NAMES,
    OF_A_SESSION,
    Plane,
    best_column,
    column_titles,
    first_depth,
    focus_curve,
    method_title,
    plane_words,
    read_planes,
    shared_white,
    shown_depths,
    side_by_side,
    sigmas,
    slider,
    weight_curves,
)
from faintfield.pipelines.pages.report_sets import set_sections
from faintfield.pipelines.reconstruction.accuracy import METRICS_FILE
from faintfield.pipelines.reconstruction.overview import OVERVIEW_FILE
from faintfield.pipelines.reconstruction.planes import TOGETHER

RECONSTRUCTION_FILE = "reconstruction.json"
REPORT_FILE = "report.html"

POSES = ("nominal", "measured", "true")


def write_report(directory: Path, *, noise: Path | None = None, geometry: Path | None = None) -> Path:
    """Write report.html into a folder of results and return its path.

    Parameters
    ----------
    directory : Path
        The folder.
    noise, geometry : Path, optional
        noise.json and geometry.json; looked for in the folder, the two above and those within when None.

    Raises
    ------
    MissingFile, BadValue
        There is no result in the folder, or one that cannot be read.
    """
    results = results_below(directory)
    inputs = {name: digest for result in results.values() for name, digest in result["inputs"].items()}
    noise, geometry = noise or find_beside(directory, NOISE_FILE), geometry or find_beside(directory, GEOMETRY_FILE)
    of_noise = noise_section(directory, noise, inputs) if noise else None
    of_geometry = geometry_section(directory, geometry, inputs) if geometry else None
    sets = set_sections(_below(directory, OVERVIEW_FILE))
    planes = read_planes(directory, results)
    shown, errors = _plane_sections(planes, results), _error_sections(directory, planes)
    led_by = [row for row in errors["metrics"] if _is_of(row, shown["best"])]
    the_set = sets[0] if sets else None
    page = template("report.html").render(
        title=_title(directory, results),
        facts=facts(the_set, of_noise, of_geometry, against_truth=errors["geometry_off"], errors=led_by),
        sets=sets,
        **shown,
        depth_maps=depth_sections(directory, results),
        noise=of_noise,
        geometry=of_geometry,
        **errors,
        links=_links(directory),
        results=[_origin(directory, folder, result) for folder, result in results.items()],
        calibrations=calibration_origins(of_noise, of_geometry),
    )
    path = directory / REPORT_FILE
    write_whole(path, page)
    return path


def results_below(directory: Path) -> dict[Path, dict[str, Any]]:
    """Return the contents of each reconstruction.json in a folder and below it, by its folder.

    Raises
    ------
    MissingFile, BadValue
        There is none, or one that cannot be read.
    """
    if not directory.is_dir():
        raise MissingFile(f"{directory}: no such folder; name one that `faintfield reconstruct` wrote")
    results = {path.parent: read_result(path, Result) for path in _below(directory, RECONSTRUCTION_FILE)}
    if not results:
        raise MissingFile(f"{directory}: holds no {RECONSTRUCTION_FILE}; run `faintfield reconstruct` first")
    return results


def _plane_sections(planes: list[Plane], results: dict[Path, dict[str, Any]]) -> dict[str, Any]:
    """Return what the page says of the planes: the best, all side by side, on sliders, and where they are sharp."""
    depths = sorted({plane.depth_mm for plane in planes if not plane.name})
    places = len({plane.place for plane in planes})
    focus = next((result["focus"] for result in results.values() if result.get("focus")), None)
    titles, best = column_titles(planes), best_column(planes)
    columns = list(titles)
    white = shared_white(planes, columns)
    rows = side_by_side(planes, columns, shown_depths(depths, focus), white)
    of_best = [plane for plane in planes if plane.column == best]
    place = columns.index(best)
    return {
        "best": of_best[0],
        "best_title": titles[best],
        "left_out": next(
            (why for one in of_best for record in one.records if (why := record.get("occlusion_left_out"))), None
        ),
        "blurred": places > 1 and of_best[0].method not in TOGETHER,
        "best_planes": [(row["words"], row["cells"][place]) for row in rows if row["cells"][place]],
        "weight_curves": weight_curves(of_best),
        "certificates": [
            (plane_words(*plane.place), record["certificate"])
            for plane in of_best
            for record in plane.records
            if record["certificate"] and "value" in record["certificate"]
        ],
        "columns": list(titles.values()),
        "rows": rows,
        "slider": slider(planes, titles, white) if places > 1 or len(columns) > 1 else None,
        "slider_column": place,
        "sigmas": sigmas(planes, titles, shown_depths(depths, focus)),
        "slider_depth": first_depth([depth for depth, _ in sorted({plane.place for plane in planes})], focus),
        "depths": places,
        "white": white,
        "focus_curve": focus_curve(focus) if focus else None,
        "sharp_mm": focus["sharp_mm"] if focus else [],
    }


def _links(directory: Path) -> list[tuple[str, str]]:
    """Return the other pages beside this one or in folders around it, each with its words."""
    found = [("the paper's figures", "figures.html"), ("the folder above", f"../{REPORT_FILE}")]
    found += [
        (path.parent.relative_to(directory).as_posix(), path.relative_to(directory).as_posix())
        for path in _below(directory, REPORT_FILE)
        if path.parent != directory
    ]
    return [(words, address) for words, address in found if (directory / address).is_file()]


def _origin(directory: Path, folder: Path, result: dict[str, Any]) -> dict[str, Any]:
    """Return how one folder's planes were made, and when."""
    written = datetime.fromtimestamp(int((folder / RECONSTRUCTION_FILE).stat().st_mtime), UTC)
    where = folder.relative_to(directory).as_posix()
    return {
        "where": where,
        "method": method_title(result["planes"]),
        "written": f"{written:%Y-%m-%d %H:%M:%S} UTC",
        **result,
    }


def _below(directory: Path, name: str) -> list[Path]:
    """Return the files of a name in a folder and down to three folders below it, in order."""
    return sorted({path for depth in range(4) for path in directory.glob("*/" * depth + name)})


def _error_sections(directory: Path, planes: list[Plane]) -> dict[str, Any]:
    """Return the errors against the truth, the folder's own or those of the folders within it, and by poses."""
    own = directory / METRICS_FILE
    found = [read_result(path, Errors) for path in ([own] if own.is_file() else _below(directory, METRICS_FILE))]
    rows = [row | {"title": _title_of(row, planes)} for metrics in found for row in metrics["planes"]]
    geometry = next((metrics["geometry"] for metrics in found if "geometry" in metrics), None)
    return {"metrics": rows, "geometry_off": geometry, **_by_poses(rows)}


def _is_of(row: dict[str, Any], plane: Plane) -> bool:
    """Return whether errors are of a plane's method; of stated poses, errors say whether they are true."""
    return bool(row["method"] == plane.method and plane.poses in ("stated", row["poses"]))


def _title_of(row: dict[str, Any], planes: list[Plane]) -> str:
    """Return what the method of errors is called beside the planes."""
    return next((plane.title for plane in planes if _is_of(row, plane)), METHOD_NAMES.get(row["method"], row["method"]))


def _by_poses(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the errors of planes that were reconstructed with several kinds of poses, side by side."""
    kinds = [kind for kind in POSES if any(row["poses"] == kind for row in rows)]
    places: dict[tuple[float, str, str], dict[str, float]] = {}
    for row in rows:
        places.setdefault((row["depth_mm"], row["object"], row["title"]), {})[row["poses"]] = row["mse_bright"]
    compared = [(*place, errors) for place, errors in places.items() if len(errors) > 1]
    return {"pose_kinds": kinds, "by_poses": sorted(compared, key=lambda row: row[:3])}


def _title(directory: Path, results: dict[Path, dict[str, Any]]) -> str:
    records = [plane for result in results.values() for plane in result["planes"]]
    depths = sorted({record["depth_mm"] for record in at_depths(records)})
    few = " and ".join(f"{depth:g}" for depth in depths)
    planes = f"{few} mm" if len(depths) <= 2 else f"{len(depths)} depths, {depths[0]:g} to {depths[-1]:g} mm"
    parts = [f"planes at {planes}"] if depths else []
    parts += list(dict.fromkeys(f"plane {record['name']}" for record in records if "rt_ref_plane" in record))
    return f"{_name(directory.resolve())}: {', '.join(parts)}"


def _name(folder: Path) -> str:
    """Return what is reconstructed in a folder: of a session its own name, and which of its sets."""
    if folder.name == OF_A_SESSION:
        return folder.parent.name
    return f"{folder.parent.parent.name}, {folder.name}" if folder.parent.name == OF_A_SESSION else folder.name
