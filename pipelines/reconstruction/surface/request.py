"""Requests for a surface: options are checked as they enter, and resolved for a set."""

import re
from dataclasses import dataclass, field, replace
from typing import Literal

from msgspec import UNSET

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.results.records import Poses
from faintfield.pipelines.formats.results.surface import SurfaceOptions
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.request import check_prior

# Folder of the surface among the results of a session.
SURFACE_FOLDER = "surface"

_NUMBER = r"(-?\d+(?:\.\d*)?(?:[eE]\+?\d{1,2})?)"

# Depths beyond this look like infinity to any camera, and sums of theirs overflow.
_FARTHEST_MM = 1e9


@dataclass(frozen=True)
class SurfaceRequest:
    """A surface to reconstruct: its range of depths, nearest first, which is found in the views if None.

    `unit` is that of the depths in its files: mm, or px of disparity from node to node.
    """

    depth_range_mm: tuple[float, float] | None = None
    unit: Literal["mm", "px"] = "mm"
    solver: SolverOptions = field(default_factory=SolverOptions)

    def options(self, poses: Poses) -> SurfaceOptions:
        """Return the options that the results record."""
        effective = {
            "uncertainty": UNSET,
            "prior": UNSET if self.solver.prior is None else self.solver.prior,
            "proposal": self.solver.proposal or UNSET,
        }
        return SurfaceOptions(
            depth_range_mm=self.depth_range_mm, unit=self.unit, **vars(self.solver) | effective, poses=poses
        )


@dataclass(frozen=True)
class SurfaceSelection:
    """The range of a surface in mm or px as the options give it, before the set is known."""

    range_mm: tuple[float, float] | None
    range_px: tuple[float, float] | None
    solver: SolverOptions

    def resolve(self, elemental_set: ElementalSet) -> SurfaceRequest:
        """Return the request for a set, whose disparities become depths (BadValue: one has none)."""
        if self.range_px is None:
            return SurfaceRequest(self.range_mm, "mm", self.solver)
        near_mm, far_mm = sorted(elemental_set.depth_of_disparity(disparity_px) for disparity_px in self.range_px)
        return SurfaceRequest((near_mm, far_mm), "px", self.solver)


def select_surface(options: Options) -> SurfaceSelection | None:
    """Return the surface that options select, None if they ask for none.

    Raises WrongUsage if a range is no range, two are given, or one although no surface is wanted; or a prior does not
    suit.
    """
    depth_range_mm, disparity_range_px = options.depth_range_mm, options.disparity_range_px
    if not options.surface:
        if depth_range_mm or disparity_range_px:
            raise WrongUsage("a range of depths or disparities is that of a surface; add --surface")
        return None
    if depth_range_mm and disparity_range_px:
        raise WrongUsage("--depth-range-mm and --disparity-range-px say the same of a surface; give one of them")
    range_mm = _ends("--depth-range-mm", depth_range_mm, "400:1500") if depth_range_mm else None
    range_px = _ends("--disparity-range-px", disparity_range_px, "-3.6:1") if disparity_range_px else None
    if range_mm is not None and not 0 < range_mm[0] < range_mm[1] <= _FARTHEST_MM:
        raise WrongUsage(
            f"--depth-range-mm {depth_range_mm}: depths are positive, and at most {_FARTHEST_MM:.0f} mm; give "
            "NEAR:FAR, such as 400:1500"
        )
    solver = replace(options.solver, uncertainty=False)  # of planes: a surface has its own always
    check_prior(["pmlem"], solver)
    return SurfaceSelection(range_mm, range_px, solver)


def _ends(option: str, text: str, example: str) -> tuple[float, float]:
    """Return the two ends of a range in ascending order."""
    parts = re.fullmatch(f"{_NUMBER}:{_NUMBER}", text)
    if parts is None or float(parts[1]) == float(parts[2]):
        raise WrongUsage(f"{option} {text}: is no range; give two different numbers as NEAR:FAR, such as {example}")
    first, last = sorted((float(parts[1]), float(parts[2])))
    return first, last
