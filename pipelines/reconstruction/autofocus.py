"""`--depth-mm auto`: the depths at which something stands, found by comparing the views."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import fronto_parallel_rt_ref_plane, image_lattice, transfer
from faintfield.pipelines.console import inform
from faintfield.pipelines.formats.sets.elemental_set import LoadedSet
from faintfield.pipelines.reconstruction.depth_map import Compared, compared_depths
from faintfield.recon.depth.best_focus import MIN_SAMPLES, SURE, likeliest_depth_mm, places_of_focus
from faintfield.recon.errors import NothingInFocus

# Depths of a search, and around a plane that it found; searches, each in the range where the one before found anything.
_DEPTHS, _DEPTHS_AROUND, _SEARCHES = 48, 9, 3

# A range that shrinks to less than this is searched again; it keeps so many steps beside what was found.
_WORTH_ANOTHER, _MARGIN_STEPS = 0.6, 2.0
_MOST_OF_THE_SURE = (0.01, 0.99)

# From one depth to the next the outermost view moves by so many bins at most, or what lies between would be missed.
_MOST_BINS_PER_STEP = 1.5

# Where the views share less than this of the reference view, in the mean, nothing is looked for.
_LEAST_OVERLAP = 0.25
_TRIED_DEPTHS = 80


@dataclass(frozen=True)
class BestFocus:
    """Depths that were found, and how.

    Attributes
    ----------
    depths_mm : list of float
        The planes of best focus.
    record : dict
        What reconstruction.json says of the search.
    """

    depths_mm: list[float]
    record: dict[str, Any]


def best_focus(loaded: LoadedSet, out: Path, range_mm: tuple[float, float] | None = None) -> BestFocus:
    """Find the planes of best focus.

    The range is searched in equal steps of 1/depth, in bins of pixels as large as the steps and the light ask for; then
    the part of it in which anything was found, more finely. Each depth at which much of the picture lies is refined
    on its own samples.

    Parameters
    ----------
    loaded : LoadedSet
        The set.
    out : Path
        Where a file may lie that holds the images while memory is short.
    range_mm : (float, float), optional
        Where to search; by default `searched_range_mm`.

    Raises
    ------
    NothingInFocus
        The views agree on nothing in this range.
    """
    near_mm, far_mm = sorted(range_mm or searched_range_mm(loaded))
    ranges = [(near_mm, far_mm)]
    for _ in range(_SEARCHES):
        compared = _searched(loaded, out, *ranges[-1])
        found = compared.depth_map()
        sure = found.confidence >= SURE
        if np.count_nonzero(sure) < MIN_SAMPLES:
            raise _nothing(ranges[0])
        first, last = np.quantile(found.index[sure], _MOST_OF_THE_SURE) + np.array([-_MARGIN_STEPS, _MARGIN_STEPS])
        if last - first > _WORTH_ANOTHER * _DEPTHS:
            break
        inverse = np.interp([first, last], np.arange(_DEPTHS), 1 / np.asarray(compared.depths_mm))
        ranges.append((float(1 / inverse[0]), float(1 / inverse[1])))
    places = places_of_focus(found, _DEPTHS)
    if not places:
        raise _nothing(ranges[0])
    depths = [
        round(_refined(loaded, out, compared, place, float(np.median(found.index[place]))), 1) for place in places
    ]
    depths = sorted(set(depths))
    inform(f"planes of best focus between {near_mm:g} and {far_mm:g} mm: {', '.join(f'{d:g}' for d in depths)} mm")
    record = {
        "depth_mm": depths,
        "searched_mm": [list(searched) for searched in ranges],
        "depths_per_search": _DEPTHS,
        "bins_px": compared.bins_px,
        "share_of_sure": [float(place.sum() / sure.sum()) for place in places],
    }
    return BestFocus(depths, record)


def searched_range_mm(loaded: LoadedSet) -> tuple[float, float]:
    """Return between which depths a set can show anything, from its own poses.

    The near end is where the views share a quarter of the reference view, in the mean. The far end is where they no
    longer do (cameras that look inwards), or else one step of the search before infinity.
    """
    baseline_mm = float(np.linalg.norm(loaded.poses_rt_cam_ref[:, 3:], axis=1).max())
    if baseline_mm <= 0:
        raise NothingInFocus("all views were taken from one place, which tells no depths apart; give --depth-mm")
    depths = np.geomspace(0.3 * baseline_mm, 1000 * baseline_mm, _TRIED_DEPTHS)
    shared = np.array([_overlap(loaded, depth) for depth in depths])
    best = int(shared.argmax())
    if shared[best] < _LEAST_OVERLAP:
        raise NothingInFocus(
            f"the views share {shared[best]:.0%} of the reference view at most, at {depths[best]:.3g} mm; "
            "give the range to search by --sweep-mm"
        )
    enough = shared >= _LEAST_OVERLAP
    first = best - int(np.argmin(np.append(enough[best::-1], False))) + 1
    last = best + int(np.argmin(np.append(enough[best:], False))) - 1
    return float(depths[first]), float(min(depths[last], _DEPTHS * depths[first]))


def _overlap(loaded: LoadedSet, depth_mm: float) -> float:
    """Return how much of what the reference view sees of a plane the views see, too, in the mean."""
    pixels = image_lattice(loaded.settings.camera.size_px)
    plane = fronto_parallel_rt_ref_plane(depth_mm)
    centres = loaded.principal_points_px()
    camera = loaded.settings.camera
    # The lens knows the camera's principal point; where a view has its own, its picture is shifted
    shifts = centres - np.array([camera.cx_px, camera.cy_px])
    seen = [
        transfer(loaded.lens, rt, plane, pixels - shifts[loaded.reference_view]) + shift
        for rt, shift in zip(loaded.poses_rt_cam_ref, shifts, strict=True)
    ]
    inside = np.all((np.array(seen) > -0.5) & (np.array(seen) < np.array(camera.size_px) - 0.5), axis=2)
    return float(inside.mean())


def _searched(loaded: LoadedSet, out: Path, near_mm: float, far_mm: float) -> Compared:
    """Compare the views at the depths of one search."""
    depths = (1 / np.linspace(1 / near_mm, 1 / far_mm, _DEPTHS)).tolist()
    moved_mm = float(np.linalg.norm(loaded.poses_rt_cam_ref[:, 3:5], axis=1).max())
    step_px = loaded.settings.camera.fx_px * moved_mm * (1 / near_mm - 1 / far_mm) / (_DEPTHS - 1)
    return compared_depths(loaded, depths, out, least_bins_px=int(np.ceil(step_px / _MOST_BINS_PER_STEP)))


def _refined(loaded: LoadedSet, out: Path, compared: Compared, place: NDArray[np.bool_], index: float) -> float:
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
