"""From a captured session to its results: each step is done only if its results are out of date; `faintfield run`."""

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cache, partial
from pathlib import Path

import msgspec

from faintfield.pipelines.arguments import LensName
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import NAMED_FAILURES, MissingFile, WrongUsage
from faintfield.pipelines.formats.files import Hashes, exclusive
from faintfield.pipelines.formats.provenance import first_difference, provenance
from faintfield.pipelines.formats.reading import JSON_FAILURES, read_content
from faintfield.pipelines.formats.results.figures import OVERVIEW_FILE
from faintfield.pipelines.formats.results.geometry import DEFAULT_DEPTHS_MM, GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, REPORT_FILE, ReconstructionRecord
from faintfield.pipelines.formats.results.surface import SURFACE_FILE
from faintfield.pipelines.formats.results.verification import is_record, records_of, verify_results
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, files_of_scene
from faintfield.pipelines.formats.units import record_of
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.reconstruction.options import OF_PLANES, PLACES, Options
from faintfield.pipelines.reconstruction.planes.sweep import Runner
from faintfield.pipelines.reconstruction.planes.workers import make_runner
from faintfield.pipelines.reconstruction.request import (
    Selection,
    distinct_depths,
    folder_of_method,
    resolve,
    select_planes,
)
from faintfield.pipelines.reconstruction.surface.request import SURFACE_FOLDER, SurfaceRequest, select_surface
from faintfield.pipelines.workflows.geometry import measure_stage
from faintfield.pipelines.workflows.noise import measure_sensor
from faintfield.pipelines.workflows.reconstruct import open_set, reconstruct_and_report, surface_and_report
from faintfield.rig.session.resume import present_settings
from faintfield.rig.session.session import PLAN, has_session, taken_frames

# The calibrated session, and the folder of its results.
type Opened = Callable[[], tuple[ElementalSet, Path]]


@dataclass(frozen=True)
class Step:
    """One thing that is made from a session.

    Attributes
    ----------
    results : dict of str to callable
        Returns the options, a mapping or Struct, that each result file would have if it were up to date; None for a
        file that records none. It is called when the file exists and the steps that this one needs are done.
    needs : tuple of str
        Names of the steps whose results it reads.
    inputs : callable
        Returns the names of all files that it reads.
    command : str, optional
        The command that does it alone, which its results record; by default named as the step.
    """

    name: str
    results: Mapping[str, Callable[[], object] | None]
    make: Callable[[], object]
    needs: tuple[str, ...] = ()
    inputs: Callable[[], Sequence[str]] = tuple
    command: str | None = None


class StepOutcome(msgspec.Struct, frozen=True):
    """A step, whether it was run, and why."""

    step: str
    ran: bool
    why: str


class RunOutcome(msgspec.Struct, frozen=True):
    """The result of `faintfield run`."""

    session: str
    report: str
    steps: list[StepOutcome]
    altered_frames: list[str]


def run_session(session: Path, options: Options, lens: LensName = "opencv5", limit_px: float = 0.5) -> RunOutcome:
    """Make the results of a session that the options ask for, as far as they are out of date; by default its planes.

    Raises
    ------
    MissingFile, WrongUsage
        There is no session, or neither options nor its rig.toml say what to reconstruct.
    """
    if not has_session(session):
        raise MissingFile(f"{session}: holds no session; name the folder of one, or capture it first")
    if not options.given(PLACES):
        options = replace(options, depth_mm=[*present_settings(session).scene.depth_mm])
    surface = select_surface(options)
    planes = None
    if options.given(PLACES):
        planes = select_planes(options)
        # A session is in mm: what is wrong with its depths is found before it is calibrated
        distinct_depths(planes.numbers("mm", "own"))
    elif surface is None or options.given(OF_PLANES):
        raise WrongUsage(
            "no plane is asked for; give --depth-mm or --sweep-mm FIRST:LAST:COUNT, or state [scene] depth_mm in the "
            "rig.toml before a capture, or give --surface without options of planes"
        )
    runner = make_runner(options.workers, options.scheduler)
    return run_steps(session, session_steps(session, planes, surface, runner, lens=lens, limit_px=limit_px))


def run_steps(session: Path, steps: Sequence[Step]) -> RunOutcome:
    """Do the steps that are out of date, in order, except those that need one that failed.

    Raises
    ------
    RigError, CalibrationError, ReconstructionError, InputError
        The first failure, after all other steps were done.
    """
    folders = {session, *((session / file).parent for step in steps for file in step.results)}
    for folder in sorted(folders, reverse=True):  # the inner ones first, as one that is empty is not kept
        with exclusive(folder):
            pass  # removes what a killed command left there, even if all steps are up to date
    hashes = Hashes(session)
    altered = _altered_frames(session, hashes)
    done: list[StepOutcome] = []
    failed: dict[str, Exception] = {}
    for step in steps:
        if missing := [name for name in step.needs if name in failed]:
            failed[step.name] = failed[missing[0]]
            inform(f"{step.name}: skipped, because it needs {missing[0]}")
            continue
        try:
            reason = _out_of_date(session, step, hashes)
            inform(f"{step.name}: {reason or 'up to date'}")
            if reason is not None:
                step.make()
        except NAMED_FAILURES as failure:
            failed[step.name] = failure
            inform(f"{step.name}: failed: {failure}")
        else:
            done.append(StepOutcome(step.name, reason is not None, reason or "up to date"))
    hashes.save()
    for first in failed.values():
        again = f"mend that and run `faintfield run {session}` again; still to be done: {', '.join(failed)}"
        raise type(first)(f"{first}; {again}") from first
    return RunOutcome(str(session), str(session / RECONSTRUCTIONS / REPORT_FILE), done, altered)


def _altered_frames(session: Path, hashes: Hashes) -> list[str]:
    """Return the frames that are not as they were captured, and inform the user: results are made from them anyway."""
    altered = [
        path.relative_to(session).as_posix()
        for _, taken, path in taken_frames(session)
        if path.is_file() and hashes.of(path.relative_to(session).as_posix()) != taken.sha256
    ]
    if altered:
        inform(
            f"warning: {altered[0]} and {len(altered) - 1} other frames are not what was captured; results are made "
            f"from them as they are now. Restore them from a copy; `faintfield verify {session}` names the first"
        )
    return altered


def _out_of_date(session: Path, step: Step, hashes: Hashes) -> str | None:
    """Return why a step has to be done, None if its results are of its inputs, options and versions."""
    inputs: dict[str, str] = {}
    for name in step.inputs():
        if not (session / name).is_file():
            raise MissingFile(f"{session / name}: is missing; restore it from a copy")
        inputs[name] = hashes.of(name)
    for file, options in step.results.items():
        if not (session / file).is_file():
            return f"{file} does not exist yet"
        if problem := _problem_of(session / file):
            return problem.removeprefix(f"{session}/")
        if options is None:
            continue
        try:
            now = provenance(step.command or step.name, options(), inputs)
            difference = first_difference(read_content(session / file), now)
        except (MissingFile, *JSON_FAILURES):
            return f"{file} is damaged"
        if difference:
            return f"{file} was made with another {difference}"
    return None


def _problem_of(path: Path) -> str | None:
    """Return why a result does not stand, None if it does, or is none that vouches for itself."""
    if not is_record(path):
        return None
    verdict = verify_results(records_of(path))
    return next(iter(verdict.problems + verdict.unchecked), None)


def session_steps(
    session: Path,
    planes: Selection | None,
    surface: SurfaceRequest | None = None,
    runner: Runner | None = None,
    *,
    lens: LensName = "opencv5",
    limit_px: float = 0.5,
) -> list[Step]:
    """Return the steps from a captured session to the planes and the surface that are asked for, in order."""
    # Depths of the rig, not of the request: the geometry stays the same for other planes
    gated_mm = list(present_settings(session).scene.depth_mm or DEFAULT_DEPTHS_MM)
    opened = cache(lambda: open_set(session))  # not before it is calibrated
    made = [] if planes is None else [_step_of_planes(session, opened, planes, runner, with_report=surface is None)]
    if surface is not None:
        made.append(_step_of_surface(session, opened, surface))
    return [
        Step(
            "noise",
            results={NOISE_FILE: dict},
            make=lambda: measure_sensor(session),
            inputs=lambda: _frames(session, "dark", "flat"),
        ),
        Step(
            "geometry",
            results={GEOMETRY_FILE: lambda: {"lens": lens, "depth_mm": gated_mm, "limit_px": limit_px}},
            make=lambda: measure_stage(session, lens=lens, depth_mm=gated_mm, limit_px=limit_px),
            inputs=lambda: _frames(session, "charuco"),
        ),
        *made,
        Step(
            "report",
            results={f"{RECONSTRUCTIONS}/{REPORT_FILE}": None},
            make=lambda: write_report(session / RECONSTRUCTIONS),
            # Planes without their surface have a report; a surface writes its own
            needs=(made[0].name,),
        ),
    ]


def _step_of_planes(
    session: Path, opened: Opened, selection: Selection, runner: Runner | None, *, with_report: bool
) -> Step:
    folders = {folder_of_method(Path(RECONSTRUCTIONS), name, selection.methods): name for name in selection.methods}

    def options(folder: Path) -> object:
        earlier = record_of(read_content(session / folder / RECONSTRUCTION_FILE), ReconstructionRecord)
        elemental_set, out = opened()
        return resolve(selection, elemental_set, out, earlier).options(folders[folder], elemental_set.poses)

    def make() -> object:
        elemental_set, out = opened()
        request = resolve(selection, elemental_set, out)
        return reconstruct_and_report(elemental_set, out, request, runner, with_report=with_report)

    return Step(
        "reconstruct",
        results={str(folder / RECONSTRUCTION_FILE): partial(options, folder) for folder in folders}
        | {f"{RECONSTRUCTIONS}/{OVERVIEW_FILE}": None},
        make=make,
        needs=("noise", "geometry"),
        inputs=lambda: files_of_scene(session, "dark_scene"),
    )


def _step_of_surface(session: Path, opened: Opened, selection: SurfaceRequest) -> Step:
    def options() -> object:
        elemental_set, _ = opened()
        return selection.options(elemental_set)

    def make() -> object:
        elemental_set, out = opened()
        return surface_and_report(elemental_set, out / SURFACE_FOLDER, selection, page_in=out)

    return Step(
        "surface",
        command="reconstruct",
        results={f"{RECONSTRUCTIONS}/{SURFACE_FOLDER}/{SURFACE_FILE}": options},
        make=make,
        needs=("noise", "geometry"),
        inputs=lambda: files_of_scene(session, "dark_scene"),
    )


def _frames(session: Path, *kinds: str) -> list[str]:
    return [PLAN, *(path.relative_to(session).as_posix() for it, _, path in taken_frames(session) if it.kind in kinds)]
