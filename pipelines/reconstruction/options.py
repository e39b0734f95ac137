"""Options of planes and surfaces, of `reconstruct` and of `run`, apart from the code that makes these: for help."""

import re
from collections.abc import Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Literal

from cyclopts import Parameter

from faintfield.pipelines.arguments import (
    IN_DEPTHS,
    IN_MACHINE,
    IN_OUTPUT,
    IN_PICTURE,
    IN_SURFACE,
    Count,
    Method,
    Positive,
    SolverOptions,
)
from faintfield.pipelines.errors import WrongUsage

# Options that say where planes are, and all that a surface does not know.
PLACES = ("depth", "sweep", "depth_mm", "sweep_mm", "disparity_px", "sweep_px", "plane_pose")
OF_PLANES = (
    *PLACES,
    *("depth_map", "method", "joint", "occlusion", "uncertainty", "pitch_mm", "workers", "scheduler"),
)

# Largest sweep: more planes are a typing error, and would fill any disk.
_MAX_PLANES = 10_000


@Parameter(name="*")
@dataclass(frozen=True, kw_only=True)
class Options:
    """Options of a reconstruction.

    Parameters
    ----------
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
        Instead of planes (`run`: beside them), reconstruct one picture of the scene from the reference view, sharp
        everywhere, with the depth of each pixel and how sure both are: picture.tiff, depth_mm.tiff, surface.ply and
        others, see docs/how-to/make_surface.md. For a session, its folder is reconstructions/surface by default.
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
    pitch_mm
        Distance between samples of a plane; by default one detector pixel of the reference view.
    workers
        Number of processes, of one thread each, that make the planes.
    scheduler
        Address of a dask scheduler whose workers make the planes; they must see OUT under the same path. Needs the
        extra faintfield[cluster].
    """

    depth: Annotated[list[float | Literal["auto"]] | None, Parameter(allow_leading_hyphen=True), IN_DEPTHS] = None
    sweep: Annotated[str | None, Parameter(allow_leading_hyphen=True), IN_DEPTHS] = None
    depth_mm: Annotated[list[float | Literal["auto"]] | None, IN_DEPTHS] = None
    sweep_mm: Annotated[str | None, IN_DEPTHS] = None
    disparity_px: Annotated[list[float] | None, IN_DEPTHS] = None
    sweep_px: Annotated[str | None, Parameter(allow_leading_hyphen=True), IN_DEPTHS] = None
    plane_pose: Annotated[list[Path] | None, IN_DEPTHS] = None
    depth_map: Annotated[bool, IN_DEPTHS] = False
    surface: Annotated[bool, IN_SURFACE] = False
    depth_range_mm: Annotated[str | None, IN_SURFACE] = None
    disparity_range_px: Annotated[str | None, Parameter(allow_leading_hyphen=True), IN_SURFACE] = None
    method: Annotated[list[Method] | None, IN_PICTURE] = None
    joint: Annotated[bool, IN_PICTURE] = False
    occlusion: Annotated[bool, IN_PICTURE] = False
    solver: SolverOptions = field(default_factory=SolverOptions)
    pitch_mm: Annotated[Positive | None, IN_OUTPUT] = None
    workers: Annotated[Count | None, IN_MACHINE] = None
    scheduler: Annotated[str | None, IN_MACHINE] = None

    def given(self, names: Sequence[str]) -> list[str]:
        """Return those of some options that are given, as a user writes them."""
        values = vars(self.solver) | vars(self)
        return [f"--{name.replace('_', '-')}" for name in names if values[name]]


DEFAULTS = Options()


def sweep_values(option: str, text: str | None, example: str = "400:900:64") -> list[float]:
    """Return the numbers of FIRST:LAST:COUNT, in equal steps; none of an option that is not given."""
    if text is None:
        return []
    parts = re.fullmatch(r"(-?\d+(?:\.\d*)?):(-?\d+(?:\.\d*)?):(\d+)", text)
    if parts is None:
        raise WrongUsage(f"{option} {text}: is no sweep; give FIRST:LAST:COUNT, such as {example}")
    first, last, count = float(parts[1]), float(parts[2]), int(parts[3])
    if first == last or not 2 <= count <= _MAX_PLANES:
        raise WrongUsage(f"{option} {text}: is no sweep; give two different ends and 2 to {_MAX_PLANES} planes")
    step = (last - first) / (count - 1)
    return [*(round(first + index * step, 6) for index in range(count - 1)), round(last, 6)]
