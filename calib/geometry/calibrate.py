"""Geometry of the rig from corners: solve, state the uncertainty, and refuse what the corners cannot carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from faintfield.calib.board import Board
from faintfield.calib.errors import PoorFit, TooFewViews
from faintfield.calib.geometry.acceptance import lacks, require_determined
from faintfield.calib.geometry.bundle import LENS_MODELS, Bundle, Problem, solve
from faintfield.calib.geometry.covariance import Uncertainty, uncertainty
from faintfield.calib.geometry.diagnostics import doubtful_views
from faintfield.calib.geometry.holdout import holdout_ratio
from faintfield.calib.geometry.observations import BoardObservation, Node, Observations, gather
from faintfield.calib.geometry.rig_geometry import BoardPose, RigGeometry
from faintfield.calib.lens import Lens

# Larger residuals are of no board.
_MOST_RESIDUAL_PX = 5.0
# What a grid of 2 x 2 has; less says nothing of a stage, and a plane seen from fewer places is no better than one view.
_FEWEST_NODES = 4
_REMEDY = "check columns, rows and first_marker_id of every [[board]] against the print, and the node of every image"


@dataclass(frozen=True)
class GeometrySettings:
    """What is asked of the calibration.

    Parameters
    ----------
    lens_model : str
        "pinhole", "opencv4", "opencv5" or "opencv8".
    depths_mm : tuple of float
        Depths of the planes that will be reconstructed, for which the transfer must be known.
    most_transfer_sigma_px : float
        Largest standard deviation allowed there, rms over views and image.
    most_holdout_ratio : float
        Largest residual of boards left out, relative to the fit's; where corners fit to a few thousandths of a pixel,
        what leaving boards out adds may be many times that and yet too little to matter.
    negligible_holdout_px : float
        So much, rms, is never refused.

    Raises
    ------
    ValueError
        An unknown lens model, no depth, or a depth or limit that is not positive.
    """

    lens_model: str = "opencv5"
    depths_mm: tuple[float, ...] = (500.0, 700.0)
    most_transfer_sigma_px: float = 0.5
    most_holdout_ratio: float = 1.3
    negligible_holdout_px: float = 0.1

    def __post_init__(self) -> None:
        if self.lens_model not in LENS_MODELS:
            raise ValueError(f"lens model '{self.lens_model}' is not known; take one of {', '.join(LENS_MODELS)}")
        numbers = (
            *self.depths_mm,
            self.most_transfer_sigma_px,
            self.most_holdout_ratio,
            self.negligible_holdout_px,
        )
        if not self.depths_mm or not all(np.isfinite(number) and number > 0 for number in numbers):
            raise ValueError(f"depths and limits must be positive, and at least one depth given; got {numbers}")


def calibrate_geometry(
    boards: Mapping[str, Board],
    observations: Sequence[BoardObservation],
    size_px: tuple[int, int],
    reference: Node,
    settings: GeometrySettings | None = None,
) -> RigGeometry:
    """Return lens, poses and their covariance from the corners of boards seen at the nodes.

    Parameters
    ----------
    boards : mapping of name to Board
        All that are named by the observations; their squares are of one size.
    observations : sequence of BoardObservation
        Per node and board as it stood.
    size_px : (int, int)
        Width and height of the detector.
    reference : (int, int)
        The centre node.
    settings : GeometrySettings, optional
        The defaults otherwise.

    Raises
    ------
    TooFewViews, NotIdentifiable, PoorFit
        The corners do not determine the geometry to the limits of `settings`; the message says why and what to add.
    """
    settings = settings or GeometrySettings()
    named = [boards[name] for name in dict.fromkeys(seen.target.board for seen in observations)]
    if not named:
        raise TooFewViews("no board was found in any image; check [[board]] against the print, and the exposure")
    gathered = gather(observations, {board.name: board.corner_shape for board in named}, reference)
    if len(gathered.nodes) < _FEWEST_NODES:
        raise TooFewViews(
            f"{len(gathered.nodes)} node(s) show the boards that the reference node {reference} shows, limit "
            f"{_FEWEST_NODES}; take more nodes, better 9 and more, and leave the boards where they are meanwhile"
        )
    one_shape = len({board.corner_shape for board in named}) == 1
    problem = Problem(gathered, size_px, _square_mm(named), settings.lens_model, with_warp=one_shape)
    bundle = _solved(problem)
    doubts = doubtful_views(bundle, gathered)
    known = uncertainty(bundle, gathered)
    geometry = replace(_geometry(problem, bundle, known), doubts=doubts)
    if not lacks(geometry, gathered, max(settings.depths_mm)):  # a set that lacks something may end anywhere
        _require_residuals(bundle, gathered)
    require_determined(geometry, gathered, settings.depths_mm, settings.most_transfer_sigma_px)
    geometry = replace(geometry, holdout_ratio=holdout_ratio(bundle, gathered))
    _require_fit(geometry, settings)
    return geometry


def _square_mm(boards: Sequence[Board]) -> float:
    sizes = sorted({board.square_mm for board in boards})
    if len(sizes) > 1:
        raise ValueError(f"boards have squares of {sizes} mm; all boards of one calibration must have the same")
    return sizes[0]


def _solved(problem: Problem) -> Bundle:
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
    """Refuse residuals that no board leaves, and name the worst view."""
    square = np.square(bundle.residuals()).sum(axis=(1, 2, 3)) / (2 * np.maximum(bundle.inlier.sum(axis=(1, 2)), 1))
    rms_px = float(np.sqrt(np.square(bundle.residuals()[bundle.inlier]).mean()))
    if not rms_px <= _MOST_RESIDUAL_PX:
        worst = observations.view_name(int(np.argmax(square)))
        raise PoorFit(
            f"the corners fit to {rms_px:.3g} px only, limit {_MOST_RESIDUAL_PX:g} px, worst at {worst}; {_REMEDY}"
        )


def _geometry(problem: Problem, bundle: Bundle, known: Uncertainty) -> RigGeometry:
    """Put the solution in raster order of the nodes."""
    observations = problem.observations
    order = sorted(range(len(observations.nodes)), key=lambda index: observations.nodes[index])
    fx_px, fy_px, cx_px, cy_px, *distortion = bundle.intrinsics.tolist()
    squares, inliers = float(np.sum(bundle.residuals() ** 2)), int(bundle.inlier.sum())
    poses = zip(observations.targets, bundle.rt_ref_board, strict=True)
    return RigGeometry(
        lens=Lens(problem.size_px, fx_px, fy_px, cx_px, cy_px, tuple(distortion)),
        lens_model=problem.lens_model,
        nodes=[observations.nodes[index] for index in order],
        reference=order.index(0),
        rt_cam_ref=bundle.rt_cam_ref[order],
        covariance=_lens_and_poses(bundle, known.covariance, order),
        boards=[BoardPose(target, rt_ref_board) for target, rt_ref_board in poses],
        warp_mm=bundle.warp_mm,
        sigma_px=known.sigma_px,
        rms_inlier_px=float(np.sqrt(squares / (2 * inliers))),
        rms_mrcal_px=float(np.sqrt(squares / bundle.inlier.size)),
        corners=inliers,
        outliers=observations.corner_count - inliers,
        holdout_ratio=None,
        repeatability=known.repeatability,
    )


def _lens_and_poses(bundle: Bundle, covariance: NDArray[np.float64], order: list[int]) -> NDArray[np.float64]:
    """Return the covariance of the intrinsics and of all nodes in their order, zero for the reference."""
    slices = bundle.state_slices()
    lens = np.arange(slices["intrinsics"].start, slices["intrinsics"].stop)
    picks = [lens]
    for index in order:
        first = slices["cameras"].start + 6 * (index - 1)
        picks.append(np.full(6, -1) if index == 0 else np.arange(first, first + 6))
    chosen = np.concatenate(picks)
    known = chosen >= 0
    result = np.zeros((len(chosen), len(chosen)))
    result[np.ix_(known, known)] = covariance[np.ix_(chosen[known], chosen[known])]
    return result


def _require_fit(geometry: RigGeometry, settings: GeometrySettings) -> None:
    """Refuse a fit that does not explain boards that it has not seen."""
    ratio, limit = geometry.holdout_ratio, settings.most_holdout_ratio
    if ratio is None or ratio <= limit:
        return
    added_px = geometry.rms_inlier_px * np.sqrt(ratio**2 - 1)
    if added_px > settings.negligible_holdout_px:
        other = "" if geometry.lens_model == "opencv8" else "try --lens opencv8, "
        raise PoorFit(
            f"boards left out of the fit are off by {ratio:.2f} times its residual of {geometry.rms_inlier_px:.3g} px, "
            f"limit {limit}; check square_mm and the flatness of the boards, {other}or show more boards"
        )
