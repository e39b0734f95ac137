"""Reconstruct the planes of a request; write them, their provenance, their errors and the overview of the set."""

import shutil
import time
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path

import msgspec
from msgspec import UNSET, UnsetType

from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import BadValue, OutputExists
from faintfield.pipelines.formats.files import remove, remove_leftovers, require_room, write_record
from faintfield.pipelines.formats.plane_poses import Place
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.figures import METRICS_FILE, Metrics
from faintfield.pipelines.formats.results.plane_files import PARTS, Origin, PlaneFiles
from faintfield.pipelines.formats.results.records import (
    RECONSTRUCTION_FILE,
    REPORT_FILE,
    BestFocusRecord,
    DepthMapRecord,
    FocusCurve,
    Method,
    PlaneRecord,
    ReconstructionRecord,
)
from faintfield.pipelines.formats.results.stacks import STACK_FILE, write_stack
from faintfield.pipelines.formats.results.surface import SURFACE_FILE, SurfaceRecord
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, in_units, light_per_e, plane_stem
from faintfield.pipelines.formats.sets.ground_truth import read_truth
from faintfield.pipelines.formats.units import StatedUnits
from faintfield.pipelines.reconstruction.accuracy import assess, write_depth_errors
from faintfield.pipelines.reconstruction.channels import SHARE_OF_DISK
from faintfield.pipelines.reconstruction.depth.depth_map import kept_depth_map, write_depth_map
from faintfield.pipelines.reconstruction.depth.scene_structure import Mode, recommendation
from faintfield.pipelines.reconstruction.depth.search import check_overlap, check_views, depths_of_set
from faintfield.pipelines.reconstruction.operators import requested_grid
from faintfield.pipelines.reconstruction.overview import inspect_set, write_overview
from faintfield.pipelines.reconstruction.planes.forecast import Forecast, forecast
from faintfield.pipelines.reconstruction.planes.saturation import saturation_text
from faintfield.pipelines.reconstruction.planes.sweep import Part, PlaneTask, Runner, Sweep, run_serially
from faintfield.pipelines.reconstruction.request import Request, folder_of_method

# Planes whose mean is at most this, in electrons per pixel, count as black.
_BLACK_E = 1e-5


class Outcome(msgspec.Struct, frozen=True, kw_only=True):
    """Outcome of a reconstruction: the result of `faintfield reconstruct`, which adds the path of the report.

    `recommendation` is a sentence on the mode that suits the scene, if its depths were searched and tell one.
    """

    out: str
    report: str | UnsetType = UNSET
    planes: list[PlaneRecord]
    focus: FocusCurve | None = None
    best_focus: BestFocusRecord | None = None
    depth_map: DepthMapRecord | None = None
    metrics: Metrics | None = None
    surface: SurfaceRecord | UnsetType = UNSET
    surface_warning: str | UnsetType = UNSET
    units: StatedUnits | UnsetType = UNSET
    recommendation: str | UnsetType = UNSET


def reconstruct_set(elemental_set: ElementalSet, out: Path, request: Request, runner: Runner = run_serially) -> Outcome:
    """Reconstruct planes of a set, and write them with their provenance and their errors.

    Planes that exist and were made from the same files with the same options are kept. An earlier report is removed,
    since it shows other planes. The caller has `out` to itself, see `formats.files.exclusive`. Raises OutputExists if a
    depth map is asked for, and a folder of planes holds a surface, whose files have the same names.
    """
    started = time.monotonic()
    found = in_units(elemental_set, request.found) if request.found else None
    folders = {name: folder_of_method(out, name, request.methods) for name in request.methods}
    check_request(elemental_set, folders.values(), request)
    sweep = plan_sweep(elemental_set, folders, request)
    sweep.keep_finished()
    needed_bytes = sweep.needed_bytes()
    # Decoded frames take the rest
    require_room(out, int(needed_bytes / (1 - SHARE_OF_DISK)), written_bytes=needed_bytes)
    overview, pictures = inspect_set(elemental_set)  # what is wrong with a set is to be found before planes are made
    read_truth(elemental_set.folder)
    depth_map = kept_depth_map(folders, sweep.origins) if request.with_depth_map else None
    search = None
    if request.with_depth_map and depth_map is None:
        search = depths_of_set(elemental_set, _range_mm(request), out, "depth map")
    _make_planes(sweep, folders, out, runner)
    write_overview(overview, pictures, out)
    if search is not None:
        depth_map = write_depth_map(elemental_set, search, sweep.written, request.disparities_px, sweep.origins)
    if depth_map is not None:
        for folder in folders.values():
            write_depth_errors(elemental_set, folder, depth_map.file, depth_map.unit)
    # The truth has the default samples
    metrics = None if request.pitch_mm else assess(elemental_set, sweep.written, sweep.records)
    remove(out / METRICS_FILE)  # of earlier planes
    if metrics:
        write_record(out / METRICS_FILE, metrics)
    remove(out / REPORT_FILE)  # likewise
    focus, records = sweep.focus(), sweep.records
    for name, folder in folders.items():
        result = ReconstructionRecord(
            planes=[record for record in records if record.method == name],
            focus=focus,
            best_focus=found,
            depth_map=depth_map,
            wall_time_s=time.monotonic() - started,
            **msgspec.structs.asdict(sweep.origins[name]),
        )
        write_record(folder / RECONSTRUCTION_FILE, result)
        if not (request.with_focus and write_stack(folder, result.planes, elemental_set.units)):
            remove(folder / STACK_FILE)  # of an earlier sweep
        shutil.rmtree(folder / PARTS, ignore_errors=True)  # also those of another call that was interrupted
    warn_of(elemental_set, records)
    searched = depth_map or found
    used: tuple[Mode, ...] = ("occlusion",) if "occlusion" in folders else ()
    advice = recommendation(searched, used) if searched else None
    return Outcome(
        out=str(out), planes=records, focus=focus, best_focus=found, depth_map=depth_map, metrics=metrics,
        units=elemental_set.units, recommendation=advice or UNSET,
    )  # fmt: skip


def reconstruct_part(
    elemental_set: ElementalSet, out: Path, request: Request, part: Part, runner: Runner = run_serially
) -> Outcome:
    """Make a part of the planes of a request, of which other processes make the other parts at the same time.

    The planes are those of `reconstruct_set`, which later keeps them and writes all that is known of them together.
    The caller shares `out` with the other parts, see `formats.files.shared`.
    """
    folders = {name: folder_of_method(out, name, request.methods) for name in request.methods}
    sweep = plan_sweep(elemental_set, folders, request).part(part)
    sweep.keep_finished()
    planes = forecast(sweep) if runner is run_serially else f"{len(sweep.plan.grids)} plane(s)"
    inform(f"part {part}: {planes}")
    require_room(out, sweep.needed_bytes())
    for folder in folders.values():
        remove(folder / RECONSTRUCTION_FILE)
    sweep.run(runner, out)
    warn_of(elemental_set, sweep.records)
    return Outcome(out=str(out), planes=sweep.records, units=elemental_set.units)


def forecast_set(elemental_set: ElementalSet, out: Path, request: Request, part: Part | None = None) -> Forecast:
    """Return what the planes of a request that are missing would take on this computer, or those of a part of it."""
    folders = {name: folder_of_method(out, name, request.methods) for name in request.methods}
    check_request(elemental_set, folders.values(), request)
    sweep = plan_sweep(elemental_set, folders, request)
    sweep = sweep if part is None else sweep.part(part)
    sweep.keep_finished()
    return forecast(sweep)


def check_request(elemental_set: ElementalSet, folders: Iterable[Path], request: Request) -> None:
    """Refuse a pitch in mm for a set that knows no lengths, and sets and folders that can have no depth map."""
    if request.pitch_mm and elemental_set.units.depth == "disparity_px":
        raise BadValue(
            f"{elemental_set.folder}: knows disparities, no lengths; a pitch of {request.pitch_mm:g} means nothing; "
            "leave --pitch-mm out, or import the pictures again with the pitch of the nodes and the focal length"
        )
    if not request.with_depth_map:
        return
    refuse_surfaces(folders)
    check_views(elemental_set, "a depth map")
    check_overlap(elemental_set, _range_mm(request))


def refuse_surfaces(folders: Iterable[Path]) -> None:
    """Refuse folders that hold a surface, and so can hold no depth map (OutputExists)."""
    for folder in folders:
        if (folder / SURFACE_FILE).exists():
            raise OutputExists(
                f"{folder}: holds a surface, whose files have the names of the depth map's; give another --out"
            )


def _range_mm(request: Request) -> tuple[float, float]:
    return min(request.depths_mm), max(request.depths_mm)


def _make_planes(sweep: Sweep, folders: dict[Method, Path], out: Path, runner: Runner) -> None:
    """Write the planes that are missing, having removed the records that vouch for earlier ones."""
    for folder in {out, *folders.values()}:
        remove_leftovers(folder)
    for folder in folders.values():
        remove(folder / RECONSTRUCTION_FILE)
        if (folder / PARTS).is_symlink():  # parts are written and removed in this folder alone
            remove(folder / PARTS)
    try:
        sweep.run(runner, out)
    finally:
        for folder in folders.values():
            with suppress(OSError):
                (folder / PARTS).rmdir()  # stays while it holds colours of incomplete planes


def plan_sweep(
    elemental_set: ElementalSet,
    folders: dict[Method, Path],
    request: Request,
    keep: type[PlaneFiles] = PlaneFiles,
) -> Sweep:
    """Return the sweep of a request, whose planes are kept in files in the folder of their method, or elsewhere."""
    layouts = elemental_set.layouts
    places: list[Place] = [*request.depths_mm, *request.tilted]
    grids = {place: requested_grid(elemental_set, place, request.pitch_mm) for place in places}
    inputs = elemental_set.input_hashes()

    def origin(method: Method, place: Place | None = None) -> Origin:
        options = in_units(elemental_set, request.options(method, elemental_set.poses, place))
        return provenance("reconstruct", options, inputs, elemental_set.units)

    channels = tuple(layout.name for layout in layouts)
    files = tuple(
        keep(folder, name, place, channels, origin(name, place), plane_stem(elemental_set, place))
        for place in grids
        for name, folder in folders.items()
    )
    plan = PlaneTask(tuple(layouts), grids, files, request.solver, request.with_focus)
    return Sweep(elemental_set, plan, {name: origin(name) for name in folders})


def warn_of(elemental_set: ElementalSet, records: list[PlaneRecord]) -> None:
    """Say what is doubtful about planes: certificates that were missed, priors left out, saturation, darkness."""
    certificates = [record.certificate for record in records if record.certificate]
    steps = [certificate for certificate in certificates if certificate.oscillates is not UNSET]
    swings = [certificate.relative_change or 0.0 for certificate in steps if certificate.oscillates]
    if swings:
        inform(
            f"the one-step-late iteration does not settle on {len(swings)} of {len(steps)} planes: it swings by up to "
            f"{max(swings):.1%} per pass (see reconstruction.json). A few percent hide little; a smaller "
            "--penalty-weight calms it, and leaves more noise."
        )
    bounds = [certificate for certificate in certificates if certificate.is_bound]
    missed = [certificate.value or 0.0 for certificate in bounds if not certificate.reached]
    if missed:
        inform(
            f"pmlem stopped before its certificate on {len(missed)} of {len(bounds)} planes: up to {max(missed):.1%} "
            f"from the optimum instead of {bounds[0].tolerance:.0%}; allow more --passes"
        )
    early = [certificate for certificate in certificates if certificate.settled is False and certificate.tolerance]
    if early:
        inform(f"pmlem stopped early on {len(early)} of {len(certificates)} planes; allow more passes")
    whys = [(record, record.prior.left_out) for record in records if record.prior and record.prior.left_out]
    if whys:
        without = _planes([record for record, _ in whys])
        inform(f"the prior is left out of {without} of {_planes(records)} planes, total variation's stay: {whys[0][1]}")
    if text := saturation_text(records):
        inform(text)
    black = [record for record in records if record.mean_e <= _BLACK_E * light_per_e(elemental_set)]
    if black:
        first = elemental_set.units.depths_text([black[0].depth_mm])
        inform(
            f"{_planes(black)} of {_planes(records)} planes are black ({black[0].method}, {first} for "
            "one): the views are no brighter than offset_dn and dark_current_e_per_s say of darkness; compare these "
            "with dark frames of the same exposure"
        )


def _planes(records: list[PlaneRecord]) -> int:
    """Return the number of planes: one in colour has several records, and planes of several methods have one name."""
    return len({(record.method, record.file) for record in records})
