"""`faintfield report`: one self-contained HTML page of everything that was reconstructed in a folder."""

from datetime import UTC, datetime
from pathlib import Path
from typing import Any

from pipelines.console import say
from pipelines.errors import MissingFile
from pipelines.files import write_whole
from pipelines.frames import read_frame
from pipelines.image_files import encoded
from pipelines.metrics import METRICS_FILE
from pipelines.overview import INTEGRAL_IMAGE, OVERVIEW_FILE, REFERENCE_OF_NOISE, REFERENCE_VIEW
from pipelines.pages import data_uri, template
from pipelines.report_calibration import (
    GEOMETRY_FILE,
    NOISE_FILE,
    find_beside,
    geometry_section,
    noise_section,
    photon_budget,
    records,
)
from pipelines.report_planes import (
    METHOD_NAMES,
    column_title,
    first_column,
    first_depth,
    focus_curve,
    read_planes,
    shared_white,
    shown_depths,
    side_by_side,
    slider,
)
from pipelines.result_files import Errors, Overview, Result, read_result

RECONSTRUCTION_FILE = "reconstruction.json"
REPORT_FILE = "report.html"

# Of a view that is shown pixel for pixel.
_MOST_SHOWN_PX = 640

POSES = ("nominal", "measured", "true")


def report(directory: Path, /) -> dict[str, Any]:
    """Draw report.html anew from the results in a folder and the folders within it.

    It shows the set, its light, the planes and their errors; the noise and the geometry of the camera where noise.json
    and geometry.json lie there or in one of the two folders above; and how everything was made.

    Parameters
    ----------
    directory
        Folder with reconstruction.json, or whose folders have one: what `reconstruct` wrote, or a session.
    """
    path = write_report(directory)
    say(f"{path}")
    return {"report": str(path)}


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
    calibrations = {
        "noise": noise_section(directory, noise, inputs) if noise else None,
        "geometry": geometry_section(directory, geometry, inputs) if geometry else None,
    }
    page = template("report.html").render(
        title=_title(directory, results),
        sets=_set_sections(directory),
        **_plane_sections(directory, results),
        depth_maps=[
            _depth_section(folder, result["depth_map"]) for folder, result in results.items() if result.get("depth_map")
        ],
        **calibrations,
        **_error_sections(directory),
        method_names=METHOD_NAMES,
        links=_links(directory),
        results=[_origin(directory, folder, result) for folder, result in results.items()],
        calibrations=records(calibrations.values()),
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


def _plane_sections(directory: Path, results: dict[Path, dict[str, Any]]) -> dict[str, Any]:
    """Return what the page says of the planes: side by side, through depths and methods, and where they are sharp."""
    planes = read_planes(directory, results, RECONSTRUCTION_FILE)
    depths = sorted({plane.depth_mm for plane in planes})
    focus = next((result["focus"] for result in results.values() if result.get("focus")), None)
    columns = list(dict.fromkeys(plane.column for plane in planes))
    white = shared_white(planes, columns)
    several = len(depths) > 1 or len(columns) > 1
    return {
        "columns": [column_title(name) for name in columns],
        "rows": side_by_side(planes, columns, shown_depths(depths, focus), white),
        "slider": slider(planes, columns, white) if several else None,
        "slider_column": first_column(columns),
        "slider_depth": first_depth(depths, focus),
        "depths": len(depths),
        "white": white,
        "focus_curve": focus_curve(focus) if focus else None,
        "sharp_mm": focus["sharp_mm"] if focus else [],
    }


def _depth_section(folder: Path, found: dict[str, Any]) -> dict[str, Any]:
    """Return what the page shows of a sweep's depth map: its pictures, where they are still there."""
    pictures = {
        key: data_uri(path.read_bytes(), ".png")
        if (path := (folder / Path(found[key]).name).with_suffix(".png")).is_file()
        else None
        for key in ("all_in_focus", "file", "confidence")
    }
    return {**found, "pictures": pictures}


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
    methods = sorted({METHOD_NAMES.get(plane["method"], plane["method"]) for plane in result["planes"]})
    where = folder.relative_to(directory).as_posix()
    return {"where": where, "method": ", ".join(methods), "written": f"{written:%Y-%m-%d %H:%M:%S} UTC", **result}


def _below(directory: Path, name: str) -> list[Path]:
    """Return the files of a name in a folder and down to three folders below it, in order."""
    return sorted({path for depth in range(4) for path in directory.glob("*/" * depth + name)})


def _error_sections(directory: Path) -> dict[str, Any]:
    """Return the errors against the truth, the folder's own or those of the folders within it, and by poses."""
    own = directory / METRICS_FILE
    rows = [
        row
        for path in ([own] if own.is_file() else _below(directory, METRICS_FILE))
        for row in read_result(path, Errors)["planes"]
    ]
    return {"metrics": rows, **_by_poses(rows)}


def _by_poses(rows: list[dict[str, Any]]) -> dict[str, Any]:
    """Return the errors of planes that were reconstructed with several kinds of poses, side by side."""
    kinds = [kind for kind in POSES if any(row["poses"] == kind for row in rows)]
    places: dict[tuple[float, str, str], dict[str, float]] = {}
    for row in rows:
        places.setdefault((row["depth_mm"], row["object"], row["method"]), {})[row["poses"]] = row["mse_bright"]
    compared = [(*place, errors) for place, errors in places.items() if len(errors) > 1]
    return {"pose_kinds": kinds, "by_poses": sorted(compared, key=lambda row: row[:3])}


def _title(directory: Path, results: dict[Path, dict[str, Any]]) -> str:
    depths = sorted({plane["depth_mm"] for result in results.values() for plane in result["planes"]})
    planes = f"{depths[0]:g} mm" if len(depths) == 1 else f"{len(depths)} depths, {depths[0]:g} to {depths[-1]:g} mm"
    return f"{directory.resolve().name}: planes at {planes}"


def _set_sections(directory: Path) -> list[dict[str, Any]]:
    """Return what the page says of each set, once of one that was reconstructed several times."""
    known: dict[bytes, Path] = {}
    for path in _below(directory, OVERVIEW_FILE):
        known.setdefault(path.read_bytes(), path.parent)
    return [_set_section(folder) for folder in known.values()]


def _set_section(folder: Path) -> dict[str, Any]:
    """Return what the page says of one set."""
    overview = read_result(folder / OVERVIEW_FILE, Overview)
    pictures = {
        key: _pixel_for_pixel(folder / name, crop=key != "integral_image") if (folder / name).is_file() else None
        for key, name in (
            ("integral_image", INTEGRAL_IMAGE),
            ("reference_view", REFERENCE_VIEW),
            ("noise_reference", REFERENCE_OF_NOISE),
        )
    }
    return {**overview, "pictures": pictures, "budget": photon_budget(overview)}


def _pixel_for_pixel(path: Path, *, crop: bool) -> str:
    """Return a picture as it is; of one too large to be shown so, the middle, since to shrink noise would hide it."""
    if not crop:
        return data_uri(path.read_bytes(), ".png")
    picture = read_frame(path).pixels_dn
    (top, left) = ((size - min(size, _MOST_SHOWN_PX)) // 2 for size in picture.shape[:2])
    middle = picture[top : top + _MOST_SHOWN_PX, left : left + _MOST_SHOWN_PX]
    return data_uri(encoded(middle, ".png"), ".png")
