"""The depth of a surface from the views of a set: the range that is asked for or found, and the depths in it.

The maps of `--surface` and of `--depth-map` both come from here.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import cv2
import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import ray_from_surface
from faintfield.pipelines.console import inform, working
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.frames import Lattice
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.channels import lattice_noise, view_electrons
from faintfield.pipelines.reconstruction.depth.autofocus import searched_range_mm, views_of_search
from faintfield.pipelines.reconstruction.depth.comparison import check_places
from faintfield.pipelines.reconstruction.depth.shared_range import overlap, remedy
from faintfield.pipelines.reconstruction.operators import plane_grid, principal_shift, response_of
from faintfield.recon.errors import GeometryMismatch, NothingInFocus
from faintfield.recon.operator.grid import PlaneGrid
from faintfield.recon.surface.confidence import RIGHT_WITHIN
from faintfield.recon.surface.estimate import SurfaceEstimate, equal_steps, estimate_surface, found_range
from faintfield.recon.surface.pinhole_views import UNKNOWN, PinholeViews
from faintfield.recon.threads import map_in_threads

# Most pixels of a view, and the fewest pixels along a side that are still added up in twos.
_MAX_PIXELS, _MIN_BINNED_SIDE_PX = 80_000, 120

# Fewest views whose halves can find depths by each other's light.
_MIN_VIEWS = 4

# Smallest side of a view: a smaller one has no room for the patches and windows in which detail is compared.
_MIN_SIDE_PX = 24

# Least that the other views see of the reference view's part of the scene at some depth of a given range, on average,
# and the number of depths in it that are tried.
_MIN_OVERLAP, _TRIED = 0.1, 8

# Movement in samples of the outermost view from one depth to the next above which the user is warned, and refused.
_COARSE, _TOO_COARSE = 3.5, 16.0


def default_bins(elemental_set: ElementalSet) -> int:
    """Return the width in detector pixels of the bins: two, or more if views are large; whole periods of a mosaic."""
    width, height = elemental_set.settings.camera.size_px
    period = int(np.lcm(*elemental_set.layouts[0].lattices[0].step))
    needed = int(np.ceil(np.sqrt(width * height / _MAX_PIXELS)))
    smallest = 2 if min(width, height) >= _MIN_BINNED_SIDE_PX else 1
    return -(-max(needed, smallest) // period) * period


def luminance(elemental_set: ElementalSet, bins: int) -> PinholeViews:
    """Return the light of all views, in bins of `bins` by `bins` detector pixels, with distortion undone.

    Each view is read by one thread. Raises WrongSize, WrongBitDepth or UnreadableImage for a frame that does not match.
    """
    layouts = elemental_set.layouts
    parts = [(layout, lattice) for layout in layouts for lattice in layout.lattices]
    responses = [_response(elemental_set, lattice, bins) for _, lattice in parts]
    noises = [lattice_noise(elemental_set, lattice, None) for _, lattice in parts]
    backgrounds = [elemental_set.background_e(noise) for noise in noises]
    read_variances = [float(np.mean(elemental_set.read_variance_e2(noise))) for noise in noises]
    variances = [float(np.mean(dark)) + read for dark, read in zip(backgrounds, read_variances, strict=True)]
    views = len(elemental_set.settings.view)
    width, height = elemental_set.settings.camera.size_px
    shape = (height // bins, width // bins)
    light = np.empty((views, *shape), np.float32)
    undistorted = _undistorted_places(elemental_set, bins, shape)

    def read(view: int) -> None:
        total = np.zeros(shape, np.float32)
        paths = elemental_set.frame_paths[view]
        electrons = (found for layout in layouts for found in view_electrons(elemental_set, layout, paths))
        for (_, lattice), response, background, (sum_e, over) in zip(
            parts, responses, backgrounds, electrons, strict=True
        ):
            usable = (response > 0) & (_summed(over, lattice, bins) == 0)
            light_e = _summed(sum_e - np.asarray(background, np.float32), lattice, bins)
            total += np.where(usable, light_e / np.where(response > 0, response, 1), UNKNOWN)
        light[view] = _resampled(total, undistorted)

    with working("reading views"):
        map_in_threads(read, range(views))
    camera = elemental_set.settings.camera
    return PinholeViews(
        light,
        float(np.sum(variances)) * _pixels(parts[0][1], bins),
        ray_from_surface(elemental_set.poses_rt_cam_ref, principal_shift(elemental_set)),
        (camera.fx_px / bins, camera.fy_px / bins),
        ((camera.cx_px + 0.5) / bins - 0.5, (camera.cy_px + 0.5) / bins - 0.5),
        plane_grid(elemental_set, 1.0).binned(bins),
        np.array(elemental_set.nodes),
        _mean_response(responses, undistorted),
        _noise_share(undistorted),
    )


def _response(elemental_set: ElementalSet, lattice: Lattice, bins: int) -> NDArray[np.float32]:
    response, pixels = response_of(elemental_set, lattice), _pixels(lattice, bins)
    whole = _summed(response > 0, lattice, bins) == pixels
    return np.where(whole, _summed(response, lattice, bins) / np.float32(pixels), np.float32(0))


def _pixels(lattice: Lattice, bins: int) -> int:
    return (bins // lattice.step[0]) * (bins // lattice.step[1])


def _summed(values: NDArray[Any], lattice: Lattice, bins: int) -> NDArray[Any]:
    """Return values of a lattice (row, column) added up in bins of `bins` by `bins` detector pixels."""
    down, right = (bins // step for step in lattice.step)
    rows, columns = values.shape[0] // down, values.shape[1] // right
    whole = values[: rows * down, : columns * right].reshape(rows, down, columns, right)
    return np.asarray(whole.sum(axis=(1, 3)))


def _undistorted_places(
    elemental_set: ElementalSet, bins: int, shape: tuple[int, int]
) -> tuple[NDArray[np.float32], NDArray[np.float32]] | None:
    """Return column and row (row, column) of the bin that a pinhole camera's bin shows; None without distortion."""
    camera = elemental_set.settings.camera
    if not any(camera.distortion):
        return None
    rows, columns = np.indices(shape, np.float64)
    pixel_x, pixel_y = (columns + 0.5) * bins - 0.5, (rows + 0.5) * bins - 0.5
    directions = [(pixel_x - camera.cx_px) / camera.fx_px, (pixel_y - camera.cy_px) / camera.fy_px, np.ones(shape)]
    seen = elemental_set.lens.project(np.stack(directions, -1).reshape(-1, 3)).reshape(*shape, 2)
    places = ((seen + 0.5) / bins - 0.5).astype(np.float32)
    return np.ascontiguousarray(places[:, :, 0]), np.ascontiguousarray(places[:, :, 1])


def _resampled(
    light: NDArray[np.float32], places: tuple[NDArray[np.float32], NDArray[np.float32]] | None
) -> NDArray[np.float32]:
    """Return light at places between bins; unknown where a bin that it needs is."""
    unknown = light < UNKNOWN / 2
    if places is None:
        return np.where(unknown, UNKNOWN, light)
    values = cv2.remap(np.where(unknown, 0, light), *places, cv2.INTER_LINEAR)
    known = cv2.remap((~unknown).astype(np.float32), *places, cv2.INTER_LINEAR)
    return np.where(known > 0.999, values, UNKNOWN).astype(np.float32)


def _mean_response(
    responses: list[NDArray[np.float32]], places: tuple[NDArray[np.float32], NDArray[np.float32]] | None
) -> NDArray[np.float32]:
    """Return the mean response of the lattices (row, column), 1 where none has one."""
    mean = np.asarray(np.mean(responses, axis=0), np.float32)
    mean = np.where(mean > 0, mean, np.float32(1))
    return mean if places is None else cv2.remap(mean, *places, cv2.INTER_LINEAR, borderValue=1.0).astype(np.float32)


def _noise_share(places: tuple[NDArray[np.float32], NDArray[np.float32]] | None) -> NDArray[np.float32] | float:
    """Return the share of independent noise's variance (row, column) left between bins: the sum of squared weights."""
    if places is None:
        return 1.0
    right, down = (place - np.floor(place) for place in places)
    return np.asarray((right**2 + (1 - right) ** 2) * (down**2 + (1 - down) ** 2), np.float32)


def check_views(elemental_set: ElementalSet, purpose: str) -> None:
    """Refuse a set whose views tell no depths; `purpose` says what these are for.

    Raises BadValue for too few or too small views, and NothingInFocus if all were taken from one place.
    """
    views, size_px = len(elemental_set.settings.view), elemental_set.settings.camera.size_px
    if views < _MIN_VIEWS:
        raise BadValue(
            f"{elemental_set.folder}: has {views} views, and {purpose} needs at least {_MIN_VIEWS}; capture more nodes"
        )
    if min(size_px) < _MIN_SIDE_PX:
        raise BadValue(
            f"{elemental_set.folder}: has views of {size_px[0]} x {size_px[1]} px, and {purpose} needs at least "
            f"{_MIN_SIDE_PX} px along each side; use larger ones"
        )
    if not np.linalg.norm(elemental_set.poses_rt_cam_ref[:, 3:], axis=1).max() > 0:
        raise NothingInFocus(
            f"{elemental_set.folder}: all views were taken from one place, which tells no depths apart; correct the "
            "poses, or capture several nodes"
        )


def check_overlap(elemental_set: ElementalSet, range_mm: tuple[float, float]) -> None:
    """Refuse a range of depths, nearest and farthest, at which the views share too little (GeometryMismatch)."""
    near_mm, far_mm = range_mm
    depths = 1 / np.linspace(1 / near_mm, 1 / far_mm, _TRIED)
    own = 1 / len(elemental_set.settings.view)  # the share of the reference view itself
    shared = (max(overlap(elemental_set, depth) for depth in depths.tolist()) - own) / (1 - own)
    if shared < _MIN_OVERLAP:
        between = elemental_set.depths_text(near_mm, far_mm, join=" and ")
        raise GeometryMismatch(
            f"between {between} the other views see {shared:.0%} of what the reference view sees, "
            f"on average, and {_MIN_OVERLAP:.0%} are needed; {remedy(elemental_set, range_mm)}"
        )


type Purpose = Literal["surface", "depth map"]


@dataclass(frozen=True)
class DepthSearch:
    """The depth of each pixel of the reference view, found in bins of `bins_px` detector pixels.

    `compared` (depth,) are the 1/depth to choose from, ascending; the maps of the estimate are on the samples of `grid`
    at unit depth.
    """

    compared: NDArray[np.float64]
    bins_px: int
    grid: PlaneGrid
    estimate: SurfaceEstimate


def depths_of_set(
    elemental_set: ElementalSet, range_mm: tuple[float, float] | None, out: Path, purpose: Purpose = "surface"
) -> DepthSearch:
    """Return the depth of each pixel of the reference view in a range, by default in that of the scene.

    `out` is for a temporary file, and `purpose` is named in messages. Raises GeometryMismatch if the range is too wide,
    or views, poses and range do not fit together, and NothingInFocus if nothing is found, or shuffled views agree as
    well.
    """
    bins, grid = default_bins(elemental_set), plane_grid(elemental_set, 1.0)
    arrangement = elemental_set.settings.arrangement
    find_range = range_mm is None and (arrangement is None or arrangement.disparity_range_px is None)
    range_mm = range_mm or searched_range_mm(elemental_set)
    views = luminance(elemental_set, bins)
    near, far = 1 / range_mm[0], 1 / range_mm[1]
    with naming_range(elemental_set, far, near, purpose):
        if find_range:
            with working("searching the range of depths"):
                far, near = found_range(views, far, near)
        depths = equal_steps(views, far, near)
        _check_steps(views, depths)
    range_mm = 1 / near, 1 / far  # of the scene: all orders agree alike elsewhere, which would hide the difference
    check_places(views_of_search(elemental_set, range_mm, out), range_mm)
    with naming_range(elemental_set, far, near, purpose):
        inform(f"{purpose} {_between(elemental_set, far, near)}: comparing {len(depths)} depths")
        _warn_of_shared_error(elemental_set, 2 / (far + near))
        with working(f"finding the depths of the {purpose}"):
            found = estimate_surface(views, depths, elemental_set.inverse_depth_sigma)
    inverse_depth = enlarged(found.inverse_depth, grid.shape, bins)
    found = replace(found, inverse_depth=inverse_depth, confidence=enlarged(found.confidence, grid.shape, bins))
    return DepthSearch(depths, bins, grid, found)


@contextmanager
def naming_range(elemental_set: ElementalSet, far: float, near: float, purpose: Purpose = "surface") -> Iterator[None]:
    """Name the range of 1/depth in which views, poses and surface or depth map do not fit together."""
    try:
        yield
    except GeometryMismatch as failure:
        raise GeometryMismatch(f"{purpose} {_between(elemental_set, far, near)}: {failure}") from failure
    except NothingInFocus as failure:
        option = "--disparity-range-px" if elemental_set.units.depth == "disparity_px" else "--depth-range-mm"
        raise NothingInFocus(
            f"{_between(elemental_set, far, near)} {failure}; or give the range by {option} NEAR:FAR"
        ) from failure


def _between(elemental_set: ElementalSet, far: float, near: float) -> str:
    return f"between {elemental_set.depths_text(float(f'{1 / near:.4g}'), float(f'{1 / far:.4g}'), join=' and ')}"


def _check_steps(views: PinholeViews, depths: NDArray[np.float64]) -> None:
    step = float(depths[1] - depths[0]) * float(views.reach.max())
    apart = (
        f"{len(depths)} depths are compared, and from one to the next a point moves by {step:.1f} bins in the "
        f"outermost view, where {_COARSE:g} are enough to miss objects"
    )
    if step > _TOO_COARSE:
        raise GeometryMismatch(f"{apart}; give a narrower range, above all a farther near end")
    if step > _COARSE:
        inform(f"warning: {apart}; a narrower range would find more")


def _warn_of_shared_error(elemental_set: ElementalSet, depth: float) -> None:
    """Say so if poses by the views leave all depths uncertain together, by half of what still counts as right."""
    share = elemental_set.inverse_depth_sigma * depth
    if share > RIGHT_WITHIN / 2:
        at = elemental_set.depth_text(float(f"{depth:.2g}"))
        inform(
            f"warning: poses by the views leave all depths uncertain together, by {share:.0%} at {at} (standard "
            "deviation), so that hardly any is sure; measure the poses by boards, or give planes at known depths to "
            "`faintfield align --depth`"
        )


def enlarged[Number: np.floating](part: NDArray[Number], shape: tuple[int, int], bins: int) -> NDArray[Number]:
    """Return a map of bins on the samples of a picture (rows, columns), each with the value of the nearest bin."""
    rows, columns = (
        np.minimum(np.arange(size) // bins, count - 1) for size, count in zip(shape, part.shape, strict=True)
    )
    return part[np.ix_(rows, columns)]


def in_unit[Numbers: (float, NDArray[np.float64])](
    elemental_set: ElementalSet, inverse_depth: Numbers, unit: Literal["mm", "px", "relative"]
) -> Numbers:
    """Return depths as the poses have them, or disparities in px from one node to the next."""
    if unit != "px":
        return 1 / inverse_depth
    at_zero, slope = elemental_set.inverse_depth_of_disparity()
    return (inverse_depth - at_zero) / slope
