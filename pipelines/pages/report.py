"""The report: one self-contained HTML page of everything that was reconstructed in a folder."""

from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import msgspec
from msgspec import UNSET

from faintfield.pipelines.formats.files import write_whole
from faintfield.pipelines.formats.results.geometry import GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.results.records import (
    OVERVIEW_FILE,
    RECONSTRUCTION_FILE,
    REPORT_FILE,
    PlaneRecord,
    ReconstructionRecord,
)
from faintfield.pipelines.formats.results.result_files import files_below, results_below
from faintfield.pipelines.formats.results.stacks import at_depths
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS
from faintfield.pipelines.pages.page import template
from faintfield.pipelines.pages.report_calibration import (
    calibration_origins,
    find_beside,
    geometry_section,
    noise_section,
)
from faintfield.pipelines.pages.report_depth import depth_sections
from faintfield.pipelines.pages.report_errors import error_sections
from faintfield.pipelines.pages.report_lead import facts
from faintfield.pipelines.pages.report_pictures import plane_sections
from faintfield.pipelines.pages.report_planes import method_title, read_planes
from faintfield.pipelines.pages.report_sets import set_sections


@dataclass(frozen=True)
class Origin:
    """How the planes of one folder were made, and when."""

    where: str
    method: str
    written: str
    planes: list[PlaneRecord]
    options: dict[str, object]
    inputs: dict[str, str]
    versions: dict[str, str]
    wall_time_s: float


def write_report(directory: Path, *, noise: Path | None = None, geometry: Path | None = None) -> Path:
    """Write report.html into a folder of results and return its path.

    Parameters
    ----------
    directory : Path
        The folder.
    noise, geometry : Path, optional
        noise.json and geometry.json; by default searched for in the folder, the two above and those within.

    Raises
    ------
    MissingFile, BadValue
        There is no result in the folder, or one that cannot be read.
    """
    results = results_below(directory)
    inputs = {name: digest for result in results.values() for name, digest in result.inputs.items()}
    noise, geometry = noise or find_beside(directory, NOISE_FILE), geometry or find_beside(directory, GEOMETRY_FILE)
    of_noise = noise_section(directory, noise, inputs) if noise else None
    of_geometry = geometry_section(directory, geometry, inputs) if geometry else None
    sets = set_sections(files_below(directory, OVERVIEW_FILE))
    planes = read_planes(directory, results)
    shown, errors = plane_sections(planes, results.values()), error_sections(directory, planes)
    the_set = sets[0] if sets else None
    page = template("report.html").render(
        title=_title(directory, results),
        facts=facts(the_set, of_noise, of_geometry, against_truth=errors.geometry_off, errors=errors.of(shown.best)),
        sets=sets,
        **vars(shown),
        depth_maps=depth_sections(directory, results),
        noise=of_noise,
        geometry=of_geometry,
        **vars(errors),
        links=_links(directory),
        results=[_origin(directory, folder, result) for folder, result in results.items()],
        calibrations=calibration_origins(of_noise, of_geometry),
    )
    path = directory / REPORT_FILE
    write_whole(path, page)
    return path


def _links(directory: Path) -> list[tuple[str, str]]:
    """Return the other pages in this folder or in folders around it: their names and addresses."""
    found = [("the paper's figures", "figures.html"), ("the folder above", f"../{REPORT_FILE}")]
    found += [
        (path.parent.relative_to(directory).as_posix(), path.relative_to(directory).as_posix())
        for path in files_below(directory, REPORT_FILE)
        if path.parent != directory
    ]
    return [(words, address) for words, address in found if (directory / address).is_file()]


def _origin(directory: Path, folder: Path, result: ReconstructionRecord) -> Origin:
    """Return how the planes of one folder were made, and when."""
    written = datetime.fromtimestamp(int((folder / RECONSTRUCTION_FILE).stat().st_mtime), UTC)
    return Origin(
        where=folder.relative_to(directory).as_posix(),
        method=method_title(result.planes),
        written=f"{written:%Y-%m-%d %H:%M:%S} UTC",
        planes=result.planes,
        options=msgspec.to_builtins(result.options),
        inputs=result.inputs,
        versions=result.versions,
        wall_time_s=result.wall_time_s,
    )


def _title(directory: Path, results: dict[Path, ReconstructionRecord]) -> str:
    """Return the title of the page: what is reconstructed, and at which depths."""
    records = [plane for result in results.values() for plane in result.planes]
    depths = sorted({record.depth_mm for record in at_depths(records)})
    few = " and ".join(f"{depth:g}" for depth in depths)
    planes = f"{few} mm" if len(depths) <= 2 else f"{len(depths)} depths, {depths[0]:g} to {depths[-1]:g} mm"
    parts = [f"planes at {planes}"] if depths else []
    parts += list(dict.fromkeys(f"plane {record.name}" for record in records if record.rt_ref_plane is not UNSET))
    return f"{_name(directory.resolve())}: {', '.join(parts)}"


def _name(folder: Path) -> str:
    """Return the name of what is reconstructed in a folder: of a session, its own name and which of its sets."""
    if folder.name == RECONSTRUCTIONS:
        return folder.parent.name
    return f"{folder.parent.parent.name}, {folder.name}" if folder.parent.name == RECONSTRUCTIONS else folder.name
