"""`faintfield run`: everything after the capture of a session, only what is out of date."""

from collections.abc import Callable
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Positive
from faintfield.pipelines.choices import LensName
from faintfield.pipelines.commands.geometry import geometry
from faintfield.pipelines.commands.noise import noise
from faintfield.pipelines.commands.reconstruct import open_set, reconstruct_and_report, surface_and_report
from faintfield.pipelines.errors import MissingFile, WrongUsage
from faintfield.pipelines.reconstruction.options import DEFAULTS, OF_PLANES, PLACES, Options

if TYPE_CHECKING:
    from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
    from faintfield.pipelines.reconstruction.request import Selection
    from faintfield.pipelines.reconstruction.steps import RunOutcome, Step
    from faintfield.pipelines.reconstruction.surface_request import SurfaceSelection
    from faintfield.pipelines.reconstruction.sweep import Runner


# The calibrated session, and the folder of its results.
type Opened = Callable[[], tuple[ElementalSet, Path]]

type Result = RunOutcome


def run(
    session: Path,
    /,
    *,
    options: Options = DEFAULTS,
    lens: LensName = "opencv5",
    limit_px: Positive = 0.5,
) -> Result:
    """Do everything after the capture: noise, geometry, reconstruction, report; skip what is up to date.

    A result is up to date while its input files (by hash), its options and the versions of the software are those that
    it records. If a step fails, the results of the others are kept. Options of the reconstruction are those of
    `reconstruct`; planes are by default at the depths under [scene] in the rig.toml.

    Parameters
    ----------
    session
        Folder of the session.
    lens
        Distortion model, as for `geometry`.
    limit_px
        Largest accepted standard deviation of the transfer between views, as for `geometry`.
    """
    # Of `reconstruct`, three options have no place here: --out, as results lie in the session; --geometry, which is
    # measured; and --scene, as the page is that of the dark scene. The bright one is reconstructed by `reconstruct`
    from faintfield.pipelines.reconstruction.cluster import make_runner
    from faintfield.pipelines.reconstruction.request import distinct_depths, select_planes
    from faintfield.pipelines.reconstruction.steps import run_steps
    from faintfield.pipelines.reconstruction.surface_request import select_surface
    from faintfield.rig.session.changes import present_settings
    from faintfield.rig.session.session import has_session

    if not has_session(session):
        raise MissingFile(f"{session}: holds no session; name the folder of one, or capture it first")
    if not options.given(PLACES):
        options = replace(options, depth_mm=[*present_settings(session).scene.depth_mm])
    surface = select_surface(options)
    planes = None
    if options.given(PLACES):
        planes = select_planes(options)
        # A session is in mm: what is wrong with its depths is found before it is calibrated
        distinct_depths([*planes.depths_mm, *planes.own, *planes.swept_mm, *planes.own_swept])
    elif surface is None or options.given(OF_PLANES):
        raise WrongUsage(
            "no plane is asked for; give --depth-mm or --sweep-mm FIRST:LAST:COUNT, or state [scene] depth_mm in the "
            "rig.toml before a capture, or give --surface without options of planes"
        )
    runner = make_runner(options.workers, options.scheduler)
    return run_steps(session, session_steps(session, planes, surface, runner, lens=lens, limit_px=limit_px))


def session_steps(
    session: Path,
    planes: "Selection | None",
    surface: "SurfaceSelection | None" = None,
    runner: "Runner | None" = None,
    *,
    lens: LensName = "opencv5",
    limit_px: float = 0.5,
) -> "list[Step]":
    """Return the steps from a captured session to the planes and the surface that are asked for, in order."""
    from faintfield.pipelines.formats.results.geometry import DEFAULT_DEPTHS_MM, GEOMETRY_FILE
    from faintfield.pipelines.formats.results.noise import NOISE_FILE
    from faintfield.pipelines.formats.results.records import REPORT_FILE
    from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS
    from faintfield.pipelines.pages.report import write_report
    from faintfield.pipelines.reconstruction.steps import Step
    from faintfield.rig.session.changes import present_settings

    # Depths of the rig, not of the request: the geometry stays the same for other planes
    gated_mm = list(present_settings(session).scene.depth_mm or DEFAULT_DEPTHS_MM)
    opened = cache(lambda: open_set(session))  # not before it is calibrated
    made = [*_steps_of_planes(session, opened, planes, runner), *_steps_of_surface(session, opened, surface)]

    return [
        Step(
            "noise",
            results={NOISE_FILE: dict},
            make=lambda: noise(session),
            inputs=lambda: _frames(session, "dark", "flat"),
        ),
        Step(
            "geometry",
            results={GEOMETRY_FILE: lambda: {"lens": lens, "depth_mm": gated_mm, "limit_px": limit_px}},
            make=lambda: geometry(session, lens=lens, depth_mm=gated_mm, limit_px=limit_px),
            inputs=lambda: _frames(session, "charuco"),
        ),
        *made,
        Step(
            "report",
            results={f"{RECONSTRUCTIONS}/{REPORT_FILE}": None},
            make=lambda: write_report(session / RECONSTRUCTIONS),
            needs=tuple(step.name for step in made),
        ),
    ]


def _steps_of_planes(
    session: Path, opened: "Opened", selection: "Selection | None", runner: "Runner | None"
) -> "list[Step]":
    """Return the step from a calibrated session to its planes, if any are asked for."""
    from faintfield.pipelines.formats.reading import read_content
    from faintfield.pipelines.formats.results.overview import OVERVIEW_FILE
    from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, ReconstructionRecord
    from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, files_of_scene
    from faintfield.pipelines.formats.units import record_of
    from faintfield.pipelines.reconstruction.request import folder_of_method, resolve
    from faintfield.pipelines.reconstruction.steps import Step

    if selection is None:
        return []
    folders = {folder_of_method(Path(RECONSTRUCTIONS), name, selection.methods): name for name in selection.methods}

    def options(folder: Path) -> object:
        earlier = record_of(read_content(session / folder / RECONSTRUCTION_FILE), ReconstructionRecord)
        elemental_set, out = opened()
        return resolve(selection, elemental_set, out, earlier).options(folders[folder], elemental_set.poses)

    def make() -> object:
        elemental_set, out = opened()
        return reconstruct_and_report(elemental_set, out, resolve(selection, elemental_set, out), runner)

    return [
        Step(
            "reconstruct",
            results={str(folder / RECONSTRUCTION_FILE): partial(options, folder) for folder in folders}
            | {f"{RECONSTRUCTIONS}/{OVERVIEW_FILE}": None},
            make=make,
            needs=("noise", "geometry"),
            inputs=lambda: files_of_scene(session, "dark_scene"),
        )
    ]


def _steps_of_surface(session: Path, opened: "Opened", selection: "SurfaceSelection | None") -> "list[Step]":
    """Return the step from a calibrated session to its surface, if one is asked for."""
    from faintfield.pipelines.formats.results.surface import SURFACE_FILE
    from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, files_of_scene
    from faintfield.pipelines.reconstruction.steps import Step
    from faintfield.pipelines.reconstruction.surface_request import SURFACE_FOLDER

    if selection is None:
        return []

    def options() -> object:
        elemental_set, _ = opened()
        return selection.resolve(elemental_set).options(elemental_set.poses)

    def make() -> object:
        elemental_set, out = opened()
        return surface_and_report(elemental_set, out / SURFACE_FOLDER, selection.resolve(elemental_set), page_in=out)

    return [
        Step(
            "surface",
            command="reconstruct",
            results={f"{RECONSTRUCTIONS}/{SURFACE_FOLDER}/{SURFACE_FILE}": options},
            make=make,
            needs=("noise", "geometry"),
            inputs=lambda: files_of_scene(session, "dark_scene"),
        )
    ]


def _frames(session: Path, *kinds: str) -> list[str]:
    """Return the names of the plan and of the frames of some kinds that count."""
    from faintfield.rig.session.session import PLAN, taken_frames

    return [PLAN, *(str(path.relative_to(session)) for it, _, path in taken_frames(session) if it.kind in kinds)]
