"""Calibrate the geometry of the rig from corners: solve, find the uncertainty, and accept or refuse the result."""

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, field, replace
from functools import partial

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.errors import CalibrationError, PoorFit, TooFewViews
from faintfield.calib.geometry.acceptance import (
    find_shortcomings,
    holdout_ratio,
    inconsistent_views,
    require_determined,
)
from faintfield.calib.geometry.bundle import (
    LENS_MODELS,
    Bundle,
    BundleProblem,
    rt_of,
    solve,
    transform_of,
    view_pose,
)
from faintfield.calib.geometry.covariance import Uncertainty, homing_shifts, uncertainty
from faintfield.calib.geometry.observations import (
    BoardObservation,
    Node,
    Observations,
    as_one_homing,
    gather,
    interrupted_sweeps,
)
from faintfield.calib.geometry.rig_geometry import BoardPose, HomingShift, RigGeometry
from faintfield.calib.lens import Lens

# Largest rms residual in pixels; beyond, boards and images do not belong together.
_MAX_RESIDUAL_PX = 5.0

# A grid of 2 x 2: fewer nodes say nothing of a stage, and hardly improve on a single view of a plane.
_MIN_NODES = 4

_REMEDY = "check columns, rows and first_marker_id of every [[board]] against the print, and the node of every image"


@dataclass(frozen=True)
class GeometrySettings:
    """Lens model and limits of a calibration.

    Parameters
    ----------
    lens_model : str
        "pinhole", "opencv4", "opencv5" or "opencv8".
    depths_mm : tuple of float
        Depths of the planes to be reconstructed, at which the transfer between views must be known.
    max_transfer_sigma_px : float
        Largest standard deviation of the transfer at these depths, rms over views and image.
    max_holdout_ratio, negligible_holdout_px : float
        Largest ratio of the residual of boards left out to that of the fit, and the rms residual that leaving boards
        out may always add: where corners fit to a few thousandths of a pixel, a large ratio does not matter.

    Raises
    ------
    ValueError
        An unknown lens model, no depth, or a depth or limit that is not positive.
    """

    lens_model: str = "opencv5"
    depths_mm: tuple[float, ...] = (500.0, 700.0)
    max_transfer_sigma_px: float = 0.5
    max_holdout_ratio: float = 1.3
    negligible_holdout_px: float = 0.1

    def __post_init__(self) -> None:
        if self.lens_model not in LENS_MODELS:
            raise ValueError(f"lens model '{self.lens_model}' is not known; take one of {', '.join(LENS_MODELS)}")
        limits = (self.max_transfer_sigma_px, self.max_holdout_ratio, self.negligible_holdout_px)
        numbers = (*self.depths_mm, *limits)
        if not self.depths_mm or not all(np.isfinite(number) and number > 0 for number in numbers):
            raise ValueError(f"depths and limits must be positive, and at least one depth given; got {numbers}")


def calibrate_geometry(
    boards: Mapping[str, Board],
    observations: Sequence[BoardObservation],
    size_px: tuple[int, int],
    reference: Node,
    settings: GeometrySettings | None = None,
) -> RigGeometry:
    """Return lens, poses and their covariance from the corners of boards seen from the nodes.

    Lens, camera poses and board poses minimise the distances between corners and their projections, by bundle
    adjustment (docs/explanation/geometry.md). The solution is refused if it does not determine the transfer between
    views.

    Parameters
    ----------
    boards : mapping of name to Board
        All boards that the observations name; their squares have one size.
    observations : sequence of BoardObservation
        Corners by node and target.
    size_px : (int, int)
        Width and height of the detector.
    reference : (int, int)
        The centre node, whose camera is the reference frame.
    settings : GeometrySettings, optional
        Lens model and limits.

    Returns
    -------
    RigGeometry
        `lens`, `nodes`, their poses `rt_cam_ref` (node, 6) as Rodrigues rad and mm, the `covariance` of lens and poses,
        and figures of the fit. `centres_mm()` gives the positions of the camera.

    Raises
    ------
    TooFewViews, NotIdentifiable, PoorFit
        The corners do not determine the geometry to the limits of `settings`; the message says why and what to add.
    MissingMrcal
        mrcal is not installed.

    Examples
    --------
    Three tilted boards, seen from 2 x 2 nodes that are 50 mm apart; a capture should have more of both:

    >>> import numpy as np
    >>> from scipy.spatial.transform import Rotation
    >>> from faintfield import Board, BoardObservation, Lens, Target, calibrate_geometry
    >>> board = Board("wall", columns=9, rows=7, square_mm=30.0, marker_mm=22.0)
    >>> camera = Lens((640, 480), fx_px=800.0, fy_px=800.0, cx_px=320.0, cy_px=240.0)
    >>> observations = []
    >>> for sweep, tilt_rad in enumerate([(0.4, 0.0, 0.0), (-0.4, 0.2, 0.0), (0.1, 0.5, 0.0)]):
    ...     corners_mm = Rotation.from_rotvec(tilt_rad).apply(board.corners_mm()) + [-80.0, -50.0, 600.0]
    ...     for row, column in np.ndindex(2, 2):
    ...         pixels = camera.project(corners_mm - [50.0 * column, 50.0 * row, 0.0])
    ...         target, sigma_px = Target("wall", sweep), np.full(48, 0.05)
    ...         observations.append(BoardObservation((row, column), target, np.arange(48), pixels, sigma_px))
    >>> geometry = calibrate_geometry({"wall": board}, observations, camera.size_px, reference=(1, 1))
    >>> round(geometry.lens.fx_px)
    800
    >>> left, right = geometry.centres_mm()[:2]
    >>> round(float(np.linalg.norm(right - left)), 1)  # mm
    50.0
    """
    settings = settings or GeometrySettings()
    problem_of = partial(_problem, boards, size_px, reference, settings.lens_model)
    solved = _solve_homings(observations, problem_of, list(boards.values()))
    gathered, bundle = solved.problem.observations, solved.bundle
    geometry = _geometry(solved)
    if not find_shortcomings(geometry, gathered, max(settings.depths_mm)):  # else the solution may be any
        _require_residuals(bundle, gathered)
    require_determined(geometry, gathered, settings.depths_mm, settings.max_transfer_sigma_px)
    geometry = replace(geometry, holdout_ratio=holdout_ratio(bundle, gathered))
    _require_fit(geometry, settings)
    return geometry


@dataclass(frozen=True)
class Adjustment:
    """A solution that nothing has judged yet: geometry, corners, which of them count, and whether boards may bend."""

    geometry: RigGeometry
    observations: Observations
    inlier: NDArray[np.bool_]
    with_warp: bool


def adjust(
    boards: Mapping[str, Board],
    observations: Sequence[BoardObservation],
    size_px: tuple[int, int],
    reference: Node,
    lens_model: str,
) -> Adjustment:
    """Return the solution from the corners that there are so far; homings within sweeps are left out of account.

    Raises
    ------
    TooFewViews, NotIdentifiable, PoorFit
        There is no solution, or corners contradict one another.
    """
    problem = _problem(boards, size_px, reference, lens_model, as_one_homing(observations))
    bundle = _solve(problem)
    solved = _Solved(problem, bundle, uncertainty(bundle, problem.observations))
    _require_residuals(bundle, problem.observations)
    return Adjustment(_geometry(solved), problem.observations, bundle.inlier, problem.with_warp)


def nominal_adjustment(
    boards: Mapping[str, Board],
    observations: Sequence[BoardObservation],
    lens: Lens,
    reference: Node,
    rt_cam_ref: Mapping[Node, NDArray[np.float64]],
) -> Adjustment:
    """Return a geometry at stated poses and a stated lens, in which only the boards are where the corners put them.

    It stands for the solution while the corners leave lens or poses free. Its covariance is not known, and is zero.
    """
    problem = _problem(boards, lens.size_px, reference, "opencv5", as_one_homing(observations))
    gathered = problem.observations
    corners = (gathered.weights > 0).sum(axis=(1, 2))
    poses = []
    for number, target in enumerate(gathered.targets):
        view = int(np.argmax(np.where(gathered.target_of == number, corners, -1)))
        ref_from_cam = np.linalg.inv(transform_of(rt_cam_ref[gathered.nodes[gathered.node_of[view]]]))
        poses.append(BoardPose(target, rt_of(ref_from_cam @ view_pose(problem, view, lens.fx_px)[0])))
    nodes = sorted(gathered.nodes)
    size = len(lens.parameters) + 6 * len(nodes)
    geometry = RigGeometry(
        lens=lens,
        lens_model=problem.lens_model,
        nodes=nodes,
        reference=nodes.index(reference),
        rt_cam_ref=np.array([rt_cam_ref[node] for node in nodes]),
        covariance=np.zeros((size, size)),
        boards=poses,
        warp_mm=np.zeros(2),
        sigma_px=float(np.median(np.concatenate([seen.sigma_px for seen in observations]))),
        rms_inlier_px=0.0,
        rms_mrcal_px=0.0,
        corners=gathered.corner_count,
        outliers=0,
        holdout_ratio=None,
        repeatability=None,
    )
    return Adjustment(geometry, gathered, gathered.weights > 0, problem.with_warp)


@dataclass(frozen=True)
class _Solved:
    """A solution, and what it says of homings within sweeps."""

    problem: BundleProblem
    bundle: Bundle
    known: Uncertainty
    shifts: list[HomingShift] = field(default_factory=list)
    undetermined: list[int] = field(default_factory=list)


def _solve_homings(
    observations: Sequence[BoardObservation],
    problem_of: Callable[[Sequence[BoardObservation]], BundleProblem],
    boards: Sequence[Board],
) -> _Solved:
    """Return the solution with a pose of each board before and after a homing, if the homing shifted the stage."""
    joined = problem_of(as_one_homing(observations))
    undetermined = interrupted_sweeps(observations)
    if undetermined:
        with suppress(CalibrationError):  # too few nodes share a board and a homing
            apart = problem_of(observations)
            if set(apart.observations.nodes) == set(joined.observations.nodes):
                bundle = _solve(apart)
                known = uncertainty(bundle, apart.observations)
                shifts = homing_shifts(bundle, apart.observations, known.covariance, boards)
                if any(shift.is_significant() for shift in shifts):
                    return _Solved(apart, bundle, known, shifts)
                undetermined = []
    bundle = _solve(joined)
    return _Solved(joined, bundle, uncertainty(bundle, joined.observations), undetermined=undetermined)


def _problem(
    boards: Mapping[str, Board],
    size_px: tuple[int, int],
    reference: Node,
    lens_model: str,
    observations: Sequence[BoardObservation],
) -> BundleProblem:
    """Return the input of the bundle adjustment, checked for enough nodes and boards of one size."""
    named = [boards[name] for name in dict.fromkeys(seen.target.board for seen in observations)]
    if not named:
        raise TooFewViews("no board was found in any image; check [[board]] against the print, and the exposure")
    gathered = gather(observations, {board.name: board.corner_shape for board in named}, reference)
    if len(gathered.nodes) < _MIN_NODES:
        raise TooFewViews(
            f"{len(gathered.nodes)} node(s) show the boards that the reference node {reference} shows, limit "
            f"{_MIN_NODES}; take more nodes, better 9 and more, and leave the boards where they are meanwhile"
        )
    sizes_mm = sorted({board.square_mm for board in named})
    if len(sizes_mm) > 1:
        raise ValueError(f"boards have squares of {sizes_mm} mm; all boards of one calibration must have the same")
    one_shape = len({board.corner_shape for board in named}) == 1
    return BundleProblem(gathered, size_px, sizes_mm[0], lens_model, with_warp=one_shape)


def _solve(problem: BundleProblem) -> Bundle:
    """Return the solution, checked for convergence and a lens that can be."""
    try:
        bundle = solve(problem)
    except RuntimeError as failure:
        raise PoorFit(f"the bundle adjustment does not converge ({failure}); {_REMEDY}") from failure
    if not (np.isfinite(bundle.intrinsics).all() and bundle.intrinsics[:2].min() > 0):
        raise PoorFit(
            f"the corners fit no lens (focal length {bundle.intrinsics[:2].min():.3g} px); {_REMEDY}; "
            "show at least 3 tilted boards at 9 nodes"
        )
    return bundle


def _require_residuals(bundle: Bundle, observations: Observations) -> None:
    """Check that the residuals are those of boards; the failure names the worst view."""
    square = np.square(bundle.residuals()).sum(axis=(1, 2, 3)) / (2 * np.maximum(bundle.inlier.sum(axis=(1, 2)), 1))
    rms_px = float(np.sqrt(np.square(bundle.residuals()[bundle.inlier]).mean()))
    if not rms_px <= _MAX_RESIDUAL_PX:
        worst = observations.view_name(int(np.argmax(square)))
        raise PoorFit(
            f"the corners fit to {rms_px:.3g} px only, limit {_MAX_RESIDUAL_PX:g} px, worst at {worst}; {_REMEDY}"
        )


def _geometry(solved: _Solved) -> RigGeometry:
    """Return the solution in raster order of the nodes, without a hold-out ratio."""
    problem, bundle, known, observations = solved.problem, solved.bundle, solved.known, solved.problem.observations
    order = sorted(range(len(observations.nodes)), key=lambda index: observations.nodes[index])
    squares, inliers = float(np.sum(bundle.residuals() ** 2)), int(bundle.inlier.sum())
    return RigGeometry(
        lens=Lens.from_parameters(problem.size_px, bundle.intrinsics),
        lens_model=problem.lens_model,
        nodes=[observations.nodes[index] for index in order],
        reference=order.index(0),
        rt_cam_ref=bundle.rt_cam_ref[order],
        covariance=_lens_and_poses(bundle, known.covariance, order),
        boards=list(map(BoardPose, observations.targets, bundle.rt_ref_board)),
        warp_mm=bundle.warp_mm,
        sigma_px=known.sigma_px,
        rms_inlier_px=float(np.sqrt(squares / (2 * inliers))),
        rms_mrcal_px=float(np.sqrt(squares / bundle.inlier.size)),
        corners=inliers,
        outliers=observations.corner_count - inliers,
        holdout_ratio=None,
        repeatability=known.repeatability,
        warnings=inconsistent_views(bundle, observations),
        homings=solved.shifts,
        undetermined_homings=solved.undetermined,
        solution=bundle,
    )


def _lens_and_poses(bundle: Bundle, covariance: NDArray[np.float64], order: list[int]) -> NDArray[np.float64]:
    """Return the covariance of the intrinsics and of all nodes in their order, zero for the reference."""
    slices = bundle.state_slices()
    first = slices["cameras"].start + 6 * (np.array(order) - 1)
    poses = np.where(np.array(order) > 0, first + np.arange(6)[:, np.newaxis], -1).T.ravel()
    chosen = np.r_[slices["intrinsics"], poses]
    known = chosen >= 0
    result = np.zeros((len(chosen), len(chosen)))
    result[np.ix_(known, known)] = covariance[np.ix_(chosen[known], chosen[known])]
    return result


def _require_fit(geometry: RigGeometry, settings: GeometrySettings) -> None:
    ratio, limit = geometry.holdout_ratio, settings.max_holdout_ratio
    if ratio is None or ratio <= limit:
        return
    if geometry.rms_inlier_px * np.sqrt(ratio**2 - 1) > settings.negligible_holdout_px:
        other = "" if geometry.lens_model == "opencv8" else "try --lens opencv8, "
        raise PoorFit(
            f"boards left out of the fit are off by {ratio:.2f} times its residual of {geometry.rms_inlier_px:.3g} px, "
            f"limit {limit}; check square_mm and the flatness of the boards, {other}or show more boards"
        )
