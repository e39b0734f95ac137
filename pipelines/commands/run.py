"""`faintfield run`: everything after the capture of a session, only what is out of date."""

from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from faintfield.pipelines.arguments import Count, NotNegative, Positive
from faintfield.pipelines.choices import LensName, Method, PriorName
from faintfield.pipelines.commands.geometry import geometry
from faintfield.pipelines.commands.noise import noise
from faintfield.pipelines.commands.reconstruct import reconstruct_and_report, surface_and_report
from faintfield.pipelines.errors import MissingFile, WrongUsage

if TYPE_CHECKING:
    from faintfield.pipelines.reconstruction.request import Request
    from faintfield.pipelines.reconstruction.steps import RunOutcome, Step
    from faintfield.pipelines.reconstruction.surface_request import SurfaceRequest


type Result = RunOutcome


def run(
    session: Path,
    /,
    *,
    depth_mm: list[Positive] | None = None,
    sweep_mm: str | None = None,
    surface: bool = False,
    depth_range_mm: str | None = None,
    method: list[Method] | None = None,
    penalty_weight: NotNegative | None = None,
    prior: PriorName | None = None,
    passes: Count | None = None,
    pitch_mm: Positive | None = None,
    lens: LensName = "opencv5",
    limit_px: Positive = 0.5,
) -> Result:
    """Do everything after the capture: noise, geometry, reconstruction, report; skip what is up to date.

    A result is up to date while its input files (by hash), its options and the versions of the software are those that
    it records. If a step fails, the results of the others are kept.

    Parameters
    ----------
    session
        Folder of the session.
    depth_mm
        Depth of a plane; repeat it for further planes. By default, the depths under [scene] in the rig.toml.
    sweep_mm
        FIRST:LAST:COUNT: COUNT planes in equal steps of depth, with a curve of focus against depth.
    surface
        Also reconstruct one picture that is sharp everywhere, with the depth of each pixel, as `reconstruct --surface`
        does; its files are in reconstructions/surface.
    depth_range_mm
        NEAR:FAR: range of the surface's depths, such as 400:1500. By default it is found by comparing the views.
    method
        Method of reconstruction, as for `reconstruct`; repeat it for further methods.
    penalty_weight
        β of the paper; by default pmlem chooses it by cross-validation, pmlem-osl from the noise level.
    prior
        What is expected of a picture, as for `reconstruct`: auto by default, tv for sweeps.
    passes
        Largest number of passes over the data.
    pitch_mm
        Distance between samples of a plane; by default one detector pixel of the reference view.
    lens
        Distortion model, as for `geometry`.
    limit_px
        Largest accepted standard deviation of the transfer between views, as for `geometry`.
    """
    from faintfield.pipelines.reconstruction.given_sweeps import swept_depths
    from faintfield.pipelines.reconstruction.request import (
        DEFAULT_METHOD,
        Request,
        check_prior,
        chosen_prior,
        distinct_depths,
    )
    from faintfield.pipelines.reconstruction.solutions import Settings
    from faintfield.pipelines.reconstruction.steps import run_steps
    from faintfield.pipelines.reconstruction.surface_request import SurfaceRequest, select_surface
    from faintfield.rig.session.changes import present_settings
    from faintfield.rig.session.session import has_session

    if not has_session(session):
        raise MissingFile(f"{session}: holds no session; name the folder of one, or capture it first")
    swept = swept_depths(sweep_mm) if sweep_mm else []
    depths = distinct_depths([*(depth_mm or ([] if swept else present_settings(session).scene.depth_mm)), *swept])
    settings = Settings(penalty_weight, passes)
    relief = select_surface(surface, depth_range_mm, None, settings)
    if not depths and (relief is None or method or pitch_mm or prior):
        raise WrongUsage(
            "no plane is asked for; give --depth-mm or --sweep-mm FIRST:LAST:COUNT, or state [scene] depth_mm in the "
            "rig.toml before a capture, or give --surface without options of planes"
        )
    methods = method or [DEFAULT_METHOD]
    of_planes = replace(settings, prior=chosen_prior(prior, methods, settings, sweeps=bool(swept)))
    check_prior(methods, of_planes)
    planes = Request(depths, methods, of_planes, pitch_mm, bool(swept)) if depths else None
    asked = None if relief is None else SurfaceRequest(relief.range_mm, settings=settings)
    return run_steps(session, session_steps(session, planes, lens, limit_px, asked))


def session_steps(
    session: Path,
    planes: "Request | None",
    lens: LensName = "opencv5",
    limit_px: float = 0.5,
    surface: "SurfaceRequest | None" = None,
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

    return [
        Step(
            "noise",
            results={NOISE_FILE: {}},
            make=lambda: noise(session),
            inputs=lambda: _frames(session, "dark", "flat"),
        ),
        Step(
            "geometry",
            results={GEOMETRY_FILE: {"lens": lens, "depth_mm": gated_mm, "limit_px": limit_px}},
            make=lambda: geometry(session, lens=lens, depth_mm=gated_mm, limit_px=limit_px),
            inputs=lambda: _frames(session, "charuco"),
        ),
        *(made := [*_steps_of_planes(session, planes), *_steps_of_surface(session, surface)]),
        Step(
            "report",
            results={f"{RECONSTRUCTIONS}/{REPORT_FILE}": None},
            make=lambda: write_report(session / RECONSTRUCTIONS),
            needs=tuple(step.name for step in made),
        ),
    ]


def _steps_of_planes(session: Path, request: "Request | None") -> "list[Step]":
    """Return the step from a calibrated session to its planes, if any are asked for."""
    from faintfield.pipelines.formats.results.overview import OVERVIEW_FILE
    from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE
    from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, files_of_scene, load_session
    from faintfield.pipelines.reconstruction.request import folder_of_method
    from faintfield.pipelines.reconstruction.steps import Step

    if request is None:
        return []
    folders = {name: folder_of_method(Path(RECONSTRUCTIONS), name, request.methods) for name in request.methods}
    return [
        Step(
            "reconstruct",
            results={
                str(folder / RECONSTRUCTION_FILE): request.options(name, "measured") for name, folder in folders.items()
            }
            | {f"{RECONSTRUCTIONS}/{OVERVIEW_FILE}": None},
            make=lambda: reconstruct_and_report(load_session(session), session / RECONSTRUCTIONS, request),
            needs=("noise", "geometry"),
            inputs=lambda: files_of_scene(session, "dark_scene"),
        )
    ]


def _steps_of_surface(session: Path, request: "SurfaceRequest | None") -> "list[Step]":
    """Return the step from a calibrated session to its surface, if one is asked for."""
    from faintfield.pipelines.formats.results.surface import SURFACE_FILE
    from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, files_of_scene, load_session
    from faintfield.pipelines.reconstruction.steps import Step
    from faintfield.pipelines.reconstruction.surface_request import SURFACE_FOLDER

    if request is None:
        return []
    out = session / RECONSTRUCTIONS
    return [
        Step(
            "surface",
            command="reconstruct",
            results={f"{RECONSTRUCTIONS}/{SURFACE_FOLDER}/{SURFACE_FILE}": request.options("measured")},
            make=lambda: surface_and_report(load_session(session), out / SURFACE_FOLDER, request, page_in=out),
            needs=("noise", "geometry"),
            inputs=lambda: files_of_scene(session, "dark_scene"),
        )
    ]


def _frames(session: Path, *kinds: str) -> list[str]:
    """Return the names of the plan and of the frames of some kinds that count."""
    from faintfield.rig.session.session import PLAN, taken_frames

    return [PLAN, *(str(path.relative_to(session)) for it, _, path in taken_frames(session) if it.kind in kinds)]
