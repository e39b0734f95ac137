"""Requests for planes: options are checked as they enter, and resolved for a set."""

from collections.abc import Sequence
from dataclasses import dataclass, field, fields, replace
from pathlib import Path
from typing import Any, Literal

from msgspec import UNSET, UnsetType

from faintfield.pipelines.arguments import PriorName, SolverOptions
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane, read_plane_poses
from faintfield.pipelines.formats.results.plane_files import plane_name
from faintfield.pipelines.formats.results.records import (
    JOINT_METHODS,
    BestFocusRecord,
    Method,
    Poses,
    ReconstructionOptions,
    ReconstructionRecord,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, plane_stem
from faintfield.pipelines.formats.units import StatedUnits
from faintfield.pipelines.reconstruction.depth.autofocus import (
    best_focus,
    found_range_mm,
    searched_range_mm,
    sweep_of_range,
)
from faintfield.pipelines.reconstruction.depth.shared_range import check_range_shared, check_shared
from faintfield.pipelines.reconstruction.operators import check_in_front
from faintfield.pipelines.reconstruction.options import PLACES, Options, sweep_values

DEFAULT_METHOD: Method = "pmlem"

# Fewer depths leave nothing to interpolate between.
_MIN_DEPTHS_OF_A_MAP = 5

# Methods whose planes a prior can improve.
WITH_PRIOR: frozenset[Method] = frozenset({"pmlem", *JOINT_METHODS})

# Units in which planes are asked for: mm, px of disparity, or that of the set.
type _Unit = Literal["mm", "px", "own"]


@dataclass(frozen=True)
class Request:
    """Planes of a set to reconstruct, and how.

    The samples of a plane are `pitch_mm` apart, one detector pixel of the reference view if None. `disparities_px` has
    the disparity of each depth if disparities were asked for. `found` says how the depths were found, if they were, and
    `auto_sweep` how many of them, the last ones, are those of `--sweep auto`.
    """

    depths_mm: list[float]
    methods: list[Method]
    solver: SolverOptions = field(default_factory=SolverOptions)
    pitch_mm: float | None = None
    with_focus: bool = False
    with_depth_map: bool = False
    disparities_px: dict[float, float] = field(default_factory=dict)
    tilted: list[TiltedPlane] = field(default_factory=list)
    found: BestFocusRecord | None = None
    auto_sweep: int | UnsetType = UNSET

    def options(self, method: Method, poses: Poses, place: Place | None = None) -> ReconstructionOptions:
        """Return the options that the results of a method record, or those that one plane of it depends on."""
        solver, improves = self.solver, method in WITH_PRIOR
        depths_mm, tilted = self.depths_mm, self.tilted
        if place is not None and method not in JOINT_METHODS:
            depths_mm, tilted = ([], [place]) if isinstance(place, TiltedPlane) else ([place], [])
        effective = {
            "prior": solver.prior if solver.has_prior and improves else UNSET,
            "proposal": (solver.proposal and improves) or UNSET,
        }
        return ReconstructionOptions(
            method=method,
            depth_mm=depths_mm,
            **recorded_options(solver) | effective,
            pitch_mm=self.pitch_mm,
            focus=self.with_focus,
            auto_sweep=self.auto_sweep if place is None else UNSET,
            depth_map=("px" if self.disparities_px else "mm") if self.with_depth_map and place is None else None,
            plane_pose={plane.name: [*plane.rt_ref_plane, *(plane.size_mm or ())] for plane in tilted},
            poses=poses,
        )


def recorded_options(solver: SolverOptions) -> dict[str, Any]:
    """Return the options of solvers that results record, without those that only Python knows."""
    return {option.name: getattr(solver, option.name) for option in fields(SolverOptions)}


@dataclass(frozen=True)
class Selection:
    """Planes as the options select them, before the set is known: single ones and those of a sweep, by unit.

    The options have the prior that is chosen by default.
    """

    options: Options
    methods: list[Method]
    tilted: list[TiltedPlane]
    single: dict[_Unit, list[float]]
    swept: dict[_Unit, list[float]]

    @property
    def auto(self) -> bool:
        """Search for the depths, within a sweep's range if there is one."""
        return "auto" in [*(self.options.depth or []), *(self.options.depth_mm or [])]

    @property
    def auto_sweep(self) -> bool:
        """Sweep the range in which depths are found."""
        return self.options.sweep == "auto"

    def numbers(self, *units: _Unit) -> list[float]:
        """Return the depths or disparities in some units, first the single ones."""
        return [number for places in (self.single, self.swept) for unit in units for number in places[unit]]


def select_planes(options: Options) -> Selection:
    """Return the planes that options select.

    Raises WrongUsage or InputError if they select none, contradict one another, would have no effect, or name a file
    that cannot be read.
    """
    if not options.given(PLACES):
        raise WrongUsage(
            "no plane is asked for; give --surface for one picture that is sharp everywhere, --depth auto, or in the "
            "unit of the set --depth NUMBER or --sweep FIRST:LAST:COUNT, or --plane-pose FILE"
        )
    selection = Selection(
        options=options,
        methods=_methods(options),
        tilted=read_plane_poses(options.plane_pose or []),
        single={
            "own": [depth for depth in options.depth or [] if depth != "auto"],
            "mm": [depth for depth in options.depth_mm or [] if depth != "auto"],
            "px": options.disparity_px or [],
        },
        swept={
            "own": [] if options.sweep == "auto" else sweep_values("--sweep", options.sweep),
            "mm": sweep_values("--sweep-mm", options.sweep_mm),
            "px": sweep_values("--sweep-px", options.sweep_px, "-3.5:0.8:40"),
        },
    )
    if any(depth <= 0 for depth in selection.swept["mm"]):
        raise WrongUsage(f"--sweep-mm {options.sweep_mm}: is no sweep; give two different positive depths")
    if options.solver.prior is None:
        solver = replace(options.solver, prior=_default_prior(selection))
        selection = replace(selection, options=replace(options, solver=solver))
    _check_depths(selection)
    _check_methods(selection)
    check_prior(selection.methods, selection.options.solver)
    return selection


def _methods(options: Options) -> list[Method]:
    by_option: dict[Method, bool] = {"joint": options.joint, "occlusion": options.occlusion}
    given = [*(options.method or []), *(name for name, wanted in by_option.items() if wanted)]
    return list(dict.fromkeys(given)) or [DEFAULT_METHOD]


def _default_prior(selection: Selection) -> PriorName:
    options, solver = selection.options, selection.options.solver
    helps = solver.penalty == "tv" and solver.penalty_weight != 0 and bool(WITH_PRIOR & set(selection.methods))
    sweeps = bool(options.sweep or options.sweep_mm or options.sweep_px) and not selection.auto
    return "auto" if helps and not sweeps else "tv"


def check_prior(methods: list[Method], solver: SolverOptions) -> None:
    """Refuse a prior beside options that it does not know (WrongUsage)."""
    if not solver.has_prior:
        if solver.proposal:
            raise WrongUsage("--proposal saves what a prior proposes, and tv proposes nothing; give --prior auto")
        return
    option = f"--prior {solver.prior}"
    if not WITH_PRIOR & set(methods):
        raise WrongUsage(f"{option} is for pmlem, joint and occlusion, not for {' and '.join(methods)}; leave it out")
    if solver.penalty_weight == 0:
        raise WrongUsage(f"{option} has no effect with --penalty-weight 0; leave one out")
    if solver.penalty != "tv":
        raise WrongUsage(f"{option} starts from total variation, not from --penalty {solver.penalty}; leave one out")


def _check_depths(selection: Selection) -> None:
    """Refuse depths beside those that are found, and too few for a depth map (WrongUsage)."""
    wants_map = selection.options.depth_map
    if selection.auto and (selection.auto_sweep or wants_map):
        option = (
            "--sweep auto makes all planes of a range"
            if selection.auto_sweep
            else "--depth-map compares those of a sweep"
        )
        raise WrongUsage(f"{option}, and --depth auto leaves few; give --sweep alone")
    if selection.auto and any(selection.single.values()):
        raise WrongUsage("--depth auto finds all depths; give others in a call of their own")
    count = len(set(selection.numbers("own", "mm", "px")))
    if wants_map and not selection.auto_sweep and count < _MIN_DEPTHS_OF_A_MAP:
        raise WrongUsage(
            f"--depth-map compares depths, and {count} are given; give at least {_MIN_DEPTHS_OF_A_MAP}, by --sweep"
        )


def _check_methods(selection: Selection) -> None:
    """Refuse options that contradict one another or would have no effect (WrongUsage)."""
    methods, solver = selection.methods, selection.options.solver
    if selection.tilted and "occlusion" in methods:
        raise WrongUsage(
            "occlusion needs to know which plane is nearer, which is undefined for planes given by a pose; use joint"
        )
    if solver.likelihood == "least-squares" and {"mlem", "pmlem-osl"} & set(methods):
        raise WrongUsage("least squares has ratios below zero, which mlem and pmlem-osl cannot take; use pmlem")
    if (solver.uncertainty or solver.penalty != "tv") and not WITH_PRIOR & set(methods):
        option = "--uncertainty" if solver.uncertainty else f"--penalty {solver.penalty}"
        raise WrongUsage(f"{option} is for pmlem, joint and occlusion, not for {' and '.join(methods)}; leave it out")


def resolve(
    selection: Selection, elemental_set: ElementalSet, out: Path, earlier: ReconstructionRecord | None = None
) -> Request:
    """Return the request for a set: disparities become depths, and `auto` the depths that are found.

    `out` is for a temporary file while depths are searched. Nothing is searched if the record of an `earlier` result is
    given: depths are then those that it has by the same search, or none. Raises WrongUsage, BadValue,
    GeometryMismatch or NothingInFocus if the depths do not suit the options, a disparity has no depth, no two views see
    a plane, or the search finds none.
    """
    _refuse_mm(selection, elemental_set)
    own_px = elemental_set.units.depth == "disparity_px"
    in_mm = selection.numbers("mm") if own_px else selection.numbers("mm", "own")
    for depth in in_mm:
        check_in_front(depth)
    in_px = selection.numbers("px", "own") if own_px else selection.numbers("px")
    disparities = {elemental_set.depth_of_disparity(disparity_px): disparity_px for disparity_px in in_px}
    depths, found, swept_mm = [*in_mm, *disparities], None, list[float]()
    if selection.auto:
        near_mm, far_mm = (min(depths), max(depths)) if depths else searched_range_mm(elemental_set)
        check_range_shared(elemental_set, (near_mm, far_mm))
        found = earlier.best_focus if earlier else best_focus(elemental_set, out, (near_mm, far_mm))
        if found and found.searched_mm[0] != (near_mm, far_mm):  # that of an earlier result was another search
            found = None
        depths, disparities = found.depth_mm if found else [], {}
    elif earlier is None:
        check_shared(elemental_set, depths, in_mm=not disparities)
    if selection.auto_sweep:
        if earlier is None:
            swept_mm = sweep_of_range(elemental_set, found_range_mm(elemental_set, out))
        elif earlier.options.auto_sweep and earlier.options.depth_mm:
            swept_mm = earlier.options.depth_mm[-earlier.options.auto_sweep :]
        depths = [*depths, *swept_mm]
    return Request(
        distinct_depths(depths, elemental_set),
        selection.methods,
        selection.options.solver,
        selection.options.pitch_mm,
        with_focus=(any(selection.swept.values()) or selection.auto_sweep) and not selection.auto,
        with_depth_map=selection.options.depth_map,
        disparities_px=disparities if len(disparities) == len(depths) else {},
        tilted=selection.tilted,
        found=found,
        auto_sweep=len(swept_mm) if selection.auto_sweep else UNSET,
    )


def _refuse_mm(selection: Selection, elemental_set: ElementalSet) -> None:
    if elemental_set.units.depth == "mm" or not (in_mm := selection.numbers("mm")):
        return
    own, in_px = ("--depth", "--disparity-px") if selection.single["mm"] else ("--sweep", "--sweep-px")
    raise WrongUsage(
        f"{own}-mm {in_mm[0]:g}: {elemental_set.folder} has no scale, its depths are "
        f"{'disparities' if elemental_set.units.depth == 'disparity_px' else 'relative'}; give {own}, in its own unit, "
        f"or {in_px}, or auto"
    )


def distinct_depths(depths: list[float], elemental_set: ElementalSet | None = None) -> list[float]:
    """Return each depth once; refuse those behind the camera, and two different ones that would share a file name.

    Names and messages are those of a set; of one in mm if it is not given.
    """
    by_name: dict[str, float] = {}
    for depth in depths:
        check_in_front(depth)
        other = by_name.setdefault(plane_stem(elemental_set, depth) if elemental_set else plane_name(depth), depth)
        if other != depth:
            own = elemental_set.depths_text(other, depth, join=" and ") if elemental_set else None
            pair = own or StatedUnits().depths_text([other, depth], " and ")
            apart = "0.1 mm apart" if pair.endswith(" mm") else "farther apart"
            raise WrongUsage(f"planes at {pair} would share a file name; keep them {apart}")
    return list(by_name.values())


def folder_of_method(out: Path, method: Method, methods: Sequence[Method]) -> Path:
    """Return the folder of a method's planes: `out`, or a folder of its own in it if there are several methods."""
    return out if len(methods) == 1 else out / method
