"""`faintfield reconstruct`: planes of a session or an elemental set at chosen depths."""

import shutil
import time
from contextlib import suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, NotNegativeOrAuto, Positive
from faintfield.pipelines.console import inform
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.files import exclusive, remove, remove_leftovers, require_room, write_json
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane, read_plane_poses, tilted_grid
from faintfield.pipelines.formats.provenance import provenance
from faintfield.pipelines.formats.results.plane_files import PARTS, PlaneFiles
from faintfield.pipelines.formats.results.stacks import write_stack
from faintfield.pipelines.formats.sets.elemental_set import LoadedSet, load_set
from faintfield.pipelines.formats.sets.measured_poses import with_measured_geometry
from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, SceneKind, load_session
from faintfield.pipelines.pages.report import RECONSTRUCTION_FILE, REPORT_FILE, write_report
from faintfield.pipelines.reconstruction.accuracy import METRICS_FILE, assess
from faintfield.pipelines.reconstruction.autofocus import BestFocus, best_focus
from faintfield.pipelines.reconstruction.channels import channel_layouts, default_pitch_px, plane_grid
from faintfield.pipelines.reconstruction.cluster import crew_of
from faintfield.pipelines.reconstruction.depth_map import require_sweep, write_depth_map
from faintfield.pipelines.reconstruction.depths import (
    depths_by_disparity,
    distinct_depths,
    swept_depths,
    swept_disparities,
)
from faintfield.pipelines.reconstruction.overview import write_overview
from faintfield.pipelines.reconstruction.planes import TOGETHER, Method, Settings
from faintfield.pipelines.reconstruction.sweep import Crew, Sweep, one_by_one
from faintfield.recon.likelihood.images import LikelihoodName
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.solver.penalties import PenaltyName
from faintfield.rig.session.access import has_session

DEFAULT_METHOD: Method = "pmlem"

# A plane of less light than this, in electrons per pixel, has none.
_BLACK_E = 1e-5


@dataclass(frozen=True)
class Request:
    """What is asked for.

    Attributes
    ----------
    depths_mm : list of float
        Of the planes.
    methods : list of Method
        By which each is reconstructed.
    settings : Settings
        Of the methods.
    pitch_mm : float, optional
        Distance of the planes' samples; one detector pixel of the reference view when None.
    with_focus : bool
        Whether a curve of focus against depth is wanted.
    with_depth_map : bool
        Whether depths and an all-in-focus picture are to be found from the planes.
    disparities_px : dict of depth in mm to px
        What was asked for instead of depths, if it was.
    tilted : list of TiltedPlane
        Planes given by a pose.
    found : dict, optional
        How the depths were found, if they were.
    """

    depths_mm: list[float]
    methods: list[Method]
    settings: Settings = field(default_factory=Settings)
    pitch_mm: float | None = None
    with_focus: bool = False
    with_depth_map: bool = False
    disparities_px: dict[float, float] = field(default_factory=dict)
    tilted: list[TiltedPlane] = field(default_factory=list)
    found: dict[str, Any] | None = None


def reconstruct(
    elemental_set: Annotated[Path, Parameter(name="SESSION|SET")],
    /,
    *,
    out: Path | None = None,
    depth_mm: list[float | Literal["auto"]] | None = None,
    sweep_mm: str | None = None,
    disparity_px: list[float] | None = None,
    sweep_px: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    plane_pose: list[Path] | None = None,
    depth_map: bool = False,
    method: list[Method] | None = None,
    joint: bool = False,
    occlusion: bool = False,
    penalty_weight: NotNegativeOrAuto = "auto",
    penalty: PenaltyName = "tv",
    likelihood: LikelihoodName | Literal["auto"] = "auto",
    uncertainty: bool = False,
    passes: Count | None = None,
    pitch_mm: Positive | None = None,
    geometry: Path | None = None,
    scene: SceneKind = "dark_scene",
    workers: Count | None = None,
    scheduler: str | None = None,
) -> dict[str, Any]:
    """Reconstruct planes of the scene at chosen depths.

    Each plane becomes a float32 TIFF (expected electrons per detector pixel of the reference view), a preview, and an
    entry in reconstruction.json; report.html shows them all. With several methods each has a folder of its own in OUT.
    Planes that are there, made of the same files with the same options, stay: a sweep that was cut short goes on.

    Parameters
    ----------
    elemental_set
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder for the results; planes of the same depth are replaced. For a session, its folder reconstructions by
        default.
    depth_mm
        Depth of a plane; give it once per plane. auto: the depths at which something stands, found by comparing the
        views; --sweep-mm or --sweep-px then only say between which depths, otherwise all that the views share.
    sweep_mm
        FIRST:LAST:COUNT, that many planes in equal steps, with a curve of focus against depth.
    disparity_px
        Instead of a depth: by how many pixels a point of the plane moves from one node to the next, right or down;
        negative for near points, unless the pictures are aligned on a nearer plane.
    sweep_px
        FIRST:LAST:COUNT, a sweep in equal steps of disparity instead of depth, such as -3.5:0.8:40.
    plane_pose
        TOML file of planes of any pose, each with a name and either rt_ref_plane, or point_mm and normal.
    depth_map
        From the sweep also how far away each pixel is, with the probability of that, and a picture that is sharp
        everywhere.
    method
        pmlem (the default; to its optimum, certified), joint and occlusion (the same for all planes together),
        pmlem-osl and mlem (the paper's iterations), or backprojection; give it once per method.
    joint
        Short for --method joint: all planes are found together, so that none holds the blur of what stands in another.
    occlusion
        Short for --method occlusion: all planes together, and the nearer ones hide what is behind them.
    penalty_weight
        The paper's β, in the unit of the number of views. auto: for pmlem the weight under which most of the views best
        predict those held out, for pmlem-osl one from the noise level.
    penalty
        What pmlem holds against rough planes: total variation, the same with small differences squared (huber-tv),
        squared differences (quadratic), or nothing.
    likelihood
        How pixels are judged. auto: exactly (poisson-gaussian) where read noise is below 3 electrons, shifted-poisson
        above, which is faster. poisson ignores read noise; least-squares knows no counts.
    uncertainty
        Save the standard deviation of each sample beside the planes of pmlem and joint; see docs/physics.md for what
        it covers.
    passes
        At most this many passes over the data.
    pitch_mm
        Distance of the plane's samples; by default one detector pixel of the reference view.
    geometry
        geometry.json, or the folder that holds it: its lens and measured poses replace those of the set, by node.
    scene
        Which of a session's sets: the dark scene, or the bright one.
    workers
        Have the planes made by so many processes of one thread each; needs the extra faintfield[cluster].
    scheduler
        Have the planes made by the workers of the dask scheduler at this address, which see OUT under the same path.
    """
    crew = crew_of(workers, scheduler)
    if not (depth_mm or sweep_mm or disparity_px or sweep_px or plane_pose):
        raise WrongUsage(
            "no plane is asked for; give --depth-mm, --sweep-mm FIRST:LAST:COUNT, --disparity-px, --sweep-px or "
            "--plane-pose"
        )
    if depth_map and "auto" in (depth_mm or []):
        raise WrongUsage(
            "--depth-map compares depths of a sweep, and --depth-mm auto leaves few; give --sweep-mm alone"
        )
    methods = _methods(method or [], joint=joint, occlusion=occlusion)
    if plane_pose and "occlusion" in methods:
        raise WrongUsage("occlusion asks which plane is nearer, which planes of any pose do not say; use joint")
    _refuse_what_methods_know_not(methods, likelihood, penalty, uncertainty=uncertainty)
    swept = swept_depths(sweep_mm) if sweep_mm else []
    swept_px = swept_disparities(sweep_px) if sweep_px else []
    tilted = read_plane_poses(plane_pose or [])
    loaded, out = _opened(elemental_set, out, scene, geometry)
    swept_of_px = depths_by_disparity(loaded, swept_px)
    of_disparity = depths_by_disparity(loaded, disparity_px or []) | swept_of_px
    depths = [*(depth for depth in depth_mm or [] if depth != "auto"), *swept, *of_disparity]
    found = None
    if "auto" in (depth_mm or []):
        found = _found(loaded, out, depth_mm or [], [*swept, *swept_of_px], disparity_px or [])
        depths, of_disparity = found.depths_mm, {}
    if depth_map:
        require_sweep(distinct_depths(depths))
    weight = None if penalty_weight == "auto" else penalty_weight
    settings = Settings(weight, passes, likelihood, penalty, uncertainty)
    request = Request(
        depths,
        methods,
        settings,
        pitch_mm,
        with_focus=bool(swept or swept_px) and found is None,
        with_depth_map=depth_map,
        disparities_px=of_disparity if len(of_disparity) == len(depths) else {},
        tilted=tilted,
        found=found.record if found else None,
    )
    return reconstruct_set(loaded, out, request, crew)


def _methods(given: list[Method], *, joint: bool, occlusion: bool) -> list[Method]:
    """Return the methods that are asked for, by name or by an option of their own."""
    of_options: dict[Method, bool] = {"joint": joint, "occlusion": occlusion}
    return [*given, *(name for name, wanted in of_options.items() if wanted)] or [DEFAULT_METHOD]


def _refuse_what_methods_know_not(
    methods: list[Method], likelihood: str, penalty: PenaltyName, *, uncertainty: bool
) -> None:
    """Refuse options that would change nothing, or cannot be (WrongUsage)."""
    if likelihood == "least-squares" and {"mlem", "pmlem-osl"} & set(methods):
        raise WrongUsage("least squares has ratios below zero, which mlem and pmlem-osl cannot take; use pmlem")
    if (uncertainty or penalty != "tv") and not {"pmlem", *TOGETHER} & set(methods):
        option = "--uncertainty" if uncertainty else f"--penalty {penalty}"
        raise WrongUsage(f"{option} is for pmlem, joint and occlusion, not for {' and '.join(methods)}; leave it out")


def _opened(folder: Path, out: Path | None, scene: SceneKind, geometry: Path | None) -> tuple[LoadedSet, Path]:
    """Return a set, or that of a session, and where its results go."""
    if has_session(folder):
        loaded = load_session(folder, scene, geometry)
        return loaded, out or folder / RECONSTRUCTIONS / ("" if scene == "dark_scene" else scene)
    if out is None:
        raise WrongUsage("no folder for the results is named; give --out")
    loaded = load_set(folder)
    return loaded if geometry is None else with_measured_geometry(loaded, geometry), out


def _found(
    loaded: LoadedSet, out: Path, depth_mm: list[float | Literal["auto"]], swept: list[float], others: list[float]
) -> BestFocus:
    """Return the planes of best focus, within a sweep's range if there is one."""
    if depth_mm != ["auto"] or others:
        raise WrongUsage("--depth-mm auto finds all depths; give others in a call of their own, with the same --out")
    return best_focus(loaded, out, (min(swept), max(swept)) if swept else None)


def reconstruct_set(loaded: LoadedSet, out: Path, request: Request, crew: Crew = one_by_one) -> dict[str, Any]:
    """Reconstruct planes of a set that was loaded, and write them, their origin, their errors and the report.

    Planes that are there, made of the same files with the same options, are not made again.
    """
    with exclusive(out):
        return _reconstructed(loaded, out, request, crew)


def _reconstructed(loaded: LoadedSet, out: Path, request: Request, crew: Crew) -> dict[str, Any]:
    """Do what `reconstruct_set` says."""
    started = time.monotonic()
    depths, methods = distinct_depths(request.depths_mm), list(dict.fromkeys(request.methods))
    request = replace(request, depths_mm=depths, methods=methods)
    folders = {name: folder_of_method(out, name, methods) for name in methods}
    sweep = _sweep(loaded, folders, request)
    require_room(out, sweep.needed_bytes())
    for folder in {out, *folders.values()}:
        remove_leftovers(folder)
    for folder in folders.values():
        remove(folder / RECONSTRUCTION_FILE)  # or it would vouch for planes that replace its own
    try:
        sweep.run(crew, out)
    finally:
        for folder in folders.values():
            with suppress(OSError):
                (folder / PARTS).rmdir()  # stays as long as planes want colours
    write_overview(loaded, out)
    mapped = None
    if request.with_depth_map:
        mapped = write_depth_map(loaded, sweep.written, request.disparities_px, sweep.origins, out)
    metrics = assess(loaded, sweep.written)
    remove(out / METRICS_FILE)  # of planes that were here before
    if metrics:
        write_json(out / METRICS_FILE, metrics)
    remove(out / REPORT_FILE)  # likewise
    for name, folder in folders.items():
        result = {
            "format": 1,
            "planes": [record for record in sweep.records if record["method"] == name],
            "focus": sweep.focus(),
            "best_focus": request.found,
            "depth_map": mapped,
            "wall_time_s": time.monotonic() - started,
            **sweep.origins[name],
        }
        write_json(folder / RECONSTRUCTION_FILE, result)
        if request.with_focus:
            write_stack(folder, result["planes"])
        shutil.rmtree(folder / PARTS, ignore_errors=True)  # also those of another call that was cut short
    report = write_report(out)
    _say_what_oscillates(sweep.records)
    _say_what_is_not_reached(sweep.records)
    _say_what_is_black(sweep.records)
    inform(f"{len(depths) + len(request.tilted)} plane(s) in {time.monotonic() - started:.1f} s: {report}")
    return {
        "out": str(out),
        "report": str(report),
        "planes": sweep.records,
        "focus": sweep.focus(),
        "best_focus": request.found,
        "depth_map": mapped,
        "metrics": metrics,
    }


def _sweep(loaded: LoadedSet, folders: dict[Method, Path], request: Request) -> Sweep:
    """Return the planes of a request, none of them made yet."""
    layouts = channel_layouts(loaded)
    mm_per_depth = default_pitch_px(loaded, layouts) / loaded.settings.camera.fx_px
    grids: dict[Place, PlaneGrid] = {
        depth: plane_grid(loaded, depth, request.pitch_mm or depth * mm_per_depth) for depth in request.depths_mm
    }
    for plane in request.tilted:
        grids[plane] = tilted_grid(loaded, plane, request.pitch_mm or plane.depth_mm * mm_per_depth)
    inputs = dict(loaded.input_hashes())

    def origin(name: Method, wanted: Request) -> dict[str, Any]:
        return provenance("reconstruct", options_of(name, wanted, loaded.poses), inputs)

    channels = tuple(layout.name for layout in layouts)
    files = [
        PlaneFiles(folder, name, place, channels, origin(name, _made_with(request, name, place)))
        for place in grids
        for name, folder in folders.items()
    ]
    origins = {name: origin(name, request) for name in folders}
    return Sweep(loaded, grids, files, origins, request.settings, with_focus=request.with_focus)


def _made_with(request: Request, method: Method, place: Place) -> Request:
    """Return the part of a request that one plane is made of: all planes by methods that find them together."""
    if method in TOGETHER:
        return replace(request, with_depth_map=False)
    alone: dict[str, Any] = (
        {"depths_mm": [], "tilted": [place]} if isinstance(place, TiltedPlane) else {"depths_mm": [place], "tilted": []}
    )
    return replace(request, with_depth_map=False, **alone)


def folder_of_method(out: Path, method: Method, methods: list[Method]) -> Path:
    """Return where the planes of a method go: into a folder of their own when there are several methods."""
    return out if len(methods) == 1 else out / method


def options_of(method: Method, request: Request, poses: str) -> dict[str, Any]:
    """Return what reconstruction.json records of a request."""
    return {
        "method": method,
        "depth_mm": request.depths_mm,
        "penalty_weight": "auto" if request.settings.penalty_weight is None else request.settings.penalty_weight,
        "penalty": request.settings.penalty,
        "likelihood": request.settings.likelihood,
        "uncertainty": request.settings.uncertainty,
        "passes": request.settings.passes,
        "pitch_mm": request.pitch_mm,
        "focus": request.with_focus,
        "depth_map": ("px" if request.disparities_px else "mm") if request.with_depth_map else None,
        "plane_pose": {plane.name: [*plane.rt_ref_plane, *(plane.size_mm or ())] for plane in request.tilted},
        "poses": poses,
    }


def _say_what_oscillates(records: list[dict[str, Any]]) -> None:
    """Tell of planes on which the iteration swings to and fro."""
    certificates = [record["certificate"] for record in records if record["certificate"]]
    certificates = [certificate for certificate in certificates if "oscillates" in certificate]
    swings = [certificate["relative_change"] for certificate in certificates if certificate["oscillates"]]
    if swings:
        inform(
            f"the one-step-late iteration does not settle on {len(swings)} of {len(certificates)} planes: it swings by "
            f"up to {max(swings):.1%} per pass (see reconstruction.json). A few percent hide little; a smaller "
            "--penalty-weight calms it, and leaves more noise."
        )


def _say_what_is_not_reached(records: list[dict[str, Any]]) -> None:
    """Tell of planes whose certificate is not what was asked for."""
    certificates = [record["certificate"] for record in records if record["method"] in ("pmlem", *TOGETHER)]
    missed = [certificate["value"] for certificate in certificates if not certificate["reached"]]
    if missed:
        inform(
            f"pmlem stopped before its certificate on {len(missed)} of {len(certificates)} planes: up to "
            f"{max(missed):.1%} from the optimum instead of {certificates[0]['tolerance']:.0%}; allow more --passes"
        )


def _say_what_is_black(records: list[dict[str, Any]]) -> None:
    """Tell of planes without light, which are right only if there is none."""
    black = [record for record in records if record["mean_e"] <= _BLACK_E]
    if black:
        inform(
            f"{len(black)} of {len(records)} planes are black ({black[0]['method']}, {black[0]['depth_mm']:g} mm for "
            "one): the views are no brighter than offset_dn and dark_current_e_per_s say of darkness; compare these "
            "with dark frames of the same exposure"
        )
