"""`faintfield run`: everything after the capture of a session, only what is out of date."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import msgspec

from faintfield.pipelines.arguments import Count, LensName, NotNegative, Positive
from faintfield.pipelines.commands.reconstruct import (
    DEFAULT_METHOD,
    Request,
    folder_of_method,
    options_of,
    reconstruct_set,
)
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import NAMED_FAILURES, MissingFile, WrongUsage
from faintfield.pipelines.formats.hashes import Hashes
from faintfield.pipelines.formats.provenance import first_difference, provenance
from faintfield.pipelines.formats.results.geometry import DEFAULT_DEPTHS_MM, GEOMETRY_FILE, GeometryRecord
from faintfield.pipelines.formats.results.noise import NOISE_FILE, NOISE_MAPS
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, files_of_scene, load_session
from faintfield.pipelines.pages.report import RECONSTRUCTION_FILE, REPORT_FILE, write_report
from faintfield.pipelines.reconstruction.depths import distinct_depths, swept_depths
from faintfield.pipelines.reconstruction.planes import Method, Settings
from faintfield.rig.session.access import has_session, read_plan, taken_frames
from faintfield.rig.session.session import PLAN


@dataclass(frozen=True)
class Step:
    """One thing that is made of a session.

    Attributes
    ----------
    name : str
        As the command that does it alone.
    needs : tuple of str
        The steps whose results it reads.
    inputs : callable
        Returns the names of all files that it reads.
    origins : dict of str to dict
        By result file: the options that it was made with, if it is up to date; None where its being there is enough.
    beside : callable
        Returns the names of the files that lie beside a result file, from its contents.
    make : callable
        Does it.
    """

    name: str
    needs: tuple[str, ...]
    inputs: Callable[[], Sequence[str]]
    origins: dict[str, dict[str, Any] | None]
    beside: Callable[[dict[str, Any]], Sequence[str]]
    make: Callable[[], object]


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
) -> dict[str, Any]:
    """Do everything after the capture: noise, geometry, reconstruction, report; only what is out of date.

    A result is up to date while the files that it was made from, its options and the versions of what made it are
    those that it names; files are compared by their hashes. What fails leaves the results of the rest in place.

    Parameters
    ----------
    session
        Its folder.
    depth_mm
        Depth of a plane; give it once per plane. By default those under [scene] in the rig.toml.
    sweep_mm
        FIRST:LAST:COUNT, that many planes in equal steps, with a curve of focus against depth.
    method
        How planes are reconstructed, as for `reconstruct`; give it once per method.
    penalty_weight
        The paper's β; chosen from the noise level by default.
    passes
        At most this many passes over the data.
    pitch_mm
        Distance of the plane's samples; by default one detector pixel of the reference view.
    lens
        Distortion model, as for `geometry`.
    limit_px
        How well the transfer between views must be known, as for `geometry`.
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
    out = session / RECONSTRUCTIONS
    # Not those of the request: other planes need no other geometry
    gated_mm = list(read_plan(session).rig.scene.depth_mm) or list(DEFAULT_DEPTHS_MM)
    of_geometry = {"lens": lens, "depth_mm": gated_mm, "limit_px": limit_px}
    folders = [(name, folder_of_method(out, name, request.methods)) for name in request.methods]
    records: dict[str, dict[str, Any] | None] = {
        str((folder / RECONSTRUCTION_FILE).relative_to(session)): options_of(name, request, "measured")
        for name, folder in folders
    }

    def measure_noise() -> None:
        from faintfield.pipelines.commands.noise import noise  # the fitting is heavy to load, and most runs need none

        noise(session)

    def measure_geometry() -> None:
        from faintfield.pipelines.commands.geometry import geometry  # likewise

        geometry(session, lens=lens, depth_mm=gated_mm, limit_px=limit_px)

    return [
        Step(
            "noise",
            (),
            lambda: _frames(session, "dark", "flat"),
            {NOISE_FILE: {}},
            lambda _: [NOISE_MAPS],
            measure_noise,
        ),
        Step(
            "geometry",
            (),
            lambda: _frames(session, "charuco"),
            {GEOMETRY_FILE: of_geometry},
            lambda content: msgspec.convert(content, GeometryRecord).files_beside(),
            measure_geometry,
        ),
        Step(
            "reconstruct",
            ("noise", "geometry"),
            lambda: files_of_scene(session, "dark_scene"),
            records,
            lambda content: [plane["file"] for plane in content["planes"]],
            lambda: reconstruct_set(load_session(session), out, request),
        ),
        Step(
            "report",
            ("reconstruct",),
            lambda: [],
            {f"{RECONSTRUCTIONS}/{REPORT_FILE}": None},
            lambda _: [],
            lambda: write_report(out),
        ),
    ]


def run_steps(session: Path, steps: Sequence[Step]) -> dict[str, Any]:
    """Make what is out of date, in order; what fails, or needs what failed, is left as it is.

    Raises
    ------
    RigError, CalibrationError, ReconstructionError, InputError
        The first failure, after all other steps were done.
    """
    hashes = Hashes(session)
    altered = _altered_frames(session, hashes)
    done: list[dict[str, Any]] = []
    failed: dict[str, Exception] = {}
    for step in steps:
        if missing := [name for name in step.needs if name in failed]:
            failed[step.name] = failed[missing[0]]
            inform(f"{step.name}: left as it is, for it needs {missing[0]}")
            continue
        try:
            why = _out_of_date(session, step, hashes)
            inform(f"{step.name}: {why or 'up to date'}")
            if why is not None:
                step.make()
        except NAMED_FAILURES as failure:
            failed[step.name] = failure
            inform(f"{step.name}: failed: {failure}")
        else:
            done.append({"step": step.name, "ran": why is not None, "why": why or "up to date"})
    hashes.save()
    for first in failed.values():
        again = f"mend that and run `faintfield run {session}` again; still to be done: {', '.join(failed)}"
        raise type(first)(f"{first}; {again}") from first
    return {
        "session": str(session),
        "report": str(session / RECONSTRUCTIONS / REPORT_FILE),
        "steps": done,
        "altered_frames": altered,
    }


def _frames(session: Path, *kinds: str) -> list[str]:
    """Return the names of the plan and of the frames of some kinds that count."""
    return [PLAN, *(str(path.relative_to(session)) for it, _, path in taken_frames(session) if it.kind in kinds)]


def _altered_frames(session: Path, hashes: Hashes) -> list[str]:
    """Return the frames that are not what was captured, and say so: results are made from what is there now."""
    altered = [
        str(path.relative_to(session))
        for _, taken, path in taken_frames(session)
        if path.is_file() and hashes.of(str(path.relative_to(session))) != taken.sha256
    ]
    if altered:
        inform(
            f"warning: {altered[0]} and {len(altered) - 1} other frames are not what was captured; results are made "
            f"from them as they are now. Restore them from a copy; `faintfield verify {session}` names the first"
        )
    return altered


def _out_of_date(session: Path, step: Step, hashes: Hashes) -> str | None:
    """Return why a step has to be done, None when its results are those of its inputs, options and versions."""
    inputs: dict[str, str] = {}
    for name in step.inputs():
        if not (session / name).is_file():
            raise MissingFile(f"{session / name}: is missing; restore it from a copy")
        inputs[name] = hashes.of(name)
    for file, options in step.origins.items():
        if not (session / file).is_file():
            return f"{file} is not there yet"
        if options is None:
            continue
        try:
            content = msgspec.json.decode((session / file).read_bytes(), type=dict[str, Any])
            if why := first_difference(content.get("provenance", content), provenance(step.name, options, inputs)):
                return f"{file} was made with another {why}"
            beside = [(session / file).parent / name for name in step.beside(content)]
        except (msgspec.MsgspecError, UnicodeDecodeError, AttributeError, LookupError, TypeError):
            return f"{file} is damaged"
        if missing := [path for path in beside if not path.is_file()]:
            return f"{missing[0].relative_to(session)} is missing"
    return None
