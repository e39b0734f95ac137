"""Acceptance of a geometry: by the transfer uncertainty that it predicts, by its outliers, and by hold-out."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.errors import LensNotInvertible, NotIdentifiable, PoorFit
from faintfield.calib.geometry.bundle import Bundle, solve_again
from faintfield.calib.geometry.observations import Observations
from faintfield.calib.geometry.rig_geometry import RigGeometry
from faintfield.calib.homography import fronto_parallel_rt_ref_plane, rotation_matrix, transfer_sigma_px

# Limits that a set has to keep in order to lack nothing. A refusal names what it lacks; the predicted transfer decides.
_MIN_BOARDS = 3
_MIN_NODES = 9  # 3 x 3
_MIN_TILT_RAD = np.radians(15)
_MIN_COVERAGE = 0.5  # share of the image's cells that hold corners
_COVERAGE_CELLS = 6  # along each side of the image
_MAX_DISTANCE_OVER_DEPTH = 2.0  # of the nearest board, over the depth of the plane

# A view is inconsistent if at least this share of its corners, and this many, are outliers: fewer are lone corners.
_MIN_OUTLIER_SHARE_OF_VIEW, _MIN_OUTLIERS_OF_VIEW = 0.2, 3

# Largest share of outliers among all corners; the model does not explain a set with more.
_MAX_OUTLIER_SHARE = 0.1

# Views that a message names, so that it stays readable.
_MAX_NAMED = 5

_MORE = "show more boards, nearer and tilted about both axes, or raise --limit-px"


def transfer_sigma_at(geometry: RigGeometry, depth_mm: float) -> NDArray[np.float64]:
    """Return σ in pixels (node, point) of the transfer by the plane normal to the axis at a depth.

    It is NaN where a view does not see the point, and for the reference view, whose transfer to itself is exact.
    """
    covariances = [geometry.lens_and_pose_covariance(node) for node in range(len(geometry.nodes))]
    rt_ref_plane = fronto_parallel_rt_ref_plane(depth_mm)
    sigma_px = transfer_sigma_px(geometry.lens, geometry.rt_cam_ref, covariances, rt_ref_plane)
    sigma_px[geometry.reference] = np.nan
    return sigma_px


def rms_over_views(sigma_px: NDArray[np.float64]) -> float:
    """Return the rms of σ over all nodes and points that are seen; infinite if none is finite."""
    with np.errstate(over="ignore", invalid="ignore"):
        mean = float(np.nanmean(np.square(sigma_px))) if np.isfinite(sigma_px).any() else np.inf
    return float(np.sqrt(mean))


def require_determined(
    geometry: RigGeometry, observations: Observations, depths_mm: Sequence[float], limit_px: float
) -> None:
    """Check that at least half of the views see the plane at each depth, and that the transfer by it is known.

    Raises
    ------
    NotIdentifiable
        It is not known to within the limit; the message gives σ, the limit, and what the boards lack.
    """
    for depth_mm in depths_mm:
        try:
            of_views_px = transfer_sigma_at(geometry, depth_mm)
        except LensNotInvertible:  # an undetermined lens may fold the image
            of_views_px = np.full((len(geometry.nodes), 1), np.inf)
        seen, others = int((~np.isnan(of_views_px)).any(axis=1).sum()), len(of_views_px) - 1
        require_seen(depth_mm, seen, others)
        sigma_px = rms_over_views(of_views_px)
        if not sigma_px <= limit_px:
            raise NotIdentifiable(
                f"plane at {depth_mm:g} mm: its transfer between views is known to {sigma_px:.3g} px only, "
                f"limit {limit_px:g} px (the corners fit to {geometry.rms_inlier_px:.2g} px, which says little): "
                f"{'; '.join(find_shortcomings(geometry, observations, depth_mm) or [_MORE])}"
            )


def require_seen(depth_mm: float, seeing_views: int, views: int) -> None:
    """Check that at least half of the views but the reference see something of a plane; raises `NotIdentifiable`."""
    if 2 * seeing_views < views:
        raise NotIdentifiable(
            f"plane at {depth_mm:g} mm: {seeing_views} of the {views} views beside the centre's see anything of it, "
            "limit half; give --depth-mm in mm from the camera, or nodes that lie nearer to one another"
        )


def find_shortcomings(geometry: RigGeometry, observations: Observations, depth_mm: float) -> list[str]:
    """Return what the set lacks, and for each what to add."""
    shortcomings = []
    boards = geometry.boards
    nearest_mm = min(float(board.rt_ref_board[5]) for board in boards)
    if len(boards) < _MIN_BOARDS:
        shortcomings.append(
            f"{len(boards)} board pose(s) only: show at least {_MIN_BOARDS}, better 6, tilted by 20 to 40 degrees"
        )
    # The angle between a board and the detector
    cosine = min(abs(rotation_matrix(board.rt_ref_board)[2, 2]) for board in boards)
    tilt_rad = float(np.arccos(min(cosine, 1.0)))
    if tilt_rad < _MIN_TILT_RAD:
        shortcomings.append(
            f"no board is tilted by more than {np.degrees(tilt_rad):.0f} degrees: "
            "tilt some by 20 to 40 degrees, about both axes"
        )
    if nearest_mm > _MAX_DISTANCE_OVER_DEPTH * depth_mm:
        shortcomings.append(f"the nearest board stands at {nearest_mm:.0f} mm: bring some to about {depth_mm:g} mm")
    if len(geometry.nodes) < _MIN_NODES:
        shortcomings.append(f"{len(geometry.nodes)} node(s) only: take at least {_MIN_NODES}")
    pixels = observations.pixels[observations.weights > 0]
    cells = np.clip((pixels / geometry.lens.size_px * _COVERAGE_CELLS).astype(int), 0, _COVERAGE_CELLS - 1)
    coverage = len(np.unique(cells, axis=0)) / _COVERAGE_CELLS**2
    if coverage < _MIN_COVERAGE:
        shortcomings.append(
            f"corners cover {coverage:.0%} of the image: move boards into its edges, or take larger ones"
        )
    return shortcomings


def inconsistent_views(bundle: Bundle, observations: Observations) -> list[str]:
    """Return a warning that names the views whose corners disagree with all others; empty if there is none.

    Raises
    ------
    PoorFit
        Too many corners disagree for any view to be trusted.
    """
    seen = (observations.weights > 0).sum(axis=(1, 2))
    lost = seen - bundle.inlier.sum(axis=(1, 2))
    worst = [
        view
        for view in np.argsort(-lost / seen, kind="stable")
        if lost[view] >= max(_MIN_OUTLIERS_OF_VIEW, _MIN_OUTLIER_SHARE_OF_VIEW * seen[view])
    ]
    named = [f"{observations.view_name(view)} ({lost[view]} of {seen[view]} corners)" for view in worst[:_MAX_NAMED]]
    more = f" and {len(worst) - _MAX_NAMED} more" if len(worst) > _MAX_NAMED else ""
    share = lost.sum() / seen.sum()
    if share > _MAX_OUTLIER_SHARE:
        raise PoorFit(
            f"{share:.0%} of the corners disagree with the fit, limit {_MAX_OUTLIER_SHARE:.0%}"
            f"{', most at ' + ', '.join(named) + more if named else ''}; check that every image has its right node and "
            "sweep, that columns and rows are those of the print, and that no board moved within a sweep"
        )
    if not named:
        return []
    return [
        f"corners disagree with all other images at {', '.join(named)}{more}: they were left out; check the node and "
        "sweep of these images, and whether they are shaken or the board moved; take them again"
    ]


def holdout_ratio(bundle: Bundle, observations: Observations) -> float | None:
    """Return the ratio of the residual of boards left out to that of the fit, √(Σ held out² / Σ fitted²).

    Each target (a board in a sweep) is left out in turn, unless some node sees it alone; None if that holds for all.
    Lens and cameras are found from the others, then only the pose of that board is fitted to its corners. A wrong lens
    model, boards of different sizes, or a board that moved make the ratio larger than 1.

    Raises
    ------
    NotIdentifiable
        There is no solution without one of the boards.
    """
    if len(observations.targets) < 2:
        return None
    held_out, fitted = 0.0, 0.0
    residuals = bundle.residuals()
    for target in range(len(observations.targets)):
        others = observations.target_of != target
        if len(set(observations.node_of[others].tolist())) < len(observations.nodes):
            continue  # some node saw this board alone
        try:
            without = solve_again(bundle, observations, others)
        except RuntimeError as failure:
            name = observations.targets[target].board
            raise NotIdentifiable(
                f"without board '{name}' the geometry cannot be solved ({failure}); show more boards"
            ) from failure
        refitted = solve_again(bundle, observations, ~others, fixed=without)
        held_out += float(np.sum(refitted.residuals() ** 2))
        fitted += float(np.sum(residuals[~others] ** 2))
    return float(np.sqrt(held_out / fitted)) if fitted else None
