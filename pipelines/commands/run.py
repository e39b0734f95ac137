"""`faintfield run`: everything after the capture of a session, only what is out of date."""

from pathlib import Path

from faintfield.pipelines.arguments import Count, LensName, NotNegative, Positive
from faintfield.pipelines.commands.reconstruct import reconstruct_and_report
from faintfield.pipelines.errors import MissingFile, WrongUsage
from faintfield.pipelines.formats.results.geometry import DEFAULT_DEPTHS_MM, GEOMETRY_FILE
from faintfield.pipelines.formats.results.noise import NOISE_FILE
from faintfield.pipelines.formats.results.overview import OVERVIEW_FILE
from faintfield.pipelines.formats.results.records import RECONSTRUCTION_FILE, REPORT_FILE, Method
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, files_of_scene, load_session
from faintfield.pipelines.pages.report import write_report
from faintfield.pipelines.reconstruction.planes import Settings
from faintfield.pipelines.reconstruction.request import (
    DEFAULT_METHOD,
    Request,
    distinct_depths,
    folder_of_method,
    swept_depths,
)
from faintfield.pipelines.reconstruction.steps import RunOutcome, Step, run_steps
from faintfield.rig.session.session import PLAN, has_session, read_plan, taken_frames


def run(
    session: Path,
    /,
    *,
    depth_mm: list[Positive] | None = None,
    sweep_mm: str | None = None,
    method: list[Method] | None = None,
    penalty_weight: NotNegative | None = None,
    passes: Count | None = None,
    pitch_mm: Positive | None = None,
    lens: LensName = "opencv5",
    limit_px: Positive = 0.5,
) -> RunOutcome:
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
    method
        Method of reconstruction, as for `reconstruct`; repeat it for further methods.
    penalty_weight
        β of the paper; by default pmlem chooses it by cross-validation, pmlem-osl from the noise level.
    passes
        Largest number of passes over the data.
    pitch_mm
        Distance between samples of a plane; by default one detector pixel of the reference view.
    lens
        Distortion model, as for `geometry`.
    limit_px
        Largest accepted standard deviation of the transfer between views, as for `geometry`.
    """
    if not has_session(session):
        raise MissingFile(f"{session}: holds no session; name the folder of one, or capture it first")
    swept = swept_depths(sweep_mm) if sweep_mm else []
    depths = distinct_depths([*(depth_mm or ([] if swept else read_plan(session).rig.scene.depth_mm)), *swept])
    if not depths:
        raise WrongUsage(
            "no plane is asked for; give --depth-mm or --sweep-mm FIRST:LAST:COUNT, or state [scene] "
            "depth_mm in the rig.toml before a capture"
        )
    request = Request(depths, method or [DEFAULT_METHOD], Settings(penalty_weight, passes), pitch_mm, bool(swept))
    return run_steps(session, session_steps(session, request, lens, limit_px))


def session_steps(session: Path, request: Request, lens: LensName = "opencv5", limit_px: float = 0.5) -> list[Step]:
    """Return the steps from a captured session to the planes of a request, in order."""
    # Depths of the rig, not of the request: the geometry stays the same for other planes
    gated_mm = list(read_plan(session).rig.scene.depth_mm or DEFAULT_DEPTHS_MM)

    def measure_noise() -> None:
        from faintfield.pipelines.commands.noise import noise  # the fitting is heavy to load, and most runs need none

        noise(session)

    def measure_geometry() -> None:
        from faintfield.pipelines.commands.geometry import geometry  # likewise

        geometry(session, lens=lens, depth_mm=gated_mm, limit_px=limit_px)

    return [
        Step(
            "noise",
            results={NOISE_FILE: {}},
            make=measure_noise,
            inputs=lambda: _frames(session, "dark", "flat"),
        ),
        Step(
            "geometry",
            results={GEOMETRY_FILE: {"lens": lens, "depth_mm": gated_mm, "limit_px": limit_px}},
            make=measure_geometry,
            inputs=lambda: _frames(session, "charuco"),
        ),
        *_steps_of_request(session, request),
    ]


def _steps_of_request(session: Path, request: Request) -> list[Step]:
    """Return the steps from a calibrated session to the planes and the report."""
    out = session / RECONSTRUCTIONS
    folders = {name: folder_of_method(Path(RECONSTRUCTIONS), name, request.methods) for name in request.methods}
    return [
        Step(
            "reconstruct",
            results={
                str(folder / RECONSTRUCTION_FILE): request.options(name, "measured") for name, folder in folders.items()
            }
            | {f"{RECONSTRUCTIONS}/{OVERVIEW_FILE}": None},
            make=lambda: reconstruct_and_report(load_session(session), out, request),
            needs=("noise", "geometry"),
            inputs=lambda: files_of_scene(session, "dark_scene"),
        ),
        Step(
            "report",
            results={f"{RECONSTRUCTIONS}/{REPORT_FILE}": None},
            make=lambda: write_report(out),
            needs=("reconstruct",),
        ),
    ]


def _frames(session: Path, *kinds: str) -> list[str]:
    """Return the names of the plan and of the frames of some kinds that count."""
    return [PLAN, *(str(path.relative_to(session)) for it, _, path in taken_frames(session) if it.kind in kinds)]
