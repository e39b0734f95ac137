"""Request to `reconstruct` and `run`: their options select planes, are checked, and are resolved for a set."""

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

from msgspec import UNSET

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
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.formats.sets.stated import plane_stem
from faintfield.pipelines.reconstruction.depth.autofocus import (
    best_focus,
    found_range_mm,
    searched_range_mm,
    sweep_of_range,
)
from faintfield.pipelines.reconstruction.operators import check_in_front
from faintfield.pipelines.reconstruction.options import PLACES, Options, sweep_values
from faintfield.pipelines.reconstruction.planes.solutions import PriorName, Settings

DEFAULT_METHOD: Method = "pmlem"

# Fewer depths leave nothing to interpolate between.
_MIN_DEPTHS_OF_A_MAP = 5

# Methods whose planes a prior can improve.
_WITH_PRIOR: frozenset[Method] = frozenset({"pmlem", *JOINT_METHODS})


def distinct_depths(depths: list[float], elemental_set: ElementalSet | None = None) -> list[float]:
    """Return each depth once; refuse those behind the camera, and two different ones that would share a file name.

    Names and messages are those of a set; of one in mm if it is not given.
    """
    by_name: dict[str, float] = {}
    for depth in depths:
        check_in_front(depth)
        other = by_name.setdefault(plane_stem(elemental_set, depth) if elemental_set else plane_name(depth), depth)
        if other != depth:
            pair = (
                elemental_set.depths_text(other, depth, join=" and ")
                if elemental_set
                else f"{other:g} and {depth:g} mm"
            )
            apart = "0.1 mm apart" if pair.endswith(" mm") else "farther apart"
            raise WrongUsage(f"planes at {pair} would share a file name; keep them {apart}")
    return list(by_name.values())


@dataclass(frozen=True)
class Request:
    """Planes of a set to reconstruct, and how.

    Attributes
    ----------
    depths_mm : list of float
        Depths of the planes.
    methods : list of Method
        Methods by which each is reconstructed.
    settings : Settings
        Settings of the methods.
    pitch_mm : float, optional
        Distance of the planes' samples; one detector pixel of the reference view if None.
    with_focus : bool
        Make a curve of focus against depth.
    with_depth_map : bool
        Make a depth map and an all-in-focus picture from the planes.
    disparities_px : dict of depth in mm to px
        Disparities that were asked for instead of depths, if any.
    tilted : list of TiltedPlane
        Planes given by a pose.
    found : BestFocusRecord, optional
        How the depths were found, if they were.
    auto_sweep : int, optional
        How many depths `--sweep auto` found, the last ones; None if it was not asked for.
    """

    depths_mm: list[float]
    methods: list[Method]
    settings: Settings = field(default_factory=Settings)
    pitch_mm: float | None = None
    with_focus: bool = False
    with_depth_map: bool = False
    disparities_px: dict[float, float] = field(default_factory=dict)
    tilted: list[TiltedPlane] = field(default_factory=list)
    found: BestFocusRecord | None = None
    auto_sweep: int | None = None

    def of_plane(self, method: Method, place: Place) -> "Request":
        """Return the part of the request that one plane depends on: all planes for methods that solve them together."""
        alone = replace(self, with_depth_map=False, auto_sweep=None)
        if method in JOINT_METHODS:
            return alone
        if isinstance(place, TiltedPlane):
            return replace(alone, depths_mm=[], tilted=[place])
        return replace(alone, depths_mm=[place], tilted=[])

    def options(self, method: Method, poses: Poses) -> ReconstructionOptions:
        """Return the options that the results of a method record."""
        weight = self.settings.penalty_weight
        return ReconstructionOptions(
            method=method,
            depth_mm=self.depths_mm,
            penalty_weight="auto" if weight is None else weight,
            penalty=self.settings.penalty,
            likelihood=self.settings.likelihood,
            uncertainty=self.settings.uncertainty,
            prior=UNSET if self.settings.prior == "tv" or method not in _WITH_PRIOR else self.settings.prior,
            proposal=(self.settings.proposal and method in _WITH_PRIOR) or UNSET,
            passes=self.settings.passes,
            pitch_mm=self.pitch_mm,
            focus=self.with_focus,
            auto_sweep=UNSET if self.auto_sweep is None else self.auto_sweep,
            depth_map=("px" if self.disparities_px else "mm") if self.with_depth_map else None,
            plane_pose={plane.name: [*plane.rt_ref_plane, *(plane.size_mm or ())] for plane in self.tilted},
            poses=poses,
        )


@dataclass(frozen=True)
class Selection:
    """Planes as the options select them, and how to reconstruct them, before the set is known.

    Attributes
    ----------
    depths_mm, swept_mm : list of float
        Single depths, and those of a sweep.
    disparities_px, swept_px : list of float
        Single disparities, and those of a sweep.
    tilted : list of TiltedPlane
        Planes given by a pose.
    auto : bool
        Search for the depths, within a sweep's range if there is one.
    own, own_swept : list of float
        Single depths, and those of a sweep, in the unit of the set.
    auto_sweep : bool
        Sweep the range in which depths are found.
    depth_map : bool
        Make a depth map of the sweep.
    methods, settings, pitch_mm : list of Method, Settings, float, optional
        As in `Request`.
    """

    depths_mm: list[float]
    swept_mm: list[float]
    disparities_px: list[float]
    swept_px: list[float]
    tilted: list[TiltedPlane]
    auto: bool
    depth_map: bool
    methods: list[Method]
    settings: Settings
    pitch_mm: float | None
    own: list[float] = field(default_factory=list)
    own_swept: list[float] = field(default_factory=list)
    auto_sweep: bool = False


def settings_of(options: Options) -> Settings:
    """Return the settings that options give, the prior of a surface unless they name one."""
    weight = None if options.penalty_weight == "auto" else options.penalty_weight
    return Settings(
        *(weight, options.passes, options.likelihood, options.penalty, options.uncertainty),
        *(options.prior or "tv", options.proposal),
    )


def select_planes(options: Options) -> Selection:
    """Return the planes that options select.

    Raises
    ------
    WrongUsage, InputError
        They select none, contradict one another, would have no effect, or name a file that cannot be read.
    """
    if not options.given(PLACES):
        raise WrongUsage(
            "no plane is asked for; give --depth auto, --sweep auto, --depth-mm, --sweep-mm FIRST:LAST:COUNT, "
            "--disparity-px, --sweep-px or --plane-pose"
        )
    own, depths_mm = options.depth or [], options.depth_mm or []
    auto = "auto" in [*own, *depths_mm]
    methods = _methods(options)
    settings = settings_of(options)
    if options.prior is None:
        sweeps = bool(options.sweep or options.sweep_mm or options.sweep_px) and not auto
        settings = replace(settings, prior=_default_prior(methods, settings, sweeps=sweeps))
    selection = Selection(
        depths_mm=[depth for depth in depths_mm if depth != "auto"],
        swept_mm=_sweep_depths(options.sweep_mm) if options.sweep_mm else [],
        disparities_px=options.disparity_px or [],
        swept_px=sweep_values("--sweep-px", options.sweep_px, "-3.5:0.8:40") if options.sweep_px else [],
        tilted=read_plane_poses(options.plane_pose or []),
        auto=auto,
        own=[depth for depth in own if depth != "auto"],
        own_swept=sweep_values("--sweep", options.sweep, "400:900:64")
        if options.sweep not in (None, "", "auto")
        else [],
        auto_sweep=options.sweep == "auto",
        depth_map=options.depth_map,
        methods=methods,
        settings=settings,
        pitch_mm=options.pitch_mm,
    )
    _check_depths(selection)
    _check_methods(selection, methods, settings)
    check_prior(methods, settings)
    return selection


def _methods(options: Options) -> list[Method]:
    """Return the methods given by name or by an option of their own, each once; the default if there are none."""
    by_option: dict[Method, bool] = {"joint": options.joint, "occlusion": options.occlusion}
    given = [*(options.method or []), *(name for name, wanted in by_option.items() if wanted)]
    return list(dict.fromkeys(given)) or [DEFAULT_METHOD]


def _default_prior(methods: Sequence[Method], settings: Settings, *, sweeps: bool) -> PriorName:
    """Return auto, or tv where a prior has no effect or, in a sweep, would take long."""
    helps = settings.penalty == "tv" and settings.penalty_weight != 0 and bool(_WITH_PRIOR & set(methods))
    return "auto" if helps and not sweeps else "tv"


def check_prior(methods: list[Method], settings: Settings) -> None:
    """Refuse a prior beside options that it does not know (WrongUsage)."""
    if settings.prior == "tv":
        if settings.proposal:
            raise WrongUsage("--proposal saves what a prior proposes, and tv proposes nothing; give --prior auto")
        return
    option = f"--prior {settings.prior}"
    if not _WITH_PRIOR & set(methods):
        raise WrongUsage(f"{option} is for pmlem, joint and occlusion, not for {' and '.join(methods)}; leave it out")
    if settings.penalty_weight == 0:
        raise WrongUsage(f"{option} has no effect with --penalty-weight 0; leave one out")
    if settings.penalty != "tv":
        raise WrongUsage(f"{option} starts from total variation, not from --penalty {settings.penalty}; leave one out")


def _check_depths(selection: Selection) -> None:
    """Refuse depths beside those that are found, and too few for a depth map (WrongUsage)."""
    if selection.auto and (selection.auto_sweep or selection.depth_map):
        option = (
            "--sweep auto makes all planes of a range"
            if selection.auto_sweep
            else "--depth-map compares those of a sweep"
        )
        raise WrongUsage(f"{option}, and --depth-mm auto leaves few; give --sweep alone")
    single = [*selection.own, *selection.depths_mm, *selection.disparities_px]
    if selection.auto and single:
        raise WrongUsage("--depth-mm auto finds all depths; give others in a call of their own")
    count = len({*single, *selection.own_swept, *selection.swept_mm, *selection.swept_px})
    if selection.depth_map and not selection.auto_sweep and count < _MIN_DEPTHS_OF_A_MAP:
        raise WrongUsage(
            f"--depth-map compares depths, and {count} are given; give at least {_MIN_DEPTHS_OF_A_MAP}, by --sweep"
        )


def _check_methods(selection: Selection, methods: list[Method], settings: Settings) -> None:
    """Refuse options that contradict one another or would have no effect (WrongUsage)."""
    if selection.tilted and "occlusion" in methods:
        raise WrongUsage(
            "occlusion needs to know which plane is nearer, which is undefined for planes given by a pose; use joint"
        )
    if settings.likelihood == "least-squares" and {"mlem", "pmlem-osl"} & set(methods):
        raise WrongUsage("least squares has ratios below zero, which mlem and pmlem-osl cannot take; use pmlem")
    if (settings.uncertainty or settings.penalty != "tv") and not _WITH_PRIOR & set(methods):
        option = "--uncertainty" if settings.uncertainty else f"--penalty {settings.penalty}"
        raise WrongUsage(f"{option} is for pmlem, joint and occlusion, not for {' and '.join(methods)}; leave it out")


def _sweep_depths(sweep_mm: str) -> list[float]:
    """Return the depths of FIRST:LAST:COUNT."""
    depths = sweep_values("--sweep-mm", sweep_mm, "400:900:64")
    if min(depths) <= 0:
        raise WrongUsage(f"--sweep-mm {sweep_mm}: is no sweep; give two different positive depths")
    return depths


def resolve(
    selection: Selection, elemental_set: ElementalSet, out: Path, earlier: ReconstructionRecord | None = None
) -> Request:
    """Return the request for a set: disparities become depths, and `auto` the depths that are found.

    `out` is for a temporary file while depths are searched. Nothing is searched if the record of an `earlier` result is
    given: depths are then those that it has by the same search, or none.

    Raises
    ------
    WrongUsage, BadValue, NothingInFocus
        The depths do not suit the options, a disparity has no depth, or the search finds none.
    """
    _refuse_mm(selection, elemental_set)
    selection = _in_unit(selection, elemental_set)
    disparities_px = [*selection.disparities_px, *selection.swept_px]
    of_disparity = {elemental_set.depth_of_disparity(disparity_px): disparity_px for disparity_px in disparities_px}
    depths = [*selection.depths_mm, *selection.swept_mm, *of_disparity]
    found = None
    if selection.auto:
        range_mm = (min(depths), max(depths)) if depths else None
        if earlier is None:
            found = best_focus(elemental_set, out, range_mm)
        else:
            found = _found_earlier(earlier, range_mm or searched_range_mm(elemental_set))
        depths, of_disparity = found.depth_mm if found else [], {}
    swept_mm: list[float] = []
    if selection.auto_sweep:
        if earlier is None:
            swept_mm = sweep_of_range(elemental_set, found_range_mm(elemental_set, out))
        elif earlier.options.auto_sweep and earlier.options.depth_mm:
            swept_mm = earlier.options.depth_mm[-earlier.options.auto_sweep :]
        depths = [*depths, *swept_mm]
    return Request(
        distinct_depths(depths, elemental_set),
        selection.methods,
        selection.settings,
        selection.pitch_mm,
        with_focus=bool(selection.swept_mm or selection.swept_px or selection.auto_sweep) and not selection.auto,
        with_depth_map=selection.depth_map,
        disparities_px=of_disparity if len(of_disparity) == len(depths) else {},
        tilted=selection.tilted,
        found=found,
        auto_sweep=len(swept_mm) if selection.auto_sweep else None,
    )


def _found_earlier(earlier: ReconstructionRecord, range_mm: tuple[float, float]) -> BestFocusRecord | None:
    """Return the depths of an earlier search of a range, None if that of a result was another."""
    found = earlier.best_focus
    near_mm, far_mm = sorted(range_mm)
    return found if found and found.searched_mm[0] == (near_mm, far_mm) else None


def _refuse_mm(selection: Selection, elemental_set: ElementalSet) -> None:
    """Refuse depths in mm for a set without a scale (WrongUsage)."""
    if elemental_set.units.depth == "mm" or not (selection.depths_mm or selection.swept_mm):
        return
    given = "--depth-mm" if selection.depths_mm else "--sweep-mm"
    own = given.removesuffix("-mm")
    other = f"{own}, in its own unit, or {'--disparity-px' if selection.depths_mm else '--sweep-px'}"
    raise WrongUsage(
        f"{given} {[*selection.depths_mm, *selection.swept_mm][0]:g}: "
        f"{elemental_set.folder} has no scale, its depths are "
        f"{'disparities' if elemental_set.units.depth == 'disparity_px' else 'relative'}; give {other}, or auto"
    )


def _in_unit(selection: Selection, elemental_set: ElementalSet) -> Selection:
    """Return a selection whose depths in the unit of the set are depths or disparities."""
    if elemental_set.units.depth == "disparity_px":
        return replace(
            selection,
            disparities_px=[*selection.disparities_px, *selection.own],
            swept_px=[*selection.swept_px, *selection.own_swept],
        )
    for depth in selection.own_swept:
        check_in_front(depth)
    return replace(
        selection,
        depths_mm=[*selection.depths_mm, *selection.own],
        swept_mm=[*selection.swept_mm, *selection.own_swept],
    )


def folder_of_method(out: Path, method: Method, methods: Sequence[Method]) -> Path:
    """Return the folder of a method's planes: `out`, or a folder of its own in it if there are several methods."""
    return out if len(methods) == 1 else out / method
