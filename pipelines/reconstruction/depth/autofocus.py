"""`--depth auto`: the depths of objects, found by comparing the views."""

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from msgspec import UNSET
from numpy.typing import NDArray

from faintfield.pipelines.console import inform, working
from faintfield.pipelines.formats.results.records import BestFocusRecord
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet, rounded_depth
from faintfield.pipelines.reconstruction.depth.comparison import BinnedViews, binned_views, check_places
from faintfield.pipelines.reconstruction.depth.shared_range import overlap
from faintfield.recon.depth.agreement import Agreement, DepthEstimate, Significance, depth_map
from faintfield.recon.depth.focus import MIN_SAMPLES, SURE, likeliest_depth_mm, places_of_focus, sure_of_lit
from faintfield.recon.errors import NothingInFocus

# Depths of a search, and searches, each in the range in which the last found anything.
_DEPTHS, _SEARCHES = 48, 3

# Steps of the search on both sides of a place, between which its depth is refined.
_STEPS_AROUND = 2

# Search again if the range shrinks to less than this share of the last one.
_SHRUNK_ENOUGH = 0.6

# Steps that a range keeps on both sides of what was found, and the quantiles of the sure samples that were found.
_MARGIN_STEPS = 2.0
_RANGE_OF_SURE = (0.01, 0.99)

# Limit of the movement of the outermost view from one depth to the next, in bins: more would miss objects between.
_MAX_BINS_PER_STEP = 1.5

# Depths at which the views share less than this of the reference view, on average, are not searched.
_MIN_OVERLAP = 0.25

# Depths at which the overlap is computed.
_OVERLAP_DEPTHS = 80

# Margin of a range of disparities that an import found: a share of the range, and in px.
_RANGE_MARGIN, _MIN_MARGIN_PX = 0.1, 0.2

# Least movement of the outermost view over a range that is searched, in px: depths beside a single plane show it.
_LEAST_MOVED_PX = 12.0

# Movement of the outermost view from one plane of a sweep of the range to the next, in px, and limits of its planes.
_SWEEP_STEP_PX, _FEWEST_PLANES, _MOST_PLANES = 0.5, 8, 96

# Depths farther than this many times the nearest are taken for infinity.
_INFINITY = 1e4


def best_focus(elemental_set: ElementalSet, out: Path, range_mm: tuple[float, float] | None = None) -> BestFocusRecord:
    """Find the planes of best focus in a range, by default that of `searched_range_mm`.

    The range is searched in equal steps of 1/depth, in bins of pixels that suit the steps and the light; then the part
    in which anything was found is searched more finely. Each depth with a large part of the picture is refined on its
    own samples. `out` is for a temporary file if memory is short. Raises NothingInFocus if the views agree on nothing
    in this range, or no better than shuffled ones.
    """
    near_mm, far_mm = sorted(range_mm or searched_range_mm(elemental_set))
    ranges, bins_px, planes, found, significance = _narrowed(elemental_set, out, (near_mm, far_mm))
    sure = found.confidence >= SURE
    places = places_of_focus(found, _DEPTHS)
    if not places:
        raise _nothing(elemental_set, ranges[0])
    searched_mm = _searched_depths(ranges[-1])
    by_depth = _merged(planes, searched_mm, found, places)
    arrangement = elemental_set.settings.arrangement
    if arrangement is not None and arrangement.aligned is None and max(by_depth) >= far_mm:
        del by_depth[max(by_depth)]
        inform(
            "warning: the views agree at infinity, where pictures that are aligned on a plane show this plane; its "
            "depth is left out: import the pictures again with --disparity-px"
        )
        if not by_depth:
            raise _nothing(elemental_set, ranges[0])
    depths = sorted({rounded_depth(elemental_set, depth) for depth in by_depth})
    between = elemental_set.range_text(near_mm, far_mm)
    inform(f"planes of best focus between {between}: {elemental_set.depths_text(*depths)}")
    return BestFocusRecord(
        depth_mm=depths,
        searched_mm=ranges,
        depths_per_search=_DEPTHS,
        bins_px=bins_px,
        share_of_sure=[float(place.sum() / sure.sum()) for place in by_depth.values()],
        sure_of_lit=sure_of_lit(found.confidence, found.lit_share),
        p_value=significance.p_value if significance else UNSET,
        z_shuffled=significance.z if significance else UNSET,
        shuffles=significance.shuffles if significance else UNSET,
    )


def found_range_mm(elemental_set: ElementalSet, out: Path) -> tuple[float, float]:
    """Return the nearest and farthest depth between which the views agree on anything, with a margin."""
    return _narrowed(elemental_set, out, searched_range_mm(elemental_set))[0][-1]


def sweep_of_range(elemental_set: ElementalSet, range_mm: tuple[float, float]) -> list[float]:
    """Return depths from the nearest to the farthest, in equal steps of disparity.

    From one to the next, a point moves by at most half a pixel in the outermost view, unless that took more than
    `_MOST_PLANES` planes.
    """
    moved_px = _moved_px(elemental_set, range_mm)
    count = int(np.ceil(moved_px / _SWEEP_STEP_PX)) + 1
    planes = int(np.clip(count, _FEWEST_PLANES, _MOST_PLANES))
    step_px = moved_px / (planes - 1)
    inform(
        f"sweep: {planes} planes, {step_px:.2g} px apart in the outermost view, "
        f"over {elemental_set.depths_text(*range_mm)}"
    )
    inverse = np.linspace(1 / range_mm[0], 1 / range_mm[1], planes)
    return list(dict.fromkeys(rounded_depth(elemental_set, depth) for depth in (1 / inverse).tolist()))


def _moved_px(elemental_set: ElementalSet, range_mm: tuple[float, float]) -> float:
    """Return by how much a point moves in the outermost view from one end of a range of depths to the other."""
    moved_mm = float(np.linalg.norm(elemental_set.poses_rt_cam_ref[:, 3:5], axis=1).max())
    return elemental_set.settings.camera.fx_px * moved_mm * (1 / range_mm[0] - 1 / range_mm[1])


def _narrowed(
    elemental_set: ElementalSet, out: Path, range_mm: tuple[float, float]
) -> tuple[list[tuple[float, float]], int, list[Agreement], DepthEstimate, Significance | None]:
    """Search a range, then the part of it in which anything was found.

    Returns all ranges, the bins, agreement and depths of the last, and the significance of the first.
    """
    views = views_of_search(elemental_set, range_mm, out)
    significance = check_places(views, range_mm)
    ranges = [range_mm]
    while True:
        depths_mm = _searched_depths(ranges[-1])
        planes = views.agreements(depths_mm)
        found = depth_map(planes, np.asarray(depths_mm))
        sure = found.confidence >= SURE
        if np.count_nonzero(sure) < MIN_SAMPLES:
            raise _nothing(elemental_set, range_mm)
        first, last = np.quantile(found.index[sure], _RANGE_OF_SURE) + np.array([-_MARGIN_STEPS, _MARGIN_STEPS])
        inverse = np.interp([first, last], np.arange(_DEPTHS), 1 / np.asarray(depths_mm))
        narrower = float(1 / inverse[0]), float(1 / inverse[1])
        alike = last - first > _SHRUNK_ENOUGH * _DEPTHS or _moved_px(elemental_set, narrower) < _LEAST_MOVED_PX
        if alike or len(ranges) == _SEARCHES:
            return ranges, views.bins_px, planes, found, significance
        ranges.append(narrower)
        views = views_of_search(elemental_set, ranges[-1], out)


def _searched_depths(range_mm: tuple[float, float]) -> list[float]:
    depths: list[float] = (1 / np.linspace(1 / range_mm[0], 1 / range_mm[1], _DEPTHS)).tolist()
    return depths


def views_of_search(elemental_set: ElementalSet, range_mm: tuple[float, float], out: Path) -> BinnedViews:
    """Return the views in bins of pixels that suit the steps of a search; `out` is for a temporary file."""
    step_px = _moved_px(elemental_set, range_mm) / (_DEPTHS - 1)
    least_px = int(np.ceil(step_px / _MAX_BINS_PER_STEP))
    with working("reading views"):
        return binned_views(elemental_set, _searched_depths(range_mm)[_DEPTHS // 2], out, min_bins_px=least_px)


def searched_range_mm(elemental_set: ElementalSet) -> tuple[float, float]:
    """Return the nearest and farthest depth at which a set can show anything.

    This is the range of disparities that an import found, with a margin, if the set states it. Otherwise it follows
    from the poses. At the near end the views share a quarter of the reference view, on average. At the far end they
    no longer do (cameras that look inwards), or else it is infinity.
    """
    baseline_mm = float(np.linalg.norm(elemental_set.poses_rt_cam_ref[:, 3:], axis=1).max())
    if baseline_mm <= 0:
        raise NothingInFocus("all views were taken from one place, which tells no depths apart; give --depth")
    arrangement = elemental_set.settings.arrangement
    if arrangement is not None and arrangement.disparity_range_px is not None:
        return _range_of_disparities(elemental_set, *arrangement.disparity_range_px)
    depths = np.geomspace(0.3 * baseline_mm, 1000 * baseline_mm, _OVERLAP_DEPTHS)
    shared = np.array([overlap(elemental_set, depth) for depth in depths])
    best = int(shared.argmax())
    if shared[best] < _MIN_OVERLAP:
        raise NothingInFocus(
            f"the views share {shared[best]:.0%} of the reference view at most, at "
            f"{elemental_set.depth_text(depths[best])}; give the range to search by --sweep, or that of a surface by "
            "--depth-range-mm"
        )
    overlapping = shared >= _MIN_OVERLAP
    first = best - int(np.argmin(np.append(overlapping[best::-1], False))) + 1
    last = best + int(np.argmin(np.append(overlapping[best:], False))) - 1
    endless = last == len(depths) - 1
    return float(depths[first]), float(_INFINITY * depths[first] if endless else depths[last])


def _range_of_disparities(elemental_set: ElementalSet, least_px: float, largest_px: float) -> tuple[float, float]:
    """Return the nearest and farthest depth of a range of disparities with a margin, at most infinity."""
    at_zero, slope = elemental_set.inverse_depth_of_disparity()
    moved_mm = float(np.linalg.norm(elemental_set.poses_rt_cam_ref[:, 3:5], axis=1).max())
    wide_px = _LEAST_MOVED_PX / max(abs(slope) * elemental_set.settings.camera.fx_px * moved_mm, 1e-9)
    found_px = largest_px - least_px
    margin_px = max(_RANGE_MARGIN * found_px, _MIN_MARGIN_PX, 0.5 * (wide_px - found_px))
    far, near = sorted(at_zero + slope * end_px for end_px in (least_px - margin_px, largest_px + margin_px))
    if near <= 0:
        raise NothingInFocus(
            f"{elemental_set.folder}: arrangement.disparity_range_px = {least_px:g} to {largest_px:g} lies behind "
            "infinity by the poses; correct one of them"
        )
    return 1 / near, 1 / max(far, near / _INFINITY)


def _merged(
    planes: list[Agreement], depths_mm: list[float], estimate: DepthEstimate, places: Sequence[NDArray[np.bool_]]
) -> dict[float, NDArray[np.bool_]]:
    """Return places by their refined depth in mm, in the order of depths; within a step of the search they are one."""
    by_depth: dict[float, NDArray[np.bool_]] = {}
    step = abs(1 / depths_mm[1] - 1 / depths_mm[0])
    for place in places:
        depth_mm = _refined(planes, depths_mm, estimate, place)
        if near := [known for known in by_depth if abs(1 / known - 1 / depth_mm) <= step]:
            place = place | by_depth.pop(near[-1])
            depth_mm = _refined(planes, depths_mm, estimate, place)
        by_depth[depth_mm] = place
    return by_depth


def _refined(
    planes: list[Agreement], depths_mm: list[float], estimate: DepthEstimate, place: NDArray[np.bool_]
) -> float:
    """Return the depth, between those of the search, at which the views agree best on a place."""
    middle = round(float(np.median(estimate.index[place])))
    near = slice(max(middle - _STEPS_AROUND, 0), middle + _STEPS_AROUND + 1)
    return likeliest_depth_mm(planes[near], depths_mm[near], place)


def _nothing(elemental_set: ElementalSet, range_mm: tuple[float, float]) -> NothingInFocus:
    return NothingInFocus(
        f"between {elemental_set.range_text(*range_mm)} there is no depth at which the views agree on "
        f"at least {MIN_SAMPLES} bins of pixels that stand out of the noise; give another range by --sweep "
        "FIRST:LAST:COUNT, more light, or --depth"
    )
