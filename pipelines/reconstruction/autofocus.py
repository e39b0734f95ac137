"""`--depth-mm auto`: the depths of objects, found by comparing the views."""

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, image_lattice, transfer
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.results.records import BestFocusRecord
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.comparison import Compared, compared_depths
from faintfield.recon.depth.agreement import DepthEstimate
from faintfield.recon.depth.focus import MIN_SAMPLES, SURE, likeliest_depth_mm, places_of_focus
from faintfield.recon.errors import NothingInFocus

# Depths of a search; depths around a plane that it found; searches, each in the range in which the last found anything.
_DEPTHS, _DEPTHS_AROUND, _SEARCHES = 48, 9, 3

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


def best_focus(loaded: ElementalSet, out: Path, range_mm: tuple[float, float] | None = None) -> BestFocusRecord:
    """Find the planes of best focus.

    The range is searched in equal steps of 1/depth, in bins of pixels that suit the steps and the light; then the part
    in which anything was found is searched more finely. Each depth with a large part of the picture is refined on its
    own samples.

    Parameters
    ----------
    loaded : ElementalSet
        The set.
    out : Path
        Folder of a temporary file for the images if memory is short.
    range_mm : (float, float), optional
        Range to search; by default `searched_range_mm`.

    Raises
    ------
    NothingInFocus
        The views agree on nothing in this range.
    """
    near_mm, far_mm = sorted(range_mm or searched_range_mm(loaded))
    ranges, compared, found = _narrowed(loaded, out, (near_mm, far_mm))
    sure = found.confidence >= SURE
    places = places_of_focus(found, _DEPTHS)
    if not places:
        raise _nothing(ranges[0])
    depths = [
        round(_refined(loaded, out, compared, place, float(np.median(found.index[place]))), 1) for place in places
    ]
    depths = sorted(set(depths))
    inform(f"planes of best focus between {near_mm:g} and {far_mm:g} mm: {', '.join(f'{d:g}' for d in depths)} mm")
    return BestFocusRecord(
        depth_mm=depths,
        searched_mm=ranges,
        depths_per_search=_DEPTHS,
        bins_px=compared.bins_px,
        share_of_sure=[float(place.sum() / sure.sum()) for place in places],
    )


def _narrowed(
    loaded: ElementalSet, out: Path, range_mm: tuple[float, float]
) -> tuple[list[tuple[float, float]], Compared, DepthEstimate]:
    """Search a range, then the part of it in which anything was found; return all ranges, and the last comparison."""
    moved_mm = float(np.linalg.norm(loaded.poses_rt_cam_ref[:, 3:5], axis=1).max())
    ranges = [range_mm]
    for _ in range(_SEARCHES):
        near_mm, far_mm = ranges[-1]
        step_px = loaded.settings.camera.fx_px * moved_mm * (1 / near_mm - 1 / far_mm) / (_DEPTHS - 1)
        depths = (1 / np.linspace(1 / near_mm, 1 / far_mm, _DEPTHS)).tolist()
        compared = compared_depths(loaded, depths, out, min_bins_px=int(np.ceil(step_px / _MAX_BINS_PER_STEP)))
        found = compared.depth_map()
        sure = found.confidence >= SURE
        if np.count_nonzero(sure) < MIN_SAMPLES:
            raise _nothing(range_mm)
        first, last = np.quantile(found.index[sure], _RANGE_OF_SURE) + np.array([-_MARGIN_STEPS, _MARGIN_STEPS])
        if last - first > _SHRUNK_ENOUGH * _DEPTHS:
            break
        inverse = np.interp([first, last], np.arange(_DEPTHS), 1 / np.asarray(compared.depths_mm))
        ranges.append((float(1 / inverse[0]), float(1 / inverse[1])))
    return ranges, compared, found


def searched_range_mm(loaded: ElementalSet) -> tuple[float, float]:
    """Return the nearest and farthest depth at which a set can show anything, from its poses.

    At the near end the views share a quarter of the reference view, on average. At the far end they no longer do
    (cameras that look inwards), or else it is one step of the search before infinity.
    """
    baseline_mm = float(np.linalg.norm(loaded.poses_rt_cam_ref[:, 3:], axis=1).max())
    if baseline_mm <= 0:
        raise NothingInFocus("all views were taken from one place, which tells no depths apart; give --depth-mm")
    depths = np.geomspace(0.3 * baseline_mm, 1000 * baseline_mm, _OVERLAP_DEPTHS)
    shared = np.array([overlap(loaded, depth) for depth in depths])
    best = int(shared.argmax())
    if shared[best] < _MIN_OVERLAP:
        raise NothingInFocus(
            f"the views share {shared[best]:.0%} of the reference view at most, at {depths[best]:.3g} mm; "
            "give the range to search by --sweep-mm, or that of a surface by --depth-range-mm"
        )
    overlapping = shared >= _MIN_OVERLAP
    first = best - int(np.argmin(np.append(overlapping[best::-1], False))) + 1
    last = best + int(np.argmin(np.append(overlapping[best:], False))) - 1
    return float(depths[first]), float(min(depths[last], _DEPTHS * depths[first]))


def overlap(loaded: ElementalSet, depth_mm: float) -> float:
    """Return the share of the reference view's part of a plane that the views see, too, on average."""
    pixels = image_lattice(loaded.settings.camera.size_px)
    plane = fronto_parallel_rt_ref_plane(depth_mm)
    centres = loaded.principal_points_px()
    camera = loaded.settings.camera
    # The lens has the camera's principal point; a view with its own has its picture shifted
    shifts = centres - np.array([camera.cx_px, camera.cy_px])
    seen = [
        transfer(loaded.lens, rt, plane, pixels - shifts[loaded.reference_view]) + shift
        for rt, shift in zip(loaded.poses_rt_cam_ref, shifts, strict=True)
    ]
    inside = np.all((np.array(seen) > -0.5) & (np.array(seen) < np.array(camera.size_px) - 0.5), axis=2)
    return float(inside.mean())


def _refined(loaded: ElementalSet, out: Path, compared: Compared, place: NDArray[np.bool_], index: float) -> float:
    """Return the depth around a place of the search at which the views agree best on it."""
    inverse = np.interp(
        index + np.linspace(-1.5, 1.5, _DEPTHS_AROUND),
        np.arange(len(compared.depths_mm)),
        1 / np.asarray(compared.depths_mm),
    )
    around = compared_depths(loaded, (1 / inverse).tolist(), out, bins_px=compared.bins_px)
    return likeliest_depth_mm(around.planes, around.depths_mm, place)


def _nothing(range_mm: tuple[float, float]) -> NothingInFocus:
    return NothingInFocus(
        f"between {range_mm[0]:.4g} and {range_mm[1]:.4g} mm there is no depth at which the views agree on at least "
        f"{MIN_SAMPLES} bins of pixels that stand out of the noise; give another range by --sweep-mm "
        "FIRST:LAST:COUNT, more light, or --depth-mm"
    )
