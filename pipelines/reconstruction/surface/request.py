"""Requests for a surface: options are checked as they enter, and resolved for a set."""

import re
from dataclasses import dataclass, field, replace
from typing import Literal

from msgspec import UNSET

from faintfield.pipelines.arguments import SolverOptions
from faintfield.pipelines.errors import WrongUsage
from faintfield.pipelines.formats.results.surface import SurfaceOptions
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.options import Options
from faintfield.pipelines.reconstruction.request import check_prior, recorded_options

# Folder of the surface among the results of a session.
SURFACE_FOLDER = "surface"

_NUMBER = r"(-?\d+(?:\.\d*)?(?:[eE]\+?\d{1,2})?)"

# Depths beyond this look like infinity to any camera, and sums of theirs overflow.
_FARTHEST_MM = 1e9


@dataclass(frozen=True)
class SurfaceRequest:
    """A surface to reconstruct: its range of depths in mm, or of disparities in px; it is found in the views if None.

    Its files state depths in the unit of the range.
    """

    ends: tuple[float, float] | None = None
    unit: Literal["mm", "px"] = "mm"
    solver: SolverOptions = field(default_factory=SolverOptions)

    def range_mm(self, elemental_set: ElementalSet) -> tuple[float, float] | None:
        """Return the range in mm, the nearest depth first (BadValue: a disparity has no depth)."""
        if self.ends is None or self.unit == "mm":
            return self.ends
        near_mm, far_mm = sorted(elemental_set.depth_of_disparity(disparity_px) for disparity_px in self.ends)
        return near_mm, far_mm

    def options(self, elemental_set: ElementalSet) -> SurfaceOptions:
        """Return the options that the results record."""
        effective = {
            "uncertainty": UNSET,
            "prior": UNSET if self.solver.prior is None else self.solver.prior,
            "proposal": self.solver.proposal or UNSET,
        }
        return SurfaceOptions(
            depth_range_mm=self.range_mm(elemental_set),
            unit=self.unit,
            **recorded_options(self.solver) | effective,
            poses=elemental_set.poses,
        )


def select_surface(options: Options) -> SurfaceRequest | None:
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
    ends = None
    if depth_range_mm:
        ends = _ends("--depth-range-mm", depth_range_mm, "400:1500")
        if not 0 < ends[0] < ends[1] <= _FARTHEST_MM:
            raise WrongUsage(
                f"--depth-range-mm {depth_range_mm}: depths are positive, and at most {_FARTHEST_MM:.0f} mm; give "
                "NEAR:FAR, such as 400:1500"
            )
    elif disparity_range_px:
        ends = _ends("--disparity-range-px", disparity_range_px, "-3.6:1")
    solver = replace(options.solver, uncertainty=False)  # of planes: a surface has its own always
    check_prior(["pmlem"], solver)
    return SurfaceRequest(ends, "px" if disparity_range_px else "mm", solver)


def range_in_mm(elemental_set: ElementalSet, option: str, text: str) -> tuple[float, float]:
    """Return a range NEAR:FAR in the unit of the set in mm, the nearest depth first.

    Raises WrongUsage if it is no range, and BadValue if a disparity has no depth.
    """
    near_mm, far_mm = sorted(elemental_set.depth_in_mm(end) for end in _ends(option, text, "400:1500"))
    if not 0 < near_mm < far_mm <= _FARTHEST_MM:
        raise WrongUsage(
            f"{option} {text}: is no range of depths in front of the camera; give NEAR:FAR, such as 400:1500"
        )
    return near_mm, far_mm


def _ends(option: str, text: str, example: str) -> tuple[float, float]:
    parts = re.fullmatch(f"{_NUMBER}:{_NUMBER}", text)
    if parts is None or float(parts[1]) == float(parts[2]):
        raise WrongUsage(f"{option} {text}: is no range; give two different numbers as NEAR:FAR, such as {example}")
    first, last = sorted((float(parts[1]), float(parts[2])))
    return first, last
