"""`faintfield reconstruct`: planes of a session or an elemental set at chosen depths."""

import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Literal

from cyclopts import Parameter

from faintfield.pipelines.arguments import Count, NotNegativeOrAuto, Positive
from faintfield.pipelines.choices import Method, PriorName, SceneKind
from faintfield.pipelines.console import inform, working
from faintfield.pipelines.errors import WrongUsage
from faintfield.recon.names import LikelihoodName, PenaltyName

if TYPE_CHECKING:
    from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
    from faintfield.pipelines.reconstruction.request import Request
    from faintfield.pipelines.reconstruction.run import Outcome
    from faintfield.pipelines.reconstruction.surface_request import SurfaceRequest
    from faintfield.pipelines.reconstruction.sweep import Runner


type Result = Outcome


def reconstruct(
    elemental_set: Annotated[Path, Parameter(name="SESSION|SET")],
    /,
    *,
    out: Path | None = None,
    depth: Annotated[list[float | Literal["auto"]] | None, Parameter(allow_leading_hyphen=True)] = None,
    sweep: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    depth_mm: list[float | Literal["auto"]] | None = None,
    sweep_mm: str | None = None,
    disparity_px: list[float] | None = None,
    sweep_px: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    plane_pose: list[Path] | None = None,
    depth_map: bool = False,
    surface: bool = False,
    depth_range_mm: str | None = None,
    disparity_range_px: Annotated[str | None, Parameter(allow_leading_hyphen=True)] = None,
    method: list[Method] | None = None,
    joint: bool = False,
    occlusion: bool = False,
    penalty_weight: NotNegativeOrAuto = "auto",
    penalty: PenaltyName = "tv",
    likelihood: LikelihoodName | Literal["auto"] = "auto",
    uncertainty: bool = False,
    prior: PriorName | None = None,
    proposal: bool = False,
    passes: Count | None = None,
    pitch_mm: Positive | None = None,
    geometry: Path | None = None,
    scene: SceneKind = "dark_scene",
    workers: Count | None = None,
    scheduler: str | None = None,
) -> Result:
    """Reconstruct planes of the scene at chosen depths, or one picture that is sharp everywhere, with its depth.

    Each plane becomes a float32 TIFF (expected electrons per detector pixel of the reference view), a preview, and an
    entry in reconstruction.json; report.html shows them all. With several methods, each has its own folder in OUT.
    Planes that were already made of the same files with the same options are kept, so an interrupted sweep resumes.

    Parameters
    ----------
    elemental_set
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder for the results; planes of the same depth are replaced. By default, for a session, its folder
        reconstructions.
    depth
        Depth of a plane in the unit of the set (mm, relative, or px of disparity); repeat it for further planes. auto:
        find the depths of the objects by comparing the views, in the range of a sweep if given, else in that which
        the import found, else at all depths that the views share; refused if shuffled views agree as well.
    sweep
        FIRST:LAST:COUNT in the unit of the set: COUNT planes in equal steps, with a curve of focus against depth. auto:
        the range in which the views agree, in steps of half a pixel of the outermost view, at most 96 planes.
    depth_mm
        Depth of a plane in mm, for sets with a scale; or auto, as above.
    sweep_mm
        FIRST:LAST:COUNT in mm, for sets with a scale.
    disparity_px
        Plane by disparity instead of depth: how many pixels a point of the plane moves from one node to the next, right
        or down; negative for near points, unless the pictures are aligned on a nearer plane.
    sweep_px
        FIRST:LAST:COUNT: a sweep in equal steps of disparity instead of depth, such as -3.5:0.8:40.
    plane_pose
        TOML file of planes of any pose, each with a name and either rt_ref_plane or point_mm and normal.
    depth_map
        Also compute, in the range of the sweep, the depth of each pixel, the probability that it is right, and an
        all-in-focus picture.
    surface
        Instead of planes, reconstruct one picture of the scene from the reference view, sharp everywhere, with the
        depth of each pixel and how sure both are: picture.tiff, depth_mm.tiff, surface.ply and others, see
        docs/results.md. For a session, its folder is reconstructions/surface by default.
    depth_range_mm
        NEAR:FAR: range of the surface's depths, such as 400:1500. By default it is found by comparing the views.
    disparity_range_px
        NEAR:FAR: the same by disparity, such as -3.6:1; depths are then written as disparities, disparity_px.tiff.
    method
        pmlem (the default; iterates to a certified optimum), joint or occlusion (pmlem for all planes together),
        pmlem-osl or mlem (the iterations of the paper), or backprojection; repeat it for further methods.
    joint
        Short for --method joint: solve all planes together, so that no plane shows the blur of objects in another.
    occlusion
        Short for --method occlusion: solve all planes together, with nearer objects hiding farther ones.
    penalty_weight
        β of the paper, in the unit of the number of views. auto: for pmlem, the weight that best predicts held-out
        views; for pmlem-osl, a weight computed from the noise level.
    penalty
        Penalty of pmlem on differences between neighbouring samples: total variation (tv), total variation with small
        differences squared (huber-tv), squared differences (quadratic), or none.
    likelihood
        Noise model of a pixel. auto: poisson-gaussian (exact) for read noise below 3 electrons, shifted-poisson
        (faster) above. poisson ignores read noise; least-squares assumes Gaussian noise of fixed variance.
    uncertainty
        Save the standard deviation of each sample beside the planes of pmlem, joint and occlusion; see
        docs/results.md for how often its intervals hold.
    prior
        What is expected of a picture. tv: little, and total variation alone decides. patches: that small patches of it
        repeat. learned: what a small network was trained with. auto: whichever of these predicts held-out views best,
        mixed. Less noise and more detail remain, and the data keep the last word: see docs/physics.md. By default auto
        for pmlem, joint and occlusion, but tv for sweeps, which take several times as long with auto. A
        surface without this option has the picture of tv with detail added by a filter of patches.
    proposal
        Save, beside each plane or the picture of a surface, what the prior proposed, and in standard deviations how far
        the data moved it.
    passes
        Largest number of passes over the data.
    pitch_mm
        Distance between samples of a plane; by default one detector pixel of the reference view.
    geometry
        geometry.json, or its folder; its lens and measured poses replace those of the set, node by node.
    scene
        Set of the session to reconstruct: the dark scene or the bright scene.
    workers
        Number of processes, of one thread each, that make the planes; needs the extra faintfield[cluster].
    scheduler
        Address of a dask scheduler whose workers make the planes; they must see OUT under the same path.
    """
    from faintfield.pipelines.reconstruction.cluster import make_runner
    from faintfield.pipelines.reconstruction.request import chosen_prior, resolve, select_planes, selected_methods
    from faintfield.pipelines.reconstruction.solutions import Settings
    from faintfield.pipelines.reconstruction.surface_request import SURFACE_FOLDER, select_surface

    weight = None if penalty_weight == "auto" else penalty_weight
    settings = Settings(weight, passes, likelihood, penalty, uncertainty, prior or "tv", proposal)
    if surface:
        _refuse_beside_surface(
            depth=depth, sweep=sweep,
            depth_mm=depth_mm, sweep_mm=sweep_mm, disparity_px=disparity_px, sweep_px=sweep_px, plane_pose=plane_pose,
            depth_map=depth_map, method=method, joint=joint, occlusion=occlusion, uncertainty=uncertainty,
            pitch_mm=pitch_mm, workers=workers, scheduler=scheduler,
        )  # fmt: skip
    asked = select_surface(surface, depth_range_mm, disparity_range_px, settings, filtered=prior is None)
    if asked is not None:
        loaded, page_in = _open(elemental_set, out, scene, geometry)
        return surface_and_report(loaded, out or page_in / SURFACE_FOLDER, asked.resolve(loaded), page_in=page_in)
    runner = make_runner(workers, scheduler)
    methods = selected_methods(method or [], joint=joint, occlusion=occlusion)
    sweeps = bool(sweep or sweep_mm or sweep_px) and "auto" not in [*(depth or []), *(depth_mm or [])]
    selection = select_planes(
        *(depth or [], sweep, depth_mm or [], sweep_mm, disparity_px or [], sweep_px, plane_pose or []),
        depth_map=depth_map,
        methods=methods,
        settings=replace(settings, prior=chosen_prior(prior, methods, settings, sweeps=sweeps)),
        pitch_mm=pitch_mm,
    )
    loaded, out = _open(elemental_set, out, scene, geometry)
    return reconstruct_and_report(loaded, out, resolve(selection, loaded, out), runner)


def reconstruct_and_report(
    loaded: "ElementalSet", out: Path, request: "Request", runner: "Runner | None" = None
) -> "Outcome":
    """Reconstruct planes of a set into `out`, and write the report of them.

    Raises
    ------
    OutputBusy
        Another command is writing to `out`.
    """
    import msgspec

    from faintfield.pipelines.formats.files import exclusive
    from faintfield.pipelines.pages.report import write_report
    from faintfield.pipelines.reconstruction.run import reconstruct_set
    from faintfield.pipelines.reconstruction.sweep import run_serially

    started = time.monotonic()
    with exclusive(out):
        outcome = reconstruct_set(loaded, out, request, runner or run_serially)
        with working("writing the report"):
            report = write_report(out)
    planes = len({record.file for record in outcome.planes})
    inform(f"{planes} plane(s) in {time.monotonic() - started:.1f} s: {report}")
    return msgspec.structs.replace(outcome, report=str(report))


def surface_and_report(loaded: "ElementalSet", out: Path, request: "SurfaceRequest", *, page_in: Path) -> "Outcome":
    """Reconstruct the surface of a set into `out`, and write the report of all that is in `page_in`, the same or above.

    Raises
    ------
    OutputBusy
        Another command is writing to one of the two.
    """
    from faintfield.pipelines.formats.files import exclusive
    from faintfield.pipelines.formats.results.records import REPORT_FILE
    from faintfield.pipelines.pages.report import write_report
    from faintfield.pipelines.reconstruction.run import Outcome
    from faintfield.pipelines.reconstruction.surface import reconstruct_surface

    started = time.monotonic()
    with ExitStack() as locks:
        for folder in dict.fromkeys((page_in, out)):
            locks.enter_context(exclusive(folder))
        record = reconstruct_surface(loaded, out, request, pages=(page_in / REPORT_FILE, out / REPORT_FILE))
        with working("writing the report"):
            report = write_report(page_in)
    sure = f"{record.known_share:.0%} of its depths known, {record.sure_share:.0%} sure"
    inform(f"a surface in {time.monotonic() - started:.1f} s, {sure}: {report}")
    return Outcome(
        out=str(out), report=str(report), planes=[], focus=None, best_focus=None, depth_map=None, metrics=None,
        surface=record, units=loaded.units,
    )  # fmt: skip


def _refuse_beside_surface(**options: object) -> None:
    """Refuse options of planes beside --surface (WrongUsage)."""
    given = [f"--{name.replace('_', '-')}" for name, value in options.items() if value]
    if given:
        raise WrongUsage(
            f"--surface makes one picture at all depths, and {' and '.join(given)} would have no effect; leave it out, "
            "or reconstruct planes in a call of their own"
        )


def _open(folder: Path, out: Path | None, scene: SceneKind, geometry: Path | None) -> "tuple[ElementalSet, Path]":
    """Return a set, or that of a session, and the folder of its results: for a session by default that of the scene."""
    from faintfield.pipelines.formats.sets.elemental_set import load_set, with_measured_geometry
    from faintfield.pipelines.formats.sets.session_set import RECONSTRUCTIONS, load_session
    from faintfield.pipelines.reconstruction.channels import keeping_frames
    from faintfield.rig.session.session import has_session

    if has_session(folder):
        loaded = load_session(folder, scene, geometry)
        out = out or folder / RECONSTRUCTIONS / ("" if scene == "dark_scene" else scene)
    elif out is None:
        raise WrongUsage("no folder for the results is named; give --out")
    else:
        loaded = load_set(folder)
        loaded = loaded if geometry is None else with_measured_geometry(loaded, geometry)
    return keeping_frames(loaded, out), out
