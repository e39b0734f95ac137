"""The report: one self-contained HTML page of everything that was reconstructed in a folder."""

from datetime import UTC, datetime
from pathlib import Path
from typing import NamedTuple

import msgspec
import numpy as np
from msgspec import UNSET

from faintfield.pipelines.formats.files import files_below, sha256, write_whole
from faintfield.pipelines.formats.results.alignment import AlignmentRecord
from faintfield.pipelines.formats.results.figures import OVERVIEW_FILE, GeometryErrors
from faintfield.pipelines.formats.results.geometry import ALIGNMENT_FOLDER, GEOMETRY_FILE, read_geometry
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.results.records import (
    RECONSTRUCTION_FILE,
    REPORT_FILE,
    BestFocusRecord,
    Poses,
    ReconstructionRecord,
)
from faintfield.pipelines.formats.results.stacks import at_depths
from faintfield.pipelines.formats.results.surface import SURFACE_FILE, SurfaceFileRecord, results_below, surfaces_below
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS
from faintfield.pipelines.formats.units import StatedUnits, named_by, units_of
from faintfield.pipelines.pages.calibration_pages import (
    GeometrySection,
    NoiseSection,
    find_calibration,
    geometry_section,
    noise_section,
)
from faintfield.pipelines.pages.page import MAX_SNR, Fact, figure, format_depths, snr_text, template
from faintfield.pipelines.pages.report_pictures import plane_sections
from faintfield.pipelines.pages.report_planes import error_sections, method_title, read_planes
from faintfield.pipelines.pages.report_sets import SetSection, set_sections
from faintfield.pipelines.pages.report_surface import depth_sections, surface_sections
from faintfield.pipelines.pages.viewer_data import viewer_of
from faintfield.pipelines.reconstruction.depth.scene_structure import Mode, StatedShares, recommendation
from faintfield.pipelines.reconstruction.planes.saturation import saturation_text

# Origins of poses in words.
_POSES: dict[Poses, str] = {
    "stated": "by the set; not measured",
    "measured": f"their uncertainty is in the {GEOMETRY_FILE} that was used, which is not here",
    "aligned": f"found by the views themselves; their uncertainty is in the {GEOMETRY_FILE} that was used",
    "nominal": "where the stage was sent; not measured",
    "true": "known to the simulation",
}


class Origin(NamedTuple):
    """A reconstruction or a surface: folder, method, time of writing, options, record, and search of its depths."""

    where: str
    method: str
    written: str
    options: dict[str, object]
    record: ReconstructionRecord | SurfaceFileRecord
    search: str | None


def write_report(directory: Path, *, noise: Path | None = None, geometry: Path | None = None) -> Path:
    """Write report.html into a folder of results and return its path.

    noise.json and geometry.json are by default searched for in the folder, the two above and those within. Raises
    MissingFile or BadValue if there is no result in the folder, or one that cannot be read.
    """
    surfaces = surfaces_below(directory)
    results = results_below(directory, required=not surfaces)
    records: list[ReconstructionRecord | SurfaceFileRecord] = [*results.values(), *surfaces.values()]
    units = units_of(records[0])
    inputs = {digest for record in records for digest in record.inputs.values()}
    noise = noise or find_calibration(directory, NOISE_FILE)
    geometry = geometry or find_calibration(directory, GEOMETRY_FILE)
    of_noise = noise_section(directory, noise, inputs) if noise else None
    of_geometry = geometry_section(directory, geometry, inputs) if geometry else None
    sets = set_sections(files_below(directory, OVERVIEW_FILE))
    planes = read_planes(directory, results)
    shown, errors = plane_sections(planes, results.values()), error_sections(directory, planes)
    the_set = sets[0] if sets else None
    lead: ReconstructionRecord | SurfaceFileRecord = results[shown.best.path.parent] if shown.best else records[0]
    of_surfaces = surface_sections(directory, surfaces)
    facts = _light(the_set) if the_set else []
    if not planes:
        facts = [*of_surfaces[0].facts, *([] if facts else [_no_snr(the_set)]), *facts]
    facts.append(_poses_by_views(directory, lead) or _poses(lead, of_geometry, errors.geometry_off))
    facts += _noise(lead, of_noise, the_set)
    led_by = [plane for plane in planes if shown.best and plane.column == shown.best.column]
    if best := errors.of(led_by):
        values = ", ".join(figure(row.mse_texture) for row in best)
        depths = format_depths(units, *(row.depth_mm for row in best))
        facts.append(Fact("Mean square error", values, f"against the object, 0…1, at {depths}"))
    solved_planes = [plane for result in results.values() for plane in result.planes]
    channels = [channel for record in surfaces.values() for channel in record.surface.channels]
    page = template("report.html").render(
        title=_title(directory, results, surfaces),
        recommendation=_recommendation(results, surfaces),
        saturation=saturation_text([*solved_planes, *channels]),
        units=units,
        facts=facts,
        sets=sets,
        **vars(shown),
        viewer=viewer_of(planes, shown, the_set, surfaces),
        depth_maps=depth_sections(directory, results),
        surfaces=of_surfaces,
        noise=of_noise,
        geometry=of_geometry,
        **vars(errors),
        links=_links(directory),
        results=[
            _origin(directory, folder / RECONSTRUCTION_FILE, method_title(result.planes), result)
            for folder, result in results.items()
        ],
        surface_origins=[
            _origin(directory, folder / SURFACE_FILE, "Surface", made) for folder, made in surfaces.items()
        ],
    )
    path = directory / REPORT_FILE
    write_whole(path, page)
    return path


def _links(directory: Path) -> list[tuple[str, str]]:
    """Return the other pages in this folder or in folders around it: their names and addresses."""
    links = [("the paper's figures", "figures.html"), ("the folder above", f"../{REPORT_FILE}")]
    links += [
        (path.parent.relative_to(directory).as_posix(), path.relative_to(directory).as_posix())
        for path in files_below(directory, REPORT_FILE)
        if path.parent != directory
    ]
    return [(name, address) for name, address in links if (directory / address).is_file()]


def _origin(directory: Path, path: Path, method: str, record: ReconstructionRecord | SurfaceFileRecord) -> Origin:
    units = units_of(record)
    best_focus = record.best_focus if isinstance(record, ReconstructionRecord) else None
    return Origin(
        where=path.parent.relative_to(directory).as_posix(),
        method=method,
        written=f"{datetime.fromtimestamp(int(path.stat().st_mtime), UTC):%Y-%m-%d %H:%M:%S} UTC",
        options=dict(named_by(msgspec.to_builtins(record.options), units)),
        record=record,
        search=_describe_search(best_focus, units) if best_focus else None,
    )


def _describe_search(search: BestFocusRecord, units: StatedUnits) -> str:
    """Return in words how depths were found, and how often shuffled views agreed as well."""
    where = f"Depths found by comparing the views between {units.range_text(*search.searched_mm[0]).replace('-', '−')}"
    if search.p_value is UNSET or search.shuffles is UNSET or search.z_shuffled is UNSET:
        return f"{where}."
    as_well = round(search.p_value * (search.shuffles + 1)) - 1
    times = f"views shuffled {search.shuffles} times: {as_well or 'none'} agreed as well (p = {search.p_value:.2g})"
    return (
        f"{where}; {times}. The stated places are {figure(search.z_shuffled)} standard deviations of the shuffled "
        "better than their mean. This is about the set, not about each plane."
    )


def _recommendation(results: dict[Path, ReconstructionRecord], surfaces: dict[Path, SurfaceFileRecord]) -> str | None:
    """Return a sentence on the mode that suits the scene, by the first search for its depths that tells one.

    A surface that does not explain its views recommends nothing, and no mode is recommended that the page shows.
    """
    searches: list[StatedShares] = [
        found for result in results.values() for found in (result.depth_map, result.best_focus) if found
    ]
    searches += [record.surface for record in surfaces.values() if record.surface.warning is None]
    used: list[Mode] = ["surface"] if surfaces else []
    if any(plane.method == "occlusion" for result in results.values() for plane in result.planes):
        used.append("occlusion")
    return next((advice for record in searches if (advice := recommendation(record, used))), None)


def _title(directory: Path, results: dict[Path, ReconstructionRecord], surfaces: dict[Path, SurfaceFileRecord]) -> str:
    records = [plane for result in results.values() for plane in result.planes]
    depths = sorted({record.depth_mm for record in at_depths(records)})
    units = units_of(next(iter(results.values()), None))
    planes = format_depths(units, *depths, join=" and ")
    if len(depths) > 2:
        ends = units.numbers_text([depths[0], depths[-1]], " to ").replace("-", "−")
        planes = f"{len(depths)} {'relative ' if units.depth == 'relative' else ''}{units.quantities}, {ends}"
    parts = [f"planes at {planes}"] if depths else []
    parts += list(dict.fromkeys(f"plane {record.name}" for record in records if record.rt_ref_plane is not UNSET))
    parts += ["a surface" if len(surfaces) == 1 else f"{len(surfaces)} surfaces"] if surfaces else []
    return f"{_name(directory.resolve())}: {', '.join(parts)}"


def _name(folder: Path) -> str:
    """Return the name of the set reconstructed in a folder; for one set of a session, the names of both."""
    if folder.name == RECONSTRUCTIONS:
        return folder.parent.name
    return f"{folder.parent.parent.name}, {folder.name}" if folder.parent.name == RECONSTRUCTIONS else folder.name


def _light(the_set: SetSection) -> list[Fact]:
    light = the_set.overview.brightness
    if light.snr is None or the_set.noise_free:
        return []
    means = f"eq. (4): {light.region} against {light.noise_from}"
    means += "; the noise of darkness hardly counts" if light.snr > MAX_SNR else ""
    facts = [Fact("SNR of a view", snr_text(light.snr), means)]
    units = units_of(the_set.overview)
    if units.light != "electrons":
        value = f"{figure(light.mean_signal_e)} {units.light_per_pixel}"
        meaning = f"{light.region}, above the dark level; the gain is not known"
        facts.append(Fact("Mean light of a view", value, meaning))
    elif light.photons_from_moments is not None:
        value = f"{figure(light.photons_from_moments)} photons/px"
        facts.append(Fact("Light", value, f"from moments; {figure(light.photons_linear)} by the paper’s eq. (7)"))
    elif light.electrons_from_moments is not None:
        value = f"{figure(light.electrons_from_moments)} e⁻/px"
        reason = "the quantum efficiency is not known, so that this is no number of photons"
        facts.append(Fact("Light", value, f"from moments; {figure(light.electrons_linear)} by eq. (7); {reason}"))
    return facts


def _no_snr(the_set: SetSection | None) -> Fact:
    if the_set is None:
        return Fact("SNR of a view", "–", "not recorded by the version that made this surface; reconstruct again")
    return Fact("SNR of a view", "–", "the views are stated to have no noise")


def _poses(
    lead: ReconstructionRecord | SurfaceFileRecord,
    geometry: GeometrySection | None,
    against_truth: GeometryErrors | None,
) -> Fact:
    """Return the poses that a result was made with, as its record says, with their σ if geometry.json is at hand."""
    poses = lead.options.poses
    if poses != "measured" or geometry is None or not geometry.used:
        scale = "" if units_of(lead).depth == "mm" else "; their scale is not known"
        return Fact("Poses", "as stated" if poses == "stated" else poses, _POSES[poses] + scale)
    record = geometry.record
    sigma_mm = [node.sigma_mm for node in record.nodes if node.node != record.reference_node]
    known = f"± {_length(float(np.sqrt(np.mean(np.square(sigma_mm))))) if sigma_mm else '–'}"
    means = f"σ of a node’s position, of {len(record.nodes)} nodes"
    if (off := record.stage.node_residual_rms_mm.value) is not None:
        means += f"; they lie {_length(off)} rms off a regular grid"
    if against_truth:
        means += f". Against the truth: {_length(against_truth.centre_rms_mm)} rms"
    return Fact("Poses, measured", known, means)


def _poses_by_views(directory: Path, lead: ReconstructionRecord | SurfaceFileRecord) -> Fact | None:
    """Return how well the poses by the views are known, None if it was not made with these or their record is away."""
    path = find_calibration(directory, f"{ALIGNMENT_FOLDER}/{GEOMETRY_FILE}")
    if lead.options.poses != "aligned" or path is None or sha256(path) not in lead.inputs.values():
        return None
    record = read_geometry(path, AlignmentRecord)
    depth, sigma_px = max(record.transfer_sigma_px.items(), key=lambda item: item[1])
    return Fact("Poses, by the views", f"± {figure(sigma_px, 2)} px", f"σ of the transfer between views at {depth}")


def _noise(
    lead: ReconstructionRecord | SurfaceFileRecord, noise: NoiseSection | None, the_set: SetSection | None
) -> list[Fact]:
    """Return the read noise that a result was made with, as its record says, from noise.json if that is at hand."""
    if noise is not None and noise.used:
        read, dark = noise.record.read_noise_e, noise.record.dark_current_e_per_s
        means = [f"± {figure(read.se, 2)}"] if read.se else []
        means += [] if dark.value is None else [f"dark current {figure(dark.value)} e⁻/s"]
        return [Fact("Read noise, measured", f"{figure(read.value)} e⁻", "; ".join(means))]
    if the_set is None or the_set.noise_free:
        return []
    units = units_of(the_set.overview)
    says = "as the set states it" if units.light == "electrons" else "estimated, not measured"
    if any(Path(name).name == NOISE_FILE for name in lead.inputs):
        says = f"measured; its uncertainty is in the {NOISE_FILE} that was used, which is not here"
    return [Fact("Read noise", f"{figure(the_set.overview.read_noise_e)} {units.light_symbol}", says)]


def _length(length_mm: float) -> str:
    return f"{figure(length_mm)} mm" if length_mm >= 0.1 else f"{figure(1e3 * length_mm)} µm"
