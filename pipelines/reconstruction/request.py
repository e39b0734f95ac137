"""What `reconstruct` is asked for: its options select planes, are checked, and are resolved for a set."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Literal

import numpy as np

from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.plane_poses import Place, TiltedPlane, read_plane_poses
from faintfield.pipelines.formats.results.plane_files import plane_name
from faintfield.pipelines.formats.results.records import (
    JOINT_METHODS,
    BestFocusRecord,
    Method,
    Poses,
    ReconstructionOptions,
)
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.autofocus import best_focus
from faintfield.pipelines.reconstruction.depth_map import check_sweep
from faintfield.pipelines.reconstruction.operators import check_in_front
from faintfield.pipelines.reconstruction.planes import Settings

# Largest sweep: more planes are a typing error, and would fill any disk.
_MAX_PLANES = 10_000


def distinct_depths(depths: list[float]) -> list[float]:
    """Return each depth once; refuse those behind the camera, and two different ones that would share a file name."""
    by_name: dict[str, float] = {}
    for depth in depths:
        check_in_front(depth)
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


def depths_by_disparity(loaded: ElementalSet, disparities_px: list[float]) -> dict[float, float]:
    """Return a mapping from depth in mm to disparity in px."""
    return {loaded.depth_of_disparity(disparity): disparity for disparity in disparities_px}


def _swept(option: str, given: str, example: str) -> list[float]:
    """Return the numbers of FIRST:LAST:COUNT, in equal steps."""
    parts = re.fullmatch(r"(-?\d+(?:\.\d*)?):(-?\d+(?:\.\d*)?):(\d+)", given)
    if parts is None:
        raise WrongUsage(f"{option} {given}: is no sweep; give FIRST:LAST:COUNT, such as {example}")
    first, last, count = float(parts[1]), float(parts[2]), int(parts[3])
    if first == last or not 2 <= count <= _MAX_PLANES:
        raise WrongUsage(f"{option} {given}: is no sweep; give two different ends and 2 to {_MAX_PLANES} planes")
    return [round(float(value), 6) for value in np.linspace(first, last, count)]


DEFAULT_METHOD: Method = "pmlem"


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

    def of_plane(self, method: Method, place: Place) -> "Request":
        """Return the part of the request that one plane depends on: all planes for methods that solve them together."""
        if method in JOINT_METHODS:
            return replace(self, with_depth_map=False)
        if isinstance(place, TiltedPlane):
            return replace(self, with_depth_map=False, depths_mm=[], tilted=[place])
        return replace(self, with_depth_map=False, depths_mm=[place], tilted=[])

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
            passes=self.settings.passes,
            pitch_mm=self.pitch_mm,
            focus=self.with_focus,
            depth_map=("px" if self.disparities_px else "mm") if self.with_depth_map else None,
            plane_pose={plane.name: [*plane.rt_ref_plane, *(plane.size_mm or ())] for plane in self.tilted},
            poses=poses,
        )


@dataclass(frozen=True)
class Selection:
    """Planes as the options select them, before the set is known.

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
    depth_map : bool
        Make a depth map of the sweep.
    """

    depths_mm: list[float]
    swept_mm: list[float]
    disparities_px: list[float]
    swept_px: list[float]
    tilted: list[TiltedPlane]
    auto: bool
    depth_map: bool


def select_planes(
    depth_mm: Sequence[float | Literal["auto"]],
    sweep_mm: str | None,
    disparity_px: Sequence[float],
    sweep_px: str | None,
    plane_pose: Sequence[Path],
    *,
    depth_map: bool,
) -> Selection:
    """Return the planes that the options of `reconstruct` select.

    Raises
    ------
    WrongUsage, InputError
        They select none, contradict one another, or name a file that cannot be read.
    """
    if not (depth_mm or sweep_mm or disparity_px or sweep_px or plane_pose):
        raise WrongUsage(
            "no plane is asked for; give --depth-mm, --sweep-mm FIRST:LAST:COUNT, --disparity-px, --sweep-px or "
            "--plane-pose"
        )
    if depth_map and "auto" in depth_mm:
        raise WrongUsage(
            "--depth-map compares depths of a sweep, and --depth-mm auto leaves few; give --sweep-mm alone"
        )
    return Selection(
        depths_mm=[depth for depth in depth_mm if depth != "auto"],
        swept_mm=swept_depths(sweep_mm) if sweep_mm else [],
        disparities_px=list(disparity_px),
        swept_px=swept_disparities(sweep_px) if sweep_px else [],
        tilted=read_plane_poses(plane_pose),
        auto="auto" in depth_mm,
        depth_map=depth_map,
    )


def selected_methods(given: list[Method], *, joint: bool, occlusion: bool) -> list[Method]:
    """Return the methods given by name or by an option of their own, the default if there are none."""
    by_option: dict[Method, bool] = {"joint": joint, "occlusion": occlusion}
    return [*given, *(name for name, wanted in by_option.items() if wanted)] or [DEFAULT_METHOD]


def check_options(selection: Selection, methods: list[Method], settings: Settings) -> None:
    """Refuse options that contradict one another or would have no effect (WrongUsage)."""
    if selection.tilted and "occlusion" in methods:
        raise WrongUsage("occlusion asks which plane is nearer, which planes of any pose do not say; use joint")
    if settings.likelihood == "least-squares" and {"mlem", "pmlem-osl"} & set(methods):
        raise WrongUsage("least squares has ratios below zero, which mlem and pmlem-osl cannot take; use pmlem")
    if (settings.uncertainty or settings.penalty != "tv") and not {"pmlem", *JOINT_METHODS} & set(methods):
        option = "--uncertainty" if settings.uncertainty else f"--penalty {settings.penalty}"
        raise WrongUsage(f"{option} is for pmlem, joint and occlusion, not for {' and '.join(methods)}; leave it out")


def resolve(
    selection: Selection,
    loaded: ElementalSet,
    out: Path,
    *,
    methods: list[Method],
    settings: Settings,
    pitch_mm: float | None = None,
) -> Request:
    """Return the request for a set: disparities become depths, and `auto` the depths that are found.

    `out` is for a temporary file while depths are searched.

    Raises
    ------
    WrongUsage, BadValue, NothingInFocus
        The depths do not suit the options, a disparity has no depth, or the search finds none.
    """
    swept_of_px = depths_by_disparity(loaded, selection.swept_px)
    of_disparity = depths_by_disparity(loaded, selection.disparities_px) | swept_of_px
    depths = [*selection.depths_mm, *selection.swept_mm, *of_disparity]
    found = None
    if selection.auto:
        found = _found(selection, loaded, out, [*selection.swept_mm, *swept_of_px])
        depths, of_disparity = found.depth_mm, {}
    if selection.depth_map:
        check_sweep(distinct_depths(depths))
    return Request(
        depths,
        methods,
        settings,
        pitch_mm,
        with_focus=bool(selection.swept_mm or selection.swept_px) and found is None,
        with_depth_map=selection.depth_map,
        disparities_px=of_disparity if len(of_disparity) == len(depths) else {},
        tilted=selection.tilted,
        found=found,
    )


def _found(selection: Selection, loaded: ElementalSet, out: Path, swept_mm: list[float]) -> BestFocusRecord:
    """Return the planes of best focus, within the range of a sweep if there is one."""
    if selection.depths_mm or selection.disparities_px:
        raise WrongUsage("--depth-mm auto finds all depths; give others in a call of their own, with the same --out")
    return best_focus(loaded, out, (min(swept_mm), max(swept_mm)) if swept_mm else None)


def folder_of_method(out: Path, method: Method, methods: Sequence[Method]) -> Path:
    """Return the folder of a method's planes: `out`, or a folder of its own in it if there are several methods."""
    return out if len(methods) == 1 else out / method
