"""`faintfield reconstruct`: planes of a session or an elemental set at chosen depths."""

import re
import time
from dataclasses import asdict, dataclass, field, replace
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from cyclopts import Parameter
from numpy.typing import NDArray

from pipelines.arguments import Count, NotNegative, Positive
from pipelines.channels import (
    ChannelLayout,
    OperatorFactory,
    channel_layouts,
    default_pitch_px,
    load_channel,
    plane_grid,
    require_in_front,
)
from pipelines.console import progress, say
from pipelines.depth_map import require_sweep, write_depth_map
from pipelines.elemental_set import LoadedSet, load_set
from pipelines.errors import WrongUsage
from pipelines.files import require_room, write_json
from pipelines.image_files import grey_levels, white_level, write_plane, write_png
from pipelines.measured_poses import with_measured_geometry
from pipelines.metrics import METRICS_FILE, assess
from pipelines.overview import write_overview
from pipelines.planes import Method, Settings, solve
from pipelines.provenance import provenance
from pipelines.report import RECONSTRUCTION_FILE, write_report
from pipelines.session_set import RECONSTRUCTIONS, SceneKind, load_session
from pipelines.stacks import write_stack
from recon.errors import GeometryMismatch
from recon.focus import Focus, focus_measure, sharp_depths_mm
from recon.images import LikelihoodName
from recon.operator import PlaneOperator
from recon.penalties import PenaltyName
from rig.session.opening import has_session

DEFAULT_METHOD: Method = "pmlem"


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
    """

    depths_mm: list[float]
    methods: list[Method]
    settings: Settings = field(default_factory=Settings)
    pitch_mm: float | None = None
    with_focus: bool = False
    with_depth_map: bool = False
    disparities_px: dict[float, float] = field(default_factory=dict)


def reconstruct(
    elemental_set: Annotated[Path, Parameter(name="SESSION|SET")],
    /,
    *,
    out: Path | None = None,
    depth_mm: list[float] | None = None,
    sweep_mm: str | None = None,
    disparity_px: list[float] | None = None,
    sweep_px: str | None = None,
    depth_map: bool = False,
    method: list[Method] | None = None,
    penalty_weight: NotNegative | Literal["auto"] = "auto",
    penalty: PenaltyName = "tv",
    likelihood: LikelihoodName | Literal["auto"] = "auto",
    passes: Count | None = None,
    pitch_mm: Positive | None = None,
    geometry: Path | None = None,
    scene: SceneKind = "dark_scene",
) -> dict[str, Any]:
    """Reconstruct planes of the scene at chosen depths.

    Each plane becomes a float32 TIFF (expected electrons per detector pixel of the reference view), a preview, and an
    entry in reconstruction.json; report.html shows them all. With several methods each has a folder of its own in OUT.

    Parameters
    ----------
    elemental_set
        A session whose noise and geometry were measured, or a folder with elemental.toml.
    out
        Folder for the results; planes of the same depth are replaced. For a session, its folder reconstructions by
        default.
    depth_mm
        Depth of a plane; give it once per plane.
    sweep_mm
        FIRST:LAST:COUNT, that many planes in equal steps, with a curve of focus against depth.
    disparity_px
        Instead of a depth: by how many pixels a point of the plane moves from one node to the next, right or down;
        negative for near points, unless the pictures are aligned on a nearer plane.
    sweep_px
        FIRST:LAST:COUNT, a sweep in equal steps of disparity instead of depth, such as -3.5:0.8:40.
    depth_map
        From the sweep also how far away each pixel is, with the probability of that, and a picture that is sharp
        everywhere.
    method
        pmlem (the default; to its optimum, certified), pmlem-osl and mlem (the paper's iterations), or backprojection;
        give it once per method.
    penalty_weight
        The paper's β, in the unit of the number of views. auto: for pmlem the weight under which most of the views best
        predict those held out, for pmlem-osl one from the noise level.
    penalty
        What pmlem holds against rough planes: total variation, the same with small differences squared (huber-tv),
        squared differences (quadratic), or nothing.
    likelihood
        How pixels are judged. auto: exactly (poisson-gaussian) where read noise is below 3 electrons, shifted-poisson
        above, which is faster. poisson ignores read noise; least-squares knows no counts.
    passes
        At most this many passes over the data.
    pitch_mm
        Distance of the plane's samples; by default one detector pixel of the reference view.
    geometry
        geometry.json, or the folder that holds it: its lens and measured poses replace those of the set, by node.
    scene
        Which of a session's sets: the dark scene, or the bright one.
    """
    swept = swept_depths(sweep_mm) if sweep_mm else []
    disparities = [*(disparity_px or []), *(swept_disparities(sweep_px) if sweep_px else [])]
    if not (depth_mm or swept or disparities):
        raise WrongUsage(
            "no plane is asked for; give --depth-mm, --sweep-mm FIRST:LAST:COUNT, --disparity-px or --sweep-px"
        )
    if has_session(elemental_set):
        loaded = load_session(elemental_set, scene, geometry)
        out = out or elemental_set / RECONSTRUCTIONS / ("" if scene == "dark_scene" else scene)
    else:
        loaded = load_set(elemental_set)
        loaded = loaded if geometry is None else with_measured_geometry(loaded, geometry)
    if out is None:
        raise WrongUsage("no folder for the results is named; give --out")
    of_disparity = {loaded.depth_of_disparity(disparity): disparity for disparity in disparities}
    depths = [*(depth_mm or []), *swept, *of_disparity]
    if depth_map:
        require_sweep(depths)
    if likelihood == "least-squares" and {"mlem", "pmlem-osl"} & set(method or []):
        raise WrongUsage("least squares has ratios below zero, which mlem and pmlem-osl cannot take; use pmlem")
    weight = None if penalty_weight == "auto" else penalty_weight
    settings = Settings(weight, passes, likelihood, penalty)
    request = Request(
        depths,
        method or [DEFAULT_METHOD],
        settings,
        pitch_mm,
        with_focus=bool(swept or sweep_px),
        with_depth_map=depth_map,
        disparities_px=of_disparity if len(of_disparity) == len(depths) else {},
    )
    return reconstruct_set(loaded, out, request)


def reconstruct_set(loaded: LoadedSet, out: Path, request: Request) -> dict[str, Any]:
    """Reconstruct planes of a set that was loaded, and write them, their origin, their errors and the report."""
    started = time.monotonic()
    depths, methods = distinct_depths(request.depths_mm), list(dict.fromkeys(request.methods))
    request = replace(request, depths_mm=depths, methods=methods)
    folders = {name: folder_of_method(out, name, methods) for name in methods}
    run = _Run(loaded, depths, request.pitch_mm, folders)
    require_room(out, run.needed_bytes())
    for folder in folders.values():
        (folder / RECONSTRUCTION_FILE).unlink(missing_ok=True)  # or it would vouch for planes that replace its own
    run.reconstruct(request.settings, with_focus=request.with_focus)
    write_overview(loaded, out)
    mapped = write_depth_map(loaded, run.written, request.disparities_px) if request.with_depth_map else None
    metrics = assess(loaded, run.written)
    (out / METRICS_FILE).unlink(missing_ok=True)  # of planes that were here before
    if metrics:
        write_json(out / METRICS_FILE, metrics)
    inputs = dict(loaded.input_hashes())
    for name, folder in folders.items():
        result = {
            "format": 1,
            "planes": [record for record in run.records if record["method"] == name],
            "focus": run.focus(),
            "depth_map": mapped,
            "wall_time_s": time.monotonic() - started,
            **provenance("reconstruct", options_of(name, request, loaded.poses), inputs),
        }
        write_json(folder / RECONSTRUCTION_FILE, result)
        if request.with_focus:
            write_stack(folder, result["planes"])
    report = write_report(out)
    _say_what_oscillates(run.records)
    _say_what_is_not_reached(run.records)
    say(f"{len(depths)} plane(s) in {time.monotonic() - started:.1f} s: {report}")
    return {
        "out": str(out),
        "report": str(report),
        "planes": run.records,
        "focus": run.focus(),
        "depth_map": mapped,
        "metrics": metrics,
    }


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
        "passes": request.settings.passes,
        "pitch_mm": request.pitch_mm,
        "focus": request.with_focus,
        "depth_map": request.with_depth_map,
        "poses": poses,
    }


def plane_name(depth_mm: float) -> str:
    """Return the file name, without suffix, of the plane at a depth."""
    return f"plane_{depth_mm:07.1f}"


class _Run:
    """The planes of one call: every channel, depth and method, written as soon as all colours of a plane are there."""

    def __init__(
        self, loaded: LoadedSet, depths: list[float], pitch_mm: float | None, folders: dict[Method, Path]
    ) -> None:
        self._loaded = loaded
        self._layouts = channel_layouts(loaded)
        mm_per_depth = default_pitch_px(loaded, self._layouts) / loaded.settings.camera.fx_px
        self._grids = {depth: plane_grid(loaded, depth, pitch_mm or depth * mm_per_depth) for depth in depths}
        self._folders = folders
        self._colours: dict[tuple[Method, float], list[NDArray[np.floating]]] = {}
        self._focus = dict.fromkeys(depths, Focus(0.0, 0.0))
        self._with_focus = False
        self.records: list[dict[str, Any]] = []
        self.written: dict[tuple[Method, float], Path] = {}

    def needed_bytes(self) -> int:
        """Return about how much disk the results take: planes, previews, and the report that shows them again."""
        samples = sum(grid.shape[0] * grid.shape[1] for grid in self._grids.values()) * len(self._folders)
        return samples * len(self._layouts) * (np.dtype(np.float32).itemsize + 3)

    def reconstruct(self, settings: Settings, *, with_focus: bool) -> None:
        """Go through the channels, one in memory at a time."""
        self._with_focus = with_focus
        tasks = [(layout, depth) for layout in self._layouts for depth in self._grids]
        factory_of: ChannelLayout | None = None
        for layout, depth in progress(tasks, "reconstructing planes"):
            if layout is not factory_of:
                images = factory = None  # the channel before goes before the next is read
                images = load_channel(self._loaded, layout)
                factory = OperatorFactory(self._loaded, layout, images)
                factory_of = layout
            assert images is not None
            assert factory is not None
            operator = self._operator(factory, depth)
            self._say_which_views_are_blind(operator, depth, len(layout.lattices))
            if with_focus:
                halves = _halves(self._loaded, len(layout.lattices))
                self._add_focus(depth, focus_measure(operator, images, halves))
            for method in self._folders:
                solution = solve(operator, images, method, settings)
                self.records.append(self._record(depth, method, layout, solution.record, solution.plane))
                colours = self._colours.setdefault((method, depth), [])
                colours.append(solution.plane)
                if len(colours) == len(self._layouts):
                    self._write(method, depth)

    def focus(self) -> dict[str, Any] | None:
        """Return the focus curve of a sweep and the depths it marks, None without a sweep."""
        if not self._with_focus:
            return None
        depths, curve = list(self._focus), list(self._focus.values())
        return {
            "depth_mm": depths,
            "detail_e2": [point.detail_e2 for point in curve],
            "sigma_e2": [point.sigma_e2 for point in curve],
            "sharp_mm": sharp_depths_mm(depths, curve),
        }

    def _add_focus(self, depth: float, of_channel: Focus) -> None:
        """Add what one more channel says of a depth."""
        known = self._focus[depth]
        sigma_e2 = float(np.hypot(known.sigma_e2, of_channel.sigma_e2))
        self._focus[depth] = Focus(known.detail_e2 + of_channel.detail_e2, sigma_e2)

    def _operator(self, factory: OperatorFactory, depth_mm: float) -> PlaneOperator:
        try:
            return factory.at_depth(depth_mm, self._grids[depth_mm])
        except GeometryMismatch as failure:
            raise GeometryMismatch(f"plane at {depth_mm:g} mm: {failure}") from failure

    def _say_which_views_are_blind(self, operator: PlaneOperator, depth_mm: float, phases: int) -> None:
        """Tell of views that see nothing of a plane: a pose may be wrong."""
        blind = {int(view) // phases for view in operator.all_views if not operator.sensitivity([int(view)]).any()}
        if blind:
            first = self._loaded.settings.view[min(blind)].image
            say(
                f"{depth_mm:g} mm: {len(blind)} views see nothing of the plane, {first} for one; are their poses right?"
            )

    def _record(
        self, depth: float, method: Method, layout: ChannelLayout, record: dict[str, Any], plane: NDArray[np.floating]
    ) -> dict[str, Any]:
        """Return the entry of one plane and channel in reconstruction.json."""
        grid = self._grids[depth]
        samples_per_px = (grid.pitch_mm * self._loaded.settings.camera.fx_px / depth) ** 2
        return {
            "depth_mm": depth,
            "method": method,
            "channel": layout.name,
            "file": f"{plane_name(depth)}.tiff",
            **asdict(grid),
            **record,
            "flux_e": float(plane.sum(dtype=np.float64)) * samples_per_px,
        }

    def _write(self, method: Method, depth: float) -> None:
        """Write a plane whose colours are complete, and its preview."""
        colours = self._colours.pop((method, depth))
        plane = colours[0] if len(colours) == 1 else np.dstack(colours)
        path = self._folders[method] / f"{plane_name(depth)}.tiff"
        write_plane(path, plane, self._grids[depth].pitch_mm)
        write_png(path.with_suffix(".png"), grey_levels(plane, white_level(plane)))
        self.written[method, depth] = path


def distinct_depths(depths: list[float]) -> list[float]:
    """Return each depth once; two that would share a file name but differ are refused, and what is no depth."""
    by_name: dict[str, float] = {}
    for depth in depths:
        require_in_front(depth)
        other = by_name.setdefault(plane_name(depth), depth)
        if other != depth:
            raise WrongUsage(f"planes at {other:g} and {depth:g} mm would share a file name; keep them 0.1 mm apart")
    return list(by_name.values())


def swept_depths(sweep_mm: str) -> list[float]:
    """Return the depths of FIRST:LAST:COUNT."""
    depths = _swept("--sweep-mm", sweep_mm, "400:900:64")
    if min(depths) <= 0:
        raise WrongUsage(f"--sweep-mm {sweep_mm}: is no sweep; give two different positive depths")
    return depths


def swept_disparities(sweep_px: str) -> list[float]:
    """Return the disparities of FIRST:LAST:COUNT."""
    return _swept("--sweep-px", sweep_px, "-3.5:0.8:40")


def _swept(option: str, given: str, example: str) -> list[float]:
    """Return COUNT numbers in equal steps."""
    parts = re.fullmatch(r"(-?\d+(?:\.\d*)?):(-?\d+(?:\.\d*)?):(\d+)", given)
    if parts is None:
        raise WrongUsage(f"{option} {given}: is no sweep; give FIRST:LAST:COUNT, such as {example}")
    first, last, count = float(parts[1]), float(parts[2]), int(parts[3])
    if first == last or count < 2:
        raise WrongUsage(f"{option} {given}: is no sweep; give two different ends and at least 2 planes")
    return [round(float(value), 6) for value in np.linspace(first, last, count)]


def _halves(loaded: LoadedSet, phases: int) -> tuple[NDArray[np.intp], NDArray[np.intp]]:
    """Return the views of either colour of a checkerboard of nodes; of either parity where nodes are not stated."""
    views = loaded.settings.view
    odd = np.array([(sum(view.node) if view.node else index) % 2 for index, view in enumerate(views)])
    odd = np.repeat(odd, phases)
    return np.flatnonzero(odd == 0), np.flatnonzero(odd == 1)


def _say_what_oscillates(records: list[dict[str, Any]]) -> None:
    """Tell of planes on which the iteration swings to and fro."""
    certificates = [record["certificate"] for record in records if record["certificate"]]
    certificates = [certificate for certificate in certificates if "oscillates" in certificate]
    swings = [certificate["relative_change"] for certificate in certificates if certificate["oscillates"]]
    if swings:
        say(
            f"the one-step-late iteration does not settle on {len(swings)} of {len(certificates)} planes: it swings by "
            f"up to {max(swings):.1%} per pass (see reconstruction.json). A few percent hide little; a smaller "
            "--penalty-weight calms it, and leaves more noise."
        )


def _say_what_is_not_reached(records: list[dict[str, Any]]) -> None:
    """Tell of planes whose certificate is not what was asked for."""
    certificates = [record["certificate"] for record in records if record["method"] == "pmlem"]
    missed = [certificate["value"] for certificate in certificates if not certificate["reached"]]
    if missed:
        say(
            f"pmlem stopped before its certificate on {len(missed)} of {len(certificates)} planes: up to "
            f"{max(missed):.1%} from the optimum instead of {certificates[0]['tolerance']:.0%}; allow more --passes"
        )
