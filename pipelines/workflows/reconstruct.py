"""Planes or a surface of a set or session, with the report: `faintfield reconstruct`."""

import re
import time
from contextlib import ExitStack
from pathlib import Path

import msgspec
from msgspec import UNSET

from faintfield.pipelines.arguments import SceneKind
from faintfield.pipelines.console import inform, working
from faintfield.pipelines.errors import OutputExists, WrongUsage
from faintfield.pipelines.formats.files import UNFINISHED, check_results_folder, exclusive, files_below, shared
from faintfield.pipelines.formats.results.records import JOINT_METHODS, RECONSTRUCTION_FILE, REPORT_FILE
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, check_exists, load_set
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, load_session, with_measured_geometry
from faintfield.pipelines.reconstruction.channels import keeping_frames
from faintfield.pipelines.reconstruction.depth.scene_structure import Mode, recommendation
from faintfield.pipelines.reconstruction.options import OF_PLANES, Options
from faintfield.pipelines.reconstruction.planes.forecast import Forecast, has_forecast
from faintfield.pipelines.reconstruction.planes.sweep import Part, Runner, run_serially
from faintfield.pipelines.reconstruction.planes.workers import make_runner
from faintfield.pipelines.reconstruction.request import Request, folder_of_method, resolve, select_planes
from faintfield.pipelines.reconstruction.run import (
    Outcome,
    forecast_set,
    reconstruct_part,
    reconstruct_set,
    refuse_surfaces,
)
from faintfield.pipelines.reconstruction.surface.reconstruct import reconstruct_surface
from faintfield.pipelines.reconstruction.surface.request import SURFACE_FOLDER, SurfaceRequest, select_surface
from faintfield.rig.session.session import has_session


def reconstruct_folder(
    folder: Path,
    out: Path | None,
    options: Options,
    geometry: Path | None = None,
    scene: SceneKind = "dark_scene",
    part: Part | None = None,
) -> Outcome:
    """Reconstruct what the options ask of a set or session, and write the report; or a part of the planes only.

    Raises MissingFile if there is no such folder, and WrongUsage if options contradict one another, or no folder for
    the results is known.
    """
    check_exists(folder)
    if options.surface and (of_planes := options.given(OF_PLANES)):
        raise WrongUsage(
            f"--surface makes one picture at all depths, and {' and '.join(of_planes)} would have no effect; leave it "
            "out, or reconstruct planes in a call of their own"
        )
    surface = select_surface(options)
    if surface is not None:
        if part:
            raise WrongUsage("--surface makes one picture, which has no --part; leave one out")
        elemental_set, page_in = open_set(folder, out, scene, geometry)
        out = out or page_in / SURFACE_FOLDER
        return surface_and_report(elemental_set, out, surface, page_in=page_in)
    runner = make_runner(options.workers, options.scheduler)
    planes = select_planes(options)
    if part and (joint := [method for method in planes.methods if method in JOINT_METHODS]):
        raise WrongUsage(f"{joint[0]} solves all planes together, which have no --part; leave one out")
    elemental_set, out = open_set(folder, out, scene, geometry)
    # Before depths are searched
    if part is None:
        check_results_folder(out)
    elif planes.auto or planes.auto_sweep:
        inform("each part searches the depths again; give those that one search finds to save that time")
    if options.depth_map:
        refuse_surfaces(folder_of_method(out, method, planes.methods) for method in planes.methods)
    request = resolve(planes, elemental_set, out)
    if part is None:
        return reconstruct_and_report(elemental_set, out, request, runner)
    # One process for each part, whose name a killed one leaves behind for the next whole command to remove
    with shared(out), exclusive(out / f".part_{part.number}_of_{part.count}{UNFINISHED}"):
        return reconstruct_part(elemental_set, out, request, part, runner)


def forecast_folder(
    folder: Path, out: Path | None, options: Options, geometry: Path | None, scene: SceneKind, part: Part | None
) -> Forecast:
    """Say what the planes that the options ask for, or a part of them, would take on this computer; write nothing.

    Raises WrongUsage for what has no forecast: planes found together, depths that must be searched, a surface, and
    several processes.
    """
    check_exists(folder)
    without = [name for name in ("surface", "depth_map", "workers", "scheduler") if getattr(options, name)]
    if without:
        raise WrongUsage(f"--dry-run knows no time of --{without[0].replace('_', '-')}; leave one out")
    planes = select_planes(options)
    if planes.auto or planes.auto_sweep:
        raise WrongUsage("--dry-run does not search depths; give those of the planes, or a sweep from one to another")
    if not has_forecast(planes.methods):
        raise WrongUsage("--dry-run knows no time of planes that are solved together; give another --method")
    elemental_set, out = open_set(folder, out, scene, geometry)
    found = forecast_set(elemental_set, out, resolve(planes, elemental_set, out), part)
    inform(str(found))
    return found


def parse_part(text: str) -> Part:
    """Return the part I/N of a sweep: WrongUsage unless 1 ≤ I ≤ N."""
    numbers = re.fullmatch(r"(\d{1,6})/(\d{1,6})", text)
    part = Part(int(numbers[1]), int(numbers[2])) if numbers else None
    if part is None or not 1 <= part.number <= part.count:
        raise WrongUsage(f"--part {text}: is no part I/N of a sweep, with I from 1 to N; give such as 3/16")
    return part


def reconstruct_and_report(
    elemental_set: ElementalSet, out: Path, request: Request, runner: Runner | None = None, *, with_report: bool = True
) -> Outcome:
    """Reconstruct planes of a set into `out`, and write the report of them unless something else follows into it."""
    started = time.monotonic()
    report = out / REPORT_FILE
    with exclusive(out):
        outcome = reconstruct_set(elemental_set, out, request, runner or run_serially)
        if with_report:
            _write_report(out)
    planes = len({record.file for record in outcome.planes})
    inform(f"{planes} plane(s) in {time.monotonic() - started:.1f} s: {report if with_report else out}")
    if outcome.recommendation:
        inform(outcome.recommendation)
    return msgspec.structs.replace(outcome, report=str(report))


def surface_and_report(elemental_set: ElementalSet, out: Path, request: SurfaceRequest, *, page_in: Path) -> Outcome:
    """Reconstruct the surface of a set into `out`, and write the report of all that is in `page_in`, the same or above.

    Raises OutputBusy if another command is writing to one of the two.
    """
    started = time.monotonic()
    with ExitStack() as locks:
        for folder in dict.fromkeys((page_in, out)):
            locks.enter_context(exclusive(folder))
        record = reconstruct_surface(elemental_set, out, request, pages=(page_in / REPORT_FILE, out / REPORT_FILE))
        report = _write_report(page_in)
    sure = f"{record.sure_share:.0%} of its depths sure"
    inform(f"a surface in {time.monotonic() - started:.1f} s, {sure}: {report}")
    used: tuple[Mode, ...] = ("surface",)
    alone = not files_below(page_in, RECONSTRUCTION_FILE)  # planes on the same page recommend
    advice = recommendation(record, used) if alone and record.warning is None else None
    if last := record.warning or record.remark or advice:
        inform(last)
    return Outcome(
        out=str(out),
        report=str(report),
        planes=[],
        surface=record,
        surface_warning=record.warning or UNSET,
        recommendation=advice or UNSET,
        units=elemental_set.units,
    )


def _write_report(folder: Path) -> Path:
    from faintfield.pipelines.pages.report import write_report  # Matplotlib's memory is needed after that of the images

    with working("writing the report"):
        return write_report(folder)


def open_set(
    folder: Path,
    out: Path | None = None,
    scene: SceneKind = "dark_scene",
    geometry: Path | None = None,
    *,
    aligned: bool = True,
) -> tuple[ElementalSet, Path]:
    """Return a set, or that of a session, and the folder of its results: for a session by default that of the scene.

    The poses are those by which its views were `aligned`, if they were, unless a geometry.json is given.
    """
    if has_session(folder):
        elemental_set = load_session(folder, scene, geometry, aligned=aligned)
        out = out or folder / RECONSTRUCTIONS / ("" if scene == "dark_scene" else scene)
    else:
        if scene != "dark_scene":
            raise WrongUsage(f"--scene {scene} names a set of a session, and {folder} is a set itself; leave it out")
        elemental_set = load_set(folder, aligned=aligned and geometry is None)
        if out is None:
            raise WrongUsage("no folder for the results is named; give --out")
        elemental_set = elemental_set if geometry is None else with_measured_geometry(elemental_set, geometry)
    if out.resolve() == elemental_set.folder.resolve():
        raise OutputExists(f"{out}: is the folder of the images, and results would lie among them; name another --out")
    return keeping_frames(elemental_set, out), out
