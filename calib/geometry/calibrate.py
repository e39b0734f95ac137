"""Geometry of the rig from corners: solve, state the uncertainty, and refuse what the corners cannot carry."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from calib.board import Board
from calib.errors import PoorFit, TooFewViews
from calib.geometry.bundle import LENS_MODELS, Bundle, Problem, solve
from calib.geometry.covariance import Uncertainty, uncertainty
from calib.geometry.gates import require_determined
from calib.geometry.holdout import holdout_ratio
from calib.geometry.observations import BoardObservation, Node, gather
from calib.geometry.rig_geometry import BoardPose, RigGeometry
from calib.lens import Lens

# Every corner thrown away is one the model did not explain.
_MOST_OUTLIERS = 0.1


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
        Largest residual of boards left out, relative to the fit's.

    Raises
    ------
    ValueError
        An unknown lens model, no depth, or a depth or limit that is not positive.
    """

    lens_model: str = "opencv5"
    depths_mm: tuple[float, ...] = (500.0, 700.0)
    most_transfer_sigma_px: float = 0.5
    most_holdout_ratio: float = 1.3

    def __post_init__(self) -> None:
        if self.lens_model not in LENS_MODELS:
            raise ValueError(f"lens model '{self.lens_model}' is not known; take one of {', '.join(LENS_MODELS)}")
        numbers = (*self.depths_mm, self.most_transfer_sigma_px, self.most_holdout_ratio)
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
    one_shape = len({board.corner_shape for board in named}) == 1
    problem = Problem(gathered, size_px, _square_mm(named), settings.lens_model, with_warp=one_shape)
    bundle = _solved(problem)
    known = uncertainty(bundle, gathered)
    geometry = _geometry(problem, bundle, known, holdout=None)
    require_determined(geometry, gathered, settings.depths_mm, settings.most_transfer_sigma_px)
    geometry = _geometry(problem, bundle, known, holdout_ratio(bundle, gathered))
    _require_fit(geometry, settings.most_holdout_ratio)
    return geometry


def _square_mm(boards: Sequence[Board]) -> float:
    sizes = sorted({board.square_mm for board in boards})
    if len(sizes) > 1:
        raise ValueError(f"boards have squares of {sizes} mm; all boards of one calibration must have the same")
    return sizes[0]


def _solved(problem: Problem) -> Bundle:
    try:
        return solve(problem)
    except RuntimeError as failure:
        raise PoorFit(
            f"the bundle adjustment does not converge ({failure}); check rows, columns and node of every image"
        ) from failure


def _geometry(problem: Problem, bundle: Bundle, known: Uncertainty, holdout: float | None) -> RigGeometry:
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
        holdout_ratio=holdout,
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


def _require_fit(geometry: RigGeometry, most_holdout_ratio: float) -> None:
    """Refuse a fit that throws many corners away or does not explain boards that it has not seen."""
    share = geometry.outliers / (geometry.outliers + geometry.corners)
    if share > _MOST_OUTLIERS:
        raise PoorFit(
            f"{share:.0%} of the corners disagree with the fit, limit {_MOST_OUTLIERS:.0%}; "
            "check that every image has its right node and sweep, and that no board moved within a sweep"
        )
    ratio = geometry.holdout_ratio
    if ratio is not None and ratio > most_holdout_ratio:
        raise PoorFit(
            f"boards left out of the fit are off by {ratio:.2f} times its residual, limit {most_holdout_ratio}; "
            "check square_mm and the flatness of the boards, try --lens opencv8, or show more boards"
        )
