"""Camera poses of a set by its views: the request, and what the views tell."""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.homography import (
    fronto_parallel_rt_ref_plane,
    image_lattice,
    rotation_matrix,
    transfer,
    transfer_sigma_px,
)
from faintfield.calib.lens import Lens
from faintfield.pipelines.console import progress, working
from faintfield.pipelines.errors import BadValue
from faintfield.pipelines.formats.files import problem_of_file
from faintfield.pipelines.formats.reading import read_arrays
from faintfield.pipelines.formats.results.alignment import PoseErrors
from faintfield.pipelines.formats.results.geometry import COVARIANCE_FILE, PosesOfSession, read_geometry
from faintfield.pipelines.formats.sets.elemental_set import ElementalSet
from faintfield.pipelines.reconstruction.depth.autofocus import searched_range_mm
from faintfield.pipelines.reconstruction.depth.search import check_views, default_bins, luminance
from faintfield.pipelines.reconstruction.operators import principal_shift
from faintfield.recon.alignment.cameras import LENS, POSE, PosedViews, move_poses
from faintfield.recon.alignment.estimate import Aligner, Alignment
from faintfield.recon.alignment.light import Folds, PlanesLight, SurfaceLight
from faintfield.recon.alignment.prior import MeasurementErrors, PosePrior
from faintfield.recon.errors import NothingInFocus
from faintfield.recon.surface.estimate import found_range

# Fewest views that are told apart from one another's noise.
MIN_VIEWS = 8

# Errors of a stage's poses unless they are stated: translations relative to the distance of neighbours, and rotations;
# and of poses that boards measured, since when little has changed but by homings, whose shifts are the last.
_STAGE_ERROR, _STAGE_RAD = 0.006, 3.5e-3
_CHANGE, _CHANGE_RAD, _HOMING = 2e-4, 3e-5, 2e-3

# Bins, on top of those of the finest pictures, in which the range of depths is found.
_RANGE_BINS = 2

# Powers of the ray that OpenCV's terms of distortion multiply: k1, k2, p1, p2, k3 to k6.
_POWERS = np.array([2, 4, 1, 1, 6, 2, 4, 6])

# Least errors that are assumed, relative to the distance of neighbours and in rad: smaller ones are none.
_LEAST_ERROR, _LEAST_RAD = 1e-6, 1e-9

# Negative eigenvalue of a covariance, relative to its largest, that is due to rounding.
_ROUNDING = 1e-6

# Step of a pose for derivatives.
_STEP = 1e-6


@dataclass(frozen=True)
class Aligned:
    """An alignment of a set, with the depths that it used or found, nearest first, and the width of its bins."""

    alignment: Alignment
    depths_mm: list[float]
    bins_px: int


def assumed_errors(elemental_set: ElementalSet, position: float | None, rotation_mrad: float | None) -> PoseErrors:
    """Return the errors of the poses: those stated, else what suits nominal or measured poses."""
    measured = elemental_set.poses == "measured"
    rad, share = (_CHANGE_RAD, _CHANGE) if measured else (_STAGE_RAD, _STAGE_ERROR)
    apart = distance_of_neighbours(elemental_set)
    return PoseErrors(
        rad if rotation_mrad is None else max(1e-3 * rotation_mrad, _LEAST_RAD),
        share * apart if position is None else max(position, _LEAST_ERROR * apart),
    )


def plausible_errors(elemental_set: ElementalSet, assumed: PoseErrors) -> PoseErrors:
    """Return the errors that are assumed, or those of a stage if they are larger."""
    stage_mm = _STAGE_ERROR * distance_of_neighbours(elemental_set)
    return PoseErrors(max(assumed.sigma_rad, _STAGE_RAD), max(assumed.sigma_mm, stage_mm))


def distance_of_neighbours(elemental_set: ElementalSet) -> float:
    """Return the median distance of a camera from its nearest neighbour, in the unit of the poses."""
    centres = np.array([_centre(pose) for pose in elemental_set.poses_rt_cam_ref])
    apart = np.linalg.norm(centres[:, np.newaxis] - centres, axis=2)
    apart[apart == 0] = np.inf  # from itself and from others at its place
    return float(np.median(apart.min(axis=1)))


def align_set(
    elemental_set: ElementalSet,
    depths_mm: Sequence[float],
    range_mm: tuple[float, float] | None,
    errors: PoseErrors,
    *,
    with_lens: bool = False,
) -> Aligned:
    """Return the poses by the views, given light on planes at given depths, else on a surface in a range or any.

    Raises BadValue for too few or too small views, two of one node, or a lens that cannot be found, and NothingInFocus
    if the views tell no depths.
    """
    check_views(elemental_set, "an alignment")
    views = len(elemental_set.settings.view)
    if views < MIN_VIEWS:
        raise BadValue(
            f"{elemental_set.folder}: has {views} views, and an alignment needs at least {MIN_VIEWS}; "
            "capture more nodes"
        )
    if len(set(elemental_set.nodes)) < views:
        raise BadValue(f"{elemental_set.folder}: two views are of one node; state a node of its own for each")
    bins, shift = default_bins(elemental_set), principal_shift(elemental_set)
    poses = elemental_set.poses_rt_cam_ref
    if with_lens and shift is not None:
        raise BadValue(f"{elemental_set.folder}: views have principal points of their own; leave out --with-lens")
    if with_lens and elemental_set.poses == "measured":
        raise BadValue(f"{elemental_set.folder}: boards know its lens better than views can; leave out --with-lens")
    shifts = np.zeros((views, 2)) if shift is None else shift
    posed = PosedViews(luminance(elemental_set, bins), poses, shifts, with_lens).at(poses)
    folds = Folds.of(views)
    light: PlanesLight | SurfaceLight
    if depths_mm:
        light = PlanesLight(folds, [1 / depth for depth in depths_mm])
    else:
        searched = range_mm or searched_range_mm(elemental_set)
        limits = 1 / searched[1], 1 / searched[0]
        light = SurfaceLight(folds, limits) if range_mm else _light_in_found_range(folds, posed, limits)
    aligner = Aligner(posed, elemental_set.reference_view, _prior(elemental_set, errors), light)
    for _ in progress(aligner.run(), "aligning views", aligner.total):
        pass
    depths = sorted(depths_mm) if isinstance(light, PlanesLight) else [1 / q for q in reversed(light.limits)]
    return Aligned(aligner.result, depths, bins)


def _light_in_found_range(folds: Folds, posed: PosedViews, searched: tuple[float, float]) -> SurfaceLight:
    try:
        with working("searching the range of depths"):
            limits = found_range(posed.binned(_RANGE_BINS).views, *searched)
    except NothingInFocus as failure:
        raise NothingInFocus(f"{failure}; or give the range by `faintfield align --depth-range NEAR:FAR`") from failure
    return SurfaceLight(folds, limits, searched)


def _prior(elemental_set: ElementalSet, errors: PoseErrors) -> PosePrior:
    nodes, reference = np.array(elemental_set.nodes), elemental_set.reference_view
    known = _measured_covariance(elemental_set)
    if known is None:
        return PosePrior.of_grid(nodes, reference, errors.sigma_rad, errors.sigma_mm)
    groups = [view.homing for view in elemental_set.settings.view]
    homing_mm = _HOMING * distance_of_neighbours(elemental_set)
    changes = MeasurementErrors(errors.sigma_rad, errors.sigma_mm, homing_mm)
    return PosePrior.of_measurement(known, groups, reference, changes)


def _measured_covariance(elemental_set: ElementalSet) -> NDArray[np.float64] | None:
    """Return the covariance of all poses but the reference's that boards measured; None if it is not at hand."""
    if elemental_set.poses != "measured" or elemental_set.measured_in is None:
        return None
    path = elemental_set.measured_in.with_name(COVARIANCE_FILE)
    if not path.is_file():
        return None
    geometry = read_geometry(elemental_set.measured_in, PosesOfSession)
    remedy = "run `faintfield geometry` again, or remove the file to align without it"
    if (digest := geometry.sha256.get(path.name)) and (fault := problem_of_file(path, path.parent, digest)):
        raise BadValue(f"{path}: {fault}; {remedy}")
    lens, places = 4 + len(geometry.lens.distortion), [entry.node for entry in geometry.nodes]
    size = lens + POSE * len(places)
    arrays = read_arrays(path, ["covariance"], shape=(size, size), max_bytes=8 * size**2, remedy=remedy)
    if "covariance" not in arrays or not np.isfinite(arrays["covariance"]).all():
        raise BadValue(f"{path}: holds no covariance, or numbers that are not finite; {remedy}")
    least, *_, largest = np.linalg.eigvalsh(arrays["covariance"])
    if least < -_ROUNDING * largest:
        raise BadValue(f"{path}: holds a covariance that is not positive; {remedy}")
    others = [node for number, node in enumerate(elemental_set.nodes) if number != elemental_set.reference_view]
    rows = np.concatenate([lens + POSE * places.index(node) + np.arange(POSE) for node in others])
    return np.asarray(arrays["covariance"][np.ix_(rows, rows)], np.float64)


@dataclass(frozen=True)
class PoseUncertainty:
    """Covariance of the numbers of the lens, then of all poses, as that of boards is written, and σ of each view.

    It is zero for the reference's pose and for what was taken as known. `sigma_rad` and `sigma_mm` (view,) are of
    orientation and centre, each the root of the trace.
    """

    covariance: NDArray[np.float64]
    sigma_rad: NDArray[np.float64]
    sigma_mm: NDArray[np.float64]


def change_lens(lens: Lens, change: tuple[float, float]) -> Lens:
    """Return the lens D((1 + s)(1 + b r²) r) of another lens D, to fourth order in the ray r, for a change (s, b)."""
    if not any(change):
        return lens
    scale, added = 1 + change[0], change[1]
    distortion = np.array(lens.distortion or (0.0,)) * scale ** _POWERS[: max(len(lens.distortion), 1)]
    if len(distortion) > 1:
        distortion[1] += 3 * added * distortion[0]
    if len(distortion) > 6:
        distortion[6] += 2 * added * distortion[5]
    distortion[0] += added
    focal_px = scale * lens.fx_px, scale * lens.fy_px
    return Lens(lens.size_px, *focal_px, lens.cx_px, lens.cy_px, tuple(distortion.tolist()))


def pose_uncertainty(alignment: Alignment, reference: int, lens: Lens) -> PoseUncertainty:
    """Return the uncertainty of the new poses and lens, by first-order propagation of that of their steps."""
    poses = alignment.rt_cam_ref
    others = np.delete(np.arange(len(poses)), reference)
    size, count = POSE * len(poses), len(lens.parameters)
    rows = np.concatenate([(POSE * others[:, np.newaxis] + np.arange(POSE)).ravel(), [size, size + 1]])
    rows = rows[: len(alignment.covariance)]
    of_steps = np.zeros((size + LENS,) * 2)
    of_steps[np.ix_(rows, rows)] = alignment.covariance
    numbers, centres = np.zeros((count + size, size + LENS)), np.zeros((3 * len(poses), size + LENS))
    numbers[:2, size] = lens.parameters[:2]
    numbers[4 : min(count, 5), size + 1] = 1
    for view in range(len(poses)):
        part = slice(POSE * view, POSE * (view + 1))
        for axis in range(POSE):
            step = np.zeros((1, POSE))
            step[0, axis] = _STEP
            ahead, behind = move_poses(poses[view : view + 1], step)[0], move_poses(poses[view : view + 1], -step)[0]
            numbers[count:][part, POSE * view + axis] = (ahead - behind) / (2 * _STEP)
            centres[3 * view : 3 * view + 3, POSE * view + axis] = (_centre(ahead) - _centre(behind)) / (2 * _STEP)
    variances = np.diag(of_steps)[:size].reshape(-1, POSE)
    of_centres = np.einsum("ij,jk,ik->i", centres, of_steps, centres).reshape(-1, 3)
    return PoseUncertainty(
        numbers @ of_steps @ numbers.T,
        np.sqrt(variances[:, :3].sum(axis=1)),
        np.sqrt(np.maximum(of_centres.sum(axis=1), 0)),
    )


def _centre(rt_cam_ref: NDArray[np.float64]) -> NDArray[np.float64]:
    return np.asarray(-rotation_matrix(rt_cam_ref).T @ rt_cam_ref[3:])


def shifts_px(
    before: tuple[Lens, NDArray[np.float64]], after: tuple[Lens, NDArray[np.float64]], depth_mm: float
) -> NDArray[np.float64]:
    """Return how the picture of a plane at a depth moves in each view, at some of its pixels (view, point, 2).

    `before` and `after` are the lens and the poses (view, 6).
    """
    plane, pixels = fronto_parallel_rt_ref_plane(depth_mm), image_lattice(before[0].size_px)
    old, new = (np.array([transfer(lens, pose, plane, pixels) for pose in poses]) for lens, poses in (before, after))
    return np.asarray(new - old)


def inverse_depth_sigma(
    before: NDArray[np.float64],
    after: NDArray[np.float64],
    covariance: NDArray[np.float64],
    depth_mm: float,
    *,
    depths_known: bool,
) -> float:
    """Return the standard deviation that the 1/depth of all points has in common by errors of the poses.

    Rotations that grow along the grid shift the views as another 1/depth does. Let s (view, 2) be where the cameras see
    a point on the axis of the reference view, and q its 1/depth. Errors δs of the poses then change q by
    `Σ s′·δs / Σ |s′|²`, with `s′ = ∂s/∂q`. Unless depths are known, so far as the alignment changed the poses in this
    way, nothing but the views vouches for it, and these hardly tell: that change counts as an error, too.

    `before` and `after` (view, 6) are the poses, and the covariance is that of all numbers of the latter.
    """
    q = 1 / depth_mm
    along = (_on_axis(after, q * (1 + _STEP)) - _on_axis(after, q * (1 - _STEP))) / (2 * _STEP * q)
    weights = along / np.sum(along**2)
    sensitivity = np.empty(after.shape)
    for axis in range(POSE):
        step = _STEP * (np.arange(POSE) == axis)
        sensitivity[:, axis] = np.sum(weights * (_on_axis(after + step, q) - _on_axis(after - step, q)), 1) / (
            2 * _STEP
        )
    variance = float(sensitivity.ravel() @ covariance @ sensitivity.ravel())
    change = 0.0 if depths_known else float(np.sum(weights * (_on_axis(after, q) - _on_axis(before, q))))
    return float(np.sqrt(max(variance, 0.0) + change**2))


def _on_axis(poses: NDArray[np.float64], inverse_depth: float) -> NDArray[np.float64]:
    """Return where cameras (view, 2), of focal length 1, see the point on the reference axis at a 1/depth."""
    turned = np.array([rotation_matrix(pose)[:, 2] for pose in poses]) + inverse_depth * poses[:, 3:]
    return np.asarray(turned[:, :2] / turned[:, 2:])


def transfer_sigmas_px(
    lens: Lens, poses: NDArray[np.float64], reference: int, uncertainty: PoseUncertainty, depth_mm: float
) -> float:
    """Return σ of the transfer between views by a plane at a depth, rms over views and image, as boards' is stated."""
    count = len(lens.parameters)
    rows = [[*range(count), *range(count + POSE * view, count + POSE * (view + 1))] for view in range(len(poses))]
    covariances = [uncertainty.covariance[np.ix_(of_view, of_view)] for of_view in rows]
    sigma_px = transfer_sigma_px(lens, poses, covariances, fronto_parallel_rt_ref_plane(depth_mm))
    return float(np.sqrt(np.nanmean(np.delete(sigma_px, reference, axis=0) ** 2)))
