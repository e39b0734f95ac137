"""The range of depths that the views of a set share, and the refusal of planes outside of it."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import image_lattice
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.operators import seen_from
from faintfield.recon.errors import GeometryMismatch

# Depths that are tried, in baselines, and the steps by which the ends of the range are refined.
_TRIED_BASELINES, _TRIED_DEPTHS, _REFINEMENTS = (1e-3, 1e4), 120, 8

# Depths of a range of which one at least has to be shared.
_DEPTHS_OF_RANGE = 16

_MM_PER_M = 1000.0

# Depth that looks like infinity, where disparities are stated.
_FARTHEST_MM = 1e12


def overlap(elemental_set: ElementalSet, depth_mm: float) -> float:
    """Return the share of the reference view's part of a plane that the views see, too, on average."""
    return float(_seen(elemental_set, depth_mm).mean())


def _seen(elemental_set: ElementalSet, depth_mm: float) -> NDArray[np.bool_]:
    """Return which views see which points of a plane (view, point), spread over the reference view."""
    size_px = elemental_set.settings.camera.size_px
    views = range(len(elemental_set.settings.view))
    seen = seen_from(elemental_set, depth_mm, image_lattice(size_px), views)
    return np.all((seen > -0.5) & (seen < np.array(size_px) - 0.5), axis=2)


def is_shared(elemental_set: ElementalSet, depth_mm: float) -> bool:
    """Return whether at least two views see the same part of a plane; of one view alone, whether it does."""
    fewest = min(2, len(elemental_set.settings.view))
    return bool(_seen(elemental_set, depth_mm).sum(axis=0).max() >= fewest)


def check_shared(elemental_set: ElementalSet, depths_mm: Sequence[float], *, in_mm: bool) -> None:
    """Refuse planes of which no two views see the same part (GeometryMismatch).

    The message asks whether metres were meant only if the depths were given `in_mm`.
    """
    unseen = [depth for depth in depths_mm if not is_shared(elemental_set, depth)]
    if unseen:
        ends = list(dict.fromkeys((unseen[0], unseen[-1])))
        planes = "plane" if len(unseen) == 1 else f"{len(unseen)} of {len(depths_mm)} planes"
        raise GeometryMismatch(
            f"{planes} at {elemental_set.depths_text(*ends, join=' to ')}: no two views see the same part; "
            f"{remedy(elemental_set, depths_mm, in_mm=in_mm and len(unseen) == len(depths_mm))}"
        )


def check_range_shared(elemental_set: ElementalSet, range_mm: tuple[float, float]) -> None:
    """Refuse a range of depths at none of which two views see the same part of a plane (GeometryMismatch)."""
    depths_mm = 1 / np.linspace(1 / range_mm[0], 1 / range_mm[1], _DEPTHS_OF_RANGE)
    if not any(is_shared(elemental_set, depth) for depth in depths_mm.tolist()):
        raise GeometryMismatch(
            f"between {elemental_set.depths_text(*range_mm, join=' and ')} no two views see the same part of a plane; "
            f"{remedy(elemental_set, range_mm)}"
        )


def remedy(elemental_set: ElementalSet, depths_mm: Sequence[float], *, in_mm: bool = True) -> str:
    """Return the depths that the views share, and those asked for as if they had been in metres if that fits."""
    shared = shared_range_mm(elemental_set)
    if shared is None:
        return "they share no depth at all; correct the poses and their signs"
    (near_mm, far_mm), units = shared, elemental_set.units
    ends = [near_mm, min(far_mm, _FARTHEST_MM)] if np.isfinite(far_mm) or units.depth == "disparity_px" else [near_mm]
    numbers = units.numbers_text([elemental_set.stated_depth(end) for end in ends], " and ")
    shared_text = f"they share {units.quantities} {f'between {numbers}' if len(ends) == 2 else f'from {numbers} on'}"
    scaled = [depth * _MM_PER_M for depth in dict.fromkeys((depths_mm[0], depths_mm[-1]))]
    if in_mm and units.depth == "mm" and all(near_mm <= depth <= far_mm for depth in scaled):
        return f"{shared_text}; did you mean {elemental_set.depths_text(*scaled, join=' to ')}?"
    return f"{shared_text}; give such, or correct the poses"


def shared_range_mm(elemental_set: ElementalSet) -> tuple[float, float] | None:
    """Return the nearest and farthest depth at which two views see the same part, to three digits; None without any.

    The farthest is infinite unless the cameras look inwards.
    """
    baseline_mm = float(np.linalg.norm(elemental_set.poses_rt_cam_ref[:, 3:], axis=1).max())
    depths = np.geomspace(*_TRIED_BASELINES, _TRIED_DEPTHS) * (baseline_mm or 1.0)
    shared = [is_shared(elemental_set, depth) for depth in depths.tolist()]
    if not any(shared):
        return None
    first, last = shared.index(True), len(shared) - 1 - shared[::-1].index(True)
    near_mm = _refined(elemental_set, depths[first], depths[first - 1]) if first > 0 else float(depths[0])
    far_mm = _refined(elemental_set, depths[last], depths[last + 1]) if last + 1 < len(shared) else np.inf
    return _rounded(near_mm, np.ceil), _rounded(far_mm, np.floor)


def _refined(elemental_set: ElementalSet, inside_mm: float, outside_mm: float) -> float:
    for _ in range(_REFINEMENTS):
        middle_mm = float(np.sqrt(inside_mm * outside_mm))
        if is_shared(elemental_set, middle_mm):
            inside_mm = middle_mm
        else:
            outside_mm = middle_mm
    return inside_mm


def _rounded(depth_mm: float, towards: np.ufunc) -> float:
    """Return a depth to three digits, rounded into the range."""
    if not np.isfinite(depth_mm):
        return depth_mm
    unit = 10.0 ** (np.floor(np.log10(depth_mm)) - 2)
    return float(f"{towards(depth_mm / unit) * unit:.4g}")
